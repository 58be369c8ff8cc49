"""What outputs and inputs determine of hidden signals, in numbers and in words."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from training.diagnosis.finding import Finding, Verdict, error
from training.evaluation.levels import Level, show_level

DETERMINED, UNDETERMINED = 0.05, 0.8  # of a signal's standard deviation: largest and least errors of these verdicts
AS_GOOD = 1.1  # times the least error, up to which a window is as good as any
SEEN = 0.1  # largest error of a signal's change, in the signal's own error, for it to be known up to a constant

# By the first word of what is said of a signal.
VERDICTS: dict[str, tuple[Verdict, str]] = {
    "determined": ("ok", ""),
    "up": ("note", "an observer follows it from a known start; measure a signal that depends on its value, too"),
    "partly": ("note", "measure one more signal that depends on it, or live with what is left"),
    "not": ("problem", "measure a signal that depends on it, or leave it out"),
    "never": ("note", "leave it out"),
}


@dataclass(frozen=True)
class Judgement:
    """What is said of one hidden signal."""

    signal: str
    verdict: str
    window: int | None
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Observability:
    """What outputs and inputs determine of hidden signals.

    Errors are root mean squares in standard deviations of the signals.

    Parameters
    ----------
    measured, inputs, hidden : tuple of str
        Names of the signals.
    dt : float
        Seconds in a step.
    windows : tuple of int, length m
        Steps back that outputs and inputs are known; 0 is the output alone.
    noise : tuple of (float or tuple of float), length k
        Levels of measurement noise; the first is 0.
    errors : ndarray, shape (k, m, nx)
        That the best estimate leaves after so many steps.
    changes : ndarray, shape (m, nx)
        That it leaves of how much a signal has changed over the window, in standard deviations of that change, without
        noise; NaN where nothing has, and over windows of which the filter forgets where they began.
    warnings : tuple of str
        What the data are too few for.
    """

    measured: tuple[str, ...]
    inputs: tuple[str, ...]
    hidden: tuple[str, ...]
    dt: float
    windows: tuple[int, ...]
    noise: tuple[Level, ...]
    errors: np.ndarray
    changes: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def judgements(self) -> tuple[Judgement, ...]:
        """What is said of each hidden signal."""
        return tuple(map(self._judged, range(len(self.hidden))))

    def findings(self) -> Iterator[Finding]:
        """The same as lines of a check."""
        known = " and ".join(", ".join(names) for names in (self.measured, self.inputs) if names)
        yield Finding("signals", "ok", f"{', '.join(self.hidden)} from {known}, in steps of {self.dt:.3g} s")
        for one in self.judgements:
            verdict, advice = VERDICTS[one.verdict.split()[0]]
            text = f"{one.signal}: {one.verdict}{self._since(one.window)}"
            if not np.isnan(one.errors[0]):
                left = [f"{error(each)} at noise {show_level(level)}" for level, each in zip(self.noise, one.errors)]
                text += f"; error {', '.join(left)}"
            yield Finding("observability", verdict, text, advice)
        for warning in self.warnings:
            found, _, advice = warning.partition("; ")
            yield Finding("data", "note", found, advice)

    def csv(self) -> str:
        """Errors by signal, level of noise and window, as the text of a file."""
        lines = ["signal,measurement_noise,steps,seconds,error"]
        for (k, m, i), left in np.ndenumerate(self.errors):
            level, window = show_level(self.noise[k]).replace(", ", " "), self.windows[m]
            lines.append(f"{self.hidden[i]},{level},{window},{window * self.dt:.6g},{left:.6g}")
        return "\n".join(lines) + "\n"

    def _judged(self, i: int) -> Judgement:
        errors, exact = tuple(self.errors[:, :, i].min(1).tolist()), self.errors[0, :, i]
        changes = self.changes[~np.isnan(self.changes[:, i]), i]
        least, window = errors[0], self._first(exact <= max(DETERMINED, AS_GOOD * exact.min()))
        if np.isnan(least):
            verdict, window = "never moves", None
        elif least <= DETERMINED:
            verdict = "determined"
        elif len(changes) and changes[-1] <= min(DETERMINED, SEEN * least):
            verdict, window = "up to a constant", self._first(self.changes[:, i] <= DETERMINED)
        elif least < UNDETERMINED:
            verdict = f"partly ({100 * least:.2g} % left)"
        else:
            verdict, window = "not determined", None
        return Judgement(self.hidden[i], verdict, window, errors)

    def _first(self, good: np.ndarray) -> int | None:
        return self.windows[int(good.argmax())]

    def _since(self, window: int | None) -> str:
        if window is None:
            return ""
        steps = f"{window} step{'s' * (window > 1)} ({window * self.dt:.3g} s)"
        return f" from {steps} of y" if window else " from y alone"
