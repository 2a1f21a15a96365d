"""Lifting and merging against the method of FROSS, on the rooms' recorded detections.

    python bench/fross.py DATA [--quick]

DATA is the folder of reference data with rooms/. FROSS's method is the implementation of
`evaluation/baselines`: a box is lifted at its centre. Its nodes and relations are kept in dense
arrays, as in its released code. Ours is `Lifting` and the surface rule: masks, depth refinement,
existence and names. Both process each frame in turn, in a second tour of the room. The larger graph
is synthetic: copies of the room's nodes stand elsewhere. The times are processor times.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from bench.figures import Figure, Paired, Setup, in_turn  # noqa: E402
from deworldsg_ros.config import Config  # noqa: E402
from deworldsg_ros.evaluation.baselines import (  # noqa: E402
    MAX_HELLINGER_DISTANCE,
    BaselineGraph,
    BaselineNode,
    Fross,
    between,
)
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, build_front_end  # noqa: E402
from deworldsg_ros.evaluation.recorded_room import open_annotations  # noqa: E402
from deworldsg_ros.graph.graph import GlobalGraph  # noqa: E402
from deworldsg_ros.graph_builder import graph_settings  # noqa: E402
from deworldsg_ros.lifting import Lifting  # noqa: E402
from deworldsg_ros.merging import Merging, build_merging  # noqa: E402
from deworldsg_ros.perception.stage import Perceived  # noqa: E402
from deworldsg_ros.recordings.recording import Recording, open_source  # noqa: E402
from deworldsg_ros.scene.camera import RgbdFrame  # noqa: E402
from deworldsg_ros.scene.gaussian import fuse, hellinger_distance  # noqa: E402

SCAN = "rooms_0"
NODES = 50, 1000
# Frames of the room that each tour uses: every second one, at 5 Hz.
EVERY = 2
TOUR_NS = 3_600_000_000_000
# Copies stand this far apart.
PITCH_M = 20.0
METHOD = "FROSS's method (evaluation/baselines, dense arrays)"

Recorded = tuple[RgbdFrame, Perceived]


class DenseFross:
    """FROSS's method with its nodes and relations in arrays of a fixed capacity.

    Args:
        classes: number of classes.
        predicates: number of predicates.
        capacity: maximum number of nodes.
    """

    def __init__(self, classes: int, predicates: int, capacity: int) -> None:
        self._fross = Fross()
        self.alive = np.zeros(capacity, bool)
        self.means = np.zeros((capacity, 3))
        self.covariances = np.zeros((capacity, 3, 3))
        self.scores = np.zeros((capacity, classes))
        self.labels = np.full(capacity, -1)
        self.weights = np.zeros(capacity)
        self.counts = np.zeros((capacity, capacity, predicates), np.int64)

    def __len__(self) -> int:
        return int(self.alive.sum())

    def process(self, recorded: Recorded) -> None:
        """Lift a frame and merge its nodes."""
        frame, perceived = recorded
        lifted = self._fross.lift(
            perceived.frame_graph, frame.rgb, frame.depth_m, frame.intrinsics, frame.T_world_camera
        )
        rows = [self.add(node) for node in lifted.nodes]
        merged_into: dict[int, int] = {}
        stack = list(rows)
        while stack:
            row = stack.pop()
            keeper = self._absorb(row) if self.alive[row] else None
            if keeper is not None:
                merged_into[row] = keeper
                stack.append(keeper)
        for index, row in enumerate(rows):
            while row in merged_into:
                row = rows[index] = merged_into[row]
        relations = between(perceived.frame_graph.relations, lifted.rows)
        for (subject, object_), logits in zip(relations.pairs.tolist(), relations.logits):
            if rows[subject] != rows[object_]:
                self.counts[rows[subject], rows[object_], logits.argmax()] += 1

    def add(self, node: BaselineNode) -> int:
        """Add a node in a free row; returns the row."""
        row = int(self.alive.argmin())
        self.alive[row] = True
        self.means[row], self.covariances[row] = node.mean_world, node.covariance_world
        self.scores[row], self.labels[row] = node.class_scores, node.label
        self.weights[row] = node.weight
        return row

    def _absorb(self, row: int) -> int | None:
        """Merge a node into the nearest one of its class; returns the row of that, or None."""
        same = self.alive & (self.labels == self.labels[row])
        same[row] = False
        others = np.flatnonzero(same)
        if not len(others):
            return None
        distances = hellinger_distance(
            self.means[row], self.covariances[row], self.means[others], self.covariances[others]
        )
        nearest = int(distances.argmin())
        if distances[nearest] >= MAX_HELLINGER_DISTANCE:
            return None
        keeper = int(others[nearest])
        weights = self.weights[keeper], self.weights[row]
        weights = weights if sum(weights) > 0 else (1.0, 1.0)
        self.means[keeper], self.covariances[keeper] = fuse(
            weights[0],
            self.means[keeper],
            self.covariances[keeper],
            weights[1],
            self.means[row],
            self.covariances[row],
        )
        total = sum(weights)
        scores = weights[0] / total * self.scores[keeper] + weights[1] / total * self.scores[row]
        self.scores[keeper], self.labels[keeper] = scores, scores.argmax()
        self.weights[keeper] += self.weights[row]
        self.counts[keeper] += self.counts[row]
        self.counts[:, keeper] += self.counts[:, row]
        self.counts[row] = self.counts[:, row] = 0
        self.counts[keeper, keeper] = 0
        self.alive[row] = False
        return keeper

    def fill(self, count: int) -> None:
        """Add copies of the nodes elsewhere until there are `count`."""
        rows = np.flatnonzero(self.alive)
        for number in range(count - len(rows)):
            row, new = rows[number % len(rows)], int(self.alive.argmin())
            self.alive[new] = True
            for array in (self.covariances, self.scores, self.labels, self.weights):
                array[new] = array[row]
            self.means[new] = self.means[row] + offset_m(number // len(rows))


class Ours:
    """Lifting and the surface rule."""

    def __init__(self, frame: RgbdFrame, perceived: Perceived) -> None:
        self._config = Config()
        self._lifting = Lifting(self._config.lifting)
        self._lifting.warm_up()
        settings = graph_settings(self._config.merging)
        self.graph = GlobalGraph(perceived.frame_graph.vocabulary, frame.frame_id, **settings)
        self._merging = self._new_merging()
        self._merging.warm_up()

    def _new_merging(self) -> Merging:
        return build_merging(self._config.merging, self._config.output.min_existence)

    def process(self, recorded: Recorded) -> None:
        """Lift a frame and merge it."""
        frame, perceived = recorded
        local = self._lifting.lift_frame(perceived.frame_graph, perceived.instances, frame)
        self._merging.merge(self.graph, local)

    def fill(self, count: int) -> None:
        """Add copies of the nodes elsewhere until there are `count`."""
        nodes, slots, known = self.graph.nodes, self.graph.nodes.slots.tolist(), len(self.graph)
        for number in range(count - known):
            slot, shift_m = slots[number % known], offset_m(number // known)
            self.graph.add_node(
                nodes.means[slot] + shift_m,
                nodes.covariances[slot].copy(),
                nodes.class_probabilities[slot].copy(),
                int(nodes.last_seen_ns[slot]),
                nodes.surface(slot) + shift_m.astype(np.float32),
                float(nodes.weights[slot]),
            )
        memory = self._merging.memory()
        self._merging = self._new_merging()
        self._merging.restore(self.graph, {} if count > known else memory)


def offset_m(copy: int) -> np.ndarray:
    """Where a copy of the room stands."""
    return PITCH_M * np.array([1 + copy % 5, copy // 5, 0.0])


def recorded_frames(rooms: Path, limit: int | None) -> list[Recorded]:
    """Frames of a room with recorded detections."""
    config = Config()
    annotations = open_annotations(rooms, "replica")
    source = open_source(annotations.scan_folder(SCAN))
    front_end = build_front_end(FrontEndChoice("recorded"), annotations, SCAN, source, config)
    frames = Recording(source, config.inputs).frames()
    try:
        return [(frame, front_end.perceive(frame)) for frame in islice(frames, 0, limit, EVERY)]
    finally:
        source.close()


def second_tour(frames: list[Recorded]) -> list[Recorded]:
    """The same frames, later."""
    return [
        (
            replace(frame, stamp_ns=frame.stamp_ns + TOUR_NS),
            replace(
                seen,
                frame_graph=replace(seen.frame_graph, stamp_ns=frame.stamp_ns + TOUR_NS),
            ),
        )
        for frame, seen in frames
    ]


def check_method(frames: list[Recorded], dense: DenseFross) -> None:
    """The dense arrays must give the nodes of the evaluated baseline."""
    fross, vocabulary = Fross(), frames[0][1].frame_graph.vocabulary
    graph = BaselineGraph(vocabulary, "world", fross.choose, fross.fuse)
    for frame, seen in frames:
        lifted = fross.lift(
            seen.frame_graph, frame.rgb, frame.depth_m, frame.intrinsics, frame.T_world_camera
        )
        relations = between(seen.frame_graph.relations, lifted.rows)
        graph.integrate(lifted.nodes, relations, frame.stamp_ns)
    means = np.array([node.mean_world for node in graph.nodes.values()])
    assert len(graph.nodes) == len(dense), (len(graph.nodes), len(dense))
    kept = dense.means[dense.alive]
    np.testing.assert_allclose(kept[np.lexsort(kept.T)], means[np.lexsort(means.T)], atol=1e-9)


def compare(frames: list[Recorded], count: int) -> tuple[Paired, int, int]:
    """Both methods in turn, in graphs of about `count` nodes; the numbers of nodes at the end."""
    vocabulary = frames[0][1].frame_graph.vocabulary
    # As in the released code: room for 1000 nodes at first, then twice as many.
    capacity = 1000 if count + len(frames) < 1000 else 2000
    fross = DenseFross(len(vocabulary.classes), len(vocabulary.predicates), capacity)
    ours = Ours(*frames[0])
    for recorded in frames:
        fross.process(recorded)
        ours.process(recorded)
    check_method(frames, fross)
    fross.fill(count)
    ours.fill(count)
    later = second_tour(frames)
    for_ours, for_fross = iter(later), iter(later)
    paired = in_turn(
        lambda: ours.process(next(for_ours)), lambda: fross.process(next(for_fross)), len(later)
    )
    return paired, len(ours.graph), len(fross)


def measure(rooms: Path, quick: bool) -> list[Figure]:
    """Figures on the unpacked rooms."""
    cv2.setNumThreads(1)
    frames = recorded_frames(rooms, 40 if quick else None)
    found = []
    for count, target in zip(NODES, (1, 10)):
        paired, our_nodes, fross_nodes = compare(frames, count)
        objects = np.mean([len(seen.frame_graph) for _, seen in frames])
        found.append(
            Figure(
                f"lifting_and_merging_{count}_nodes",
                paired.ours_ms,
                "ms",
                reference=METHOD,
                reference_value=paired.reference_ms,
                ratio=paired.ratio,
                ratio_target=target,
                note=f"{len(frames)} frames of {SCAN} with {objects:.1f} objects, second tour; "
                f"{our_nodes} nodes of ours and {fross_nodes} of FROSS; processor time",
            )
        )
    return found


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`."""
    data = setup.folder("rooms")
    if (data / "noisy").is_dir():
        return measure(data / "noisy", setup.quick)
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, str(data / "unpack.py"), folder, SCAN], check=True)
        return measure(Path(folder) / "noisy", setup.quick)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of reference data")
    parser.add_argument("--quick", action="store_true", help="few frames")
    options = parser.parse_args()
    for figure in figures(Setup(options.data, options.quick)):
        print(
            f"{figure.name}: {figure.value:.2f} ms; {figure.reference} "
            f"{figure.reference_value:.2f} ms; ratio {figure.ratio:.1f} ({figure.note})"
        )


if __name__ == "__main__":
    main()
