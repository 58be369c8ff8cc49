"""One line of a diagnosis, and its numbers as text."""

from dataclasses import dataclass
from typing import Literal

RESOLUTION = 1e-3  # networks are at best as accurate as if z had an error of so many standard deviations

Verdict = Literal["ok", "note", "problem"]


@dataclass(frozen=True)
class Finding:
    """One line of a diagnosis: the check, its verdict, what it found, and advice."""

    check: str
    verdict: Verdict
    found: str
    advice: str = ""


def percent(share: float) -> str:
    """Format a share in percent: with two significant digits, or from 99.5 % on as a whole number."""
    return (f"{100 * share:.0f}" if abs(share) >= 0.995 else f"{100 * share:.2g}") + " %"


def error(share: float) -> str:
    """Format an error in percent, or as an upper bound if it is below the resolution of a network."""
    return percent(share) if share >= RESOLUTION else f"< {percent(RESOLUTION)}"
