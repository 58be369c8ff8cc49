"""The observer's step written once more, in doubles throughout, and signals for it."""

from contextlib import contextmanager

import numpy as np
import pytest

import kkl_gym
from kkl_gym.simulate import simulate
from observers import MLP, Artifact, KKLObserver
from observers.decoder import Decoder
from observers.names import resolve
from training.export import Exported

_ACTIVE = {"tanh": np.tanh, "silu": lambda h: h / (1 + np.exp(-h)), "relu": lambda h: h * (h > 0)}


def exported_of(artifact, folder, name="made", **options):
    artifact.save(folder / f"{name}.safetensors")
    return Exported.read(str(folder / f"{name}.safetensors"), **options)


def noise(artifact, steps, rows=()):
    """Outputs and inputs that floats hold exactly; the inputs begin after a third of the steps."""
    rng = np.random.default_rng(1)
    y = rng.normal(scale=3.0, size=(steps, *rows, artifact.ny)).astype(np.float32).astype(float)
    u = rng.normal(size=(steps, *rows, artifact.nu)).astype(np.float32).astype(float)
    u[: steps // 3] = 0.0
    return y, u


def motion(artifact, steps, runs=1):
    """The output along runs of a shipped system, end to end, under inputs that are held for a second.

    No input acts in the first fifth.
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
    """A network in doubles."""
    h = h.astype(float)
    for i, (weight, bias) in enumerate(mlp.layers):
        h = (_ACTIVE[mlp.activation](h) if i else h) @ weight.astype(float) + bias
    return h


@contextmanager
def doubles():
    """Makes observers compute all in doubles, as far as NumPy computes it."""

    def read(decoder, z, age):
        told = [decoder._inverse.age_feature(age)] if decoder._told_age else []
        return np.array([*(z @ decoder._whiten + decoder._offset), *decoder._conditions, *told])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MLP, "__call__", network)
        patch.setattr(Decoder, "read", read)
        yield


def stepped(exported, y, u):
    """The observer at each sample of a record, of which some may be missing."""
    levels = exported.measurement_noise, exported.process_noise
    observer = KKLObserver(exported.artifact, levels[0], process_noise=levels[1], compiled=False)
    for k, sample in enumerate(y):
        if k:
            observer.step(None if np.isnan(sample).all() else sample, u[k - 1])
        else:
            observer.reset(sample)
        yield observer


def lost_and_inflated(exported, y, u):
    """Whether a tracker is lost, and whether its covariance is inflated and no more, at each sample, (steps,) each."""
    begun = [observer._tracker._state[0, observer._tracker._end :][:2] == 1.0 for observer in stepped(exported, y, u)]
    lost, inflated = np.array(begun).T
    return lost, inflated & ~lost


def in_doubles(exported, y, u):
    """Estimates along a record, (steps, ..., nx), with a network of doubles too."""
    artifact, linear = exported.artifact, exported.artifact.filter
    if artifact.flow is not None:
        with doubles():
            return np.array([observer.decode() for observer in stepped(exported, y, u)])
    z = [y[0] @ linear.equilibrium.T]
    for k in range(1, len(y)):
        driven = y[k - 1] @ linear.early_y.T + y[k] @ linear.late_y.T + u[k - 1] @ linear.held_u.T
        z.append(z[-1] @ linear.transition.T + driven)
    z = np.array(z)
    age = (np.arange(len(y)) * linear.dt).reshape(-1, *(1 for _ in z.shape[1:]))

    def mapped(inverse):
        modes = (z[..., : len(inverse.z_offset)] - inverse.z_offset) @ inverse.whiten.T
        told = [*inverse.noise_features(exported.measurement_noise, exported.process_noise)]
        told += [inverse.age_feature(age)] if "age" in inverse.features else []
        told = [np.broadcast_to(value, (*modes.shape[:-1], 1)) for value in told]
        h = np.concatenate([modes * inverse.gain(exported.measurement_noise), *told], axis=-1)
        return inverse.x_offset + inverse.x_scale * network(inverse.mlp, h)

    x_hat = mapped(artifact.inverse)
    if artifact.free_inverse is None:
        return x_hat
    return np.where(z[..., len(linear.A) :].any(-1)[..., None], x_hat, mapped(artifact.free_inverse))


def in_python(exported, y, u):
    """Estimates along a record, (steps, ..., nx): KKLObserver's (float), or those of :func:`in_doubles` (double)."""
    artifact = exported.artifact
    if exported.precision == "double":
        return in_doubles(exported, y, u)
    if artifact.flow is not None:
        return np.array([observer.decode() for observer in stepped(exported, y, u)])
    observer = KKLObserver(artifact, exported.measurement_noise, process_noise=exported.process_noise)
    x_hat = observer.estimate(y, u)
    if not artifact.estimated_parameters:
        return x_hat
    return np.concatenate([x_hat, observer.estimate_parameters(y, u)], axis=-1)


def apart(exported, x_hat, y, u):
    """The largest difference from :func:`in_python`, in scales of the estimates."""
    return (abs(x_hat - in_python(exported, y, u)) / exported.artifact.inverse.x_scale).max()


def apart_at_all_levels(name, precision, step, steps=100_000, length=5000):
    """The largest difference that a shipped map's export makes in runs of so many samples, laid end to end.

    At no measurement noise, at what is usual, and at the most that the map knows of. ``step`` gives estimates for an
    exported map, outputs and inputs.

    Returns the largest as a part of each estimate's range in the runs, and as a part of its scale.
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
