"""Drawn rooms of shaded boxes: clips of object pairs with a known predicate.

Each room has its own wall, floor and colours. A moving camera observes a small and a large box in
one of five relations. Colours and textures do not depend on the relation.
"""

from dataclasses import dataclass

import cv2
import numpy as np

PREDICATES = ("on", "under", "near", "in", "behind")
WIDTH, HEIGHT = 160, 120
FOCAL_PX = 150.0
LIGHT = np.array([0.4, -0.5, 0.77])

# Subject and object classes of each predicate; some class pairs have two predicates.
CLASSES = ("cup", "box", "table", "chair", "basket")
CLASS_PAIRS = {
    "on": (("cup", "table"), ("box", "table")),
    "under": (("box", "table"), ("chair", "table")),
    "near": (("chair", "table"), ("box", "basket")),
    "in": (("cup", "basket"), ("box", "basket")),
    "behind": (("chair", "basket"), ("box", "chair")),
}


@dataclass(frozen=True)
class Solid:
    """An axis-aligned box: corners in metres, z up. `kind` is solid, hollow (no top) or legs."""

    low: np.ndarray
    high: np.ndarray
    colour: np.ndarray
    kind: str = "solid"


@dataclass(frozen=True)
class PairClip:
    """A rendered pair.

    `frames` (T, H, W, 3) uint8; `boxes_xyxy` of subject and object in the last frame.
    """

    room: str
    predicate: str
    subject_class: str
    object_class: str
    frames: np.ndarray
    boxes_xyxy: tuple[np.ndarray, np.ndarray]


def render_room(seed: int, pair_count: int, length: int = 16) -> list[PairClip]:
    """Pairs of one room with alternating predicates. The same seed gives the same clips."""
    generator = np.random.default_rng([seed, 7])
    background = _background(generator)
    clips = []
    for number in range(pair_count):
        predicate = PREDICATES[number % len(PREDICATES)]
        pairs = CLASS_PAIRS[predicate]
        subject_class, object_class = pairs[generator.integers(len(pairs))]
        solids = _arrange(predicate, generator)
        yaw = generator.uniform(-0.5, 0.5) + np.linspace(0, generator.uniform(-0.35, 0.35), length)
        distance = generator.uniform(2.2, 3.0)
        frames, boxes = [], None
        for angle in yaw:
            frame, boxes = _render(background, solids, angle, distance)
            frames.append(frame)
        clips.append(
            PairClip(
                f"room {seed}", predicate, subject_class, object_class, np.stack(frames), boxes
            )
        )
    return clips


def _arrange(predicate: str, generator: np.random.Generator) -> tuple[Solid, Solid]:
    """Subject and object in a random arrangement with this predicate."""
    colours = generator.uniform(40, 240, (2, 3))
    size = generator.uniform([0.2, 0.2, 0.15], [0.35, 0.35, 0.35])
    large = generator.uniform([0.8, 0.6, 0.5], [1.1, 0.8, 0.7])
    kind, height, foot = "solid", 0.0, generator.uniform(-0.15, 0.15, 2)
    if predicate == "on":
        height = large[2]
        kind = "legs"
    elif predicate == "under":
        kind = "legs"
        size[2] = min(size[2], 0.6 * large[2])
    elif predicate == "near":
        side = generator.choice([-1, 1])
        foot = np.array([side * (large[0] / 2 + size[0] / 2 + generator.uniform(0.05, 0.2)), 0.0])
        kind = generator.choice(["legs", "hollow"])
    elif predicate == "in":
        kind, height = "hollow", 0.05
        size[2] = large[2] * generator.uniform(0.6, 0.9)
    else:
        size[2] = large[2] * generator.uniform(1.2, 1.5)
        foot = np.array([foot[0], large[1] / 2 + size[1] / 2 + generator.uniform(0.05, 0.2)])
    low = np.array([foot[0] - size[0] / 2, foot[1] - size[1] / 2, height])
    subject = Solid(low, low + size, colours[0])
    corner = np.array([-large[0] / 2, -large[1] / 2, 0.0])
    return subject, Solid(corner, corner + large, colours[1], str(kind))


def _background(generator: np.random.Generator) -> np.ndarray:
    """A textured wall above a textured floor."""
    image = np.zeros((HEIGHT, WIDTH, 3))
    horizon = HEIGHT // 2 + int(generator.integers(-8, 8))
    for rows in (slice(0, horizon), slice(horizon, HEIGHT)):
        part = image[rows]
        grain = generator.uniform(-1, 1, (*part.shape[:2], 1)).astype(np.float32)
        blurred = cv2.GaussianBlur(grain, (0, 0), generator.uniform(0.6, 4))[..., None]
        part += generator.uniform(50, 220, 3) + 25 * blurred / max(np.abs(blurred).max(), 1e-6)
        period = int(generator.integers(9, 40))
        part[:, :: int(period)] *= generator.uniform(0.75, 1)
    return image


def _render(background, solids, yaw, distance):
    """One frame and the image boxes of both solids. Faces are drawn from far to near."""
    eye = np.array([distance * np.sin(yaw), -distance * np.cos(yaw), 1.3])
    forward = np.array([0, 0, 0.35]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    image = background.copy()
    faces = []
    boxes = []
    for solid in solids:
        corners = _project(_corners(solid), eye, R)[0]
        near, far = corners.min(axis=0), corners.max(axis=0)
        edges = np.clip([*near, *far], 0, [WIDTH - 1, HEIGHT - 1] * 2)
        boxes.append(edges.astype(np.float64))
        for part in _parts(solid):
            faces += [(face, normal, part.colour) for face, normal in _faces(part)]
    shown = []
    for face, normal, colour in faces:
        centre = face.mean(axis=0)
        if (eye - centre) @ normal <= 0:
            continue
        pixels, _ = _project(face, eye, R)
        brightness = 0.55 + 0.45 * max(0.0, float(normal @ LIGHT))
        shown.append((np.linalg.norm(centre - eye), pixels, colour * brightness))
    for _, pixels, colour in sorted(shown, key=lambda item: -item[0]):
        points = np.round(pixels * 16).astype(np.int32)
        cv2.fillConvexPoly(image, points, colour.tolist(), cv2.LINE_8, 4)
    return np.clip(image, 0, 255).astype(np.uint8), tuple(boxes)


def _parts(solid: Solid) -> list[Solid]:
    """The solid boxes that form a solid of any kind."""
    low, high = solid.low, solid.high
    thick = 0.05

    def box(a, b):
        return Solid(np.array(a), np.array(b), solid.colour)

    if solid.kind == "legs":
        legs = [
            box((x, y, low[2]), (x + thick, y + thick, high[2] - thick))
            for x in (low[0], high[0] - thick)
            for y in (low[1], high[1] - thick)
        ]
        return [*legs, box((low[0], low[1], high[2] - thick), high)]
    if solid.kind == "hollow":
        top = low[2] + 0.6 * (high[2] - low[2])
        return [
            box(low, (high[0], high[1], low[2] + thick)),
            box(low, (low[0] + thick, high[1], top)),
            box((high[0] - thick, low[1], low[2]), (high[0], high[1], top)),
            box(low, (high[0], low[1] + thick, top)),
            box((low[0], high[1] - thick, low[2]), (high[0], high[1], top)),
        ]
    return [solid]


def _corners(solid: Solid) -> np.ndarray:
    ends = np.stack([solid.low, solid.high])
    return np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])


def _faces(solid: Solid):
    """The six faces: four corners in order, and the outward normal."""
    corners = _corners(solid).reshape(2, 2, 2, 3)
    for axis in range(3):
        for end in (0, 1):
            face = np.take(corners, end, axis=axis)
            normal = np.zeros(3)
            normal[axis] = 2 * end - 1
            yield np.array([face[0, 0], face[0, 1], face[1, 1], face[1, 0]]), normal


def _project(points_world, eye, R):
    camera = (points_world - eye) @ R.T
    pixels = FOCAL_PX * camera[:, :2] / camera[:, 2:] + [WIDTH / 2, HEIGHT / 2]
    return pixels, camera[:, 2]
