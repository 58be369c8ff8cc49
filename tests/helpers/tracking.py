"""A tracking observer of the oscillator with the exact motion, and the Kalman filter that it must equal."""

from dataclasses import replace

import numpy as np
from linear_system import C, F, exact_observer
from scipy.linalg import expm

from observers import MLP, Equations, ErrorCovariance, Expression, Factors, Flow, Motion

DT, PROCESS, STD = 0.05, 0.02, 0.3  # s; standard deviations: of process noise of level 1 per sample, and of T_inv
AGE_MAX = 1.0  # s
ONE = Factors(np.zeros(1), np.zeros(1), np.ones((1, 1, 1)))
X_OFFSET, X_SCALE, U_SCALE = np.array([0.3, -0.1]), np.array([2.0, 0.5]), 0.5


def exact_motion(dt=DT):
    """Phi and Gamma of x_next = Phi x + Gamma u, where u acts on x2' and is constant between samples."""
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = F, 1.0
    moved = expm(whole * dt)
    return moved[:2, :2], moved[:2, 2:]


def exact_flow(dt=DT, nu=0, x_scale=X_SCALE):
    """The oscillator's motion as a flow in scaled states; the network returns zero."""
    (Phi, Gamma), x_scale = exact_motion(dt), np.asarray(x_scale)
    moved = Phi - np.eye(2)
    linear = [
        moved @ X_OFFSET / x_scale,
        moved * x_scale / x_scale[:, None],
        Gamma[:, :nu] * U_SCALE / x_scale[:, None],
    ]
    mlp = MLP([np.zeros((4, 2 + nu)), np.zeros((2, 4))], [np.zeros(4), np.zeros(2)], "tanh")
    return Flow(mlp, np.column_stack(linear), gain=np.ones(2), u_scale=np.full(nu, U_SCALE))


def exact_equations(dt=DT, nu=0):
    """The oscillator from sample to sample, as equations in discrete time."""
    Phi, Gamma = exact_motion(dt)
    return Equations(
        Expression(
            [
                ["+", ["*", a, ["x", 0]], ["*", b, ["x", 1]], *(["*", g, ["u", 0]] for g in gamma[:nu])]
                for (a, b), gamma in zip(Phi.tolist(), Gamma.tolist(), strict=True)
            ]
        ),
        substeps=0,
    )


def linear_motion(by="equations", nu=0, ny=1, factors=ONE, x_scale=X_SCALE):
    """The exact motion with all settings of a tracker; the initial covariance is that of T_inv."""
    moved = {"equations": exact_equations(nu=nu)} if by == "equations" else {"flow": exact_flow(DT, nu, x_scale)}
    return Motion(
        **moved,
        x_offset=X_OFFSET,
        x_scale=np.asarray(x_scale),
        low=np.array([-30.0, -30.0]),
        high=np.array([30.0, 30.0]),
        mean=np.zeros(2),
        covariance=np.array([[0.4, 0.1], [0.1, 0.3]]),
        error=np.zeros(2),
        process_noise=PROCESS / np.asarray(x_scale),
        least_process_noise=1.0,
        least_measurement_noise=np.full(ny, 0.01),
        window=0.5,
        factors=factors,
    )


def plain_observer(outputs=C):
    """The exact observer, without input, as a map with the features measurement noise and age, which it ignores.

    Its error covariance has a standard deviation of 0.3 for each state.
    """
    exact = exact_observer(DT, outputs)
    weight = np.hstack([exact.inverse.mlp.weights[0], np.zeros((2, 2))])
    inverse = replace(
        exact.inverse,
        mlp=MLP([weight], [np.zeros(2)], "tanh"),
        features=("z_y", "measurement_noise", "age"),
        measurement_noise_unit=0.02,
        measurement_noise_max=1.0,
        age_unit=0.25,
        age_max=AGE_MAX,
        error_covariance=ErrorCovariance(np.zeros(1), np.zeros(1), STD**2 * np.eye(2)[None, None]),
    )
    training = {"pipeline": "input-aware", "eigenvalues": [-1.0, -2.5, -4.0], "dt": DT, "duration": 20.0, "batch": 512}
    return replace(exact, inverse=inverse, training=training)


def tracking_observer(outputs=C, **options):
    """:func:`plain_observer` with the exact motion; options are those of :func:`linear_motion`."""
    return replace(plain_observer(outputs), motion=linear_motion(ny=len(outputs), **options))


def of_t_inv(artifact, std):
    """Return the artifact with another standard deviation of T_inv."""
    covariance = std**2 * np.eye(artifact.nx)[None, None]
    error = ErrorCovariance(np.zeros(1), np.zeros(1), covariance)
    return replace(artifact, inverse=replace(artifact.inverse, error_covariance=error))


class KalmanFilter:
    """The textbook Kalman filter, for the same motion and noise."""

    def __init__(self, x, P, level, outputs=C):
        self.x, self.P, self.H = x, P, outputs
        self.Phi, _ = exact_motion()
        self.Q, self.R = PROCESS**2 * np.eye(2), level**2 * np.eye(len(outputs))

    def step(self, y=None):
        self.x, self.P = self.Phi @ self.x, self.Phi @ self.P @ self.Phi.T + self.Q
        return self.x if y is None else self.correct(y)

    def correct(self, y):
        seen = ~np.isnan(y)
        H, S = self.H[seen], self.H[seen] @ self.P @ self.H[seen].T + self.R[np.ix_(seen, seen)]
        K = self.P @ H.T @ np.linalg.inv(S)
        self.white = np.linalg.solve(np.linalg.cholesky(S), y[seen] - H @ self.x)
        self.x, self.P = self.x + K @ (y[seen] - H @ self.x), (np.eye(2) - K @ H) @ self.P
        return self.x
