"""Commands killed at random moments: no file is damaged, and at most one checkpoint interval of work is repeated.

The environment variable KILLS sets the number of kills, 100 by default. One in five is an interruption, Ctrl-C.
"""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from observers import Artifact
from observers.storage import UNFINISHED
from training.agents.agent import Agent
from training.agents.play import play
from training.run import CHECKPOINT, LOG_EVERY, load_checkpoint

pytestmark = pytest.mark.long

KILLS = int(os.environ.get("KILLS", "100"))
INTERRUPTIONS = 0.2  # share of the kills
ROOT = Path(__file__).parents[2]

# The command line with a checkpoint as often as possible, and a byte in a journal for each batch of a training of
# maps, or for each step of the environments on which an agent learns.
COMMAND = """
import os, sys
import training.cli

journal, *arguments = sys.argv[1:]
journal = os.open(journal, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
import_module = training.cli.import_module

def import_and_watch(name):
    module = import_module(name)
    import training.run
    training.run.CHECKPOINT_SECONDS = -1.0
    if arguments[0] == "train":
        from torch.optim.optimizer import register_optimizer_step_post_hook
        register_optimizer_step_post_hook(lambda *_: os.write(journal, b"."))
    else:
        from training.agents.cost import Cost

        def step(self, *arguments, step=Cost.step, **options):
            result = step(self, *arguments, **options)
            os.write(journal, b".")
            return result

        Cost.step = step
    return module

training.cli.import_module = import_and_watch
training.cli.main(arguments)
"""


class Train:
    """A command, the work that its checkpoints keep, and the results that kills must not change."""

    interval = LOG_EVERY  # batches between two checkpoints

    def arguments(self, out):
        sizes = "--set trajectories=20 duration=5 samples=30 width=16 depth=1 batch=128 inverse_steps=1500"
        return ["train", "van_der_pol", *sizes.split(), "--resume", "--out", str(out)]

    def kept(self, out):
        """Return the units of work that a checkpoint keeps; raise ValueError if a file is damaged."""
        for path in out.glob("van_der_pol.safetensors"):
            Artifact.read(path)
        for path in out.glob("config.json"):
            json.loads(path.read_text())
        return sum(load_checkpoint(path)["step"] for path in out.glob(f"[!.]*{CHECKPOINT}"))

    def result(self, out):
        artifact = Artifact.read(out / "van_der_pol.safetensors")
        spent = ("seconds", "cpu_seconds_spent", "resumed")
        history = {key: value for key, value in artifact.training.items() if key not in spent}
        maps = (artifact.inverse, artifact.free_inverse)
        weights = [array.tobytes() for found in maps for array in (*found.mlp.weights, *found.mlp.biases, found.whiten)]
        return history, weights, (out / "report.png").stat().st_size > 10_000


class TrainAgent:
    """The training of an agent, compared by its metadata: a resumed agent differs from an uninterrupted one."""

    interval = 32  # steps of the environments between two checkpoints

    def arguments(self, out):
        timesteps = str(4 * 256 * self.interval)
        options = ["--information", "y", "--timesteps", timesteps, "--resume", "--out", str(out)]
        return ["agent", "train", "lorenz", *options]

    def kept(self, out):
        for path in out.glob("agent.safetensors"):
            Agent.read(path)
        saved = (load_checkpoint(path) for path in out.glob(f"agent{CHECKPOINT}"))
        return sum(state["counters"]["num_timesteps"] // 256 for state in saved)

    def result(self, out):
        agent = Agent.read(out / "agent.safetensors")
        env = agent.make(2)
        assert np.isfinite(play(env, agent.policy(env.single_action_space), seed=0).x).all()
        assert pd.read_csv(out / "curve.csv").steps.is_monotonic_increasing
        return {key: value for key, value in agent.training.items() if key != "resumed"}


def run(scenario, out, journal, signal_number=None, after=None):
    """Start the command and kill it; return whether it was killed, the work that it did, and its messages."""
    with subprocess.Popen(
        [sys.executable, "-c", COMMAND, str(journal), *scenario.arguments(out)],
        cwd=out.parent,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        while signal_number == signal.SIGINT and process.poll() is None and not journal.exists():
            time.sleep(0.01)  # an interruption while Python starts prints Python's own traceback
        try:
            _, messages = process.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            process.send_signal(signal_number)
            _, messages = process.communicate(timeout=120.0)
    killed = process.returncode != 0
    assert not killed or (signal_number and process.returncode in (-signal_number, 128 + signal_number)), messages
    if signal_number == signal.SIGINT and not messages:  # the work was done, and Python was shutting down
        killed = False
    return killed, journal.stat().st_size if journal.exists() else 0, messages


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("scenario", [Train(), TrainAgent()], ids=["train", "agent train"])
def test_kills(scenario, tmp_path):
    """Kill and resume in one folder until the command is done, then start again in another."""
    rng, counts, journals = random.Random(0), Counter(), (tmp_path / f"journal-{i}" for i in count())
    began = time.monotonic()
    run(scenario, tmp_path / "whole", next(journals))
    seconds, expected, out = time.monotonic() - began, scenario.result(tmp_path / "whole"), None
    while counts["kills"] < KILLS // 2 or out:
        if out is None:
            out, kept = tmp_path / f"run-{counts['done']}", 0
        last, began = counts["kills"] >= KILLS // 2, time.monotonic()
        number = signal.SIGINT if rng.random() < INTERRUPTIONS else signal.SIGKILL
        halves = set(out.rglob(f"{UNFINISHED}*"))
        after = None if last else rng.uniform(0.0, seconds)
        killed, work, messages = run(scenario, out, next(journals), number, after)
        if not killed:
            assert scenario.result(out) == expected
            if not kept:  # the duration of a run on this machine, for kills at any moment of a run
                seconds = time.monotonic() - began
            counts["done"], out = counts["done"] + 1, None
            continue
        counts["kills"] += 1
        if number == signal.SIGINT:
            counts["interruptions"] += 1
            assert re.fullmatch("kkl-gym: interrupted.*\n", messages)
            assert not set(out.rglob(f"{UNFINISHED}*")) - halves  # the command leaves no temporary file
        now = scenario.kept(out)
        assert kept + work - now <= scenario.interval
        kept = now
    print(f"\n{scenario.arguments('')[0]}: {dict(counts)}")
