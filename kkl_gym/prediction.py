"""A memory for noisy outputs: combinations of filters that predict later outputs, fitted under random actions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from kkl_gym.memory import Memory
from observers.checks import real_array

# Predictions are kept if their variance exceeds this multiple of the variance that a fit to white noise would have.
CHANCE = 3.0
# The fit needs at least this number of samples for each feature.
SAMPLES = 10


class PredictiveMemory(Memory):
    """A memory that returns the outputs expected in the next step, and predictions of later ones.

    It filters all outputs and angles, also the angles' cosines and sines, on which a torque may depend. ``weights``
    (features, width) multiply outputs, angles, their filters w, the inputs' filters v, and 1. Its first columns give
    expected changes in one step, of angles and of outputs other than cosines and sines; the others, later predictions.
    """

    def __init__(
        self, ny: int, nu: int, angles: Sequence[tuple[int, int]], weights: Any, **time_constants: Sequence[float]
    ) -> None:
        super().__init__(ny, nu, angles, **time_constants)
        self._plain, self._others = self._others, np.arange(ny)
        self._targets = np.r_[self._plain, ny : ny + len(angles)]  # indices of the predicted signals
        features = (ny + len(angles)) * (1 + len(self.decay)) + nu * len(self.input_decay) + 1
        given = real_array("weights", weights)
        self.weights = given if given.shape != (0,) else np.zeros((features, len(self._targets)))
        if self.weights.ndim != 2 or len(self.weights) != features or self.weights.shape[1] < len(self._targets):
            raise ValueError(
                f"weights must be {features} rows of {len(self._targets)} numbers or more, got the shape "
                f"{self.weights.shape}: pass weights from learn_weights() of a KKLMemory with otherwise equal arguments"
            )
        self.size = ny + self.weights.shape[1] - len(self._targets)

    def features(self) -> np.ndarray:
        """Return signals, filters and a constant 1, (..., features)."""
        return np.concatenate([self._signals, *self._w, *self._v, np.ones((*self._ages.shape, 1))], axis=-1)

    def shown(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return expected outputs and further predictions, (..., size), in all environments or in ``rows``, a mask."""
        self._check_begun()
        predicted = self.features() @ self.weights
        n, plain = len(self._targets), len(self._plain)
        expected, further = self._signals[..., self._targets] + predicted[..., :n], predicted[..., n:]
        y = np.empty((*self._ages.shape, self._ny))
        y[..., self._plain], angles = expected[..., :plain], expected[..., plain:]
        y[..., self._cosines], y[..., self._sines] = np.cos(angles), np.sin(angles)
        out = np.concatenate([y, further], axis=-1, dtype=np.float32)
        return out if rows is None else out[rows]

    def fit(self, episodes: Sequence[np.ndarray]) -> np.ndarray:
        """Fit the weights by least squares. Shapes: each episode (samples, features).

        Of the predictions beyond the next step, the fit keeps the linear combinations whose variance is well above that
        of a fit to white noise, and scales them to unit variance.
        """
        horizons = sorted({1, 2, *np.ceil(self.time_constants).astype(int).tolist()})  # in steps
        last = horizons[-1]
        x = np.concatenate([episode[:-last] for episode in episodes])
        n, features = x.shape
        if n < SAMPLES * features:
            raise ValueError(
                f"the fit needs {SAMPLES * features} samples, each followed by {last} more of its episode, got {n}: "
                "take more steps or shorter time constants"
            )
        signals = [episode[:, self._targets] for episode in episodes]
        following = [np.concatenate([s[h : len(s) - last + h] for s in signals if len(s) > last]) for h in horizons]
        later = np.hstack([y - following[0] for y in following[1:]])
        size = np.maximum(np.abs(x).max(0), 1e-12)
        change = np.hstack([following[0] - x[:, self._targets], later])
        weights = np.linalg.lstsq(x / size, change, rcond=1e-9)[0] / size[:, None]
        to_next, to_later = weights[:, : len(self._targets)], weights[:, len(self._targets) :]
        predicted = x @ to_later
        # This lower bound of the variance keeps the covariance of the errors invertible where predictions are exact.
        floor = np.maximum(1e-9 * later.var(0), 1e-12)
        error = np.atleast_2d(np.cov((later - predicted).T, bias=True)) + np.diag(floor)
        to_white = to_later @ np.linalg.inv(np.linalg.cholesky(error)).T
        mean = (x @ to_white).mean(0)
        _, values, directions = np.linalg.svd(x @ to_white - mean, full_matrices=False)
        kept = values**2 > CHANCE * features
        scaled = directions[kept].T * (np.sqrt(n) / values[kept])
        further = to_white @ scaled
        further[-1] -= mean @ scaled
        return np.hstack([to_next, further])


__all__ = ["PredictiveMemory"]
