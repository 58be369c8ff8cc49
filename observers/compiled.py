"""Networks as machine code, where Numba is installed: what lies between a batch's matrix products, or a whole sample.

A batch goes through in pieces that stay in the processor's cache, into memory that is there already. Its products are
NumPy's, which is BLAS at the machine's limit. A single sample is one call, where NumPy's own overhead would be most.
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from observers.machine import fast_kernel, fast_part, kernel

PIECE = 2**15  # values of a layer that a batch computes at once: they fit into the second cache
_TILE = 256  # biases that lie one after another for some rows: in loops as short as a narrow layer much would be lost
UNROLLED = 4  # inputs that a single sample's loop takes at once
_LINE = 16  # numbers of float32 in a line of the cache

Layers = Sequence[tuple[np.ndarray, np.ndarray]]
"""Weights (inputs, outputs) and biases (outputs,) in float32."""


class CompiledNetwork:
    """A multilayer perceptron. Shapes: ``bias`` (outputs,)."""

    def __init__(self, layers: Layers, activation: str) -> None:
        _activate(activation)  # or say now that there is no Numba
        self._layers, self.activation, self.bias = layers, activation, layers[-1][1]
        widths = [len(layers[0][0]), *(len(bias) for _, bias in layers)]
        self.outputs, self.widths, self._most = widths[-1], np.array(widths), max(widths)
        self._tiles = [np.tile(bias, -(-_TILE // len(bias))) for _, bias in layers[:-1]]
        self.packed = _aligned(
            np.concatenate([part.ravel() for weight, bias in layers for part in (bias, _padded(weight))])
        )
        row = -(-(self._most + UNROLLED) // _LINE) * _LINE
        self.between = _aligned(np.zeros(3 * row, np.float32)).reshape(3, row)  # no kernel lets another thread in
        self._spare: list[np.ndarray] = []  # what batches take, and put back: BLAS does let others in

    def batch(self, x: np.ndarray) -> np.ndarray:
        """Evaluate for many samples. Shapes: ``x`` (n, inputs); returns (n, outputs)."""
        out = np.empty((len(x), self.outputs), np.float32)
        with self.memory() as memory:
            for here in self.pieces(len(x)):
                self.piece(x[here], memory, out[here])
        out += self.bias
        return out

    def pieces(self, n: int) -> list[slice]:
        """Rows of a batch that go through together."""
        count = -(-n // self._rows)
        return [slice(n * i // count, n * (i + 1) // count) for i in range(count)]

    def piece(self, h: np.ndarray, memory: np.ndarray, out: np.ndarray) -> None:
        """Evaluate for the rows of a piece, (rows, inputs), all but the last biases, into ``out`` (rows, outputs)."""
        *hidden, (last, _) = self._layers
        activate, rows = _activate(self.activation), len(h)
        for i, ((weight, bias), tile) in enumerate(zip(hidden, self._tiles)):
            flat = memory[i % 2, : rows * len(bias)]
            h = np.matmul(h, weight, out=flat.reshape(rows, len(bias)))
            activate(flat, tile)
        np.matmul(h, last, out=out)

    @contextmanager
    def memory(self) -> Iterator[np.ndarray]:
        """Lend memory for the layers of a piece, the same to one after another."""
        spare = self._spare
        memory = spare.pop() if spare else np.empty((2, self._rows * self._most), np.float32)
        try:
            yield memory
        finally:
            spare.append(memory)

    @property
    def _rows(self) -> int:
        return max(1, PIECE // self._most)


class CompiledDecoder:
    """From the filter's state to the estimate: one call for a single sample, a few for each piece of a batch.

    The coordinates in which the network sees z are a matrix product, as its first layer is: they are one, in float64.
    (The coordinates are differences of filter states that are much alike, of which float32 would leave little.)

    Shapes: ``whiten`` (size, modes), ``offset`` (modes,), ``x_offset``, ``x_scale`` (nx,).
    """

    def __init__(
        self,
        layers: Layers,
        activation: str,
        *,
        whiten: np.ndarray,
        offset: np.ndarray,
        conditions: Sequence[float],
        age: tuple[float, float] | None,
        x_offset: np.ndarray,
        x_scale: np.ndarray,
    ) -> None:
        self._network = CompiledNetwork(layers[1:], activation)
        weight, bias = (part.astype(float) for part in layers[0])
        modes, given = len(offset), len(offset) + len(conditions)
        of_age = np.zeros_like(bias) if age is None else weight[given]
        bias = bias + offset @ weight[:modes] + np.array(conditions, dtype=float) @ weight[modes:given]
        self._first = np.vstack([bias, of_age, whiten @ weight[:modes]])  # (2 + size, outputs)
        self._age_unit, self._age_max = age or (1.0, 0.0)
        self._sums = np.empty(self._first.shape[1])
        self._units = np.array([x_offset, x_scale], dtype=float)
        network = self._network
        self._one = functools.partial(
            _decode(activation),
            self._first,
            self._sums,
            network.packed,
            network.widths,
            network.between,
            self._units,
            float(self._age_unit),
            float(self._age_max),
        )

    def single(self, z: np.ndarray, age: float) -> np.ndarray:
        """Estimate for one sample. Shapes: ``z`` (size,); returns (nx,)."""
        x_hat = np.empty(self._network.outputs)
        self._one(z, age, x_hat)
        return x_hat

    def batch(self, z: np.ndarray, age: float | np.ndarray) -> np.ndarray:
        """Estimate for many samples. Shapes: ``z`` (n, size), ``age`` (n,); returns (n, nx)."""
        network, n, width = self._network, len(z), len(self._sums)
        enter, finish = _batch_kernels(network.activation)
        ages = np.full(n, np.log1p(np.minimum(age, self._age_max) / self._age_unit))  # to Numba, of one type
        x_hat = np.empty((n, network.outputs))
        pieces = network.pieces(n)
        most = max(piece.stop - piece.start for piece in pieces)
        sums = np.empty((most, width))
        out = np.empty((most, network.outputs), np.float32)
        with network.memory() as memory:
            for here in pieces:
                rows = here.stop - here.start
                np.matmul(z[here], self._first[2:], out=sums[:rows])
                entered = memory[1, : rows * width].reshape(rows, width)  # which is free until the second layer
                enter(sums, self._first, ages[here], entered)
                network.piece(entered, memory, out[:rows])
                finish(out, network.bias, self._units, x_hat[here])
        return x_hat


def available() -> bool:
    """Whether Numba is installed."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True


def _aligned(values: np.ndarray) -> np.ndarray:
    """A copy that begins with a line of the cache: one that lies across two costs a single sample a quarter."""
    memory = np.empty(len(values) + _LINE, np.float32)
    first = -memory.ctypes.data % (4 * _LINE) // 4
    memory[first : first + len(values)] = values
    return memory[first : first + len(values)]


def _padded(weight: np.ndarray) -> np.ndarray:
    """Weights with rows of zeros, for as many inputs as the loop takes at once."""
    return np.pad(weight, ((0, -len(weight) % UNROLLED), (0, 0)))


@functools.cache
def _decode(activation: str) -> Callable[..., None]:
    """The first layer on z and age, and the network behind it, for one sample."""
    active, evaluate = _active(activation), single_network(activation)

    @fast_kernel
    def decode(
        first: np.ndarray,
        sums: np.ndarray,
        packed: np.ndarray,
        widths: np.ndarray,
        between: np.ndarray,
        units: np.ndarray,
        age_unit: float,
        age_max: float,
        z: np.ndarray,
        age: float,
        out: np.ndarray,
    ) -> None:
        width, size, entered, found = len(sums), len(z), between[0], between[2]
        age = math.log1p(min(age, age_max) / age_unit)
        for j in range(width):
            sums[j] = first[0, j] + age * first[1, j]
        for i in range(0, size - 1, 2):
            a, b = z[i], z[i + 1]
            for j in range(width):
                sums[j] += a * first[i + 2, j] + b * first[i + 3, j]
        if size % 2:
            for j in range(width):
                sums[j] += z[size - 1] * first[size + 1, j]
        for j in range(width):
            entered[j] = active(np.float32(sums[j]))
        evaluate(entered[:width], packed, widths, between, found[: len(out)])
        for j in range(len(out)):
            out[j] = units[0, j] + units[1, j] * found[j]

    return decode


@functools.cache
def _batch_kernels(activation: str) -> tuple[Any, Any]:
    """What follows the first layer's matrix product, and what follows the last one's, for the rows of a piece."""
    active = _active(activation)

    @fast_kernel
    def enter(sums: np.ndarray, first: np.ndarray, ages: np.ndarray, entered: np.ndarray) -> None:
        bias, of_age = first[0], first[1]
        for row in range(len(ages)):
            age = ages[row]
            for j in range(len(bias)):
                entered[row, j] = active(np.float32(sums[row, j] + bias[j] + age * of_age[j]))

    @kernel()
    def finish(h: np.ndarray, bias: np.ndarray, units: np.ndarray, out: np.ndarray) -> None:
        for row in range(len(out)):
            for j in range(len(bias)):
                out[row, j] = units[0, j] + units[1, j] * (h[row, j] + bias[j])

    return enter, finish


@functools.cache
def _active(activation: str) -> Any:
    """An activation of one number in float32."""
    return fast_part(_ACTIVATIONS[activation]())


@functools.cache
def _activate(activation: str) -> Any:
    """Bias and activation of a batch's layer in place."""
    active = _active(activation)

    @fast_kernel
    def activate(h: np.ndarray, tile: np.ndarray) -> None:
        for first in range(0, len(h), len(tile)):
            part = h[first : first + len(tile)]
            for j in range(len(part)):
                part[j] = active(part[j] + tile[j])

    return activate


@functools.cache
def single_network(activation: str) -> Callable[..., None]:
    """A whole network for one sample."""
    active = _active(activation)

    @fast_part
    def evaluate(x: np.ndarray, packed: np.ndarray, widths: np.ndarray, between: np.ndarray, out: np.ndarray) -> None:
        h, into, at = between[0], between[1], 0
        for j in range(len(x)):
            h[j] = x[j]
        for layer in range(len(widths) - 1):
            inputs, width = widths[layer], widths[layer + 1]
            for j in range(inputs, inputs + UNROLLED):
                h[j] = 0.0  # beside the rows of zeros
            for j in range(width):
                into[j] = packed[at + j]
            at += width
            for i in range(0, inputs, UNROLLED):
                a, b, c, d = h[i], h[i + 1], h[i + 2], h[i + 3]
                first, second = packed[at : at + width], packed[at + width : at + 2 * width]
                third, fourth = packed[at + 2 * width : at + 3 * width], packed[at + 3 * width : at + 4 * width]
                for j in range(width):
                    into[j] += a * first[j] + b * second[j] + c * third[j] + d * fourth[j]
                at += 4 * width
            if layer < len(widths) - 2:
                for j in range(width):
                    into[j] = active(into[j])
            h, into = into, h
        for j in range(len(out)):
            out[j] = h[j]

    return evaluate


def _tanh() -> Callable[[Any], Any]:
    """A quotient of polynomials in x^2 that is tanh(x)/x to 2e-8, and to 4e-7 with the rounding of float32.

    Loops take many values of it at a time. The coefficients are those of the least relative error.
    """
    p = tuple(map(np.float32, (2.40733336e-11, -1.48956287e-08, 9.93605136e-06, 2.99177715e-03, 1.29846185e-01, 1.0)))
    q = tuple(map(np.float32, (2.38041306e-04, 2.40518041e-02, 4.63179380e-01, 1.0)))
    end = np.float32(7.90531110763549805)  # beyond which float32 knows no difference to 1

    def tanh(x: Any) -> Any:
        x = -end if x < -end else x
        x = end if x > end else x
        s = x * x
        above = ((((p[0] * s + p[1]) * s + p[2]) * s + p[3]) * s + p[4]) * s + p[5]
        return x * above / (((q[0] * s + q[1]) * s + q[2]) * s + q[3])

    return tanh


def _silu() -> Callable[[Any], Any]:
    tanh, half = fast_part(_tanh()), np.float32(0.5)

    def silu(x: Any) -> Any:
        x = half * x  # as observers.network has it
        return x + x * tanh(x)

    return silu


def _relu() -> Callable[[Any], Any]:
    zero = np.float32(0.0)

    def relu(x: Any) -> Any:
        return zero if x < zero else x

    return relu


_ACTIVATIONS = {"tanh": _tanh, "silu": _silu, "relu": _relu}
