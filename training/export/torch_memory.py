"""The memory of :class:`kkl_gym.KKLMemory` as a module of Torch."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from kkl_gym.memory import IMAGINED, Memory
from training.export.torch_parts import Module


class TorchMemory(Module):
    """The memory of :class:`kkl_gym.KKLMemory` as a module of Torch: batched, differentiable, on any device.

    A state row of zeros marks a start: the next outputs are the row's first. :meth:`start` returns such rows, and
    ``state * ~done[:, None]`` restarts the rows of finished episodes.

    Parameters
    ----------
    ny, nu : int
        Numbers of outputs and inputs.
    angles : sequence of (int, int), optional
        Pairs of outputs that are cosine and sine of an angle, as for :class:`kkl_gym.KKLMemory`.
    time_constants, input_time_constants : sequence of float
        Time constants of the memories of y and of u in steps, as for :class:`kkl_gym.KKLMemory`.

    Raises
    ------
    ValueError
        If time constants are invalid, or ``angles`` are not pairs of outputs.

    Examples
    --------
    >>> import torch
    >>> from training import TorchMemory
    >>> memory = TorchMemory(3, 1, angles=[(0, 1)])
    >>> state, shown = memory(memory.start(1024), torch.zeros(1024, 3))
    >>> shown.shape
    torch.Size([1024, 13])
    """

    def __init__(
        self,
        ny: int,
        nu: int,
        *,
        angles: Sequence[tuple[int, int]] = (),
        time_constants: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
        input_time_constants: Sequence[float] = (1.0, 4.0),
    ) -> None:
        pairs = np.asarray(angles) if np.size(angles) else np.empty((0, 2), dtype=int)
        if pairs.dtype.kind not in "iu" or pairs.shape[1:] != (2,) or len({*pairs.flat} & {*range(ny)}) < pairs.size:
            raise ValueError(f"angles must be pairs of different outputs, from 0 to {ny - 1}, got {angles!r}")
        super().__init__()
        self.cosines, self.sines = pairs.T.tolist()
        self.others = [i for i in range(ny) if i not in pairs]
        signals, self.nu = len(self.others) + len(pairs), nu
        memory = Memory(signals, nu, time_constants=time_constants, input_time_constants=input_time_constants)
        self.widths = [1, signals, signals * len(memory.decay), nu * len(memory.input_decay)]
        self.put(decay=memory.decay[:, None], input_decay=memory.input_decay[:, None], rise=memory.rise[:, None])
        self.put(mixing=memory.mixing, time_constants=np.array(memory.time_constants)[:, None])

    def start(self, n: int) -> Tensor:
        """Return the state of n rows before their first outputs: zeros, (n, width)."""
        return self.mixing.new_zeros(n, sum(self.widths))

    def forward(self, state: Tensor, y: Tensor, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Process the next outputs.

        Parameters
        ----------
        state : Tensor, shape (n, width)
            The state that the last step returned, or :meth:`start`.
        y : Tensor, shape (n, ny)
            The outputs.
        u : Tensor, shape (n, nu), optional
            The inputs that led to these outputs, by default zero; at a start they are ignored.

        Returns
        -------
        state : Tensor, shape (n, width)
            The next state.
        shown : Tensor, shape (n, size)
            The observation of the wrapper KKLMemory: y, the memory of y, and the memory of u; float32 unless ``y`` is
            float64.
        """
        begins = state[:, :1] == 0
        age, before, w, v = torch.split(torch.where(begins, 0.0, state), self.widths, 1)
        signals = self._signals(y.to(state.dtype), before)
        u = torch.where(begins, 0.0, y.new_zeros(1, self.nu) if u is None else u.to(state.dtype))
        w = self.decay * w.reshape(-1, len(self.decay), signals.shape[1])
        w = w + self.rise * torch.where(begins, 0.0, signals - before)[:, None]
        v = v.reshape(-1, len(self.input_decay), self.nu)
        v = (v + (1.0 - self.input_decay) * (u[:, None] - v)).flatten(1)
        steps = age[..., None].clamp(min=1.0)  # at a start any positive number will do, because the memory w is 0
        with_past = torch.expm1(-(steps + IMAGINED) / self.time_constants) / torch.expm1(-steps / self.time_constants)
        shown = torch.cat([y, (self.mixing @ (w * with_past)).flatten(1), v], 1)
        shown = shown.to(torch.promote_types(y.dtype, torch.float32))
        return torch.cat([age + 1.0, signals, w.flatten(1), v], 1), shown

    def _signals(self, y: Tensor, before: Tensor) -> Tensor:
        """Return the signals to filter: plain outputs, then angles, unwrapped to steps of at most half a turn."""
        cosine, sine, before = y[:, self.cosines], y[:, self.sines], before[:, len(self.others) :]
        known = cosine**2 + sine**2 > 0
        angle = torch.atan2(sine, torch.where(known, cosine, 1.0))
        angle = angle - 2 * math.pi * torch.round((angle - before) / (2 * math.pi))
        return torch.cat([y[:, self.others], torch.where(known, angle, before)], 1)
