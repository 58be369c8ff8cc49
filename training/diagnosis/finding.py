"""One line of a check, and how it writes numbers."""

from dataclasses import dataclass
from typing import Literal

RESOLUTION = 1e-3  # to which a network reads z, in standard deviations: what is left where there is no noise

Verdict = Literal["ok", "note", "problem"]


@dataclass(frozen=True)
class Finding:
    """One line of a check: what was found, and what to change."""

    check: str
    verdict: Verdict
    found: str
    advice: str = ""


def number(value: float) -> str:
    """Three digits, without an exponent where that is short."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def percent(share: float) -> str:
    """Two digits, in percent."""
    value = 100.0 * share
    return (f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}") + " %"


def error(share: float) -> str:
    """An error in percent, as far as a network resolves it."""
    return percent(share) if share >= RESOLUTION else f"< {percent(RESOLUTION)}"


def point(x: object) -> str:
    """A state."""
    return f"({', '.join(f'{value:.3g}' for value in x)})"  # type: ignore[attr-defined]
