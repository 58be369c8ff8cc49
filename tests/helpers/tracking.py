"""An observer of the oscillator that tracks by the exact motion, beside the Kalman filter that it then is."""

from dataclasses import replace

import numpy as np
from linear_system import C, F, exact_observer
from scipy.linalg import expm

from observers import MLP, Factors, Flow, Spread

DT, PROCESS, STD = 0.05, 0.02, 0.3  # s, standard deviation that noise of level 1 adds at each sample, that of T_inv
AGE_MAX = 1.0  # s


def exact_motion(dt=DT):
    """Phi and Gamma of x_next = Phi x + Gamma u, with u on x2 and held."""
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = F, 1.0
    moved = expm(whole * dt)
    return moved[:2, :2], moved[:2, 2:]


def exact_flow(dt=DT, ny=1, factors=None, x_scale=(2.0, 0.5)):
    """The oscillator's motion in scaled states, with a network that adds nothing."""
    Phi, Gamma = exact_motion(dt)
    x_scale, x_offset, u_scale = np.array(x_scale), np.array([0.3, -0.1]), np.array([0.5])
    linear = np.hstack([(Phi - np.eye(2)) * x_scale / x_scale[:, None], Gamma * u_scale / x_scale[:, None]])
    return Flow(
        MLP([np.zeros((4, 3)), np.zeros((2, 4))], [np.zeros(4), np.zeros(2)], "tanh"),
        x_offset=x_offset,
        x_scale=x_scale,
        u_scale=u_scale,
        gain=np.ones(2),
        polynomial=np.column_stack([(Phi - np.eye(2)) @ x_offset / x_scale, linear]),
        low=np.array([-30.0, -30.0]),
        high=np.array([30.0, 30.0]),
        error=np.zeros(2),
        process_noise=PROCESS / x_scale,
        least_process_noise=1.0,
        least_measurement_noise=np.full(ny, 0.01),
        window=0.5,
        factors=factors or Factors(np.zeros(1), np.zeros(1), np.ones((1, 1))),
    )


def told(exact):
    """The exact observer, with the input left out, as a map that is told measurement noise and age, and uses neither.

    Its error bars are a standard deviation of 0.3 of each state.
    """
    weight = np.hstack([exact.inverse.mlp.weights[0], np.zeros((2, 2))])
    biases = [np.zeros(4), np.array([np.log(STD), np.log(STD), 0.0])]
    bars = MLP([np.zeros((4, weight.shape[1])), np.zeros((3, 4))], biases, "tanh")
    spread = Spread(bars, np.zeros(1), np.zeros(1), np.ones((1, 1)))
    inverse = replace(
        exact.inverse,
        mlp=MLP([weight], [np.zeros(2)], "tanh"),
        features=("z_y", "measurement_noise", "age"),
        measurement_noise_unit=0.02,
        measurement_noise_max=1.0,
        age_unit=0.25,
        age_max=AGE_MAX,
        spread=spread,
    )
    training = {"pipeline": "input-aware", "eigenvalues": [-1.0, -2.5, -4.0], "dt": DT, "duration": 20.0, "batch": 512}
    return replace(exact, inverse=inverse, training=training)


def plain_observer(outputs=C):
    """The observer without a flow; it takes no input."""
    return told(exact_observer(DT, outputs))


def tracking_observer(outputs=C, **options):
    """The observer with the exact flow, without input."""
    artifact, flow = plain_observer(outputs), exact_flow(ny=len(outputs), **options)
    mlp = MLP([np.zeros((4, 2)), np.zeros((2, 4))], [np.zeros(4), np.zeros(2)], "tanh")
    return replace(artifact, flow=replace(flow, mlp=mlp, u_scale=np.zeros(0), polynomial=flow.polynomial[:, :3]))


class KalmanFilter:
    """The textbook's, for the same motion and noise."""

    def __init__(self, x, P, level, outputs=C):
        self.x, self.P, self.H = x, P, outputs
        self.Phi, _ = exact_motion()
        self.Q, self.R = PROCESS**2 * np.eye(2), level**2 * np.eye(len(outputs))

    def step(self, y=None):
        self.x, self.P = self.Phi @ self.x, self.Phi @ self.P @ self.Phi.T + self.Q
        if y is not None:
            seen = ~np.isnan(y)
            H, R = self.H[seen], self.R[np.ix_(seen, seen)]
            K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)
            self.x, self.P = self.x + K @ (y[seen] - H @ self.x), (np.eye(2) - K @ H) @ self.P
        return self.x
