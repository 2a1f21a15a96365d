"""Time of lifting and of its plain reference, on 12 masks of 640x480 (134 k mask pixels).

    python bench/lifting.py [ROUNDS]

The times are processor times. Both must find the same number of inliers.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from support.reference_lifting import reference_lift  # noqa: E402

from bench.figures import Figure, Paired, Setup, in_turn  # noqa: E402
from deworldsg_ros.config import LiftingConfig  # noqa: E402
from deworldsg_ros.lifting import Lifting  # noqa: E402
from deworldsg_ros.nodes import keep_freed_memory  # noqa: E402
from deworldsg_ros.scene.camera import Intrinsics  # noqa: E402
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, Relations, Vocabulary  # noqa: E402

HEIGHT, WIDTH, OBJECTS = 480, 640, 12
REFERENCE = "lifting without optimisation (test/support/reference_lifting.py)"


def make_frame(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Twelve elliptic masks over slanted surfaces. Each mask also covers some background."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    depth = 4.0 - v / HEIGHT
    instances = np.zeros((HEIGHT, WIDTH), np.uint16)
    for k in range(OBJECTS):
        row, column = divmod(k, 4)
        x = (u - (80 + 160 * column)) / 56
        y = (v - (80 + 160 * row)) / 56
        surface = x**2 + y**2 < 1
        depth[surface] = (1.2 + 0.15 * k + 0.1 * x)[surface]
        instances[x**2 + y**2 < 1.13] = k + 1
    if kind == "two layers":
        depth[:, :: WIDTH // 16] += 2.0
        depth[::3, : WIDTH // 2] += 0.8
    depth += rng.normal(0, 0.002, depth.shape) * depth
    depth[rng.random(depth.shape) < 0.02] = 0
    if kind == "millimetres":
        depth = np.round(depth, 3)
    return instances, depth.astype(np.float32)


def compare(lifting: Lifting, kind: str, rounds: int) -> tuple[Paired, int]:
    """Lifting and its reference in turn, on a kind of frame; and the number of mask pixels."""
    intrinsics = Intrinsics(525.0, 525.0, 319.5, 239.5, WIDTH, HEIGHT)
    graph = FrameGraph(
        0,
        "camera",
        WIDTH,
        HEIGHT,
        Vocabulary(("object",), ()),
        np.zeros((OBJECTS, 4)),
        np.ones((OBJECTS, 1)),
        np.ones(OBJECTS),
        Relations.none(0),
    )
    instances, depth_m = make_frame(kind)
    # As in the nodes. Else the time that glibc takes to return the memory of the reference to the
    # operating system, 1.5 ms, falls into lifting, which frees last.
    keep_freed_memory()

    def lift() -> LocalGraph:
        return lifting.lift(graph, instances, depth_m, intrinsics, np.eye(4), "world")

    def lift_plainly() -> list:
        return reference_lift(
            instances, depth_m, intrinsics, np.eye(4), LiftingConfig(), OBJECTS, fast_median=True
        )

    assert [int(r.inliers.sum()) for r in lift_plainly()] == lift().pixel_counts.tolist()
    return in_turn(lift, lift_plainly, rounds), int((instances > 0).sum())


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    cv2.setNumThreads(1)
    lifting = Lifting(LiftingConfig())
    lifting.warm_up()
    found = []
    for kind in ("smooth", "millimetres", "two layers"):
        paired, pixels = compare(lifting, kind, 3 if setup.quick else 31)
        found.append(
            Figure(
                f"lifting_{kind.replace(' ', '_')}",
                paired.ours_ms,
                "ms",
                target=2.5,
                reference=REFERENCE,
                reference_value=paired.reference_ms,
                ratio=paired.ratio,
                ratio_target=14,
                note=f"a frame of {OBJECTS} masks, {pixels} mask pixels, processor time",
            )
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rounds", type=int, nargs="?", default=31, help="number of measurements")
    rounds = parser.parse_args().rounds
    cv2.setNumThreads(1)
    lifting = Lifting(LiftingConfig())
    start = time.process_time()
    lifting.warm_up()
    print(f"warm-up {time.process_time() - start:.2f} s")
    for kind in ("smooth", "millimetres", "two layers"):
        paired, pixels = compare(lifting, kind, rounds)
        print(
            f"{kind:12} {pixels} mask pixels, {OBJECTS} objects: {paired.ours_ms:.2f} ms; "
            f"reference {paired.reference_ms:.1f} ms; ratio {paired.ratio:.1f}"
        )


if __name__ == "__main__":
    main()
