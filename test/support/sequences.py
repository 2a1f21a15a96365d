"""Tiny scans in the layout of 3RScan: a camera in front of three blocks."""

import json
from pathlib import Path

import cv2
import numpy as np
from support.evaluation import write_dataset, write_json, write_ply

from deworldsg_ros.scene.camera import Intrinsics

WIDTH, HEIGHT = 96, 64
CAMERA = Intrinsics(80.0, 80.0, 47.5, 31.5, WIDTH, HEIGHT)
# Object id, class and pixel columns of each block.
BLOCKS = ((1, "chair", 4, 34), (2, "table", 40, 62), (3, "book", 68, 92))
ROWS = (20, 50)
DEPTH_M, BACKGROUND_M = 2.0, 4.0
RELATIONS = ((1, 2, "near"), (3, 2, "on"))


def instance_image() -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH), np.uint16)
    for number, _, left, right in BLOCKS:
        image[ROWS[0] : ROWS[1], left:right] = number
    return image


def depth_mm() -> np.ndarray:
    return np.where(instance_image() > 0, 1000 * DEPTH_M, 1000 * BACKGROUND_M).astype(np.uint16)


def write_info(path: Path, color: Intrinsics = CAMERA, depth: Intrinsics = CAMERA) -> None:
    lines = ["m_versionNumber = 4", "m_depthShift = 1000", "m_frames.size = 3"]
    for name, camera in (("Color", color), ("Depth", depth)):
        matrix = np.eye(4)
        matrix[:3, :3] = camera.matrix
        numbers = " ".join(map(repr, matrix.ravel().tolist()))
        lines += [
            f"m_{name.lower()}Width = {camera.width}",
            f"m_{name.lower()}Height = {camera.height}",
            f"m_calibration{name}Intrinsic = {numbers}",
        ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def write_pgm(path: Path, image: np.ndarray) -> None:
    header = f"P5\n{image.shape[1]} {image.shape[0]}\n65535\n".encode()
    path.write_bytes(header + image.astype(">u2").tobytes())


def write_sequence(
    scan: Path,
    frames: int = 3,
    *,
    depth: Intrinsics = CAMERA,
    depth_image: np.ndarray | None = None,
) -> Path:
    """Write frames of a camera that moves along x by 1 cm per frame; returns `scan`."""
    sequence = scan / "sequence"
    write_info(sequence / "_info.txt", CAMERA, depth)
    picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    picture[:5, :10] = (255, 0, 0)
    for number in range(frames):
        stem = sequence / f"frame-{number:06d}"
        cv2.imwrite(f"{stem}.color.jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 100])
        write_pgm(Path(f"{stem}.depth.pgm"), depth_mm() if depth_image is None else depth_image)
        T = np.eye(4)
        T[0, 3] = 0.01 * number
        np.savetxt(f"{stem}.pose.txt", T)
    return scan


def write_surface(scan: Path) -> None:
    """Write the annotated surface points of the blocks that are visible in the first frame."""
    rows, columns = np.nonzero(instance_image())
    x = (columns - CAMERA.cx) / CAMERA.fx * DEPTH_M
    y = (rows - CAMERA.cy) / CAMERA.fy * DEPTH_M
    points = np.stack([x, y, np.full(len(x), DEPTH_M)], axis=1)
    write_ply(
        scan / "labels.instances.annotated.v2.ply",
        points,
        instance_image()[rows, columns],
        "binary_little_endian",
    )


def write_front_end(sequence: Path, number: int, flip: bool = False) -> None:
    """Write detections of all blocks. They are not sorted by score."""
    stem = f"frame-{number:06d}"
    detections = []
    for number_in_file, (object_id, _, left, right) in enumerate(BLOCKS):
        class_index = {1: 1, 2: 2, 3: 0}[object_id]
        top = 2 - class_index if flip else class_index
        score = 0.8 + 0.05 * number_in_file
        detections.append(
            {
                "box": [float(left), float(ROWS[0]), right - 1.0, ROWS[1] - 1.0],
                "top": top,
                "score": score,
                "probs": [[top, score]],
                "rest": 1 - score,
                "mask": {"png": f"{stem}.instance.png", "value": object_id},
            }
        )
    relations = [
        {"s": 0, "o": 1, "predicate": 0, "score": 0.9, "probs": [[0, 0.9], [2, 0.05]]},
        {"s": 2, "o": 1, "predicate": 1, "score": 0.95, "probs": [[1, 0.95]]},
    ]
    content = {"version": 1, "detections": detections, "relations": relations}
    suffix = ".frontend_flip10.json" if flip else ".frontend.json"
    (sequence / f"{stem}{suffix}").write_text(json.dumps(content))


def write_room(root: Path, frames: int = 3) -> Path:
    """Write a data set with one rendered room, `room_0`; returns its root."""
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    write_dataset(root, {"room_0": (objects, RELATIONS)})
    folder = write_sequence(root / "data" / "room_0", frames)
    write_surface(folder)
    for number in range(frames):
        path = folder / "sequence" / f"frame-{number:06d}.instance.png"
        cv2.imwrite(str(path), instance_image())
        write_front_end(folder / "sequence", number)
        write_front_end(folder / "sequence", number, flip=True)
    return root


def write_ground_truth(folder: Path) -> None:
    """Write gt.json with the blocks, an undetectable object and an object without a class."""
    objects = []
    for number, name, left, right in BLOCKS:
        low, high = ((left - CAMERA.cx) / 80 * 2, (right - 1 - CAMERA.cx) / 80 * 2)
        box = [[low, -0.3, 1.95], [high, 0.5, 2.05]]
        centre = [(low + high) / 2, 0.075, 2.0]
        objects.append(
            {"id": number, "vg": name, "aabb": box, "visible_centroid": centre, "detectable": True}
        )
    objects.append({**objects[0], "id": 8, "detectable": False})
    objects.append({**objects[0], "id": 9, "vg": None})
    relations = [[subject, object_, 0, name] for subject, object_, name in RELATIONS]
    write_json(folder / "gt.json", {"objects": objects, "relationships": relations})
