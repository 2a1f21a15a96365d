"""The interface of world models of clips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.frame_graph import Vocabulary


@dataclass(frozen=True)
class PairContext:
    """One direction of a pair in a clip.

    Attributes:
        subject_box_xyxy, object_box_xyxy: (4,) float64 pixels of the crop, in the clip's last
            frame.
        subject_class, object_class: indices into the vocabulary's classes.
        subject_name, object_name: names of these classes.
    """

    subject_box_xyxy: Float64
    object_box_xyxy: Float64
    subject_class: int
    object_class: int
    subject_name: str
    object_name: str


@dataclass(frozen=True)
class ClipRequest:
    """One clip, and the ordered pairs to predict from it.

    Attributes:
        clip: (T, h, w, 3) uint8 RGB, oldest frame first.
        pairs: directions to predict, usually both of one pair; the clip is encoded once.
        vocabulary: its predicates are the columns of the prediction.
    """

    clip: UInt8
    pairs: tuple[PairContext, ...]
    vocabulary: Vocabulary


class WorldModel(Protocol):
    """A frozen video model with its probe: maps a clip to predicate distributions.

    A world model whose attribute `window` is ``valid_interval`` gets clips of the frames since both
    objects were seen without a break.
    """

    @property
    def name(self) -> str:
        """The `source` of its published evidence."""
        ...

    @property
    def clip_length(self) -> int:
        """T, frames of its clips."""
        ...

    def predict(self, request: ClipRequest) -> Float64:
        """Predicate distributions of the pairs of a request.

        Clips differ in height and width. The world model resizes them.

        Returns:
            (pairs, R), rows >= 0 that sum to one.
        """
        ...


def require_predicates(model: WorldModel | None, predicates: tuple[str, ...]) -> None:
    """Refuse a world model whose predicates differ from the graph's, before the first frame.

    A world model with fixed predicates has a method `require_predicates`.

    Raises:
        ConfigurationError: the predicates differ.
    """
    check = getattr(model, "require_predicates", None)
    if check is not None:
        check(predicates)
