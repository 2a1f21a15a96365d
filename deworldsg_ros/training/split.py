"""Training, validation and held-out clips. The clips of one room stay together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.errors import ConfigurationError


@dataclass(frozen=True)
class Split:
    """Rows of the clips in each part.

    Attributes:
        train, validation, held_out: (n,) int64 rows.
        held_out_groups: names of the held-out rooms.
        validation_by: ``group``, or ``pair`` if only one room is left to train on.
    """

    train: Int64
    validation: Int64
    held_out: Int64
    held_out_groups: tuple[str, ...]
    validation_by: str

    def parts(self) -> dict[str, Int64]:
        """The rows of each part by its name."""
        return {"train": self.train, "validation": self.validation, "held_out": self.held_out}


def split_by_group(
    groups: Sequence[str],
    pairs: Sequence[str],
    *,
    held_out_fraction: float,
    held_out_groups: Sequence[str] = (),
    seed: int = 0,
) -> Split:
    """Split clips so that early stopping uses no held-out room.

    Args:
        groups: group of each clip, e.g. its room.
        pairs: pair of objects of each clip.
        held_out_fraction: fraction of the groups to hold out, at least one group.
        held_out_groups: hold out exactly these groups instead.
        seed: of the random choice.

    Raises:
        ConfigurationError: fewer than two groups, or an unknown held-out group.
    """
    names = sorted(set(groups))
    unknown = sorted(set(held_out_groups) - set(names))
    if unknown:
        raise ConfigurationError(
            f"held-out groups {', '.join(unknown)} have no clips: "
            f"expected some of {', '.join(names)}"
        )
    if len(names) < 2 or len(set(held_out_groups)) == len(names):
        raise ConfigurationError(
            f"the clips have {len(names)} group(s), {len(set(held_out_groups))} of them held out: "
            "expected at least one to train on and one to hold out"
        )
    generator = np.random.default_rng(seed)
    chosen = set(held_out_groups) or _choose(generator, names, held_out_fraction)
    held_out = np.array([group in chosen for group in groups])
    rest = [name for name in names if name not in chosen]
    by_group = len(rest) > 1
    units = np.array(groups if by_group else pairs)
    candidates = sorted(set(units[~held_out].tolist()))
    if len(candidates) < 2:
        raise ConfigurationError(
            "the training clips have one pair of objects: expected at least two pairs"
        )
    # 15 % of the rest decide when the training stops.
    validating = np.isin(units, sorted(_choose(generator, candidates, 0.15)))
    validating &= ~held_out
    return Split(
        np.flatnonzero(~held_out & ~validating).astype(np.int64),
        np.flatnonzero(validating).astype(np.int64),
        np.flatnonzero(held_out).astype(np.int64),
        tuple(sorted(chosen)),
        "group" if by_group else "pair",
    )


def _choose(generator: np.random.Generator, names: Sequence[str], fraction: float) -> set[str]:
    """A fraction of the names, at least one and never all."""
    count = min(max(1, round(fraction * len(names))), len(names) - 1)
    return {names[index] for index in generator.permutation(len(names))[:count].tolist()}
