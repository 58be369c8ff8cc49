"""Episodes of several environments as they happen, kept as records."""

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from observers import Artifact
from training.records import Record, Signals, check_dt, resampled
from training.sources.recorded import check_plant

LONGEST = 250  # steps of a piece: episodes without an end are cut, so that some of each can be held out


@dataclass
class _Piece:
    """Samples of one row since its reset, or since it was cut."""

    y: list[np.ndarray] = field(default_factory=list)
    x: list[np.ndarray] = field(default_factory=list)
    u: list[np.ndarray] = field(default_factory=list)
    sample: int = 0  # the number of the last one
    goes_on: bool = False  # whether the row may be further than its first sample


class Gathering:
    """What an observer and who knows the hidden signals have seen, as far as it is kept."""

    def __init__(
        self, artifact: Artifact, *, keep: int, held_out: float, outputs: str = "y", before: Sequence[Record] = ()
    ) -> None:
        signals, self._environment = artifact.signals or {}, artifact.environment or {}
        names = (tuple(signals[role]) for role in ("measured", "inputs", "hidden"))
        self._outputs = outputs
        self._signals, self._dt, self._nx = Signals("t", *names), artifact.filter.dt, artifact.nx
        self._keep, self._every = keep, max(2, round(1 / held_out)) if held_out else 0
        self._open = defaultdict[int, _Piece](_Piece)  # by row
        self._kept: deque[tuple[bool, Record]] = deque()
        self._total = self._made = self.steps = 0
        check_dt(before, self._dt)
        for record in before:
            check_plant(artifact, record)
            self._take_before(resampled(record, self._dt))

    def begin(self, row: int, info: Mapping[str, Any], *, goes_on: bool = False) -> None:
        """Take in the first sample of an episode."""
        self._close(row)
        piece = self._open[row] = _Piece(goes_on=goes_on)
        if self._outputs in info:
            piece.y, piece.x = [np.array(info[self._outputs])], [info.get("x", np.full(self._nx, np.nan))]

    def add(self, row: int, info: Mapping[str, Any]) -> None:
        """Take in the sample after a step."""
        if missing := [key for key in (self._outputs, "u", "x", "sample") if key not in info]:
            raise ValueError(
                f"info of environment {row} has no {', '.join(map(repr, missing))}: KKLObservation tells the true "
                f"{', '.join(self._signals.hidden)} as 'x' where the environment inside shows them at each step; an "
                "observer is refitted there alone; training.agents.SB3VecEnv passes on what its info_keys name, "
                "('y', 'u', 'x', 'sample')"
            )
        piece, sample = self._open[row], int(info["sample"])
        if piece.y and sample != piece.sample + 1:
            if not piece.goes_on:
                raise ValueError(
                    f"environment {row} showed sample {sample} after {piece.sample}: put wrappers that skip steps, "
                    "such as ActionRepeat, inside KKLObservation while observers are refitted"
                )
            piece = self._open[row] = _Piece()
        if piece.y:
            piece.u.append(info["u"])
        piece.y.append(np.array(info[self._outputs]))
        piece.x.append(info["x"])
        piece.sample, piece.goes_on = sample, False
        self.steps += 1
        if len(piece.u) == LONGEST:
            self._cut(row)

    def records(self) -> tuple[list[Record], list[Record]]:
        """What is kept, with the episodes that are under way as far as they have come."""
        for row, piece in self._open.items():
            if piece.u:
                self._cut(row)
        return [record for held, record in self._kept if not held], [record for held, record in self._kept if held]

    def _cut(self, row: int) -> None:
        """End a piece; the next one begins with its last sample."""
        piece = self._open[row]
        self._close(row)
        self._open[row] = _Piece(piece.y[-1:], piece.x[-1:], sample=piece.sample)

    def _close(self, row: int) -> None:
        piece = self._open[row]
        if not piece.u or np.isnan(piece.x).all():
            return
        n, inputs = len(piece.y), self._signals.inputs
        record = Record(
            f"{self._environment['id']}, piece {self._made}",
            self._dt * np.arange(n),
            np.stack(piece.y),
            np.stack([*piece.u, piece.u[-1]]) if inputs else None,
            np.stack(piece.x),
            self._signals,
            source=self._environment["id"],
            environment=self._environment,
        )
        self._take(record, held_out=bool(self._every) and self._made % self._every == 1)
        self._made += 1

    def _take_before(self, record: Record) -> None:
        """Take in an episode from before in pieces, without inputs where the observer has none."""
        u = record.u if self._signals.inputs else None
        record = replace(record, u=u, signals=self._signals)
        for begin in range(0, len(record.t) - 1, LONGEST):
            piece = record.part(slice(begin, begin + LONGEST + 1))
            if piece.x is not None:
                self._take(piece, held_out=False)

    def _take(self, record: Record, *, held_out: bool) -> None:
        self._kept.append((held_out, record))
        self._total += len(record.t) - 1
        while self._total > self._keep and len(self._kept) > 1:
            self._total -= len(self._kept.popleft()[1].t) - 1


__all__ = ["Gathering"]
