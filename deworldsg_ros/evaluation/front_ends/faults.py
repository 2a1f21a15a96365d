"""Faults of detections that persist over frames, made on purpose, as plain values."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.poses.perturbation import parse_numbers

SHARES = ("label", "bleed", "merge", "cut")
# False boxes that can be in view at once.
MOST_FALSE_BOXES = 8


@dataclass(frozen=True)
class Faults:
    """What goes on being wrong with detections for a while, and how often.

    Time is cut into spells, for each object and fault at other moments, and a share of them is
    affected from end to end.

    Attributes:
        label: share of spells in which an object is called the same other class throughout.
        false: mean number of boxes in view on what is no object; half of them stay at a place of
            the room, half move through the image.
        bleed: share of spells in which a mask takes in a strip of whatever is beside it.
        merge: share of spells in which a mask takes in all of the neighbour with which it shares
            the longest border, which is then not detected.
        cut: share of spells in which a mask covers a part of its object only.
        spell_s: length of a spell, seconds.
        false_s: how long a false box is there, seconds.

    Raises:
        EvaluationError: for what is no share, negative or not finite.
    """

    label: float = 0.0
    false: float = 0.0
    bleed: float = 0.0
    merge: float = 0.0
    cut: float = 0.0
    spell_s: float = 2.0
    false_s: float = 0.5

    def __post_init__(self) -> None:
        for name in SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise EvaluationError(f"fault {name}={getattr(self, name):g}: wanted 0 to 1")
        if not 0.0 <= self.false <= MOST_FALSE_BOXES:
            raise EvaluationError(f"fault false={self.false:g}: wanted 0 to {MOST_FALSE_BOXES}")
        for name in ("spell_s", "false_s"):
            # Shorter than a millisecond is shorter than any camera's frame.
            if not 1e-3 <= getattr(self, name) < math.inf:
                raise EvaluationError(f"fault {name}={getattr(self, name):g}: wanted seconds > 0")

    def describe(self) -> str:
        """What is not as by default: ``label 0.1 spell_s 1``; empty without faults."""
        names = [field.name for field in fields(self)]
        changed = [name for name in names if getattr(self, name) != getattr(Faults, name)]
        return " ".join(f"{name} {getattr(self, name):g}" for name in changed)


def parse_faults(text: str) -> Faults:
    """Faults of ``name=number,name=number,…``; raises ConfigurationError, EvaluationError."""
    return Faults(**parse_numbers(text, [field.name for field in fields(Faults)], "fault"))
