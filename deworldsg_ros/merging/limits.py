"""Fixed limits of the life cycle of a node (surface rule)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LifeCycleLimits:
    """Limits that no configuration changes; tests vary them. docs/dev/notebook.md has the
    measurements.

    Attributes:
        confirm_score: a node needs one detection with this score, or four times as many
            observations. NanoDet in the rendered rooms is right in 49 % of its detections with
            scores of 0.40 to 0.45, and in 69 % of those of 0.50 to 0.55.
        baseline_deg: motion of the camera, as an angle seen from the node, that makes a new
            viewpoint. Every value from 0.5 to 4 keeps all nine correct nodes of the kitchen.
        min_detection_rate: a node becomes tentative again if a smaller fraction of its viewpoints
            detected it. Correct nodes of two rendered rooms and the kitchen were detected from at
            least 0.55 of their viewpoints, false nodes with four detections from at most 0.33.
        expire_tentative_s: a tentative node is removed when unseen for this long. Chosen, not
            measured: longer than a camera needs to return to an object.
        absent_frames: consecutive frames that see through a node before it is removed from its
            position. One frame is not enough: depth images have holes and noise.
        lost_s: a moved object keeps its id if it is detected again within this time. Chosen, not
            measured.
    """

    confirm_score: float = 0.45
    baseline_deg: float = 0.5
    min_detection_rate: float = 0.4
    expire_tentative_s: float = 10.0
    absent_frames: int = 5
    lost_s: float = 30.0
