"""Training, validation and held-out clips, by room: no room is on two sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.errors import ConfigurationError


@dataclass(frozen=True)
class Split:
    """Rows of each part, and how they were parted.

    Attributes:
        train, validation, held_out: (n,) int64.
        held_out_groups: names of the rooms that were kept aside.
        validation_by: ``group``, or ``pair`` where one room is left to train on.
    """

    train: Int64
    validation: Int64
    held_out: Int64
    held_out_groups: tuple[str, ...]
    validation_by: str


def split_by_group(
    groups: Sequence[str],
    pairs: Sequence[str],
    *,
    held_out_share: float,
    held_out_groups: Sequence[str] = (),
    validation_share: float = 0.15,
    seed: int = 0,
) -> Split:
    """Part clips so that early stopping sees no held-out room.

    Args:
        groups: of each clip, e.g. its room.
        pairs: of each clip, its pair of objects.
        held_out_share: share of the groups to keep aside, at least one.
        held_out_groups: these and no others, where given.
        validation_share: share of the rest that decides when to stop.
        seed: of the choice.

    Raises:
        ConfigurationError: where there are fewer than two groups, or unknown ones are named.
    """
    names = sorted(set(groups))
    unknown = sorted(set(held_out_groups) - set(names))
    if unknown:
        raise ConfigurationError(
            f"held-out groups {', '.join(unknown)} are none of the clips': {', '.join(names)}"
        )
    if len(names) < 2 or len(set(held_out_groups)) == len(names):
        raise ConfigurationError(
            f"the clips are of {len(names)} group(s), {len(set(held_out_groups))} of them held "
            "out: wanted at least one to train on and one to hold out"
        )
    generator = np.random.default_rng(seed)
    chosen = set(held_out_groups) or _choose(generator, names, held_out_share)
    held_out = np.array([group in chosen for group in groups])
    rest = [name for name in names if name not in chosen]
    by_group = len(rest) > 1
    units = np.array(groups if by_group else pairs)
    candidates = sorted(set(units[~held_out].tolist()))
    if len(candidates) < 2:
        raise ConfigurationError("the clips to train on are of one pair: wanted at least two")
    validating = np.isin(units, sorted(_choose(generator, candidates, validation_share)))
    validating &= ~held_out
    return Split(
        np.flatnonzero(~held_out & ~validating).astype(np.int64),
        np.flatnonzero(validating).astype(np.int64),
        np.flatnonzero(held_out).astype(np.int64),
        tuple(sorted(chosen)),
        "group" if by_group else "pair",
    )


def _choose(generator: np.random.Generator, names: Sequence[str], share: float) -> set[str]:
    """A share of the names, at least one and never all."""
    count = min(max(1, round(share * len(names))), len(names) - 1)
    return {names[place] for place in generator.permutation(len(names))[:count].tolist()}
