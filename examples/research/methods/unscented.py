"""The unscented Kalman filter with the exact model."""

import numpy as np

from kkl_gym.simulate import advance_batch
from observers.unscented import add, shift, transformed, whitened
from training.kalman import ExtendedKalmanFilter, Gaussian


class UnscentedKalmanFilter(ExtendedKalmanFilter):
    """A batch of unscented Kalman filters (Wan and van der Merwe, 2000).

    Sigma points have alpha = 1, beta = 2 and kappa = max(3 - nx, 0). If h is undefined at a point, h is evaluated at
    the mean instead. A filter restarts if its corrected mean leaves the system's declared bounds, or if
    its covariance is no longer positive definite. The rest is as in the base class.
    """

    @np.errstate(over="ignore", invalid="ignore")
    def _predicted(self, x: np.ndarray, P: np.ndarray, u: np.ndarray, dt: float) -> Gaussian:
        def move(points: np.ndarray) -> np.ndarray:
            flat = np.ascontiguousarray(points.reshape(-1, points.shape[-1]).T)
            moved = advance_batch(self._system, flat, np.tile(u, len(points)), np.zeros_like(flat), dt)
            return moved.T.reshape(points.shape)

        mean, covariance, _ = transformed(x, P, move)
        return mean, covariance + self._Q * dt

    @np.errstate(over="ignore", invalid="ignore")
    def _corrected(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> Gaussian:
        x, P = self._updated(x, P, y)
        lost = ~self._inside(x, P)
        if lost.any():
            x0, P0, _ = self.start(int(lost.sum()))
            restarted = self._updated(x0, P0, y[lost])
            sound = self._inside(*restarted)  # the others restart without the sample
            x[lost] = np.where(sound[:, None], restarted[0], x0)
            P[lost] = np.where(sound[:, None, None], restarted[1], P0)
        return x, P

    def _updated(self, x: np.ndarray, P: np.ndarray, y: np.ndarray) -> Gaussian:
        expected, S, across = transformed(x, P, self._output)
        V, white = whitened(y - expected, S + self._R, across, np.isnan(y))
        return shift(x, V, white), add(P, V, V, -1.0)

    def _output(self, points: np.ndarray) -> np.ndarray:
        y = self._system.output(points)
        if not np.isfinite(y).all():
            y = np.where(np.isfinite(y), y, self._system.output(points.mean(0, keepdims=True)))
        return y
