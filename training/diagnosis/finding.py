"""One line of a diagnosis, and its numbers as text."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

RESOLUTION = 1e-3  # of z in a network, in standard deviations: the error that remains without noise

Verdict = Literal["ok", "note", "problem"]


@dataclass(frozen=True)
class Finding:
    """One line of a check: the finding, and the remedy."""

    check: str
    verdict: Verdict
    found: str
    advice: str = ""


def percent(share: float) -> str:
    """Two digits, in percent."""
    return (f"{100 * share:.0f}" if abs(share) >= 1 else f"{100 * share:.2g}") + " %"


def error(share: float) -> str:
    """An error in percent, down to the resolution of a network."""
    return percent(share) if share >= RESOLUTION else f"< {percent(RESOLUTION)}"


def point(x: Iterable[float]) -> str:
    """A state."""
    return f"({', '.join(f'{value:.3g}' for value in x)})"
