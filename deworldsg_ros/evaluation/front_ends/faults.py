"""Faults of detections that persist over frames, as picklable values."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.poses.perturbation import parse_numbers

FRACTIONS = ("label", "bleed", "merge", "cut")
# Maximum number of false detections at once.
MAX_FALSE_BOXES = 8


@dataclass(frozen=True)
class Faults:
    """Persistent faults of detections, and their rates.

    Time is divided into spells of equal length, whose start depends on object and fault. A fault
    affects an object during whole spells.

    Attributes:
        label: fraction of spells in which an object has the same wrong class throughout.
        false: mean number of false boxes in view. Half of them stay at a position in the room, half
            move through the image.
        bleed: fraction of spells in which a mask includes a strip around the object.
        merge: fraction of spells in which a mask includes the neighbour with the longest common
            border, which is then not detected.
        cut: fraction of spells in which a mask covers only a part of its object.
        spell_s: length of a spell, seconds.
        false_s: duration of a false box, seconds.

    Raises:
        EvaluationError: a value is out of range.
    """

    label: float = 0.0
    false: float = 0.0
    bleed: float = 0.0
    merge: float = 0.0
    cut: float = 0.0
    spell_s: float = 2.0
    false_s: float = 0.5

    def __post_init__(self) -> None:
        for name in FRACTIONS:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise EvaluationError(f"fault {name}={getattr(self, name):g}: expected 0 to 1")
        if not 0.0 <= self.false <= MAX_FALSE_BOXES:
            raise EvaluationError(f"fault false={self.false:g}: expected 0 to {MAX_FALSE_BOXES}")
        for name in ("spell_s", "false_s"):
            # A shorter spell is shorter than a frame of any camera.
            if not 1e-3 <= getattr(self, name) < math.inf:
                raise EvaluationError(
                    f"fault {name}={getattr(self, name):g}: expected at least 0.001 seconds"
                )

    def describe(self) -> str:
        """Values other than the defaults, e.g. ``label 0.1 spell_s 1``; empty without faults."""
        names = [field.name for field in fields(self)]
        changed = [name for name in names if getattr(self, name) != getattr(Faults, name)]
        return " ".join(f"{name} {getattr(self, name):g}" for name in changed)


def parse_faults(text: str) -> Faults:
    """Faults of ``name=number,name=number,…``; raises ConfigurationError, EvaluationError."""
    return Faults(**parse_numbers(text, [field.name for field in fields(Faults)], "fault"))
