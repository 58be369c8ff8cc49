"""Multilayer perceptrons."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from observers.checks import choice, real_array, shown

_PIECE = 2**15  # largest number of a layer's values that are computed together; they fit the second-level cache
UNROLLED = 4  # number of a layer's inputs that the machine code processes together


def _tanh(h: np.ndarray) -> np.ndarray:
    np.tanh(h, out=h)
    return h


def _silu(h: np.ndarray) -> np.ndarray:
    h *= 0.5  # h sigmoid(h) = h/2 + h/2 tanh(h/2), which cannot overflow
    h += h * np.tanh(h)
    return h


def _relu(h: np.ndarray) -> np.ndarray:
    return np.maximum(h, 0.0, out=h)


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"tanh": _tanh, "silu": _silu, "relu": _relu}


@dataclass(frozen=True)
class MLP:
    """A multilayer perceptron in float32. Raises ValueError if shapes do not fit, or numbers are not finite.

    Parameters
    ----------
    weights : sequence of ndarray, shape (outputs, inputs) each
        The weights of each layer, as torch stores them.
    biases : sequence of ndarray, shape (outputs,) each
        The biases of each layer.
    activation : {"tanh", "silu", "relu"}
        The activation after every layer except the last.
    """

    weights: Sequence[np.ndarray]
    biases: Sequence[np.ndarray]
    activation: str
    layers: list[tuple[np.ndarray, np.ndarray]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        choice("the activation", self.activation, ACTIVATIONS)
        for name in ("weights", "biases"):
            arrays = getattr(self, name)
            if not isinstance(arrays, Sequence) or isinstance(arrays, str | bytes):
                raise ValueError(f"{name} must be a sequence of arrays, got {shown(arrays)}")
            with np.errstate(over="ignore"):  # numbers that are too large become infinite, and are rejected below
                object.__setattr__(self, name, [real_array(name, each).astype(np.float32) for each in arrays])
        if not self.weights or len(self.weights) != len(self.biases):
            raise ValueError(f"a network needs n > 0 weights and n biases, got {len(self.weights)}, {len(self.biases)}")
        width, layers = None, []
        for weight, bias in zip(self.weights, self.biases, strict=True):
            if weight.ndim != 2 or bias.shape != weight.shape[:1]:
                raise ValueError(
                    f"weights must be (outputs, inputs), biases (outputs,), got {weight.shape} and {bias.shape}"
                )
            if width not in (None, weight.shape[1]):
                raise ValueError(f"weights of shape {weight.shape} cannot follow a layer of {width} outputs")
            layers.append((np.ascontiguousarray(weight.T), bias))
            if not all(np.isfinite(values).all() for values in layers[-1]):
                raise ValueError("the network holds weights or biases that are not finite")
            width = len(bias)
        object.__setattr__(self, "layers", layers)

    @property
    def inputs(self) -> int:
        """Width of the input."""
        return int(self.weights[0].shape[1])

    @property
    def outputs(self) -> int:
        """Width of the output."""
        return int(self.weights[-1].shape[0])

    def part(self, outputs: slice) -> "MLP":
        """Return the same network with only some of its outputs."""
        *weights, last = self.weights
        *biases, bias = self.biases
        return MLP([*weights, last[outputs]], [*biases, bias[outputs]], self.activation)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Evaluate the network. Shapes: ``x`` (..., inputs); returns (..., outputs)."""
        h: np.ndarray = x.astype(np.float32, copy=False)
        if h.ndim > 2:
            h = h.reshape(-1, h.shape[-1])
        rows = max(1, _PIECE // max(len(bias) for _, bias in self.layers))
        if h.ndim == 2 and len(h) > rows:
            h = np.concatenate([self._evaluated(piece) for piece in np.array_split(h, -(-len(h) // rows))])
        else:
            h = self._evaluated(h)
        return h if x.ndim <= 2 else h.reshape(*x.shape[:-1], h.shape[-1])

    def _evaluated(self, h: np.ndarray) -> np.ndarray:
        activation = ACTIVATIONS[self.activation]
        *hidden, (weight, bias) = self.layers
        for w, b in hidden:
            h = h.dot(w)
            h += b
            h = activation(h)
        h = h.dot(weight)
        h += bias
        return h

    def packed(self, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the layers from ``first`` on, in the form that :func:`observers.kernel_functions.evaluate` takes.

        One array holds each layer's bias and weights (inputs, outputs), with zeros up to a multiple of UNROLLED inputs.
        The other array holds the activation's index, and the widths from the input of layer ``first`` on.
        """
        layers, (outputs, inputs) = self.layers[first:], np.shape(self.weights[max(first - 1, 0)])
        padded = [(bias, np.pad(weight, ((0, -len(weight) % UNROLLED), (0, 0)))) for weight, bias in layers]
        parts = [part.ravel() for both in padded for part in both]
        shape = [list(ACTIVATIONS).index(self.activation), outputs if first else inputs]
        packed = np.concatenate([np.zeros(0, np.float32), *parts])
        return packed, np.array(shape + [len(bias) for _, bias in layers])
