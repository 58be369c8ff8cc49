"""A sampling interval that machine code takes where it can, and Python or NumPy where not."""

import functools
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from kkl_gym.compiled.reading import made_of
from kkl_gym.system import System

Values = TypeVar("Values")
Advance = Callable[[Values, Values, Values, float], Values]
"""(x, u, w, dt) to the next x."""

_KEPT = 64  # compiled steps
_kept: dict[Any, "SamplingStep[Any]"] = {}  # by all that they were made of

logger = logging.getLogger("kkl_gym")


@dataclass(frozen=True)
class SamplingStep(Generic[Values]):
    """One sampling interval, called as ``step(x, u, w, dt)``.

    Parameters
    ----------
    advance : callable
        Takes the step.
    obstacle : str, optional
        Why it is not compiled; None where it is.
    """

    advance: Advance[Values]
    obstacle: str | None = None

    def __call__(self, x: Values, u: Values, w: Values, dt: float) -> Values:
        """Take the step.

        Parameters
        ----------
        x : ndarray, shape (nx, n), or sequence of float
            States, component first, or a single one.
        u : ndarray, shape (nu, n), or sequence of float
            Inputs, held over the interval.
        w : ndarray, shape (nx, n), or sequence of float
            Process noise, held over the interval.
        dt : float
            Length of the interval in seconds.

        Returns
        -------
        ndarray, shape (nx, n), or sequence of float
            The next states; those that escape are not finite.
        """
        return self.advance(x, u, w, dt)


def shared_step(
    system: System,
    compile_step: Callable[[System], Advance[Values]],
    otherwise: Callable[..., Values],
    *,
    said: str,
    again: Callable[[Advance[Values], System], Advance[Values]] | None = None,
) -> SamplingStep[Values]:
    """The compiled step of a system, made once for all systems that it is the same of.

    Parameters
    ----------
    system : System
        Whose equations are taken.
    compile_step : callable
        Compiles them, or raises anything at all.
    otherwise : callable
        From (system, x, u, w, dt) to the next x, where it does.
    said : str
        What the logger then says once, before the reason.
    again : callable, optional
        From a compiled step and another system to the same for that; ValueError if its equations say something else.

    Returns
    -------
    SamplingStep
        The step, and why it is not compiled where it is not.
    """
    plain = functools.partial(otherwise, system)
    if system.discrete:
        return SamplingStep(plain, f"{system.name} makes its step itself")
    try:
        of = compile_step, *made_of(system)
    except Exception as error:
        return SamplingStep(plain, _reason(error))
    found = _kept.get(of)
    if found is not None and found.obstacle is None and again is not None:
        try:
            return SamplingStep(again(found.advance, system))
        except ValueError:  # something has changed that nobody can see
            found = None
    if found is None:
        try:
            found = SamplingStep(compile_step(system))
        # Anything may come out of a user's equations on symbols, or of Numba. Python then takes the equations as they
        # are, and raises by itself what is wrong with them on numbers, too.
        except Exception as error:
            found = SamplingStep(plain, _reason(error))
            logger.info("%s: %s", said, found.obstacle)
        while len(_kept) >= _KEPT:
            _kept.pop(next(iter(_kept)), None)
        _kept[of] = found
    return found if found.obstacle is None else SamplingStep(plain, found.obstacle)


def _reason(error: Exception) -> str:
    """What went wrong, in one line: Numba writes a page, in colours, of which a line says what it cannot take."""
    lines = re.sub(r"\x1b\[\d*m", "", str(error)).splitlines()
    said = [line for line in lines if line.strip() and not line.startswith("Failed in ")]
    return f"{type(error).__name__}: {said[0] if said else ''}"


def trial_states(system: System, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """States at which compiled equations are compared with the others.

    Parameters
    ----------
    system : System
        Whose box and bounds are taken.
    n : int
        How many of each of five kinds.
    rng : numpy.random.Generator
        Draws them.

    Returns
    -------
    ndarray, shape (2 n, nx)
        Random ones within X and within the bounds.
    ndarray, shape (3 n, nx)
        Where equations tend to branch: at bounds and zeros, whole numbers, and where the system draws its starts.
    """
    low, high = np.array(system.bounds, dtype=float).T
    random = np.concatenate([rng.uniform(*system.box(), (n, system.nx)), rng.uniform(low, high, (n, system.nx))])
    ends = np.choose(rng.choice(3, (n, system.nx)), [low, np.zeros(system.nx), high])
    return random, np.concatenate([ends, np.rint(random[:n]), system.draw_starts(rng, n)])
