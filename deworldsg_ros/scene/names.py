"""Text of others in messages: labels and frame_ids without control characters."""

from __future__ import annotations

import re
from collections.abc import Sequence

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import MAX_NAME_CHARACTERS, MAX_NAMES

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
