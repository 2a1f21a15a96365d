"""Options of a training; without torch, so that the command line can check them first."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from deworldsg_ros.checkpoints.cards import Crop, Window


@dataclass(frozen=True)
class FitOptions:
    """Options of the fit.

    Attributes:
        epochs: maximum number of passes over the training clips; without validation clips their
            number.
        patience: passes without a lower validation loss after which the fit stops.
        batch_size: clips per step.
        learning_rate, weight_decay: of AdamW.
        seed: of the initial weights and the order of the clips.
        class_weights: of the predicates in the loss. ``none`` is the paper's: the probe learns
            their distribution. ``inverse_frequency`` favours rare ones.
    """

    epochs: int = 200
    patience: int = 20
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    seed: int = 0
    class_weights: Literal["none", "inverse_frequency"] = "none"


@dataclass(frozen=True)
class TrainingOptions:
    """Options of a training.

    Attributes:
        layout, inputs: of the probe, see `ProbeCard`.
        window, crop: frames of the clips of a data set and region of them, see `ProbeCard`.
        held_out_fraction: fraction of the groups that is kept for the final scores. 0 trains on
            all groups: none is held out, and none stops the fit.
        held_out_groups: keep these groups instead.
        batch_size: clips encoded at once.
        fit: options of the fit.
    """

    layout: Literal["two_layer", "batch_norm"] = "two_layer"
    inputs: Literal["clip", "clip_and_boxes"] = "clip"
    window: Window = "last_frames"
    crop: Crop = "last_frame"
    held_out_fraction: float = 0.2
    held_out_groups: tuple[str, ...] = ()
    batch_size: int = 1
    fit: FitOptions = field(default_factory=FitOptions)


@dataclass(frozen=True)
class ClipOrigin:
    """Where clips come from, for the record.

    Attributes:
        source: its name.
        data_split: of a data set; empty = a folder of clips.
    """

    source: str = ""
    data_split: str = ""
