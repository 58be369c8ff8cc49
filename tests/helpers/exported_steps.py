"""References for exported observers: KKLObserver's step in double precision, and signals for it."""

import copy
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np
import pytest
from random_artifacts import random_artifact
from random_tracking import KINDS, OFF, of_floats, tracking

import kkl_gym
from kkl_gym.simulate import simulate
from observers import MLP, Artifact, Expression, KKLObserver, decoder
from observers.names import resolve
from training.export.exported import Exported

_ACTIVE = {"tanh": np.tanh, "silu": lambda h: h / (1 + np.exp(-h)), "relu": lambda h: h * (h > 0)}
# Options of random_artifact, and activations, for which exports are compared.
MAPS = (
    ({"inputs": False, "noise": False, "age": False}, "relu"),
    ({"pair": True, "outputs": 2, "process": True, "free_inverse": True}, "silu"),
    ({"estimated": True, "process": True}, "silu"),
    ({"system": "lorenz", "free_inverse": True}, "tanh"),
)


def exported_of(artifact, folder, name="made", **options):
    artifact.save(folder / f"{name}.safetensors")
    return Exported.read(str(folder / f"{name}.safetensors"), **options)


def _in_doubles(artifact):
    with TemporaryDirectory() as folder:
        return exported_of(artifact, Path(folder), precision="double")


@cache
def mapped(index):
    """A map of MAPS, outputs and inputs (steps, 3, .), and estimates; the inputs of the first row are zero."""
    options, activation = MAPS[index]
    artifact = random_artifact(**options)
    mlp = replace(artifact.inverse.mlp, activation=activation)
    exported = _in_doubles(replace(artifact, inverse=replace(artifact.inverse, mlp=mlp)))
    y, u = noise(artifact, 300, (3,))
    u[:, 0] = 0.0
    expected = in_doubles(exported, y, u)
    assert np.ptp(expected, axis=0).min() > 0.005
    return exported, y, u, expected


@cache
def tracked(index):
    """An observer of KINDS, a record with gaps, and estimates; the tracker diverges and inflates its covariance."""
    exported = _in_doubles(tracking(**KINDS[index]))
    y, u = of_floats(exported.artifact, OFF[1] + 50)
    y[2:9] = y[700:720] = y[300::7, 0] = np.nan  # gaps: right after the start, later, and in single outputs
    expected, std, taken = [], [], 0
    with doubles():
        for k, observer in enumerate(stepped(exported, y, u)):
            expected.append(observer.decode())
            std.append(observer.std)
            if 600 <= k < 700:  # after the jump, T_inv re-initialises a tracker that has diverged
                taken += np.allclose(expected[-1], t_inv(observer), rtol=1e-9)
    assert taken > 1
    assert (np.divide(std[1:], std[:-1]).max(1)[OFF[0] :] > 2.5).any()
    return exported, y, u, np.array(expected)


X, V = ["x", 0], ["x", 1]
OPERATIONS = [
    *([name, X] for name in ("sin", "cos", "tanh", "sign", "floor", "abs")),
    ["tan", ["*", 0.1, X]],
    ["exp", ["*", -1.0, ["abs", X]]],
    ["log", ["+", 1.0, ["abs", X]]],
    ["sqrt", ["abs", V]],
    ["%", X, -0.7],
    ["%", V, 0.6],
    ["**", X, 3.0],
    ["**", ["abs", X], 1.3],
    ["**", ["+", 2.0, ["abs", V]], -2.0],
    ["minimum", X, V, 0.3],
    ["maximum", X, V, -0.3],
    ["where", ["and", ["<", X, V], ["not", [">=", X, 0.5]]], X, ["u", 0]],
    ["where", ["or", ["<=", X, V], [">", X, 0.5], ["<", V, 0.0]], 1.0, V],
]


def operated(*others):
    """A tracking observer whose equations use all operations of expressions, a record, and estimates."""
    artifact = tracking(by="discrete")
    steps = ["*", 0.002, ["+", *OPERATIONS, *others]]
    field = Expression([["+", ["*", 0.95, X], steps], ["+", ["*", 0.95, V], ["*", 0.05, X], steps]])
    equations = replace(artifact.motion.equations, field=field)
    exported = _in_doubles(replace(artifact, motion=replace(artifact.motion, equations=equations)))
    y, u = of_floats(exported.artifact, 150)
    return exported, y, u, in_doubles(exported, y, u)


def t_inv(observer):
    """T_inv's estimate from the filter state of a tracking observer, clipped to the bounds of the motion."""
    alone, motion = copy.copy(observer), observer.artifact.motion
    alone.replace(replace(observer.artifact, motion=None))
    return np.clip(alone.decode(), motion.low, motion.high)


def noise(artifact, steps, rows=()):
    """Random outputs and inputs that float32 represents exactly; the inputs are zero in the first third."""
    rng = np.random.default_rng(1)
    y = rng.normal(scale=3.0, size=(steps, *rows, artifact.ny)).astype(np.float32).astype(float)
    u = rng.normal(size=(steps, *rows, artifact.nu)).astype(np.float32).astype(float)
    u[: steps // 3] = 0.0
    return y, u


def motion(artifact, steps, runs=1):
    """Outputs and inputs along concatenated runs of a shipped system, with inputs that are constant for 1 s at a time.

    The inputs are zero in the first fifth.
    """
    system, dt, rng = kkl_gym.get_system(artifact.system), artifact.filter.dt, np.random.default_rng(2)
    length, held = -(-steps // runs), round(1.0 / dt)
    u = np.zeros((length, runs, artifact.nu))
    if artifact.nu:
        pieces = rng.uniform(-0.3, 0.3, (length // held + 1, runs, artifact.nu)) * system.u_max
        u = np.repeat(pieces, held, axis=0)[:length]
        u[:, : runs // 5] = 0.0
        u[: length // 5] *= runs > 1
    u = u.astype(np.float32).astype(float)
    x0 = rng.uniform(*np.transpose(system.X), (runs, system.nx))
    x = simulate(system, x0, length, dt, u if artifact.nu else None)[:length]
    y = np.moveaxis(np.asarray(system.h(np.moveaxis(x, -1, 0))), 0, -1)
    y, u = (np.swapaxes(signal, 0, 1).reshape(length * runs, -1)[:steps] for signal in (y, u))
    return y.astype(np.float32).astype(float), u


def network(mlp, h):
    """Evaluate a network in double precision."""
    h = h.astype(float)
    for i, (weight, bias) in enumerate(mlp.layers):
        h = (_ACTIVE[mlp.activation](h) if i else h) @ weight.astype(float) + bias
    return h


@contextmanager
def doubles():
    """Make observers compute in double precision wherever they use NumPy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MLP, "__call__", network)
        patch.setattr(decoder, "np", SimpleNamespace(**{**vars(np), "float32": float}))
        yield


def stepped(exported, y, u):
    """Yield the observer after each sample of a record; samples may be missing."""
    levels = exported.measurement_noise, exported.process_noise
    observer = KKLObserver(exported.artifact, levels[0], process_noise=levels[1], compiled=False)
    for k, sample in enumerate(y):
        if k:
            observer.step(None if np.isnan(sample).all() else sample, u[k - 1])
        else:
            observer.reset(sample)
        yield observer


def in_doubles(exported, y, u):
    """Estimates along a record, (steps, ..., nx + number of estimated parameters), in double precision."""
    with doubles():
        return in_python(replace(exported, precision="float"), y, u)


def in_python(exported, y, u):
    """Estimates along a record by KKLObserver, in the precision of the export."""
    artifact = exported.artifact
    if exported.precision == "double":
        return in_doubles(exported, y, u)
    if artifact.motion is not None:
        return np.array([observer.decode() for observer in stepped(exported, y, u)])
    if artifact.estimated_parameters:  # T_inv then estimates states and parameters together
        artifact = replace(artifact, parameter_ranges={}, estimated_parameters=())
    observer = KKLObserver(artifact, exported.measurement_noise, process_noise=exported.process_noise, compiled=False)
    return observer.estimate(y, u)


def apart(exported, x_hat, expected):
    """The largest difference of estimates in units of T_inv's x_scale."""
    return (abs(x_hat - expected) / exported.artifact.inverse.x_scale).max()


def apart_at_all_levels(name, precision, step, steps=100_000, length=5000):
    """The largest difference between a shipped map's export and KKLObserver, in concatenated runs of `length` samples.

    Measurement noise is zero, the system's usual level and the map's largest level in turn. ``step`` returns estimates
    for an exported map, outputs and inputs.

    Returns the difference divided by the range of the estimates in the runs, and by their scale.
    """
    artifact = Artifact.read(resolve(name))
    y, u = motion(artifact, steps, runs=-(-steps // length))
    found = []
    for level in (0.0, artifact.measurement_noise, artifact.inverse.measurement_noise_max):
        exported = Exported.read(name, precision=precision, measurement_noise=level)
        x_hat, expected = step(exported, y, u), in_python(exported, y, u)
        assert x_hat.shape == (steps, artifact.nx)
        units = np.ptp(expected, axis=0), artifact.inverse.x_scale
        found.append([(abs(x_hat - expected) / unit).max() for unit in units])
    return np.max(found, axis=0)
