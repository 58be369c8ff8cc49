"""Regression guard: stored estimates, errors, trainings, dynamics, arrays and public names.

``python tests/guard/guard.py`` measures all parts and compares them with the files in this folder; ``make test``
compares the parts that take seconds. If a change is meant to move digits, renew the part in a separate commit
whose message gives the reason: ``python tests/guard/guard.py --renew estimates``.
"""

import argparse
import csv
import dataclasses
import hashlib
import json
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np

import kkl_gym
import observers

FOLDER = Path(__file__).parent
SYSTEMS = tuple(sorted(kkl_gym.SYSTEMS))
VARIANTS = ("", "-large", "-spinn")
NOISE = 0.5
DT = 0.01
EVERY = 40  # number of samples between two stored estimates
# Largest differences in widths of X. Estimates come from float32 networks, whose rounding differs between processors.
# Dynamics are in float64; the runs are too short for chaos to amplify rounding.
CLOSE = {"estimates": 1e-5, "dynamics": 1e-9}
SAME_ERROR = 0.02  # relative tolerance of median errors: chaos amplifies the rounding of other processors
SHORT_TRAINING, LUCKY = 1.15, 3.0  # largest factors by which a short training's error may rise and fall


def records(system):
    """Yield outputs and inputs of four kinds of runs from X: clean, noisy, driven, and with missing samples."""
    from kkl_gym.simulate import simulate

    rng = np.random.default_rng(20_000)
    steps, n = 400, 3
    u = {"driven": np.repeat(rng.uniform(-1, 1, (steps // 50, n, system.nu)), 50, 0) * np.array(system.u_max)}
    for kind in ("clean", "noisy", "driven", "missing"):
        x = simulate(system, rng.uniform(*system.box(), (n, system.nx)), steps, DT, u=u.get(kind))
        y = system.output(x) + (kind != "clean") * NOISE * rng.standard_normal((steps + 1, n, system.ny))
        if kind == "missing":
            y[rng.uniform(size=steps + 1) < 0.3] = np.nan
            y[200:230] = np.nan
            y[0] = system.output(x[0])
        yield kind, y.astype(np.float32), u.get(kind, np.zeros((steps, n, system.nu))).astype(np.float32)


def follow(observer, y, u):
    """Estimates and covariances of an observer along records, at every EVERY-th sample."""
    kept = []
    for k in range(len(y)):
        if k == 0:
            x_hat = observer.reset(y[0].astype(float))
        else:
            x_hat = observer.step(y[k].astype(float), u[k - 1].astype(float) if observer.artifact.nu else None)
        if k % EVERY == 0:
            try:
                kept.append(np.concatenate([x_hat, observer.covariance.reshape(len(x_hat), -1)], 1))
            except observers.ArtifactError:  # a map without error bars
                kept.append(x_hat)
    return np.array(kept)


def estimates():
    """Estimates and covariances of every map that ships, on the records in records.npz."""
    path = FOLDER / "records.npz"
    held = dict(np.load(path)) if path.exists() else {}
    if new := [name for name in SYSTEMS if f"{name}/clean/y" not in held]:
        for name in new:
            for kind, y, u in records(kkl_gym.get_system(name)):
                held[f"{name}/{kind}/y"], held[f"{name}/{kind}/u"] = y, u
        np.savez_compressed(path, **held)
    found = {}
    for name in SYSTEMS:
        low, high = kkl_gym.get_system(name).box()
        for variant in VARIANTS:
            for kind in ("clean", "noisy", "driven", "missing"):
                alone = False if variant == "-large" else None  # T_inv alone, no tracking
                observer = observers.load(name + variant, 0.0 if kind == "clean" else NOISE, tracking=alone)
                kept = follow(observer, held[f"{name}/{kind}/y"], held[f"{name}/{kind}/u"])
                widths = high - low
                unit = np.concatenate([widths, np.outer(widths, widths).ravel()])[: kept.shape[-1]]
                found[f"{name}{variant}/{kind}"] = kept / unit
    return found


def dynamics():
    """Outputs, states and rewards of every environment, single and vector, for some seeds and actions."""
    from kkl_gym.elementary import sin

    class Pendulum(kkl_gym.System):
        name, X, bounds = "pendulum", ((-3, 3), (-2, 2)), ((-200, 200), (-20, 20))
        u_max, G = (1.0,), ((0.0,), (1.0,))

        def f(self, x):
            return x[1], -sin(x[0]) - 0.1 * x[1]

        def h(self, x):
            return (x[0],)

    ids = {gym_id: {} for gym_id in kkl_gym.ENV_IDS.values()} | {kkl_gym.OWN_ID: {"system": Pendulum()}}
    found = {}
    for gym_id, arguments in ids.items():
        env = gym.make(gym_id, process_noise=0.05, **arguments)
        actions = np.random.default_rng(1).uniform(env.action_space.low, env.action_space.high, (60, 1))
        rows = []
        for seed in (3, 4):
            y, info = env.reset(seed=seed)
            rows.append([*y, *info["y"], *info["x"], 0.0])
            for action in actions:
                y, reward, *_, info = env.step(action.astype(np.float32))
                rows.append([*y, *info["y"], *info["x"], reward])
        found[f"{gym_id}/single"] = np.array(rows)
        envs = gym.make_vec(gym_id, 3, vectorization_mode="vector_entry_point", process_noise=0.05, **arguments)
        y, info = envs.reset(seed=5)
        rows = [np.concatenate([y, info["y"], info["x"], np.zeros((3, 1))], 1)]
        for action in actions:
            y, reward, *_, info = envs.step(np.broadcast_to(action, (3, 1)).astype(np.float32))
            rows.append(np.concatenate([y, info["y"], info["x"], reward[:, None]], 1))
        found[f"{gym_id}/vector"] = np.array(rows)
    return {key: value / np.abs(value).max() for key, value in found.items()}


def arrays():
    """A digest of the arrays in every shipped file, independent of the arrays' names."""
    from safetensors.numpy import load_file

    folders = (
        Path(observers.__file__).parent / "maps",
        Path(observers.__file__).parents[1] / "training/agents/shipped",
    )
    found = {}
    for path in sorted(path for folder in folders for path in folder.glob("*.safetensors")):
        parts = sorted(hashlib.sha256(array.tobytes()).hexdigest() for array in load_file(path).values())
        found[f"{path.parent.name}/{path.stem}"] = hashlib.sha256("".join(parts).encode()).hexdigest()
    return found


def names():
    """The public names of the packages, the environments, the maps and the commands."""
    import training
    import training.agents
    from training.cli import COMMANDS

    public = {module.__name__: sorted(module.__all__) for module in (kkl_gym, observers, training, training.agents)}
    maps = sorted(name + variant for name in SYSTEMS for variant in VARIANTS)
    for name in maps:
        observers.load(name)
    return public | {"environments": sorted([*kkl_gym.ENV_IDS.values(), kkl_gym.OWN_ID]), "maps": maps,
                     "commands": sorted(COMMANDS)}  # fmt: skip


def errors():
    """Median held-out errors in % over 20 s of every shipped map: starts in X and 2X, inputs, process noise."""
    from training import errors, unseen_trajectories

    cases = {
        "X": ({}, (0.0, 0.1, NOISE, 1.0)),
        "2X": ({"domain": "2X"}, (0.0, NOISE)),
        "driven": ({"driven": True}, (NOISE,)),
        "process noise": ({"process_noise": 0.05}, (NOISE,)),
    }
    found = {}
    for name in SYSTEMS:
        system = kkl_gym.get_system(name)
        for case, (motions, levels) in cases.items():
            unseen = unseen_trajectories(system, DT, n=40, duration=20.0, seed=11, **motions)
            for variant in VARIANTS:
                artifact = observers.load(name + variant).artifact
                if variant == "-large":  # no tracking
                    artifact = dataclasses.replace(artifact, motion=None)
                if case == "driven" and not artifact.nu:
                    continue
                for level in levels:
                    of = errors(artifact, system, unseen, measurement_noise=level, seed=11)
                    found[f"{name}{variant}/{case}/{level:g}"] = float(np.median(of.full))
                print(name + variant, case, flush=True)
    return found


def trainings():
    """Held-out errors of short trainings: from equations by both pipelines, from records, from rollouts."""
    import training
    from training.cli import main

    found = {}
    sizes = {"trajectories": 100, "duration": 10.0, "width": 20, "depth": 2, "batch": 256, "inverse_steps": 1000}
    system = kkl_gym.get_system("van_der_pol")
    unseen = training.unseen_trajectories(system, DT, n=40, duration=10.0, seed=11)
    for pipeline in ("input-aware", "spinn"):
        config = dataclasses.replace(training.preset(system, pipeline, "fast"), **sizes)
        if pipeline == "spinn":
            config = dataclasses.replace(config, forward_steps=1000)
        with tempfile.TemporaryDirectory() as folder:
            artifact = training.train(system, config, Path(folder) / "run").artifact
        for level in (0.0, NOISE):
            of = training.errors(artifact, system, unseen, measurement_noise=level, seed=11)
            found[f"equations/{pipeline}/{level:g}"] = float(np.median(of.full))

    with tempfile.TemporaryDirectory() as folder:
        paths = [str(oscillator(Path(folder) / f"run{seed}.csv", seed)) for seed in range(6)]
        out = Path(folder) / "run"
        main(["train", "spring", "--data", *paths, "--measured", "position", "--inputs", "force", "--hidden", "speed",
              "--set", "inverse_steps=1000", "--out", str(out)])  # fmt: skip
        observer = observers.load(out / "spring.safetensors")
        table = np.loadtxt(oscillator(Path(folder) / "new.csv", 100), delimiter=",", skiprows=1)
    x_hat = observer.estimate(table[:, 1:2], table[:-1, 2:3])
    found["records"] = relative(x_hat[100:, 0], table[100:, 3])

    artifact = training.learn("Pendulum-v1", measured=[0, 1], hidden=[2], steps=4000, seed=1, inverse_steps=1000)
    (found["rollouts"],) = artifact.training["held_out_errors"].values()
    return found


def oscillator(path, seed):
    """Write a record of p'' = -p + u, where u is constant for a second at a time: time, position, force, speed."""
    rng = np.random.default_rng(seed)
    dt, steps = 0.05, 600
    c, s = np.cos(dt), np.sin(dt)
    u = np.repeat(rng.uniform(-1, 1, steps // 20), 20)
    p, v = rng.uniform(-1, 1, 2)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", "position", "force", "speed"])
        for k in range(steps):
            rows.writerow([k * dt, p, u[k], v])
            p, v = u[k] + c * (p - u[k]) + s * v, -s * (p - u[k]) + c * v
    return path


def relative(estimate, truth):
    """Root mean square error, divided by the standard deviation of the truth."""
    return float(np.sqrt(np.mean((estimate - truth) ** 2)) / np.std(truth))


QUICK = {"estimates": estimates, "dynamics": dynamics, "arrays": arrays, "names": names}
SLOW = {"errors": errors, "trainings": trainings}


def differences(part):
    """Measure a part; return a line for each difference from the stored values."""
    found = (QUICK | SLOW)[part]()
    if part in CLOSE:
        kept = dict(np.load(FOLDER / f"{part}.npz"))
        lines = [f"{part}: {key} is either not stored or not measured" for key in sorted(kept.keys() ^ found.keys())]
        for key in kept.keys() & found.keys():
            if kept[key].shape != found[key].shape:
                lines.append(f"{part}: {key} has the shape {found[key].shape}, not {kept[key].shape}")
            elif not np.allclose(found[key], kept[key], rtol=0, atol=CLOSE[part], equal_nan=True):
                lines.append(f"{part}: {key} is off by {np.nanmax(np.abs(found[key] - kept[key])):.2g}")
        return lines
    kept = json.loads((FOLDER / f"{part}.json").read_text())
    lines = [f"{part}: {key} is either not stored or not measured" for key in sorted(kept.keys() ^ found.keys())]
    for key in kept.keys() & found.keys():
        a, b = kept[key], found[key]
        if part == "names" and a != b:
            lines.append(f"{part}: {key} lacks {sorted({*a} - {*b})}, and has {sorted({*b} - {*a})}, which is new")
        if part == "arrays" and a != b:
            lines.append(f"{part}: {key} holds other arrays")
        if part == "errors" and not abs(b / a - 1) <= SAME_ERROR:
            lines.append(f"{part}: {key} is {b:.4g} %, not {a:.4g} %")
        if part == "trainings" and not a / LUCKY < b <= SHORT_TRAINING * a:
            lines.append(f"{part}: {key} errs by {b:.4g}, not {a:.4g}")
    return lines


def renew(part):
    """Measure a part and store its values."""
    found = (QUICK | SLOW)[part]()
    if part in CLOSE:
        np.savez_compressed(FOLDER / f"{part}.npz", **found)
    else:
        (FOLDER / f"{part}.json").write_text(json.dumps(found, indent=1) + "\n")


def run():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(QUICK | SLOW)}; all by default")
    parser.add_argument("--renew", action="store_true", help="store the measured values")
    arguments = parser.parse_args()
    if unknown := {*arguments.parts} - {*(QUICK | SLOW)}:
        parser.error(f"unknown parts: {', '.join(sorted(unknown))}; there are {', '.join(QUICK | SLOW)}")
    lines = []
    for part in arguments.parts or QUICK | SLOW:
        began = time.process_time()
        lines += renew(part) or [] if arguments.renew else differences(part)
        print(f"{part}: {time.process_time() - began:.0f} s of CPU time", flush=True)
    sys.exit("\n".join(lines) or None)


if __name__ == "__main__":
    run()
