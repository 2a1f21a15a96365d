"""What of two objects a world model sees: three ways to bring a crop to the square input.

    python bench/clip_fit.py [RECORDING] [--pictures FILE.png]

Each neighbour pair of each frame (Eq. 8) gives one crop. `centre` is the preprocessing of the
published processors, which version 0.2 of this package used, too: the short edge is resized, the
middle is used. `stretch` is used now. `letterbox` pads the short side. The picture shows the crops
with the greatest loss, and some at random: the frame, centre, stretch, letterbox.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deworldsg_ros.config import Config
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.relations import union_box
from deworldsg_ros.relations.paper import neighbour_pairs

BAG = Path(__file__).resolve().parents[1] / "bags" / "demo_room"
# V-JEPA 2's processor: short edge 292, middle 256.
CENTRE_FRACTION = 256 / 292
TILE_PX = 192


def centre_of(crop: tuple[int, int, int, int]) -> np.ndarray:
    """(4,) the part of a crop that `centre` shows, pixels of the image."""
    x1, y1, x2, y2 = crop
    side = CENTRE_FRACTION * min(x2 - x1, y2 - y1)
    middle = np.array([x1 + x2, y1 + y2, x1 + x2, y1 + y2]) / 2
    return middle + side / 2 * np.array([-1, -1, 1, 1])


def seen_area(box: np.ndarray, view: np.ndarray) -> float:
    """Area of a box inside a view, square pixels."""
    sides = np.minimum(box[2:], view[2:]) - np.maximum(box[:2], view[:2])
    return float(np.prod(np.maximum(sides, 0)))


def tile(image: np.ndarray, fit: str) -> np.ndarray:
    """A square picture of a crop."""
    height, width = image.shape[:2]
    if fit == "centre":
        side = CENTRE_FRACTION * min(height, width)
        top, left = (height - side) / 2, (width - side) / 2
        image = image[int(top) : int(top + side) + 1, int(left) : int(left + side) + 1]
    elif fit == "letterbox":
        side = max(height, width)
        padded = np.zeros((side, side, 3), np.uint8)
        top, left = (side - height) // 2, (side - width) // 2
        padded[top : top + height, left : left + width] = image
        image = padded
    return cv2.resize(image, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA)


def picture_row(rgb: np.ndarray, crop: tuple[int, int, int, int], boxes: np.ndarray) -> np.ndarray:
    """Frame, centre, stretch, letterbox, with the two boxes."""
    drawn = rgb.copy()
    for box, colour in zip(boxes, ((255, 60, 60), (60, 160, 255))):
        x1, y1, x2, y2 = np.rint(box).astype(int).tolist()
        cv2.rectangle(drawn, (x1, y1), (x2, y2), colour, 2)
    x1, y1, x2, y2 = crop
    part = drawn[y1:y2, x1:x2]
    frame = cv2.resize(drawn, (TILE_PX * 4 // 3, TILE_PX), interpolation=cv2.INTER_AREA)
    return np.hstack([frame, *(tile(part, fit) for fit in ("centre", "stretch", "letterbox"))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", type=Path, default=BAG)
    parser.add_argument("--pictures", type=Path, help="PNG file to write")
    options = parser.parse_args()
    config = Config()
    pipeline = Pipeline(config)
    recording = Recording(open_source(options.recording, inputs=config.inputs), config.inputs)
    lost: list[np.ndarray] = []
    ratios: list[float] = []
    rows: list[tuple[float, np.ndarray]] = []
    generator = np.random.default_rng(0)
    for frame in recording.frames():
        local = pipeline.process(frame).local
        boxes = local.boxes_xyxy
        pairs, _ = neighbour_pairs(
            boxes, local.depths_m, local.width, local.height, config.relations.geo_cost_threshold
        )
        for i, j in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
            crop = union_box(boxes[i], boxes[j], local.width, local.height)
            view = centre_of(crop)
            both = boxes[[i, j]]
            areas = (both[:, 2:] - both[:, :2]).prod(axis=1)
            seen = np.array([seen_area(box, view) for box in both])
            lost.append(np.stack([areas, seen]))
            sides = crop[2] - crop[0], crop[3] - crop[1]
            ratios.append(min(sides) / max(sides))
            if options.pictures and generator.random() < 0.02:
                rows.append((seen.sum() / areas.sum(), picture_row(frame.rgb, crop, both)))
    areas, seen = np.array(lost).transpose(1, 0, 2)
    absent = (seen == 0).any(axis=1).mean()
    print(f"{len(ratios)} clips; short over long side of a crop: median {np.median(ratios):.2f}")
    mean_loss = 1 - (seen.sum(axis=1) / areas.sum(axis=1)).mean()
    print(
        f"centre: {mean_loss:.1%} of the boxes' area is cut off in the mean clip, "
        f"{1 - seen.sum() / areas.sum():.1%} of all area; "
        f"one object is not in view in {absent:.1%}"
    )
    print("stretch, letterbox: nothing is cut off; letterbox leaves ", end="")
    print(f"{1 - np.mean(ratios):.1%} of the input without a picture in the mean clip")
    if options.pictures:
        rows.sort(key=lambda row: row[0])
        kept = rows[:4] + rows[4 :: max(1, len(rows) // 5)][:5]
        sheet = np.vstack([row for _, row in kept])
        cv2.imwrite(str(options.pictures), sheet[..., ::-1])


if __name__ == "__main__":
    main()
