"""What of two objects a world model sees: the fit of a crop to the square, the region of a clip.

    python bench/clip_fit.py [RECORDING] [--pictures FILE.png] [--regions FILE.png]

Each neighbour pair of each frame (Eq. 8) gives one clip.

The fit, in the last frame. `centre` is the preprocessing of the published processors, which version
0.2 of this package used, too: the short edge is resized, the middle is used. `stretch` is used now.
`letterbox` pads the short side. `--pictures` shows the crops with the greatest loss, and some at
random: the frame, centre, stretch, letterbox.

The region, in the frames before the last, see `ProbeCard.crop`. The graph says which boxes are of
the pair's two objects. `--regions` shows clips that lose an object, evenly spread: the earlier
frame with both boxes, its three crops, and the last frame.
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
from deworldsg_ros.relations.clips import BoxPair, clip_regions
from deworldsg_ros.relations.paper import neighbour_pairs

BAG = Path(__file__).resolve().parents[1] / "bags" / "demo_room"
# V-JEPA 2's processor: short edge 292, middle 256.
CENTRE_FRACTION = 256 / 292
TILE_PX = 192
CROPS = ("last_frame", "clip_union", "each_frame")


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


class Earlier:
    """The boxes of the pairs in the frames of their clips before the last.

    Attributes:
        inside: for each crop one row a box: the fraction of its area in the region.
        clips: the clip of each box.
        growth: for each crop and clip its mean area, over the area of its last frame's union box.
        lost: frame, boxes and regions of the frames in which `last_frame` loses an object, and the
            stamp of the clip.
    """

    def __init__(self) -> None:
        self.inside: dict[str, list[float]] = {crop: [] for crop in CROPS}
        self.clips: list[int] = []
        self.growth: dict[str, list[float]] = {crop: [] for crop in CROPS}
        self.lost: list[tuple[int, int, list[np.ndarray], list[tuple[int, ...]]]] = []

    def add(self, frames: dict[int, list[BoxPair]], width: int, height: int) -> None:
        """One clip: the pair's boxes by the stamp of the frame, oldest first."""
        stamps_ns, pairs = list(frames), list(frames.values())
        regions = {crop: clip_regions(pairs, crop, width, height) for crop in CROPS}
        number = len(self.growth["last_frame"])
        for crop, own in regions.items():
            areas = [(x2 - x1) * (y2 - y1) for x1, y1, x2, y2 in own]
            last = regions["last_frame"][-1]
            area = (last[2] - last[0]) * (last[3] - last[1])
            self.growth[crop].append(float(np.mean(areas)) / area)
        for row, pair in enumerate(pairs[:-1]):
            boxes = [box for box in pair if box is not None]
            for box in boxes:
                # A box ends in the middle of its outer pixels.
                area = float(np.prod(np.maximum(box[2:] - box[:2], 1e-9)))
                for crop in CROPS:
                    part = seen_area(box, np.array(regions[crop][row])) / area
                    self.inside[crop].append(part)
                    if crop == "last_frame" and part == 0:
                        shown = [regions[name][row] for name in CROPS]
                        self.lost.append((stamps_ns[row], stamps_ns[-1], boxes, shown))
                self.clips.append(number)

    def report(self) -> None:
        """Print what each region loses."""
        total = len(self.growth["last_frame"])
        print(f"{total} clips of two nodes, {len(self.clips)} boxes in frames before the last")
        for crop in CROPS:
            inside = np.array(self.inside[crop])
            lost = inside == 0
            clips = len(set(np.array(self.clips)[lost].tolist())) / total
            print(
                f"{crop}: {lost.mean():.1%} of the boxes are wholly outside, in {clips:.1%} of the "
                f"clips; {1 - inside.mean():.1%} of the mean box is cut off; the region has "
                f"{np.mean(self.growth[crop]):.2f} times the area of the last frame's"
            )


def region_rows(lost: list, images: dict[int, np.ndarray]) -> np.ndarray:
    """Ten clips that lose an object: the earlier frame, its three crops, the last frame."""
    rows = []
    for stamp_ns, last_ns, boxes, regions in lost[:: max(1, len(lost) // 10)][:10]:
        drawn, last = images[stamp_ns].copy(), images[last_ns].copy()
        for box in boxes:
            x1, y1, x2, y2 = np.rint(box).astype(int).tolist()
            cv2.rectangle(drawn, (x1, y1), (x2, y2), (255, 60, 60), 2)
        x1, y1, x2, y2 = regions[0]
        cv2.rectangle(last, (x1, y1), (x2, y2), (60, 160, 255), 2)
        tiles = [tile(drawn[y1:y2, x1:x2], "stretch") for x1, y1, x2, y2 in regions]
        size = (TILE_PX * 4 // 3, TILE_PX)
        rows.append(np.hstack([cv2.resize(drawn, size), *tiles, cv2.resize(last, size)]))
    return np.vstack(rows)


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
    parser.add_argument("--regions", type=Path, help="PNG file to write")
    options = parser.parse_args()
    config = Config()
    pipeline = Pipeline(config)
    recording = Recording(open_source(options.recording, inputs=config.inputs), config.inputs)
    lost: list[np.ndarray] = []
    ratios: list[float] = []
    rows: list[tuple[float, np.ndarray]] = []
    generator = np.random.default_rng(0)
    earlier = Earlier()
    history: dict[int, np.ndarray] = {}
    images: dict[int, np.ndarray] = {}
    for frame in recording.frames():
        local = pipeline.process(frame).local
        assert pipeline.builder is not None
        boxes = local.boxes_xyxy
        history[local.stamp_ns] = boxes
        images |= {local.stamp_ns: frame.rgb} if options.regions else {}
        graph = pipeline.builder.graph
        recent = list(history)[-config.relations.clip_length :]
        known = {stamp: graph.nodes_of_frame(stamp) or [] for stamp in recent}
        pairs, _ = neighbour_pairs(
            boxes, local.depths_m, local.width, local.height, config.relations.geo_cost_threshold
        )
        for i, j in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
            ids = known[local.stamp_ns] or [0] * len(boxes)
            if 0 not in (ids[i], ids[j]) and ids[i] != ids[j]:
                clip = {
                    stamp: tuple(
                        history[stamp][there.index(node)] if node in there else None
                        for node in (ids[i], ids[j])
                    )
                    for stamp, there in known.items()
                }
                earlier.add(
                    {**clip, local.stamp_ns: (boxes[i], boxes[j])}, local.width, local.height
                )
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
    earlier.report()
    if options.regions and earlier.lost:
        cv2.imwrite(str(options.regions), region_rows(earlier.lost, images)[..., ::-1])
    if options.pictures:
        rows.sort(key=lambda row: row[0])
        kept = rows[:4] + rows[4 :: max(1, len(rows) // 5)][:5]
        sheet = np.vstack([row for _, row in kept])
        cv2.imwrite(str(options.pictures), sheet[..., ::-1])


if __name__ == "__main__":
    main()
