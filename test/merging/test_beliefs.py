"""Existence and class of a node: equal to their definitions, and right over a walk."""

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.merging import VOCABULARY, node_states, random_local_graphs
from support.surfaces import CUP, HERE, depth_grid, frame

from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.merging import SurfaceMerging, beliefs
from deworldsg_ros.merging.records import RECORD, NodeRecords
from deworldsg_ros.merging.views import FULL, HALF, QUARTER

# --- existence, over a walk ----------------------------------------------------------------------

STEP_M = 0.05  # 4 degrees, seen from the cup


class Walk:
    """A cup before a wall, and a camera that moves sideways or stands still."""

    def __init__(self, frames_per_s: float = 10.0, min_existence: float = 0.5) -> None:
        self.graph = GlobalGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig(), min_existence)
        self.period_ns = round(1e9 / frames_per_s)
        self.stamp_ns = 0
        self.x_m = 0.0
        self.direction = 1

    def see(
        self, times: int = 1, *, score: float = 0.9, step_m: float = STEP_M, z_m: float = 0.0
    ) -> None:
        """Frames of the cup; a score of 0 is no detection. The camera moves to and fro."""
        for _ in range(times):
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
            objects = [(HERE, CUP)] if score else []
            scores = np.full(len(objects), score)
            self.merging.merge(self.graph, frame(0, *objects, scores=scores, **changes))

    def miss(self, times: int = 1, **changes: float) -> None:
        self.see(times, score=0.0, **changes)

    @property
    def published(self) -> list[int]:
        return list(node_states(self.graph, 1))

    @property
    def existence(self) -> float:
        return float(self.graph.nodes.existence[0])

    @property
    def hidden(self) -> dict[int, str]:
        return self.merging.hidden(self.graph)


def test_one_sure_look_is_enough_if_there_are_few() -> None:
    walk = Walk(frames_per_s=1.0)
    walk.see()
    assert walk.published == [1]
    assert node_states(walk.graph, 1)[1].existence == walk.existence > 0.5


def test_one_frame_of_many_is_not_enough() -> None:
    walk = Walk()
    walk.miss(5, step_m=0.0)
    walk.see(step_m=0.0)
    assert walk.published == [] and 0.0 < walk.existence < 0.5
    assert walk.hidden == {1: "missed by the detector"}
    walk.see(5)
    assert walk.published == [1] and walk.hidden == {}


def test_the_reader_chooses_the_threshold() -> None:
    cautious, open_ = Walk(min_existence=0.8), Walk(min_existence=0.0)
    for walk in (cautious, open_):
        walk.miss()
        walk.see(score=0.2)
    assert cautious.published == [] and open_.published == [1]
    cautious.see(60)
    assert cautious.published == [1]


def test_a_lost_node_of_an_open_graph_is_kept_until_its_time_is_over() -> None:
    """With a threshold of 0, improbable nodes are published, and may be lost, too."""
    walk = Walk(min_existence=0.0)
    walk.miss()
    walk.see(score=0.2)
    for count, nodes in ((8, 1), (880, 1), (30, 0)):
        for _ in range(count):
            walk.stamp_ns += walk.period_ns
            local = frame(0, stamp_ns=walk.stamp_ns, depth_grid=depth_grid())
            walk.merging.merge(walk.graph, local)
        assert len(walk.graph) == nodes and walk.published == []


def test_a_node_missed_from_most_positions_is_hidden_until_it_is_detected_again() -> None:
    walk = Walk()
    walk.see(12, score=0.4)
    assert walk.published == [1]
    walk.miss(90)
    assert walk.published == [] and list(walk.graph.nodes.slot_of) == [1]
    assert walk.hidden == {1: "missed by the detector"}
    walk.see(100, score=0.4)
    assert walk.published == [1]


@pytest.mark.parametrize(
    ("frames", "changes"),
    [(12, {"z_m": -0.4}), (1, {"step_m": 1.2})],  # further away than detections; out of view
)
def test_misses_that_are_no_evidence_change_nothing(frames: int, changes: dict) -> None:
    walk = Walk()
    walk.see(11, step_m=0.0)
    before = walk.existence
    walk.miss(frames, **changes)
    assert walk.existence == before


def test_an_improbable_node_is_forgotten() -> None:
    walk = Walk()
    walk.miss()
    walk.see(score=0.2)
    walk.miss(20)
    assert walk.existence < 0.2
    walk.miss(100, step_m=5.0)
    assert len(walk.graph) == 0


def test_a_merged_node_was_last_detected_when_either_was() -> None:
    """Else the frame that merges a new node into an improbable one forgets both."""
    walk = Walk()
    walk.see()
    walk.miss(50, step_m=5.0)
    beside = HERE + np.array([0.3, 0.0, 0.0], np.float32)
    local = frame(0, (beside, CUP), scores=np.ones(1), stamp_ns=walk.stamp_ns + 1)
    walk.merging.merge(walk.graph, local)
    records, slot_of = walk.merging._records, walk.graph.nodes.slot_of
    first, second = records.rows["last_frame"][[slot_of[1], slot_of[2]]]
    assert first < second
    walk.graph.merge_nodes(1, 2)
    records.merge(walk.graph, slot_of[1], int(1 - slot_of[1]))
    assert records.rows["last_frame"][slot_of[1]] == second


def test_a_loaded_node_is_published(tmp_path: Path) -> None:
    walk = Walk()
    walk.see(10)
    # The saved graph alone, without the memory of the rule.
    graph_files.save(walk.graph, tmp_path / "graph.npz")
    walk.graph = graph_files.load(tmp_path / "graph.npz")
    walk.merging = SurfaceMerging(MergingConfig())
    walk.merging.restore(walk.graph, {})
    for look in (walk.miss, walk.see):
        look()
        assert walk.published == [1] and list(walk.graph.nodes.slot_of) == [1]


# --- existence, by its definition ----------------------------------------------------------------


def records_of(count: int) -> NodeRecords:
    records = NodeRecords()
    for node_id in range(1, count + 1):
        records.add(node_id - 1, node_id, np.ones(2) / 2)
    return records


def camera_at(position: int) -> np.ndarray:
    """One of the positions around a node, 17 degrees apart."""
    return 2.0 * np.array([np.cos(0.3 * position), np.sin(0.3 * position), 0.0])


def look(
    records: NodeRecords, slot: int, position: int, score: float, visibility: int = FULL
) -> None:
    """A frame from a position around a node."""
    arrays = np.array([score]), np.array([visibility]), np.zeros((1, 3))
    records.look(np.array([slot]), *arrays, camera_at(position))


def existence_of(records: NodeRecords, slot: int = 0) -> float:
    return float(records.existence(np.array([slot]))[0])


def test_at_a_high_detection_rate_a_miss_counts_for_more() -> None:
    found = []
    for detects in (True, False):
        records = records_of(2)
        # A known object, detected from all viewpoints or from every third one.
        for index in range(20):
            look(records, 0, index, 0.9 if detects or index % 3 == 0 else 0.0)
        for index in range(6):
            look(records, 1, index, 0.9 if index < 3 else 0.0)
        found.append(existence_of(records, 1))
    assert found[0] < found[1] - 0.03


def test_where_new_nodes_turn_out_to_be_errors_a_new_one_is_less_probable() -> None:
    found = []
    for fates in ([10, 60], [60, 10]):
        records = records_of(1)
        records.fates[:] = fates
        look(records, 0, 0, 0.5)
        found.append(existence_of(records))
    assert found[0] > found[1] + 0.2


def test_what_was_seen_once_and_missed_from_other_sides_is_an_error_that_counts() -> None:
    records, both = records_of(2), np.arange(2)
    for index in range(8):
        for slot in both.tolist():
            look(records, slot, index, 0.9 if slot or index == 0 else 0.0)
    records.looks[:] = beliefs.first_counts() + 60 * np.array([1.0, 0.9])
    np.testing.assert_array_equal(records.settle(both), records.existence(both))
    first = beliefs.first_fates().tolist()
    assert records.fates.tolist() == [first[0] + 1, first[1] + 1]
    records.settle(both)  # each counts once
    assert sum(records.fates) == sum(first) + 2


def test_a_viewpoint_counts_once_however_long_it_lasts_and_however_often_it_returns() -> None:
    records = records_of(2)
    for position in (0, 1, 2):
        look(records, 0, position, 0.9)
        for _ in range(100):
            look(records, 1, position, 0.9)
    for position in (1, 0, 2, 1) * 20:
        look(records, 1, position, 0.9)
    records.looks[:] = beliefs.first_counts()  # the rates have learned
    assert existence_of(records, 0) == existence_of(records, 1) > 0.5


def log_odds(views: dict[int, list[tuple[float, int]]], rate: float) -> float:
    """The definition in `beliefs`.

    Args:
        views: the frames of each viewpoint, in the order of the first ones: score and visibility.
        rate: of detection.
    """
    best = max(score for frames in views.values() for score, _ in frames)
    best = min(max(best, beliefs.MIN_SCORE), beliefs.MAX_SCORE)
    detected = missed = since = 0.0
    detecting = 0
    for frames in views.values():
        fraction = sum(score > 0 for score, _ in frames) / len(frames)
        evidence = -(1.0 - fraction) * math.log(1.0 - rate)
        detected += min(1.0, fraction / rate)
        missed += evidence
        since = 0.0 if fraction else since + evidence
        detecting += fraction > 0
    result = (
        beliefs.OFFSET
        + beliefs.SCORE * math.log(best / (1 - best))
        + beliefs.LOOKS * math.log(detected)
        - beliefs.MISSES * math.log(1 + missed)
    )
    if detecting <= beliefs.MOMENT_VIEWS:
        result -= beliefs.MOMENT * math.log(1 + since)
    return beliefs.SLOPE * result


@pytest.mark.parametrize("seed", range(20))
def test_the_log_odds_are_those_of_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    records, views = records_of(1), {}
    records.looks[:] = 2e12, 1e12  # after so many viewpoints, the rates stay at one half
    # More viewpoints than are remembered, and some of them again while they are.
    for index in range(int(rng.integers(1, 20))):
        position = index if index < 3 or rng.random() < 0.7 else index - 1
        for _ in range(int(rng.integers(1, 5))):
            score = float(rng.choice([0.0, 0.2, 0.6, 0.9])) if views else 0.3
            visibility = int(rng.choice([QUARTER, HALF, FULL]))
            views.setdefault(position, []).append((score, visibility))
            look(records, 0, position, score, visibility)
    expected = 1 / (1 + math.exp(-log_odds(views, 0.5)))
    assert existence_of(records) == pytest.approx(expected, rel=1e-6)


# --- classes -------------------------------------------------------------------------------------

COUNT = 12


def named(frames: list[np.ndarray], frames_per_view: int = 3) -> np.ndarray:
    """Class distribution after frames with these distributions, on a way around the node."""
    records, classes = NodeRecords(), frames[0][None]
    records.said[:] = 10**9  # of a source that earns nothing
    records.add(0, 1, frames[0])
    look(records, 0, 0, 0.9)
    for index, seen in enumerate(frames[1:], 1):
        position = index // frames_per_view
        classes = records.name(np.array([0]), seen[None], np.zeros((1, 3)), camera_at(position))
        look(records, 0, position, 0.9)
    assert np.isclose(classes.sum(), 1.0) and (classes > 0).all()
    return classes[0]


def frames_of(labels: list[int], certainty: float = 0.85) -> list[np.ndarray]:
    """What a detector says: one label, and a little of each."""
    rest = (1 - certainty) / (COUNT - 1)
    return [np.where(np.arange(COUNT) == label, certainty, rest) for label in labels]


def random_errors(seed: int) -> list[int]:
    """More labels than there are places for."""
    wrong = np.random.default_rng(seed).integers(COUNT, size=20).tolist()
    return [3] * 5 + [label for other in wrong for label in (other, 3)]


@pytest.mark.parametrize(
    "labels",
    [
        [3] * 2,
        ([3] * 4 + [5]) * 10,  # single wrong frames do not matter
        # The wrong name has more frames, but its single spell could be chance: three are not.
        [3] * 6 + [5] * 20 + [3] * 6 + [7] * 4 + [3] * 6,
        *map(random_errors, range(3)),
        [3] * 54 + [5] * 5,  # a name of many viewpoints is not lost to the last one
    ],
)
def test_the_name_that_returns_wins(labels: list[int]) -> None:
    assert named(frames_of(labels)).argmax() == 3


def test_views_do_not_make_a_name_surer_than_the_surest_of_them() -> None:
    rest = (1 - 0.6) / COUNT
    assert named(frames_of([3] * 40, 0.6), 1)[3] == pytest.approx(0.6 + rest, abs=0.01)
    once = [*frames_of([3] * 20, 0.6), *frames_of([3], 0.9), *frames_of([3] * 20, 0.6)]
    assert named(once, 1)[3] == pytest.approx(0.9, abs=0.01)


def filtered(frames: list[np.ndarray], frames_per_view: int) -> np.ndarray:
    """The same filter with all labels, by matrices; for few classes."""
    count = len(frames[0])
    drawn = np.full((count, count), beliefs.WRONG / (count - 1))
    np.fill_diagonal(drawn, 1 - beliefs.WRONG)
    joint = drawn * frames[0][None]
    for index, seen in enumerate(frames[1:], 1):
        leave = beliefs.DRAWN if index % frames_per_view == 0 else 0.0
        joint = (1 - leave) * joint + leave * drawn * joint.sum(axis=1, keepdims=True)
        joint = joint * ((1 - beliefs.OUTLIERS) * seen + beliefs.OUTLIERS / count)[None]
        joint /= joint.sum()
    classes = joint.sum(axis=1)
    # The best name is no more certain than in the view that was most certain of it.
    others = max(beliefs.OTHERS, 1 - np.max(frames, axis=0)[classes.argmax()])
    return others / count + (1 - others) * classes


@pytest.mark.parametrize("seed", range(10))
def test_the_filter_is_that_of_the_definition(seed: int) -> None:
    """With no more classes than places, all labels are considered."""
    rng = np.random.default_rng(seed)
    frames = [rng.dirichlet(np.full(beliefs.LABELS, 0.5)) for _ in range(15)]
    np.testing.assert_allclose(named(frames, 3), filtered(frames, 3), rtol=1e-9)


def test_a_node_of_many_labels_that_is_seen_again_has_a_distribution() -> None:
    """A new record considers some labels only, and a viewpoint that has spoken says nothing."""
    records, slots = records_of(1), np.array([0])
    look(records, 0, 0, 0.9)
    look(records, 0, 1, 0.9)
    beliefs.start(records.rows[0], np.full(COUNT, 1 / COUNT))
    seen = np.full((1, COUNT), 1 / COUNT)
    for position in (1, 0):
        classes = records.name(slots, seen, np.zeros((1, 3)), camera_at(position))
        assert classes.sum() == pytest.approx(1.0)


def test_a_viewpoint_says_its_name_once() -> None:
    """The camera goes to and fro between two of three viewpoints."""
    seen = [frame[None] for frame in frames_of([3, 3, 5])]
    found = []
    for times in (1, 30):
        records = NodeRecords()
        records.add(0, 1, seen[0][0])
        look(records, 0, 0, 0.9)
        for position in (1, 2, *([1, 2] * (times - 1)), 1):
            where = np.zeros((1, 3)), camera_at(position)
            classes = records.name(np.array([0]), seen[position], *where)
            look(records, 0, position, 0.9)
        found.append(classes[0])
    np.testing.assert_allclose(*found)


def names_of_nodes(labels: np.ndarray) -> tuple[np.ndarray, NodeRecords]:
    """The distribution of each of n nodes after views (n, k) from as many sides, node by node."""
    records, found = NodeRecords(), []
    for slot, views in enumerate(labels):
        frames = frames_of(views.tolist(), 0.9)
        records.add(slot, slot + 1, frames[0])
        look(records, slot, 0, 0.9)
        for position, seen in enumerate(frames[1:], 1):
            where = np.zeros((1, 3)), camera_at(position)
            classes = records.name(np.array([slot]), seen[None], *where)
            look(records, slot, position, 0.9)
        found.append(classes[0])
    return np.array(found), records


def test_names_of_a_source_that_agrees_with_itself_become_surer_node_by_node() -> None:
    found, records = names_of_nodes(np.repeat(np.arange(40) % COUNT, 10).reshape(40, 10))
    surest = found.max(axis=1)
    assert (found.argmax(axis=1) == np.arange(40) % COUNT).all()
    assert (np.diff(surest) >= 0).all() and surest[0] < 0.94 and 0.97 < surest[-1] < 1.0
    # What is wrong everywhere agrees, too: some doubt stays.
    records.said[:] = 0, 10**9
    assert beliefs.doubt(records.said) == beliefs.LEAST_DOUBT


def test_names_of_a_source_that_contradicts_itself_are_as_at_first() -> None:
    labels = np.repeat(np.arange(40) % COUNT, 10).reshape(40, 10)
    labels[:, 1] = (labels[:, 1] + 1) % COUNT
    found, records = names_of_nodes(labels)
    assert beliefs.doubt(records.said) == 1.0
    assert found.max() <= 0.9 + 0.1 / COUNT + 1e-9


@pytest.mark.parametrize("contradictions", [0, 1, 5, 60])
def test_more_viewpoints_that_agree_never_add_doubt(contradictions: int) -> None:
    counts = np.arange(contradictions, 2000)
    doubts = [beliefs.doubt(np.array([contradictions, count])) for count in counts]
    assert (np.diff(doubts) <= 0).all() and max(doubts) <= 1.0
    more = [beliefs.doubt(np.array([contradictions + 1, count + 1])) for count in counts]
    assert (np.array(more) >= doubts).all()


def test_a_long_look_at_one_node_says_little_of_its_source() -> None:
    _, few = names_of_nodes(np.full((1, beliefs.VIEWS), 3))
    _, many = names_of_nodes(np.full((1, 40), 3))
    assert few.said.tolist() == many.said.tolist() == [0, beliefs.VIEWS - 1]


# --- stamps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1 / 3, 10.0])
def test_the_same_pictures_give_the_same_nodes_at_any_stamps(factor: float) -> None:
    """Slower, faster, and with pauses; the order of the frames is all that counts."""
    rng = np.random.default_rng(0)
    graphs = [GraphBuilder(Config(), VOCABULARY, "world") for _ in range(2)]
    times = [np.arange(1, 401) * 10**8, np.arange(1, 401) * 10**8 * factor]
    times[1] += np.cumsum(rng.random(400) < 0.02) * 40 * 10**9
    state = rng.bit_generator.state
    for builder, stamps_ns in zip(graphs, times):
        rng.bit_generator.state = state
        for local in random_local_graphs(rng, 400):
            at = int(stamps_ns[local.stamp_ns - 1])
            builder.integrate(replace(local, stamp_ns=at))
    told = [builder.full() for builder in graphs]
    assert len(told[0].nodes) > 2
    without = [
        [msgspec.structs.replace(node, first_seen=None, last_seen=None) for node in graph.nodes]
        for graph in told
    ]
    assert without[0] == without[1] and told[0].edges == told[1].edges
    hidden = [[(node.id, node.reason) for node in graph.hidden] for graph in told]
    assert hidden[0] == hidden[1]


@pytest.mark.parametrize("kept", [0, 1])
def test_a_merged_node_has_the_viewpoints_of_both_parts(kept: int) -> None:
    rows = np.zeros(2, RECORD)
    rows["views"] = 1, 2
    rows["view_camera"][0, 0] = rows["view_camera"][1, 0] = 0.0, 0.0, -1.0
    rows["view_camera"][1, 1] = 1.0, 0.0, 0.0
    rows["view_shown"][:, :2] = (4, 0), (5, 2)
    rows["view_detected"][:, :2] = (1, 0), (3, 2)
    beliefs.merge(rows[kept], rows[1 - kept], np.zeros(3))
    # From the first viewpoint, each part had some of the detections.
    assert rows["views"][kept] == 2
    assert rows["view_shown"][kept, :2].tolist() == [5, 2]
    assert rows["view_detected"][kept, :2].tolist() == [4, 2]
