"""Detections of another process: our JSON and vision_msgs, checked by one decoder."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.scene import checks
from deworldsg_ros.scene.arrays import Float32, Float64, UInt16
from deworldsg_ros.scene.camera import MaskPatch, SentDetections
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import check_labels, checked_frame_id
from deworldsg_ros.wire import messages as wire


def read_detections(message: Any) -> wire.DetectionsMessage:
    """The message of a std_msgs/String with our JSON, or of a vision_msgs/Detection2DArray.

    Raises:
        RefusedInput: as `wire.decode`.
    """
    if hasattr(message, "data"):
        return wire.decode(message.data, wire.DetectionsMessage)
    return _from_vision(message)


def _from_vision(message: Any) -> wire.DetectionsMessage:
    """The JSON message with the content of a vision_msgs/Detection2DArray.

    A turned box becomes the upright one around it. Detections without a result are left out.
    """
    stamp = message.header.stamp
    content = {
        "schema": wire.schema_of(wire.DetectionsMessage),
        "stamp": {"sec": stamp.sec, "nanosec": stamp.nanosec},
        "frame_id": checked_frame_id(str(message.header.frame_id)),
        "detections": [
            {
                "box_xyxy": _corners(one.bbox),
                "hypotheses": [
                    {"name": str(one.hypothesis.class_id), "score": float(one.hypothesis.score)}
                    for one in one.results
                ],
            }
            for one in message.detections
            if len(one.results)
        ],
    }
    try:
        return msgspec.convert(content, wire.DetectionsMessage, from_attributes=True)
    except msgspec.ValidationError as error:
        raise RefusedInput("invalid_message", f"Detection2DArray: {error}") from error


def _corners(box: Any) -> list[float]:
    """Corners x1, y1, x2, y2 of a vision_msgs/BoundingBox2D, pixels."""
    centre = getattr(box.center, "position", box.center)  # a geometry_msgs/Pose2D until Galactic
    cos, sin = abs(math.cos(box.center.theta)), abs(math.sin(box.center.theta))
    half_x = (box.size_x * cos + box.size_y * sin) / 2
    half_y = (box.size_x * sin + box.size_y * cos) / 2
    return [centre.x - half_x, centre.y - half_y, centre.x + half_x, centre.y + half_y]


def sent_detections(
    message: wire.DetectionsMessage, width: int, height: int, instances: UInt16 | None = None
) -> SentDetections:
    """The checked objects of a message.

    Args:
        message: decoded.
        width: of the image, pixels, and
        height: of it.
        instances: (H, W) uint16 from the same source: k + 1 on the pixels of the k-th detection of
            the message, 0 = no object. It replaces the masks of the message. None = not available.

    Raises:
        RefusedInput: ``invalid_message``; ``grid_mismatch`` if the masks are of another image.
    """
    items = message.detections
    try:
        boxes = np.array([item.box_xyxy for item in items], np.float64).reshape(-1, 4)
        checks.check_boxes(boxes, len(items))
        for item in items:
            check_labels([one.name for one in item.hypotheses])
        return SentDetections(
            boxes_xyxy=boxes,
            scores=np.array([_score(item) for item in items], np.float64),
            names=tuple([tuple([one.name for one in item.hypotheses]) for item in items]),
            name_scores=tuple(
                [tuple([min(one.score, 1.0) for one in item.hypotheses]) for item in items]
            ),
            masks=_masks(items, width, height)
            if instances is None
            else _cut(instances, boxes, width, height),
            embeddings=_embeddings(message),
            embedding_model=message.embedding_model,
        )
    except ValueError as error:
        raise RefusedInput("invalid_message", f"detections: {error}") from error


def _score(item: wire.SentDetection) -> float:
    best = max(one.score for one in item.hypotheses)
    return min(best if item.score is msgspec.UNSET else item.score, 1.0)


def _masks(
    items: list[wire.SentDetection], width: int, height: int
) -> tuple[MaskPatch, ...] | None:
    """Masks if every object has one; None if none has."""
    given = [item.mask for item in items if item.mask is not None]
    if not given:
        return None
    if len(given) < len(items):
        raise ValueError(f"{len(given)} of {len(items)} objects have a mask: expected all or none")
    masks = []
    for row, mask in enumerate(given):
        if mask.left + mask.width > width or mask.top + mask.height > height:
            raise RefusedInput(
                "grid_mismatch",
                f"mask of object {row} ends at column {mask.left + mask.width} and row "
                f"{mask.top + mask.height}: the image has {width}x{height}",
            )
        count = mask.width * mask.height
        if len(mask.bits) != (count + 7) // 8:
            raise ValueError(
                f"mask of object {row} has {len(mask.bits)} bytes: expected {(count + 7) // 8} for "
                f"{mask.width}x{mask.height} bits"
            )
        bits = np.unpackbits(np.frombuffer(mask.bits, np.uint8), count=count)
        shape = mask.height, mask.width
        masks.append(MaskPatch(mask.top, mask.left, bits.reshape(shape).astype(np.bool_)))
    return tuple(masks)


def _cut(instances: UInt16, boxes: Float64, width: int, height: int) -> tuple[MaskPatch, ...]:
    """The mask of each object within its box in an instance image."""
    if instances.shape != (height, width):
        raise RefusedInput(
            "grid_mismatch",
            f"instance image of the detections is {instances.shape[1]}x{instances.shape[0]}: the "
            f"image has {width}x{height}",
        )
    corners = np.concatenate([np.floor(boxes[:, :2]), np.ceil(boxes[:, 2:]) + 1], axis=1)
    corners = np.clip(corners, 0, [width, height, width, height]).astype(int)
    return tuple(
        [
            MaskPatch(top, left, instances[top:bottom, left:right] == row + 1)
            for row, (left, top, right, bottom) in enumerate(corners.tolist())
        ]
    )


def _embeddings(message: wire.DetectionsMessage) -> Float32 | None:
    """Embeddings (n, D), zeros for objects without one; None if none has one."""
    given = [item.embedding for item in message.detections]
    size = max(map(len, given), default=0)
    if not size:
        return None
    if not message.embedding_model:
        raise ValueError("embeddings without embedding_model: expected the name of their model")
    wrong = [len(one) for one in given if len(one) not in (0, size)]
    if wrong or size % 2:
        raise ValueError(
            f"embeddings have {size} and {(wrong or [size])[0]} bytes: expected as many for each "
            "object, two a number, or none"
        )
    none = bytes(size)
    values: NDArray[Any] = np.frombuffer(b"".join(one or none for one in given), "<f2")
    values = values.reshape(len(given), -1).astype(np.float32)
    if not np.isfinite(values).all():
        raise ValueError("embeddings contain values that are not finite")
    return values
