"""How large things are: outputs and their noise, and process noise."""

from collections.abc import Iterator

import numpy as np

from kkl_gym.system import NOISE_SHARE, PROCESS_NOISE
from training.diagnosis.finding import Finding, Verdict, number, percent
from training.diagnosis.subject import Subject

LOUD = 0.25  # measurement noise in an output's range
STILL = 1e-9  # range of an output in its size
AT_REST = 1e-3  # range of an output late in motions, in its range over X
WALK, LONG_WALK = 0.3, 1.0  # standard deviation, in X's half-widths, to which process noise leads over a motion


def outputs(subject: Subject) -> Iterator[Finding]:
    """How far each output ranges, and how noisy it is."""
    system = subject.system
    in_X, along = system.output(subject.points["X"]), subject.staying_outputs
    noise = np.broadcast_to(np.asarray(system.measurement_noise, dtype=float), (system.ny,))
    for i, level in enumerate(noise):
        name, size = f"y{i + 1}", float(np.ptp(in_X[:, i]))
        if size <= STILL * np.abs(in_X[:, i]).max():
            found = f"{name} is {in_X[0, i]:.4g} everywhere in X"
            yield Finding("output", "problem", found, "let h measure something that moves, or leave this output out")
            continue
        verdict: Verdict = "ok"
        found, advice = f"{name} ranges over {number(size)} in X", ""
        if along.size:
            found += f", {number(np.ptp(along[..., i]))} along motions"
            late = np.ptp(along[len(along) // 2 :, :, i], axis=0).max()
            if not system.nu and late < AT_REST * size:
                found += ", and hardly any more in their second half"
                verdict, advice = "note", "motions come to rest: a shorter duration shows more of how they do"
        found += f"; noise {number(level)} by default, {percent(level / size)} of that in X"
        if level > LOUD * size:
            verdict, advice = "note", f"set measurement_noise: {NOISE_SHARE * size:.2g} is 5 % of the range"
        yield Finding("output", verdict, found, advice)


def process_noise(subject: Subject) -> Iterator[Finding]:
    """How far the default process noise drives the state, against the drift and against X."""
    system = subject.system
    level = system.process_noise * np.array(system.scale)
    if not level.any():
        yield Finding("process noise", "ok", "none by default")
        return
    with np.errstate(all="ignore"):
        drift = np.sqrt(np.nanmean(system.drift(subject.points["X"]) ** 2, axis=0))
    parts = [
        f"{name} up to {number(size)} per second" + (f" ({percent(size / speed)} of f)" if speed > 0 else "")
        for name, size, speed in zip(system.state_names, level, drift, strict=True)
    ]
    # Uniform in +-level and held for dt, so that its integral has the variance level^2 / 3 dt t.
    walk = float((level * np.sqrt(subject.dt * subject.duration / 3) / subject.half).max())
    found = f"{', '.join(parts)} by default; over {subject.duration:g} s it leads {number(walk)} half-widths of X away"
    if walk > WALK:
        fitting = f"{PROCESS_NOISE / system.pace:.1g}"
        advice = f"set process_noise = {fitting}, which is to this system what the default is to those that ship"
        yield Finding("process noise", "problem" if walk > LONG_WALK else "note", found, advice)
    else:
        yield Finding("process noise", "ok", found)
