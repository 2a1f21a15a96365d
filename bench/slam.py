"""What is left of a drift after a SLAM system closed its loop, and what following it costs.

    python bench/slam.py [ROOMS] [--quick]

A camera goes through a room, and a third of the way again. Its poses drift by 1 m and 5 degrees.
Then the loop is closed: all poses are true, and the graph is told so. The graph is compared with
that of the same frames under true poses. Without ROOMS, the shipped recording is used; its
detections are those of its ground truth. The cost is that of a synthetic map of 10 000 nodes that
all move, with 1 000 keyframes (`synthetic_map.py`).
"""

from __future__ import annotations

import argparse
import sys
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from deworldsg_ros.config import Config  # noqa: E402
from deworldsg_ros.evaluation.edge_measures import ReferenceScene, read_reference  # noqa: E402
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, build_front_end  # noqa: E402
from deworldsg_ros.evaluation.graph_measures import measure  # noqa: E402
from deworldsg_ros.evaluation.recorded_room import open_annotations  # noqa: E402
from deworldsg_ros.evaluation.runner import translate  # noqa: E402
from deworldsg_ros.graph_builder import GraphBuilder, warm_up  # noqa: E402
from deworldsg_ros.lifting.stage import Lifting  # noqa: E402
from deworldsg_ros.poses.drift import moved  # noqa: E402
from deworldsg_ros.recordings.recording import Recording, open_source  # noqa: E402
from deworldsg_ros.scene.arrays import Float64  # noqa: E402
from deworldsg_ros.scene.camera import invert_pose, rigid_motion  # noqa: E402
from deworldsg_ros.scene.frame_graph import LocalGraph, derived  # noqa: E402
from deworldsg_ros.wire import messages as wire  # noqa: E402
from deworldsg_ros.wire.follow import GraphReplica  # noqa: E402

SHIPPED = ROOT / "bags" / "demo_room"
DRIFT_M, DRIFT_DEG = 1.0, 5.0
# A SLAM system publishes a pose after so many frames, and its own body's: the camera is mounted
# 20 cm before and 1 m above it, and looks ahead.
EVERY = 8
T_BODY_CAMERA = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1.0]])
NODES, KEYFRAMES = 10_000, 1_000


class Room(NamedTuple):
    """The local graphs of a room under true poses, and what is true of it."""

    frames: list[LocalGraph]
    reference: ReferenceScene
    annotations: object


def read_room(rooms: Path | None, scan: str, count: int | None = None) -> Room:
    """Lift the frames of a room, and a third of them again."""
    root, layout = (SHIPPED, "recording") if rooms is None else (rooms, "replica")
    annotations = open_annotations(root, layout)
    scan = scan or next(iter(annotations.scans()))
    source = open_source(SHIPPED if rooms is None else annotations.scan_folder(scan))
    config = Config()
    kind = "ground-truth" if rooms is None else "recorded"
    front_end = build_front_end(FrontEndChoice(kind), annotations, scan, source, config)
    recording, lifting, frames = Recording(source, config.inputs), Lifting(config.lifting), []
    for frame in islice(recording.frames(), count):
        seen = front_end.perceive(frame)
        frames.append(lifting.lift_frame(seen.frame_graph, seen.instances, frame))
    recording.close()
    last_ns = frames[-1].stamp_ns - frames[0].stamp_ns + 100_000_000
    again = [derived(f, stamp_ns=f.stamp_ns + last_ns) for f in frames[: len(frames) // 3]]
    points = annotations.points(scan)
    return Room(frames + again, read_reference(annotations, scan, points), annotations)


def drifting(frames: list[LocalGraph]) -> list[LocalGraph]:
    """The frames under poses whose error grows evenly with the way of the camera."""
    places = np.array([frame.T_world_camera[:3, 3] for frame in frames])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    found = []
    for frame, part in zip(frames, way / way[-1]):
        turn = np.radians(DRIFT_DEG * part) * np.array([0.0, 0.0, 1.0])
        error = rigid_motion(DRIFT_M * part * np.array([0.8, -0.6, 0.0]), turn)
        about = rigid_motion(places[0], np.zeros(3))
        found.append(moved(frame, about @ error @ invert_pose(about)))
    return found


def trajectory(frames: list[LocalGraph]) -> tuple[np.ndarray, Float64]:
    """What SLAM publishes: stamps, and poses of the robot's body."""
    chosen = frames[::EVERY] if (len(frames) - 1) % EVERY == 0 else [*frames[::EVERY], frames[-1]]
    poses = [frame.T_world_camera @ invert_pose(T_BODY_CAMERA) for frame in chosen]
    return np.array([frame.stamp_ns for frame in chosen]), np.array(poses)


def run(
    frames: list[LocalGraph], true: list[LocalGraph], follows: str, corrects: bool = True
) -> tuple[wire.SceneGraphMessage, bool]:
    """The graph of frames; at their end, SLAM has the true poses.

    Args:
        frames: under the poses as they came.
        true: the same under true poses.
        follows: trajectory, jump (only how the newest pose moved), or nothing.
        corrects: whether the node's own correction of drift is on.

    Returns:
        The graph, and whether the copy of a client that followed the updates is equal.
    """
    builder, copy = GraphBuilder(Config(), frames[0].vocabulary, frames[0].frame_id), GraphReplica()
    copy.reset(builder.snapshot())
    if not corrects:
        builder._drift = None
    for number, frame in enumerate(frames):
        builder.integrate(frame)
        if follows == "trajectory" and number % EVERY == 0:
            builder.apply_trajectory(*trajectory(frames[: number + 1]))
        if (update := builder.update()) is not None:
            copy.apply(update)
    if follows == "trajectory":
        builder.apply_trajectory(*trajectory(true))
    elif follows == "jump":
        jump = true[-1].T_world_camera @ invert_pose(frames[-1].T_world_camera)
        builder.apply_jump(jump, frames[-1].stamp_ns + 1)
    while (update := builder.update()) is not None or builder.waiting:
        if update is not None:
            copy.apply(update)
    shown = builder.snapshot()
    same = dict(copy.nodes) == {node.id: node for node in shown.nodes}
    same &= (
        list(copy.edges.values()) == []
        if not shown.edges
        else sorted(copy.edges.values(), key=lambda edge: (edge.subject, edge.object))
        == shown.edges
    )
    return builder.full(), same


def report(room: Room, ways_: list[str] | None = None) -> list[tuple[str, dict[str, float]]]:
    """The measures of each way, by name."""
    warm_up(Config())
    wrong = drifting(room.frames)
    ways = {
        "true poses": (room.frames, "nothing", True),
        "drift, own correction": (wrong, "nothing", True),
        "drift, own correction, followed": (wrong, "trajectory", True),
        "drift": (wrong, "nothing", False),
        "drift, followed": (wrong, "trajectory", False),
        "drift, jump only": (wrong, "jump", False),
    }
    found = []
    for name, (frames, follows, corrects) in ways.items():
        if ways_ and name not in ways_:
            continue
        graph, same = run(frames, room.frames, follows, corrects)
        m = measure(translate(graph, room.annotations), room.reference)
        edges = m.edge_scores()["all"]
        errors = np.array(m.main_errors_m)
        numbers = {
            "objects": m.objects,
            "found": m.found,
            "nodes": m.nodes,
            "duplicates": m.duplicates,
            "nodes_an_object": m.matched / max(m.found, 1),
            "stray": m.stray,
            "worst_m": float(errors.max(initial=0.0)),
            "median_m": float(np.median(errors)) if len(errors) else 0.0,
            "within_10cm": int((errors < 0.1).sum()),
            "relations": 100 * edges.recall,
            "precision": 100 * edges.precision,
            "copy": float(same),
        }
        found.append((name, numbers))
        print(f"{name:32s}", *(f"{k} {v:.2f}" for k, v in numbers.items()), flush=True)
    return found


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rooms", type=Path, nargs="?")
    parser.add_argument("--scan", default="")
    parser.add_argument("--count", type=int)
    options = parser.parse_args()
    report(read_room(options.rooms, options.scan, options.count))


if __name__ == "__main__":
    main()
