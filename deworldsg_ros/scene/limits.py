"""The largest values that a message may contain, and the text that it may contain.

A value inside these limits cannot overflow a sum, an index or the memory. A value outside of them
is an error of its sender, and is refused by name.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from deworldsg_ros.scene.errors import RefusedInput

# --- The largest values that a message may contain, and why. What exceeds them is refused by
# name.
#
# A value inside these limits cannot overflow a sum, an index or the memory. A value outside of them
# is an error of its sender.

# A file or message with 64-bit integers: larger ones do not fit the arrays.
MAX_INT = 2**63 - 1
# ROS times have 32 bits of seconds.
MAX_SECONDS = 2**31 - 1
# Stamps that go back by more are of a clock that was set, or of a recording that was restarted;
# else the message is late.
RESTART_NS = 10**9
# The instance image has 16 bits.
MAX_INSTANCE = 2**16 - 1
# Objects of a frame. Perception keeps at most 50; this leaves room for other detectors. Matching
# 256 objects takes a second at most.
MAX_OBJECTS = 256
# Rooms of a graph: those of a large office building.
MAX_ROOMS = 1000
# Relations of a frame: the largest value of `perception.max_relations`.
MAX_RELATIONS = 1000
# Neighbour pairs of a frame: each ordered pair of its objects.
MAX_PAIRS = MAX_OBJECTS * (MAX_OBJECTS - 1)
# Classes or predicates. The largest vocabularies in use have 21 843 (ImageNet) and 1203 (LVIS).
# The table of class pairs needs 8 bytes times the square: 512 MiB at this limit.
MAX_NAMES = 8192
# Surface points of an object in one frame. Lifting samples 800 at most.
MAX_POINTS = 4096
# Side of an image. OpenCV writes no larger PNG, and its largest JPEG has 65 535.
MAX_SIDE_PX = 32768
# Focal lengths and principal points. A lens of 1 m on pixels of 1 µm has 10^6 px.
MAX_FOCAL_PX = 1e6
# Less than a pixel shows all directions in one.
MIN_FOCAL_PX = 1e-3
# Distance of objects and cameras from the world's origin. A float32 point keeps a millimetre up
# to 16 km, and the map of cells ends at 31 km.
MAX_COORDINATE_M = 1e4
# Coordinates of a scene graph: corrections of poses move its objects, each by MAX_COORDINATE_M.
MAX_GRAPH_COORDINATE_M = 1e8
# Length of a transform in TF: the distance to the centre of the earth (REP 105) is 6.4e6 m.
MAX_TRANSFORM_M = 1e8
# Variances of an object of a scene graph, which may be made of many.
MAX_GRAPH_VARIANCE_M2 = MAX_GRAPH_COORDINATE_M**2
# Variances of an object: its extent is below MAX_COORDINATE_M, and no sensor measures micrometres.
MAX_VARIANCE_M2 = MAX_COORDINATE_M**2
MIN_VARIANCE_M2 = 1e-12
# Ratio of the smallest to the largest variance. A rotation keeps a covariance positive definite
# if the ratio is far above 2e-16, the rounding of float64.
MIN_VARIANCE_RATIO = 1e-13
# Relation logits. A sigmoid is 0 or 1 to the last bit beyond 745, and 10^9 frames of this logit
# still have a finite sum.
MAX_LOGIT = 1e9
# Geometric costs of pairs (Eq. 8): half a diagonal and a difference of depths, metres.
MAX_COST = 1e6
# Bytes of a mask in a message, a bit a pixel: those of an image of 4K.
MAX_MASK_BYTES = 2**20
# Values of a CIELAB colour. Those of sRGB are up to 108.
MAX_LAB = 128.0
# Values of an embedding. Those of CLIP and SigLIP have 512 to 1536.
MAX_EMBEDDING = 2048
# Length of a label or frame_id, characters.
MAX_NAME_CHARACTERS = 256
# Size of a message of one frame: 256 objects with 800 points each need 12 MB.
MAX_FRAME_BYTES = 16 * 2**20
# Size of a message of the global graph: 5000 nodes with 512 points each need 150 MB.
MAX_GRAPH_BYTES = 256 * 2**20
# Reasons why an object is hidden, characters.
MAX_REASON_CHARACTERS = 1000
# Predictions of a frame, pairs times predicates: all pairs of 256 objects with 64 predicates. They
# are a table of 8 bytes each, also where a pair has no prediction.
MAX_PREDICTIONS = 2**22
# Error of the sum of a predicted distribution: that of float32 networks.
MAX_PREDICTION_SUM_ERROR = 1e-3


# --- Text of others in messages: labels and frame_ids without control characters.

# Of the frames of objects on /tf: this, and the id.
OBJECT_FRAME = "object_"
# Control characters forge lines of logs and terminals; half of a surrogate pair has no UTF-8.
_UNWANTED = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def checked_frame_id(frame_id: str) -> str:
    """The frame_id; raises RefusedInput ``invalid_frame_id``."""
    if len(frame_id) > MAX_NAME_CHARACTERS or _UNWANTED.search(frame_id):
        raise RefusedInput(
            "invalid_frame_id",
            f"frame_id is {frame_id[:MAX_NAME_CHARACTERS]!r}: expected at most "
            f"{MAX_NAME_CHARACTERS} characters, and no control character",
        )
    return frame_id


def check_labels(labels: Sequence[str]) -> None:
    """Raise ValueError for a label with a control character."""
    if _UNWANTED.search("".join(labels)):
        bad = next(label for label in labels if _UNWANTED.search(label))
        raise ValueError(f"label {bad!r} contains a control character")


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError for names of classes or predicates that no message may contain."""
    if len(names) > MAX_NAMES:
        raise ValueError(f"{len(names)} names: expected at most {MAX_NAMES}")
    longest = max(names, key=len, default="")
    if len(longest) > MAX_NAME_CHARACTERS:
        raise ValueError(
            f"name {longest[:40]!r} of {len(longest)} characters: expected at most "
            f"{MAX_NAME_CHARACTERS}"
        )
    check_labels(names)


# Sessions of graphs that are not yet found in their map begin with this.
APART_SESSION = "apart-"
