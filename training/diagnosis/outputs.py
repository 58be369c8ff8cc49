"""Which states a system's outputs determine locally (from the equations) and globally (from simulated motions)."""

from collections.abc import Iterator

import numpy as np

from kkl_gym.simulate import simulate
from training.diagnosis.finding import RESOLUTION, Finding, Verdict, error
from training.diagnosis.records import AS_GOOD, DETERMINED, left_by
from training.diagnosis.system import POINTS, Subject, of_X
from training.evaluation.levels import show_level
from training.kalman import ExtendedKalmanFilter
from training.presets import eigenvalues
from training.sources.simulated import unknown_start
from training.trajectories.motions import how_to_stay

FOLLOWED, MAX_STEPS = 20, 2000  # largest numbers of motions, and of steps of each
MIN_STEPS = 10  # least number of samples of a motion
# "problem" or "note" if more than this share of the initial standard deviation along a direction of x remains.
UNSEEN, HARDLY = 0.9, 0.3
INVOLVED = 0.3  # a finding names a state if its component of the direction, a unit vector, is larger
VAGUE, NOTHING = 0.3, 1.0  # errors in standard deviations of the state, without and with noise, that get a "note"
# Under a symmetry, least errors (in standard deviations) are <= LOCALLY, but predictions from y err by >= GLOBALLY.
LOCALLY, GLOBALLY = 0.1, 0.3
WINDOWS, MAX_SAMPLES = 7, 100  # number of windows, each half as long as the one before; upper bound of samples in each


def observability(subject: Subject) -> Iterator[Finding]:
    """Yield the least error of each state at each noise level, and the states that y does not determine."""
    names = subject.system.state_names
    errors, left = least_errors(subject)
    # The second half of the steps also stands for the steps beyond MAX_STEPS.
    weights = np.ones(errors.shape[1])
    late = weights[len(weights) // 2 :]
    late += max(0, round(subject.duration / subject.dt) + 1 - len(weights)) / len(late)
    least = np.average(errors, axis=1, weights=weights)
    # Symmetries show in motions under the same inputs, but under a policy the inputs depend on the start.
    findings = _unseen(names, left) | ({} if subject.policy else _symmetries(subject, least[0]))
    yield from findings.values()
    for i, name in enumerate(names):
        if any(i in states for states in findings) or np.isnan(least[0, i]):
            continue
        exact = errors[0, :, i]
        first = int((exact <= max(DETERMINED, AS_GOOD * exact.min())).argmax())
        shares = [f"{error(least[0, i])} without noise ({error(exact[first])} after {first * subject.dt:.3g} s)"]
        shares += [f"{error(one[i])} at noise {show_level(level)}" for level, one in zip(subject.noise, least[1:])]
        text = f"{name}: least error, relative to its standard deviation: {'; '.join(shares)}"
        blind = [show_level(level) for level, one in zip(subject.noise, least[1:, i]) if one >= NOTHING]
        if blind or least[0, i] > VAGUE:
            text += f"; at noise {blind[0]}, y shows nothing of it" if blind else ""
            advice = f"{'reduce the noise, or ' if blind else ''}let h measure another quantity that depends on {name}"
            yield Finding("observability", "note", text, advice)
        else:
            yield Finding("observability", "ok", text)


def least_errors(subject: Subject) -> tuple[np.ndarray, np.ndarray]:
    """Return posterior Cramér-Rao bounds along motions without process noise, and the covariance at their end.

    The bounds (levels, steps, nx) are in standard deviations of the states along motions; the first level is without
    noise. The covariance (nx, nx), without noise, is normalised by the starts' standard deviations.
    """
    system, levels = subject.system, (0.0, *subject.noise)
    x, u = subject.followed[0][: MAX_STEPS + 1, :FOLLOWED], subject.followed[1][:MAX_STEPS, :FOLLOWED]
    (length, n, nx), start = x.shape, unknown_start(system)[1]
    if 2 * n < FOLLOWED:
        raise ValueError(f"only {n} motions from X stayed within the bounds; {how_to_stay(system, subject.policy)}")
    if length < MIN_STEPS:
        few = f"motions of {subject.duration:g} s have only {length - 1} steps of {subject.dt:g} s"
        raise ValueError(f"{few}; take a longer duration, or a smaller dt")
    floor = [RESOLUTION * (size or 1.0) for size in system.output_range]  # no network reads y more accurately
    R = np.repeat([np.diag(np.maximum(level, floor) ** 2) for level in levels], n, axis=0)
    bound = ExtendedKalmanFilter(system, subject.dt, Q=np.zeros_like(start), R=R)
    _, P = bound.along(*(np.tile(each, (1, len(levels), 1)) for each in (system.output(x), u, x)))
    square = P.diagonal(axis1=2, axis2=3).reshape(length, len(levels), n, nx).mean(2).swapaxes(0, 1)
    deviation = np.sqrt(start.diagonal())
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(square) / x.std((0, 1)), P[-1, :n].mean(0) / np.multiply.outer(deviation, deviation)


def _unseen(names: tuple[str, ...], left: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """Return findings on directions of x that y determines hardly or not at all, by indices of the states involved."""
    findings = dict[tuple[int, ...], Finding]()
    values, directions = np.linalg.eigh(left)
    for share, direction in zip(np.sqrt(np.maximum(values, 0.0)), directions.T, strict=True):
        if share > HARDLY:
            involved = np.flatnonzero(np.abs(direction) > INVOLVED)
            states = [names[i] for i in involved]
            of = states[0] if len(states) == 1 else f"a combination of {' and '.join(states)}"
            advice = f"let h measure {' or '.join(states)} too, or leave {' or '.join(states)} out"
            verdict: Verdict = "problem" if share > UNSEEN else "note"
            text = f"y {'does not determine' if share > UNSEEN else 'hardly determines'} {of}"
            findings[tuple(involved.tolist())] = Finding("observability", verdict, text, advice)
    return findings


def spectrum(subject: Subject) -> Iterator[Finding]:
    """Yield the eigenvalues of A that a training uses."""
    taken = eigenvalues(subject.system, subject.dt)
    text = f"{len(taken)} eigenvalues of A for each output, {taken[0]:.3g} to {taken[-1]:.3g} 1/s"
    yield Finding("spectrum", "ok", text)


def _symmetries(subject: Subject, exact: np.ndarray) -> dict[tuple[int, ...], Finding]:
    """Return a finding on states that y determines only locally, as motions under the same inputs show."""
    system, u = subject.system, subject.followed[1][:MAX_STEPS, :1]
    x = simulate(system, of_X(system, POINTS), len(u), subject.dt, u=np.repeat(u, POINTS, 1), step=subject.step)
    x = x[:, np.isfinite(np.dstack([x, system.output(x)])).all((0, 2))]
    if x.shape[1] < POINTS // 2:
        return {}
    y, errors = system.output(x), np.full(system.nx, np.nan)
    y = (y - y.mean(1, keepdims=True)) / system.output_range
    for window in (len(u) // 2**k for k in range(WINDOWS)):
        U, size, _ = np.linalg.svd(np.hstack(list(y[: window + 1 : window // MAX_SAMPLES + 1])), full_matrices=False)
        z, end = np.sqrt(len(U)) * U[:, size > RESOLUTION * size[0]], x[window]
        errors = np.fmin(errors, left_by(z[::2], end[::2], z[1::2], end[1::2]))
    confused = np.flatnonzero((exact <= LOCALLY) & (errors >= GLOBALLY)).tolist()
    names = ", ".join(system.state_names[i] for i in confused)
    text = f"y determines {names} only locally: distant states have nearly the same y, as under a symmetry"
    advice = "let h measure what the symmetry changes, or estimate only what it leaves unchanged"
    return {tuple(confused): Finding("observability", "problem", text, advice)} if confused else {}
