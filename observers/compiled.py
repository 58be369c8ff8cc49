"""Networks as machine code, where Numba is installed: what lies between a batch's matrix products, or a whole sample.

A batch goes through in pieces that stay in the processor's cache, into memory that is there already. Its products are
NumPy's, which is BLAS at the machine's limit. A single sample is one call, where NumPy's own overhead would be most.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

PIECE = 256  # rows of a batch at once: their activations fit into the second cache, and overhead is not yet felt
_UNROLLED = 4  # inputs that a single sample's loop takes at once
_LINE = 16  # numbers of float32 in a line of the cache
_FAST = {"contract", "reassoc", "nsz", "arcp"}  # what may be done to sums; NaN and infinity keep their meaning

Layers = Sequence[tuple[np.ndarray, np.ndarray]]
"""Weights (inputs, outputs) and biases (outputs,) in float32."""


class CompiledNetwork:
    """A multilayer perceptron; the estimate is offset + scale * network.

    Parameters
    ----------
    layers : sequence of (ndarray, ndarray)
        Weights (inputs, outputs) and biases (outputs,) in float32.
    activation : {"tanh", "silu", "relu"}
        After every layer but the last.
    offset, scale : ndarray, shape (outputs,), optional
        What single samples are put into units with; by default they stay as they are.

    Attributes
    ----------
    activation : str
        As given.
    outputs : int
        Number of outputs.
    packed : ndarray of float32
        Biases and weights, layer by layer.
    widths : ndarray of int
        Of the inputs and of each layer.
    between : ndarray of float32
        Memory for a single sample.
    offset, scale : ndarray, shape (outputs,)
        Of single samples.

    Raises
    ------
    ImportError
        If Numba is not installed.
    """

    def __init__(
        self, layers: Layers, activation: str, *, offset: np.ndarray | None = None, scale: np.ndarray | None = None
    ) -> None:
        _kernels(activation)  # or say now that there is no Numba
        self._layers, self.activation = layers, activation
        widths = [len(layers[0][0]), *(len(bias) for _, bias in layers)]
        self.outputs = outputs = widths[-1]
        self.offset = np.zeros(outputs) if offset is None else np.array(offset, dtype=float)
        self.scale = np.ones(outputs) if scale is None else np.array(scale, dtype=float)
        self.widths = np.array(widths)
        self._most = max(widths)
        self.packed = _aligned(
            np.concatenate([part.ravel() for weight, bias in layers for part in (bias, _padded(weight))])
        )
        row = -(-(self._most + _UNROLLED) // _LINE) * _LINE
        self.between = _aligned(np.zeros(2 * row, np.float32)).reshape(2, row)  # no kernel lets another thread in
        self._spare: list[np.ndarray] = []  # what batches take, and put back: BLAS does let others in

    def single(self, x: np.ndarray) -> np.ndarray:
        """Evaluate for one sample.

        Parameters
        ----------
        x : ndarray of float32, shape (inputs,)
            Inputs.

        Returns
        -------
        ndarray, shape (outputs,)
            The estimate.
        """
        out = np.empty(self.outputs)
        _kernels(self.activation)[1](x, self.packed, self.widths, self.between, self.offset, self.scale, out)
        return out

    def batch(self, x: np.ndarray) -> np.ndarray:
        """Evaluate for many samples, as the network has it: without offset and scale.

        Parameters
        ----------
        x : ndarray of float32, shape (n, inputs)
            Inputs.

        Returns
        -------
        ndarray of float32, shape (n, outputs)
            Outputs.
        """
        *hidden, (last, offset) = self._layers
        activate = _kernels(self.activation)[0]
        out = np.empty((len(x), len(offset)), np.float32)
        spare = self._spare
        memory = spare.pop() if spare else np.empty((2, PIECE * self._most), np.float32)
        for first in range(0, len(x), PIECE):
            h = x[first : first + PIECE]
            rows = len(h)
            for i, (weight, bias) in enumerate(hidden):
                width = len(bias)
                into = memory[i % 2, : rows * width].reshape(rows, width)
                h = np.matmul(h, weight, out=into)
                activate(h, bias)
            np.matmul(h, last, out=out[first : first + PIECE])
        spare.append(memory)
        out += offset
        return out


class CompiledDecoder:
    """From the filter's state to the estimate, for one sample at a time: coordinates, network and units in one call.

    Parameters
    ----------
    network : CompiledNetwork
        With offset and scale of the states.
    whiten : ndarray, shape (size, modes)
        From z to the network's coordinates.
    offset : ndarray, shape (modes,)
        Added to them.
    conditions : sequence of float
        What the network is given behind them.
    age : (float, float), optional
        Unit and end of the age in seconds, where the network is told that too.

    Raises
    ------
    ImportError
        If Numba is not installed.
    """

    def __init__(
        self,
        network: CompiledNetwork,
        whiten: np.ndarray,
        offset: np.ndarray,
        *,
        conditions: Sequence[float],
        age: tuple[float, float] | None = None,
    ) -> None:
        self._network = network
        self._whiten, self._offset = np.array(whiten, order="C"), np.array(offset)
        self._conditions = np.array(conditions, dtype=float)
        self._age_unit, self._age_max = (1.0, 0.0) if age is None else age
        self._modes = np.empty(len(offset))
        self._inputs = len(offset) + len(conditions) + (age is not None)

    def __call__(self, z: np.ndarray, age: float) -> tuple[np.ndarray, np.ndarray]:
        """Estimate.

        Parameters
        ----------
        z : ndarray, shape (size,)
            The filter's state.
        age : float
            Seconds since reset.

        Returns
        -------
        inputs : ndarray of float32, shape (inputs,)
            What the network was given.
        x_hat : ndarray, shape (nx,)
            The estimate.
        """
        to, inputs = self._network, np.empty(self._inputs, np.float32)
        x_hat = np.empty(to.outputs)
        _decode(to.activation)(
            z,
            self._whiten,
            self._offset,
            self._conditions,
            min(age, self._age_max) / self._age_unit,
            self._modes,
            inputs,
            to.packed,
            to.widths,
            to.between,
            to.offset,
            to.scale,
            x_hat,
        )
        return inputs, x_hat


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
    return np.pad(weight, ((0, -len(weight) % _UNROLLED), (0, 0)))


@functools.cache
def _decode(activation: str) -> Callable[..., None]:
    """Coordinates and conditions, and the network behind them."""
    import numba

    evaluate: Any = _kernels(activation)[1]

    @numba.njit(fastmath=_FAST, error_model="numpy")
    def decode(
        z: np.ndarray,
        whiten: np.ndarray,
        z_offset: np.ndarray,
        conditions: np.ndarray,
        age: float,
        modes: np.ndarray,
        inputs: np.ndarray,
        packed: np.ndarray,
        widths: np.ndarray,
        between: np.ndarray,
        offset: np.ndarray,
        scale: np.ndarray,
        out: np.ndarray,
    ) -> None:
        n, told = len(z_offset), len(conditions)
        for j in range(n):
            modes[j] = z_offset[j]  # in loops: to compile an assignment of slices takes a second
        for i in range(len(z)):
            for j in range(n):
                modes[j] += z[i] * whiten[i, j]
        for j in range(n):
            inputs[j] = modes[j]
        for j in range(told):
            inputs[n + j] = conditions[j]
        if len(inputs) > n + told:
            inputs[n + told] = math.log1p(age)
        evaluate(inputs, packed, widths, between, offset, scale, out)

    return decode


@functools.cache
def _kernels(activation: str) -> tuple[Callable[..., None], Callable[..., None]]:
    """For an activation: bias and activation of a batch's layer in place, and a whole network for one sample."""
    import numba

    compiled = functools.partial(numba.njit, fastmath=_FAST, error_model="numpy")
    active: Any = compiled(_ACTIVATIONS[activation](compiled))

    @compiled
    def activate(h: np.ndarray, bias: np.ndarray) -> None:
        rows, width = h.shape
        for row in range(rows):
            for j in range(width):
                h[row, j] = active(h[row, j] + bias[j])

    @compiled
    def evaluate(
        x: np.ndarray,
        packed: np.ndarray,
        widths: np.ndarray,
        between: np.ndarray,
        offset: np.ndarray,
        scale: np.ndarray,
        out: np.ndarray,
    ) -> None:
        h, into, at = between[0], between[1], 0
        for j in range(len(x)):
            h[j] = x[j]
        for layer in range(len(widths) - 1):
            inputs, width = widths[layer], widths[layer + 1]
            for j in range(inputs, inputs + _UNROLLED):
                h[j] = 0.0  # beside the rows of zeros
            for j in range(width):
                into[j] = packed[at + j]
            at += width
            for i in range(0, inputs, _UNROLLED):
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
            out[j] = offset[j] + scale[j] * h[j]

    return activate, evaluate


def _tanh(compiled: Any) -> Callable[[Any], Any]:
    """A quotient of polynomials, to 3e-7: that of Eigen. Loops take many values of it at a time."""
    f = np.float32
    p = tuple(
        map(f, (-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08))
    ) + tuple(map(f, (1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03)))
    q = tuple(map(f, (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)))
    end = f(7.90531110763549805)  # beyond which float32 knows no difference to 1

    def tanh(x: Any) -> Any:
        x = -end if x < -end else x
        x = end if x > end else x
        s = x * x
        above = (((((p[0] * s + p[1]) * s + p[2]) * s + p[3]) * s + p[4]) * s + p[5]) * s + p[6]
        return x * above / (((q[0] * s + q[1]) * s + q[2]) * s + q[3])

    return tanh


def _silu(compiled: Any) -> Callable[[Any], Any]:
    tanh, half = compiled(_tanh(compiled)), np.float32(0.5)

    def silu(x: Any) -> Any:
        x = half * x  # as observers.network has it
        return x + x * tanh(x)

    return silu


def _relu(compiled: Any) -> Callable[[Any], Any]:
    zero = np.float32(0.0)

    def relu(x: Any) -> Any:
        return zero if x < zero else x

    return relu


_ACTIVATIONS = {"tanh": _tanh, "silu": _silu, "relu": _relu}
