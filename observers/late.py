"""Inputs of which the effect has not been measured yet, where outputs are late."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Pending:
    """The inputs of the last samples, (n, delay, nu), and how many there are, (n,); no method changes either."""

    inputs: np.ndarray
    count: np.ndarray

    def restarted(self, rows: np.ndarray) -> "Pending":
        """Return the inputs without those of some rows."""
        return Pending(self.inputs, np.where(rows, 0, self.count))

    def after(self, u: np.ndarray, rows: np.ndarray) -> tuple["Pending", np.ndarray, np.ndarray]:
        """Return the inputs after those of the next sample, (n, nu), in some rows.

        Also those that led to the outputs which now arrive, (n, nu), and in which of the rows one does, (n,).
        """
        delay = self.inputs.shape[1]
        due, first = rows & (self.count == delay), self.inputs[:, 0]
        inputs = np.where(due[:, None, None], np.roll(self.inputs, -1, axis=1), self.inputs)
        count, at = self.count + (rows & ~due), np.flatnonzero(rows)
        inputs[at, count[at] - 1] = u[at]
        return Pending(inputs, count), first, due
