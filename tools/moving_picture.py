#!/usr/bin/env python3
"""Make the moving picture of README: the camera's image beside the graph that grows from it.

python tools/moving_picture.py [OUT.webp]

It runs the shipped recording, and draws the page in Chromium (three minutes). The picture has at
most 1.5 MB.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from deworldsg_ros.config import Config
from deworldsg_ros.pipeline import FrameResult, Pipeline
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.view import page
from deworldsg_ros.view.colours import class_colours, to_rgb

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from support.browser import browser  # noqa: E402

RECORDING = ROOT / "bags" / "demo_room"
OUT = ROOT / "docs" / "images" / "growing.webp"
EVERY, HEIGHT, STEP_MS, LAST_MS = 9, 480, 450, 3000
MAX_BYTES = 1_500_000


def seen(frame: RgbdFrame, result: FrameResult) -> UInt8:
    """The image of the camera with the masks of its objects."""
    image = frame.rgb.copy()
    graph = result.perceived.frame_graph
    names = [graph.vocabulary.classes[row.argmax()] for row in graph.class_probabilities]
    colours = class_colours(names)
    for value, (name, box) in enumerate(zip(names, graph.boxes_xyxy), 1):
        colour = 255 * np.array(to_rgb(colours[name]), np.float32)
        mask = result.perceived.instances == value
        image[mask] = (0.5 * image[mask] + 0.5 * colour).astype(np.uint8)
        left, top = (int(v) for v in box[:2])
        place, font = (left + 3, top + 14), cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(image, name, place, font, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(image, name, place, font, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def beside(left: UInt8, right: UInt8) -> Image.Image:
    """Two images of one height, side by side."""
    parts = []
    for image in (left, right):
        width = round(image.shape[1] * HEIGHT / image.shape[0])
        parts.append(cv2.resize(image, (width, HEIGHT), interpolation=cv2.INTER_AREA))
    return Image.fromarray(np.hstack(parts))


def pictures(folder: Path) -> list[Image.Image]:
    """The steps of the moving picture."""
    steps: list[tuple[UInt8, Path]] = []
    recording, pipeline = open_recording(RECORDING), Pipeline(Config())
    path: list[np.ndarray] = []
    for index, frame in enumerate(recording.frames()):
        result = pipeline.process(frame)
        path.append(frame.T_world_camera[:3, 3])
        graph, builder = pipeline.graph(), pipeline.builder
        if index % EVERY == EVERY - 1 and graph.nodes and builder is not None:
            file = folder / f"{index}.html"
            page.write(graph, file, camera_path_world=np.array(path), space=builder.space)
            steps.append((seen(frame, result), file))
    recording.close()
    with browser() as opened:
        # All are seen from where the last one is seen whole.
        from_there = drawn(opened, steps[-1][1], "[...camera.position, ...controls.target]")[1]
        place = f"camera.position.set({from_there[:3]}), controls.target.set({from_there[3:]})"
        place = place.replace("[", "").replace("]", "")
        shots = [drawn(opened, file, f"{place}, controls.update(), draw()")[0] for _, file in steps]
    return [beside(left, right) for (left, _), right in zip(steps, shots)]


def drawn(opened: Any, file: Path, script: str) -> tuple[UInt8, Any]:
    """The scene of a page, after a script; and what that returned."""
    shown = opened.new_page(viewport={"width": 700, "height": 520})
    shown.goto(file.as_uri())
    shown.add_style_tag(content="#side, #switches { display: none !important }")
    shown.wait_for_timeout(1500)
    value = shown.evaluate(f"({script})")
    shown.wait_for_timeout(1000)
    image = np.asarray(Image.open(io.BytesIO(shown.screenshot())).convert("RGB"))
    shown.close()
    return image, value


def main() -> None:
    """Write the picture."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    with tempfile.TemporaryDirectory() as folder:
        steps = pictures(Path(folder))
    durations = [STEP_MS] * (len(steps) - 1) + [LAST_MS]
    for quality in (75, 60, 45, 30):
        content = io.BytesIO()
        steps[0].save(
            content,
            "WEBP",
            save_all=True,
            append_images=steps[1:],
            duration=durations,
            loop=0,
            quality=quality,
            method=6,
        )
        if content.tell() <= MAX_BYTES:
            break
    out.write_bytes(content.getvalue())
    print(f"{out}: {len(steps)} steps, {steps[0].size}, {content.tell() / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
