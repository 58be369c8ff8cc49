import pickle

import numpy as np
import pytest

from observers import LinearFilter

DIAGONAL = -np.diag([0.5, 2.0, 7.0])
PAIR = np.array([[-1.0, 5.0, 0.0], [-5.0, -1.0, 0.5], [0.0, 0.0, -3.0]])
FULL = np.array([[-2.0, 0.5, 0.1, 0.3], [0.2, -3.0, 0.4, 0.1], [0.3, 0.1, -1.0, 0.2], [0.1, 0.2, 0.3, -4.0]])
both = pytest.mark.parametrize("A", [DIAGONAL, PAIR], ids=["diagonal", "pair"])
DT = 0.1


def random_filter(A, ny=2, nu=1, dt=DT):
    return LinearFilter(A, np.random.default_rng(0).normal(size=(len(A), ny)), dt, nu)


def run(linear, y, u):
    z = [linear.start(y[0])]
    for k in range(len(u)):
        z.append(linear.advance(z[-1], y[k], u[k], y[k + 1]))
    return np.array(z)


def signals(linear, steps, *batch):
    rng = np.random.default_rng(1)
    ny = linear.B.shape[1]
    return rng.normal(size=(steps + 1, *batch, ny)), rng.normal(size=(steps, *batch, linear.nu))


@both
@pytest.mark.parametrize(("nu", "dt"), [(0, 0.1), (2, 1e-3), (2, 2.0)])
def test_one_interval_is_exact(A, nu, dt):
    """Compare with the matrix exponential of the system augmented with the ramp of y and the constant u."""
    expm = pytest.importorskip("scipy.linalg").expm
    linear = random_filter(A, 2, nu, dt)
    nz = len(A)
    (y, y_next), (u,) = signals(linear, 1)
    z = np.random.default_rng(2).normal(size=linear.size)
    expected = []
    for block in range(1 + nu):
        drive, slope = (
            (linear.B @ y, linear.B @ (y_next - y) / dt) if block == 0 else (linear.B.sum(1) * u[block - 1], 0)
        )
        M = np.zeros((nz + 2, nz + 2))  # (z, 1, t)
        M[:nz, :nz], M[:nz, nz], M[:nz, nz + 1], M[nz + 1, nz] = A, drive, slope, 1.0
        expected.append((expm(M * dt) @ [*z[block * nz : (block + 1) * nz], 1.0, 0.0])[:nz])
    assert np.allclose(linear.advance(z, y, u, y_next), np.concatenate(expected), rtol=1e-10, atol=1e-11)


@both
def test_start_is_the_equilibrium_of_a_constant_output(A):
    linear = random_filter(A)
    y = np.array([0.7, -1.3])
    z = linear.start(y)
    assert np.allclose(A @ z[:3] + linear.B @ y, 0, atol=1e-12)
    assert (z[3:] == 0).all()
    assert np.allclose(linear.advance(z, y, np.zeros(1), y), z, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("A", "ny", "nu"), [(DIAGONAL, 1, 0), (DIAGONAL, 2, 2), (PAIR, 2, 1), (FULL, 2, 1)])
@pytest.mark.parametrize("batch", [(5,), (2, 3), (0,), (128,)])
def test_batches_equal_their_rows(A, ny, nu, batch):
    linear = random_filter(A, ny, nu)
    y, u = signals(linear, 4, *batch)
    z = run(linear, y, u)
    assert z.shape == (5, *batch, linear.size) == (5, *batch, len(A) * (1 + nu))
    for index in list(np.ndindex(*batch))[::7]:
        one = run(linear, y[(slice(None), *index)], u[(slice(None), *index)])
        assert np.allclose(z[(slice(None), *index)], one, rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(run(pickle.loads(pickle.dumps(linear)), y, u), z)


@pytest.mark.parametrize(
    ("A", "B", "match"),
    [
        (np.eye(2) * [-1, 0.5], np.ones((2, 1)), r"Hurwitz.*0\.5"),
        (np.diag([-1.0, 0.0]), np.ones((2, 1)), "Hurwitz"),
        ([[0.0, 1.0], [-1.0, 0.0]], np.ones((2, 1)), "Hurwitz"),
        ([[-1.0, 1.0], [0.0, -1.0]], np.ones((2, 1)), "diagonalisable"),
        (-np.eye(2), np.ones((3, 1)), r"\(3, 1\)"),
    ],
)
def test_wrong_matrices_raise(A, B, match):
    with pytest.raises(ValueError, match=match):
        LinearFilter(A, B, DT)


def test_intervals_beyond_floats():
    B = np.ones((3, 1))
    for A, dt in ((DIAGONAL, 1e308), (-1e-320 * np.eye(3), DT)):
        with pytest.raises(ValueError, match="beyond the range of floats"):
            LinearFilter(A, B, dt)


def test_a_filter_copies_its_matrices_and_they_are_read_only():
    A, B = np.diag([-1.0, -2.0]), np.ones((2, 1))
    linear = LinearFilter(A, B, dt=0.1)
    A[0, 0] = 5.0
    assert linear.A[0, 0] == -1.0
    with pytest.raises(ValueError, match="read-only"):
        linear.B[0] = 2.0
