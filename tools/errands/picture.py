"""Make the moving picture of an errand: the map of the robot with its way, beside its camera.

    python tools/errands/picture.py [OUT.webp] [--home SEED] [--errand NUMBER]

It needs MuJoCo for the colours. The picture has at most 1 MB.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2
import numpy as np
from errands import ROOT, Errands
from mind import by_question
from PIL import Image
from tasks import standing_tasks

from deworldsg_ros.client.graph import SceneGraph

OUT = ROOT / "docs" / "images" / "errand.webp"
HEIGHT, EVERY, STEP_MS, LAST_MS, MAX_BYTES = 360, 3, 280, 3000, 1_000_000
PAPER, FREE, WALL = (244, 244, 240), (255, 255, 255), (70, 70, 75)
ROBOT, WAY, NODE, TARGET = (200, 60, 30), (200, 110, 60), (60, 110, 190), (20, 140, 60)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def drawn_map(errands: Errands, graph: SceneGraph, trail: list[np.ndarray], target: int | None):
    """The floor grid of the robot, the objects of its graph, and its way so far (h, w, 3) RGB."""
    grid = errands.robot.grid
    clear = grid.clearance()
    occupied = (grid.hits >= 2) & (grid.hits >= 0.5 * grid.passes)
    image = np.full((*clear.shape, 3), PAPER, np.uint8)
    image[clear > 0], image[occupied] = FREE, WALL
    rows, columns = np.nonzero(occupied | (clear > 0))
    window = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    corner = grid.corner + 0.05 * np.array([columns.min(), rows.min()])
    scale = HEIGHT / (rows.max() + 1 - rows.min())
    image = image[window]
    size = (int(image.shape[1] * scale), HEIGHT)
    image = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)[::-1].copy()

    def at(point) -> tuple[int, int]:
        x, y = (np.asarray(point[:2]) - corner) / 0.05 * scale
        return int(x), int(HEIGHT - 1 - y)

    for item in graph:
        chosen = item.id == target
        colour = TARGET if chosen else NODE
        cv2.circle(image, at(item.position_m), 6 if chosen else 3, colour, -1, cv2.LINE_AA)
        if chosen or item.size_m[0] * item.size_m[1] > 0.15:
            text = at(item.position_m)
            cv2.putText(image, item.label, (text[0] + 5, text[1] - 3), FONT, 0.33, colour, 1,
                        cv2.LINE_AA)  # fmt: skip
    way = np.array([at(pose) for pose in trail], np.int32)
    cv2.polylines(image, [way], False, WAY, 2, cv2.LINE_AA)
    x, y, yaw = errands.robot.believed
    cv2.circle(image, at((x, y)), int(0.24 / 0.05 * scale), ROBOT, 2, cv2.LINE_AA)
    nose = (x + 0.35 * np.cos(yaw), y + 0.35 * np.sin(yaw))
    cv2.line(image, at((x, y)), at(nose), ROBOT, 2, cv2.LINE_AA)
    return image


def main() -> None:
    """Run one errand, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", default=OUT)
    parser.add_argument("--home", type=int, default=4)
    parser.add_argument("--errand", type=int, default=0)
    options = parser.parse_args()
    errands = Errands(options.home, "boxes", colours=True)
    camera = errands.robot.camera
    view, camera.view = camera.view, None  # true boxes need no colours; the picture does
    errands.tour()
    errands.on_tour, camera.view = False, view
    task = standing_tasks(errands.home, errands.rng)[options.errand]
    shots: list[tuple[np.ndarray, list[np.ndarray]]] = []
    trail: list[np.ndarray] = []

    def keep(frame, perceived) -> None:
        trail.append(errands.robot.believed)
        shots.append((frame.rgb, drawn_map(errands, graph, trail, target and target.id)))

    graph = errands.mind.graph()
    target = by_question(graph, task.words, errands.seeker.at)
    errands.on_frame = keep
    outcome = errands.run(task)
    print(f"{task.words}: {outcome.failure or 'fulfilled'}; {outcome.said}")
    steps = []
    for rgb, plan in [*shots[::EVERY], shots[-1]]:
        view = cv2.resize(rgb, (480, HEIGHT), interpolation=cv2.INTER_AREA)
        cv2.rectangle(view, (0, 0), (480, 26), (30, 30, 34), -1)
        words = '"go to the ' + task.words.replace(" on ", " on the ") + '"'
        cv2.putText(view, words, (8, 18), FONT, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        steps.append(Image.fromarray(np.hstack([plan, view])))
    durations = [STEP_MS] * (len(steps) - 1) + [LAST_MS]
    for quality in (75, 60, 45, 30):
        content = io.BytesIO()
        steps[0].save(content, "WEBP", save_all=True, append_images=steps[1:], loop=0,
                      duration=durations, quality=quality, method=6)  # fmt: skip
        if content.tell() <= MAX_BYTES:
            break
    options.out.write_bytes(content.getvalue())
    print(f"{options.out}: {len(steps)} steps, {steps[0].size}, {content.tell() / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
