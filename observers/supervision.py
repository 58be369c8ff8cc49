"""Divergence detection: a limit of the NIS and a whiteness test of the innovations.

Innovations in units of their standard deviations are white and have a mean square of 1 where the filter is consistent.
Where it diverged they are large. Where it is off by less than the noise, but by more than its covariance says, they are
hardly larger but correlated; so they are where the noise itself is not white.
"""

import math
from dataclasses import dataclass
from typing import Self

from observers.motion import Motion

# Normal quantiles of the limits: to start again in vain costs the estimate, to inflate a covariance in vain little. The
# running means are more skewed than the chi-square distribution that the limits assume: chance exceeds the second some
# twenty times as often as it says.
_DIVERGED = 6.0  # 1e-9, of the NIS
_COLOURED = 4.265  # 1e-5, of the mean square of the innovations' running mean
_TREND = 0.25  # windows over which innovations are averaged to see whether they agree
_LONG = 4.0  # windows over which the square of that is averaged
INFLATION = 10.0  # of the covariance where innovations are not white
RELINEARISATIONS = 2  # of a step within the first window: with 0 errors without noise rise by 40 to 80 %


@dataclass(frozen=True)
class Supervision:
    """Of a tracker, for all levels of noise."""

    window: int
    share: float
    limit: float
    trend_share: float
    trend_square_share: float
    trend_limit: float

    @classmethod
    def of(cls, motion: Motion, dt: float) -> Self:
        """Return that of a motion on samples every ``dt`` seconds."""
        window, ny = max(1, round(motion.window / dt)), len(motion.least_measurement_noise)
        share, trend_share, long_share = (-math.expm1(-1 / (each * window)) for each in (1.0, _TREND, _LONG))
        memory = (1 - trend_share) ** 2 * (1 - long_share)  # of a trend's square, a sample later
        return cls(
            window,
            share,
            _limit(ny * (2 - share) / share, _DIVERGED),
            trend_share,
            long_share,
            _limit(ny * (2 - long_share) / long_share * (1 - memory) / (1 + memory), _COLOURED),
        )

    @property
    def trend_gain(self) -> float:
        """What the square of a trend is multiplied with to be 1 on average where innovations are independent."""
        return (2 - self.trend_share) / self.trend_share


def _limit(freedom: float, quantile: float) -> float:
    """A quantile of the mean square of so many standard normal numbers, by Wilson and Hilferty's approximation."""
    spread = 2 / (9 * freedom)
    return float((1 - spread + quantile * math.sqrt(spread)) ** 3)
