"""What a benchmark returns: figures, by name, with what they are compared with."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


class MissingError(Exception):
    """Something that the benchmark needs is not on this machine, e.g. a recording."""


@dataclass(frozen=True)
class Setup:
    """What every benchmark is given.

    Attributes:
        data: folder with ``redkitchen/`` and ``rooms/``; None = not on this machine.
        quick: few rounds and small graphs: the benchmark works, its figures say little.
    """

    data: Path | None = None
    quick: bool = False

    def folder(self, name: str) -> Path:
        """A folder of `data`; raises `MissingError`."""
        if self.data is None or not (self.data / name).is_dir():
            raise MissingError(f"no folder {name} below --data {self.data}")
        return self.data / name


@dataclass(frozen=True)
class Figure:
    """One measured number.

    Attributes:
        name: of the figure, unique in a run, e.g. ``update_10000_nodes``.
        value: in `unit`.
        unit: e.g. ``ms``, ``frames/s``.
        target: the value to reach; None = none.
        more_is_better: whether a larger value is better; it is for rates and ratios.
        reference: what `reference_value` and `ratio` compare with; empty = nothing.
        reference_value: of the reference in the same run, in `unit`.
        ratio: how many times as good as the reference: the median of pairs that ran in turn.
        ratio_target: the ratio to reach; None = none.
        note: what was measured, in one sentence.
    """

    name: str
    value: float
    unit: str
    target: float | None = None
    more_is_better: bool = False
    reference: str = ""
    reference_value: float | None = None
    ratio: float | None = None
    ratio_target: float | None = None
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether all targets are reached; None without a target."""
        met = []
        if self.target is not None:
            better = self.value >= self.target if self.more_is_better else self.value <= self.target
            met.append(better)
        if self.ratio_target is not None:
            met.append(self.ratio is not None and self.ratio >= self.ratio_target)
        return all(met) if met else None


@dataclass(frozen=True)
class Paired:
    """Two implementations that ran in turn: median milliseconds, and the median of the ratios."""

    ours_ms: float
    reference_ms: float
    ratio: float


def in_turn(
    ours: Callable[[], object],
    reference: Callable[[], object],
    rounds: int,
    clock: Callable[[], float] = time.process_time,
) -> Paired:
    """Time two calls in turn. The default clock is the processor time of all threads."""
    pairs = []
    for _ in range(rounds):
        start = clock()
        ours()
        middle = clock()
        reference()
        pairs.append((middle - start, clock() - middle))
    return Paired(
        1e3 * statistics.median(a for a, _ in pairs),
        1e3 * statistics.median(b for _, b in pairs),
        statistics.median(b / a for a, b in pairs),
    )
