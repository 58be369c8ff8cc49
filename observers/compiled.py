"""Networks as machine code, where Numba is installed: batches, whose matrix products are NumPy's, and T_inv's arrays.

A batch goes through in pieces that stay in the processor's cache, into memory that is there already. Its products are
NumPy's, which is BLAS at the machine's limit.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

PIECE = 2**15  # values of a layer that a batch computes at once: they fit into the second cache
_TILE = 256  # biases that lie one after another for some rows: in loops as short as a narrow layer much would be lost

Layers = Sequence[tuple[np.ndarray, np.ndarray]]
"""Weights (inputs, outputs) and biases (outputs,) in float32."""


class CompiledNetwork:
    """A multilayer perceptron; ImportError without Numba.

    Attributes
    ----------
    packed : ndarray
        Biases and weights of each layer, with as many rows of zeros that the kernel takes four rows at once.
    shape : ndarray
        The number of the activation, and the widths.
    bias : ndarray, shape (outputs,)
        Of the last layer.
    """

    def __init__(self, layers: Layers, activation: str, inputs: int) -> None:
        from observers import network_kernel

        self._layers, self._kernels = layers, network_kernel
        self.kind = network_kernel.ACTIVATIONS.index(activation)
        self.shape = np.array([self.kind, inputs, *(len(bias) for _, bias in layers)])
        self._most = int(self.shape[1:].max())
        self._tiles = [np.tile(bias, -(-_TILE // len(bias))) for _, bias in layers[:-1]]
        padded = [np.pad(weight, ((0, -len(weight) % network_kernel.UNROLLED), (0, 0))) for weight, _ in layers]
        parts = [part.ravel() for weight, (_, bias) in zip(padded, layers) for part in (bias, weight)]
        self.packed = np.concatenate([np.zeros(0, np.float32), *parts])
        self.bias = layers[-1][1] if layers else np.zeros(inputs, np.float32)
        self._spare: list[np.ndarray] = []  # what batches take, and put back: BLAS lets other threads in

    def batch(self, x: np.ndarray) -> np.ndarray:
        """Evaluate for many samples. Shapes: ``x`` (n, inputs); returns (n, outputs)."""
        out = np.empty((len(x), len(self.bias)), np.float32)
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
        rows = len(h)
        for i, ((weight, bias), tile) in enumerate(zip(hidden, self._tiles)):
            flat = memory[i % 2, : rows * len(bias)]
            h = np.matmul(h, weight, out=flat.reshape(rows, len(bias)))
            self._kernels.activate(flat, tile, self.kind)
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

    Attributes
    ----------
    network : tuple of ndarray
        What :func:`observers.network_kernel.decode` takes.
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
        weight, bias = (part.astype(float) for part in layers[0])
        self._network = network = CompiledNetwork(layers[1:], activation, len(bias))
        modes, given = len(offset), len(offset) + len(conditions)
        of_age = np.zeros_like(bias) if age is None else weight[given]
        bias = bias + offset @ weight[:modes] + np.array(conditions, dtype=float) @ weight[modes:given]
        first = np.vstack([bias, of_age, whiten @ weight[:modes]])  # (2 + size, outputs)
        units, ages = np.array([x_offset, x_scale], dtype=float), np.array(age or (1.0, 0.0), dtype=float)
        self.network, self.has_layers = (first, units, ages, network.packed, network.shape), len(layers) > 1
        self.widest = int(max(network.shape[1:].max(), len(x_offset)))
        self._kernels = network._kernels

    def single(self, z: np.ndarray, age: float) -> np.ndarray:
        """Estimate for one sample. Shapes: ``z`` (size,); returns (nx,)."""
        x_hat = np.empty(self.network[1].shape[1])
        self._kernels.decode_one(z, age, self.network, x_hat)
        return x_hat

    def batch(self, z: np.ndarray, age: float | np.ndarray) -> np.ndarray:
        """Estimate for many samples. Shapes: ``z`` (n, size), ``age`` (n,); returns (n, nx)."""
        network, n = self._network, len(z)
        first, units, (unit, end), _, _ = self.network
        width, outputs = first.shape[1], units.shape[1]
        ages = np.full(n, np.log1p(np.minimum(age, end) / unit))  # to Numba, of one type
        x_hat = np.empty((n, outputs))
        pieces = network.pieces(n)
        most = max((piece.stop - piece.start for piece in pieces), default=0)
        sums = np.empty((most, width))
        out = np.empty((most, outputs), np.float32)
        with network.memory() as memory:
            for here in pieces:
                rows = here.stop - here.start
                np.matmul(z[here], first[2:], out=sums[:rows])
                entered = memory[1, : rows * width].reshape(rows, width)  # which is free until the second layer
                self._kernels.enter(sums, first, ages[here], network.kind, entered)
                network.piece(entered, memory, out[:rows])
                self._kernels.finish(out, network.bias, units, x_hat[here])
        return x_hat


def available() -> bool:
    """Whether Numba is installed."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True
