"""One line of a diagnosis, and its numbers as text."""

from dataclasses import dataclass
from typing import Literal

RESOLUTION = 1e-3  # error with which a network reads z, in standard deviations; it remains even without noise

Verdict = Literal["ok", "note", "problem"]


@dataclass(frozen=True)
class Finding:
    """One line of a diagnosis: the check, its verdict, what it found, and advice."""

    check: str
    verdict: Verdict
    found: str
    advice: str = ""


def percent(share: float) -> str:
    """Format a share in percent, with two digits."""
    return (f"{100 * share:.0f}" if abs(share) >= 1 else f"{100 * share:.2g}") + " %"


def error(share: float) -> str:
    """Format an error in percent, or as an upper bound if it is below the resolution of a network."""
    return percent(share) if share >= RESOLUTION else f"< {percent(RESOLUTION)}"
