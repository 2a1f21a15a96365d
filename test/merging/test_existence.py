"""A node is published as soon as it is likely to be an object, and hidden when it is not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from msgspec import UNSET
from support.merging import VOCABULARY
from support.node_states import node_states
from support.surfaces import CUP, HERE, depth_grid, frame

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.merging import PaperMerging, SurfaceMerging, beliefs
from deworldsg_ros.merging.records import NodeRecords
from deworldsg_ros.merging.views import FULL, HALF, QUARTER

STEP_M = 0.05  # 4 degrees, seen from the cup


class Walk:
    """A cup before a wall, and a camera that moves sideways or stands still."""

    def __init__(self, frames_per_s: float = 10.0, min_existence: float = 0.5) -> None:
        self.graph = SceneGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig(), min_existence)
        self.period_ns = round(1e9 / frames_per_s)
        self.stamp_ns = 0
        self.x_m = 0.0
        self.direction = 1

    def see(
        self,
        *,
        detected: bool,
        step_m: float = STEP_M,
        z_m: float = 0.0,
        score: float = 0.9,
    ) -> None:
        """One frame of the cup, detected or not; the camera moves to and fro by this step."""
        self.stamp_ns += self.period_ns
        self.x_m += self.direction * step_m
        if abs(self.x_m) > 0.25:
            self.direction *= -1
        pose = np.eye(4)
        pose[:3, 3] = self.x_m, 0.0, z_m
        points = HERE - pose[:3, 3].astype(np.float32)
        in_view = points[np.abs(points[:, 0]) < points[:, 2]]
        grid = depth_grid(in_view, background_m=1.0 - z_m)
        changes = {"T_world_camera": pose, "depth_grid": grid, "stamp_ns": self.stamp_ns}
        if detected:
            changes["scores"] = np.array([score])
        objects = [(HERE, CUP)] if detected else []
        self.merging.merge(self.graph, frame(0, *objects, **changes))

    def reload(self, path: Path) -> None:
        """Continue with the saved graph alone, without the memory of the rule."""
        graph_files.save(self.graph, path)
        self.graph = graph_files.load(path)
        self.merging = SurfaceMerging(MergingConfig())
        self.merging.restore(self.graph, {})

    @property
    def published(self) -> list[int]:
        return list(node_states(self.graph, 1))

    @property
    def existence(self) -> float:
        return float(self.graph.nodes.existence[0])


def test_one_sure_look_is_enough_if_there_are_few() -> None:
    walk = Walk(frames_per_s=1.0)
    walk.see(detected=True)
    assert walk.published == [1]
    state = node_states(walk.graph, 1)[1]
    assert state.existence == walk.existence > 0.6


def test_one_frame_of_many_is_not_enough() -> None:
    walk = Walk()
    walk.see(detected=False)
    walk.see(detected=True)
    assert walk.published == [] and 0.0 < walk.existence < 0.5
    assert walk.merging.hidden(walk.graph) == {1: "seen too little"}
    for _ in range(5):
        walk.see(detected=True)
    assert walk.published == [1] and walk.merging.hidden(walk.graph) == {}


def test_unsure_looks_from_different_positions_add_up() -> None:
    """Scores of 0.2 are far below the usual threshold of a detector."""
    moving, still = Walk(frames_per_s=1.0), Walk(frames_per_s=1.0)
    for _ in range(3):
        moving.see(detected=True, score=0.2)
        still.see(detected=True, score=0.2, step_m=0.0)
        if not moving.published:
            assert moving.existence < 0.5
    assert moving.existence > still.existence + 0.1
    for _ in range(10):
        still.see(detected=True, score=0.2, step_m=0.0)
    assert still.published == moving.published == [1]


def test_a_higher_score_makes_a_node_more_likely() -> None:
    beliefs = []
    for score in (0.3, 0.6, 0.9):
        walk = Walk(frames_per_s=1.0)
        walk.see(detected=True, score=score)
        beliefs.append(walk.existence)
    assert beliefs == sorted(beliefs) and beliefs[2] > beliefs[0] + 0.1


def test_the_reader_chooses_the_threshold() -> None:
    cautious, open_ = Walk(min_existence=0.95), Walk(min_existence=0.0)
    for walk in (cautious, open_):
        walk.see(detected=False)
        walk.see(detected=True, score=0.2)
    assert cautious.published == [] and open_.published == [1]
    for _ in range(60):
        cautious.see(detected=True)
    assert cautious.published == [1]


def test_a_node_missed_from_most_positions_is_hidden_until_it_is_detected_again() -> None:
    walk = Walk()
    for _ in range(12):
        walk.see(detected=True, score=0.4)
    assert walk.published == [1]
    for _ in range(600):
        walk.see(detected=False)
    assert walk.published == [] and list(walk.graph.nodes.slot_of) == [1]
    assert walk.merging.hidden(walk.graph) == {1: "missed by the detector"}
    for _ in range(100):
        walk.see(detected=True, score=0.4)
    assert walk.published == [1]


@pytest.mark.parametrize(
    ("frames", "step_m", "z_m"),
    [
        (12, STEP_M, -0.4),  # further away than any detection
        (3, 1.2, 0.0),  # out of view
    ],
)
def test_misses_that_are_no_evidence_change_nothing(frames: int, step_m: float, z_m: float) -> None:
    walk = Walk()
    for _ in range(11):
        walk.see(detected=True, step_m=0.0)
    before = walk.existence
    for _ in range(frames):
        walk.see(detected=False, step_m=step_m, z_m=z_m)
    assert walk.existence == before


def test_a_detection_that_lasted_a_moment_is_soon_hidden() -> None:
    """Two nodes with as many detections; those of one are more than a second apart."""
    moment, longer = Walk(), Walk()
    for index in range(6):
        moment.see(detected=True)
        longer.see(detected=True)
        if index == 3:
            longer.stamp_ns += 2 * 10**9
    assert moment.published == longer.published == [1]
    for _ in range(40):
        moment.see(detected=False)
        longer.see(detected=False)
    assert moment.published == [] and longer.published == [1]


def test_an_improbable_node_is_forgotten_and_a_hidden_one_is_kept() -> None:
    walk = Walk()
    walk.see(detected=False)
    walk.see(detected=True, score=0.2)
    for _ in range(20):
        walk.see(detected=False)
    assert walk.existence < 0.2
    walk.stamp_ns += 11 * 10**9
    walk.see(detected=False, step_m=5.0)
    assert len(walk.graph) == 0


def test_the_message_of_a_node_changes_with_its_rounded_existence_only() -> None:
    walk = Walk()
    for _ in range(60):
        walk.see(detected=True)
    walk.see(detected=False, step_m=0.0)
    before = node_states(walk.graph, 1)[1]
    walk.see(detected=False, step_m=0.0)
    after = node_states(walk.graph, 1)[1]
    assert after is before or after.existence != before.existence
    walk.see(detected=False, step_m=9.0)  # out of view
    assert node_states(walk.graph, 1)[1] is node_states(walk.graph, 1)[1]


def test_the_rule_of_the_paper_does_not_estimate_existence() -> None:
    graph, merging = SceneGraph(VOCABULARY, "world"), PaperMerging(MergingConfig())
    merging.merge(graph, frame(1, (HERE, CUP), scores=np.array([0.01])))
    assert node_states(graph, 1)[1].existence is UNSET and merging.hidden(graph) == {}


def test_a_loaded_node_is_published(tmp_path: Path) -> None:
    walk = Walk()
    for _ in range(10):
        walk.see(detected=True)
    walk.reload(tmp_path / "graph.npz")
    walk.see(detected=False)
    assert walk.published == [1]
    walk.see(detected=True)
    assert walk.published == [1] and list(walk.graph.nodes.slot_of) == [1]


def records_of(count: int) -> NodeRecords:
    records = NodeRecords()
    for node_id in range(1, count + 1):
        records.add(node_id - 1, node_id, np.ones(2) / 2, 0)
    return records


def look(
    records: NodeRecords,
    slot: int,
    camera_world: np.ndarray,
    stamp_ns: int,
    score: float,
    visibility: int = FULL,
    weight: float = 1.0,
) -> None:
    arrays = np.array([score]), np.array([visibility]), np.zeros((1, 3))
    records.last_ns = stamp_ns - round(weight * beliefs.LOOK_NS)
    records.look(np.array([slot]), *arrays, camera_world, stamp_ns)


def around(index: int) -> np.ndarray:
    return 2.0 * np.array([np.cos(0.3 * index), np.sin(0.3 * index), 0.0])


def test_at_a_high_detection_rate_a_miss_counts_for_more() -> None:
    beliefs = []
    for detects in (True, False):
        records = records_of(2)
        # A known object, detected in all looks or in every third one.
        for index in range(100):
            score = 0.9 if detects or index % 3 == 0 else 0.0
            look(records, 0, around(index), index * 10**9, score)
        for index in range(100, 103):
            look(records, 1, around(index), index * 10**9, 0.9)
        for index in range(103, 106):
            look(records, 1, around(index), index * 10**9, 0.0)
        beliefs.append(records.existence(np.array([1]))[0])
    assert beliefs[0] < beliefs[1] - 0.03


def test_where_new_nodes_turn_out_to_be_errors_a_new_one_is_less_probable() -> None:
    beliefs = []
    for fates in ([10, 60], [60, 10]):
        records = records_of(1)
        records.fates[:] = fates
        look(records, 0, around(0), 0, 0.5)
        beliefs.append(records.existence(np.array([0]))[0])
    assert beliefs[0] > beliefs[1] + 0.2


def test_the_fate_of_a_node_is_counted_once_and_only_after_a_clear_miss() -> None:
    records = records_of(3)
    records.rows["missed_since"][:3] = 0.0, 2.0, 0.0
    for _ in range(2):
        beliefs.settle(records.rows, records.fates, np.arange(3), np.array([0.95, 0.05, 0.05]))
        assert records.fates.tolist() == [11, 11]


@pytest.mark.parametrize("behind_s", [0, 10**6])
def test_restored_records_continue_if_the_clock_is_behind(behind_s: int) -> None:
    records = records_of(1)
    for index in range(20):
        look(records, 0, around(index), (10**7 + index) * 10**9, 0.9)
    before = records.existence(np.array([0]))[0]
    look(records, 0, around(20), (10**7 + 20 - behind_s) * 10**9, 0.9)
    assert records.existence(np.array([0]))[0] >= before > 0.9


def reference(looks: list[list[tuple[float, int, float]]], rates: dict[int, float]) -> float:
    """The log odds by the definition in `existence`, for a camera that moves between looks.

    Args:
        looks: the frames of each look: detection score, visibility and weight.
        rates: of detection, by visibility.
    """
    best = max(score for frames in looks for score, _, _ in frames)
    best = min(max(best, beliefs.MIN_SCORE), beliefs.MAX_SCORE)
    detected = missed = since = 0.0
    for frames in looks:
        total = sum(weight for _, _, weight in frames)
        fraction = sum(weight for score, _, weight in frames if score) / total
        visibility = max(visibility for _, visibility, _ in frames)
        evidence = (
            -min(beliefs.MAX_WEIGHT, total) * (1.0 - fraction) * math.log(1.0 - rates[visibility])
        )
        detected += min(beliefs.MAX_WEIGHT, total) * fraction
        missed += evidence
        since = 0.0 if fraction else since + evidence
    return (
        beliefs.OFFSET
        + beliefs.SCORE * math.log(best / (1 - best))
        + beliefs.LOOKS * math.log(detected)
        - beliefs.MISSES * math.log(1 + missed)
        - beliefs.MOMENT * math.log(1 + since)
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_log_odds_are_those_of_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    records, looks, stamp_ns = records_of(1), [], 0
    records.looks[:] = 2e12, 1e12  # so many looks that the rates stay one half
    for index in range(int(rng.integers(1, 8))):
        frames = []
        for number in range(int(rng.integers(1, 5))):
            first = index == number == 0
            score = float(rng.choice([0.0, 0.2, 0.6, 0.9])) if not first else 0.3
            frames.append((score, int(rng.choice([QUARTER, HALF, FULL])), 0.3))
        for score, visibility, weight in frames:
            stamp_ns += 10**6
            look(records, 0, around(index), stamp_ns, score, visibility, weight)
        looks.append(frames)
    odds = reference(looks, dict.fromkeys((QUARTER, HALF, FULL), 0.5))
    assert math.isclose(
        records.existence(np.array([0]))[0], 1 / (1 + math.exp(-odds)), rel_tol=1e-9
    )


def test_a_lost_node_of_an_open_graph_is_kept_until_its_time_is_over() -> None:
    """With a threshold of 0, improbable nodes are published, and may be lost, too."""
    walk = Walk(min_existence=0.0)
    walk.see(detected=False)
    walk.see(detected=True, score=0.2)
    empty = depth_grid()
    for _ in range(8):
        walk.stamp_ns += walk.period_ns
        walk.merging.merge(walk.graph, frame(0, stamp_ns=walk.stamp_ns, depth_grid=empty))
    assert walk.published == [] and walk.graph.nodes.existence[0] < 0.2
    for pause_ns, nodes in ((11 * 10**9, 1), (31 * 10**9, 0)):
        walk.stamp_ns += pause_ns
        walk.merging.merge(walk.graph, frame(0, stamp_ns=walk.stamp_ns, depth_grid=empty))
        assert len(walk.graph) == nodes
