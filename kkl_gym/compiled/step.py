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
    """One sampling interval, called as ``step(x, u, w, dt)``."""

    advance: Advance[Values]
    obstacle: str | None = None

    def __call__(self, x: Values, u: Values, w: Values, dt: float) -> Values:
        """Take the step, for arrays of a batch (nx, n) and (nu, n), or for sequences of floats."""
        return self.advance(x, u, w, dt)


def shared_step(
    system: System,
    compile_step: Callable[[System], Advance[Values]],
    otherwise: Callable[..., Values],
    *,
    said: str,
    again: Callable[[Advance[Values], System], Advance[Values]] | None = None,
) -> SamplingStep[Values]:
    """The compiled step of a system, made once for all systems that it is the same of."""
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
    """States at which compiled equations are compared with the others. Shapes: returns (2 n, nx), (3 n, nx)."""
    low, high = np.array(system.bounds, dtype=float).T
    random = np.concatenate([rng.uniform(*system.box(), (n, system.nx)), rng.uniform(low, high, (n, system.nx))])
    ends = np.choose(rng.choice(3, (n, system.nx)), [low, np.zeros(system.nx), high])
    return random, np.concatenate([ends, np.rint(random[:n]), system.draw_starts(rng, n)])
