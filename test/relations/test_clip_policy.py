"""The choice of clips: uncertain pairs, each once, within the budget; every lost clip counted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.relations import (
    VOCABULARY,
    RecordingModel,
    config,
    crowd_graph,
    empty_graph,
    local_graph,
    pair_graph,
    picture,
)

from deworldsg_ros.relations import NodeView, RelationReasoner
from deworldsg_ros.scene.frame_graph import Vocabulary

SECOND_NS = 10**9


class Graph:
    """A graph with a given state; row r of every frame is node r + 1."""

    def __init__(self, count=2, newest_ns=10**12):
        self.generation = 0
        self.newest_ns = newest_ns
        self.labels = {node: VOCABULARY.classes[(node - 1) % 3] for node in range(1, count + 1)}
        self.observations = dict.fromkeys(self.labels, 3)
        self.tentative = set()
        self.entropies = {}
        self.rows = list(self.labels)
        self.unknown = set()

    def nodes_of_frame(self, stamp_ns):
        return None if stamp_ns in self.unknown else self.rows

    def node(self, node_id):
        if node_id in self.tentative:
            return None
        return NodeView(self.labels[node_id], self.observations[node_id])

    def visual_entropy_nats(self, a_id, b_id):
        return self.entropies.get((a_id, b_id), math.inf)


def watching(graph, model=None, queue_size=100, **changes):
    stage = RelationReasoner(
        config(**changes),
        model or RecordingModel(),
        report=lambda _: None,
        queue_size=queue_size,
    )
    stage.watch(graph)
    return stage


def of_pair():
    """The graph of `pair_graph`: a table and a cup."""
    graph = Graph()
    graph.labels = {1: "table", 2: "cup"}
    return graph


def encoded_clips(stage, *stamps):
    """Number of clips encoded at each of these frames of the pair."""
    counts = []
    for stamp in stamps:
        stage.observe(pair_graph(stamp), picture(stamp))
        counts.append(len(stage.drain()))
    return counts


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        ({"entropies": {(1, 2): 0.99}}, "certain"),
        ({"entropies": {(1, 2): 1.0}}, "certain"),
        ({"entropies": {(1, 2): 1.01}}, None),
        ({"entropies": {(1, 2): 1e9}}, None),
        ({"labels": {1: "chair", 2: "cup"}}, "other_class"),  # frame and graph disagree
        ({"rows": [0, 1]}, "node_removed"),
        ({"rows": [1, 1]}, "node_removed"),  # merged
        ({"rows": [1]}, "node_removed"),
        ({"newest_ns": 7, "unknown": {6}}, "node_removed"),  # the graph refused the frame
        ({"newest_ns": 5, "unknown": {6}}, "waits"),  # the graph has not merged it yet
        ({"tentative": {2}}, "waits"),
    ],
)
def test_which_clips_of_a_pair_are_encoded(state, reason):
    graph = of_pair()
    vars(graph).update(state)
    stage = watching(graph)
    assert encoded_clips(stage, 6) == [int(reason is None)]
    counters = stage.counters()
    assert counters.pending == (reason == "waits")
    assert counters.dropped == ({reason: 1} if reason not in (None, "waits") else {})
    vars(graph).update(vars(of_pair()))
    assert len(stage.drain()) == (reason == "waits")
    if reason == "other_class":  # the graph has changed its class: another class pair
        assert encoded_clips(stage, 7, 8) == [1, 0]


def test_with_two_predicates_the_prior_never_enters_and_no_clip_is_encoded():
    stage, local = watching(of_pair()), pair_graph(1)
    small = Vocabulary(VOCABULARY.classes, ("on", "near"))
    object.__setattr__(local, "vocabulary", small)
    stage.observe(local, picture(1))
    assert stage.drain() == [] and stage.counters().dropped == {"certain": 1}


def test_a_pair_is_encoded_once_and_again_after_twice_as_many_observations():
    graph, counts = of_pair(), []
    stage = watching(graph)
    for frame in range(3, 100):
        graph.observations = {1: frame, 2: 2 * frame}
        counts += encoded_clips(stage, frame)
    assert [frame for frame, count in enumerate(counts, 3) if count] == [3, 6, 12, 24, 48, 96]
    assert stage.counters().dropped == {"already_encoded": 97 - 6}


def test_every_clip_is_encoded_without_a_graph_and_without_a_budget():
    graph = of_pair()
    graph.newest_ns = None
    assert encoded_clips(watching(graph), 1, 2, 3) == [1, 1, 1]
    certain = of_pair()
    certain.entropies[1, 2] = 0.0
    assert encoded_clips(watching(certain, max_clips_per_s=0.0), 1, 2, 3) == [1, 1, 1]


def test_a_new_graph_resets_the_encodings():
    graph = of_pair()
    stage = watching(graph)
    assert encoded_clips(stage, 1, 2) == [1, 0]
    graph.generation += 1
    assert encoded_clips(stage, 3, 4) == [1, 0]


@pytest.mark.parametrize(
    ("uncertain", "observed", "expected"),
    [
        # Class pairs without a prior, then uncertainty, then observations. (2, 3) and (5, 6) have
        # one class pair, and so do (1, 2) and (4, 5).
        (
            {(1, 2): 1.1, (4, 5): 1.3, (1, 3): 1.2, (2, 3): 1.2, (5, 6): 1.35},
            {1: 9, 3: 9},
            [(5, 6), (4, 5), (1, 3), (2, 3), (1, 2)],
        ),
        ({(1, 4): 1.2, (1, 3): 1.2}, {1: 9, 3: 8}, [(1, 3), (1, 4)]),
    ],
)
def test_the_order_of_clips(uncertain, observed, expected):
    graph = Graph(6)
    graph.entropies = {(a, b): 0.0 for a in range(1, 7) for b in range(a + 1, 7)} | uncertain
    graph.observations.update(observed)
    stage = watching(graph)
    stage.observe(crowd_graph(1, 6), picture(1))
    assert [tuple((item.pairs[0] + 1).tolist()) for item in stage.drain()] == expected


@given(
    st.lists(st.tuples(st.integers(1, 2 * SECOND_NS), st.integers(0, 6)), max_size=12),
    st.sampled_from([0.3, 1.0, 2.5, 10.0]),
)
def test_no_more_is_encoded_than_the_budget_allows(frames, clips_per_s):
    graph = Graph(6)
    graph.newest_ns = None  # no graph is known: every clip may be encoded
    stage = watching(graph, max_clips_per_s=clips_per_s)
    stamp_ns, encoded = SECOND_NS, 0
    for step_ns, count in frames:
        stamp_ns += step_ns
        stage.observe(crowd_graph(stamp_ns, count), picture(1))
        encoded += len(stage.drain())
        passed_s = (stamp_ns - SECOND_NS) / SECOND_NS
        assert encoded <= max(1.0, clips_per_s) + clips_per_s * passed_s + 1e-6
    counters = stage.counters()
    assert counters.encoded == encoded
    assert counters.queued == encoded + counters.pending + sum(counters.dropped.values())


def test_clips_that_wait_for_the_budget_are_encoded_when_it_has_grown():
    stage = watching(Graph(6), max_clips_per_s=2.0)
    stage.observe(crowd_graph(1, 6), picture(1))
    assert len(stage.drain()) == 2 and stage.counters().pending == 13
    stage.observe(crowd_graph(1 + SECOND_NS // 2, 0), picture(1))
    assert len(stage.drain()) == 1
    stage.observe(crowd_graph(1 + 60 * SECOND_NS, 0), picture(1))
    assert len(stage.drain()) == 2  # a long pause saves up one second of budget


class ValidIntervalModel(RecordingModel):
    window = "valid_interval"


def shown_stamps(model):
    """Stamps of the frames in the first clip that was encoded."""
    clip = model.requests[0].clip
    height, width = clip.shape[1:3]
    crops = {stamp: picture(stamp)[10 : 10 + height, 10 : 10 + width] for stamp in range(1, 5)}
    return [next(s for s, crop in crops.items() if (crop == frame).all()) for frame in clip]


@pytest.mark.parametrize("options", [{}, {"max_clips_per_s": 0.0}])
@pytest.mark.parametrize(
    ("make", "alone", "unknown", "expected"),
    [
        (ValidIntervalModel, {2}, (), [3, 4, 4, 4]),
        (ValidIntervalModel, set(), (), [1, 2, 3, 4]),
        (RecordingModel, {2}, (), [1, 2, 3, 4]),
        # A frame that the graph does not know is as the one before it.
        (ValidIntervalModel, {1}, {2}, [3, 4, 4, 4]),
        (ValidIntervalModel, set(), {2}, [1, 2, 3, 4]),
        (ValidIntervalModel, None, (), [1, 2, 3, 4]),  # without a graph every frame is valid
    ],
)
def test_a_clip_of_the_valid_interval_begins_after_the_last_gap(
    make, alone, unknown, expected, options
):
    """A probe's card says which frames its clips have; the graph knows what a frame shows."""
    model, graph = make(), of_pair()
    nodes = {**dict.fromkeys(range(1, 5), [1, 2]), **dict.fromkeys(alone or (), [1])}
    graph.nodes_of_frame = {**nodes, **dict.fromkeys(unknown)}.get
    if alone is None:
        stage = RelationReasoner(config(**options), model, report=lambda _: None)
    else:
        stage = watching(graph, model, **options)
    for stamp in (1, 2, 3, 4):
        # A frame shows one object alone, or both.
        local = crowd_graph(stamp, 1) if alone and stamp in alone else pair_graph(stamp)
        stage.observe(local, picture(stamp))
    stage.drain()
    # The clip of the newest frame comes first.
    assert shown_stamps(model) == expected


@pytest.mark.parametrize("waited", [False, True])
@pytest.mark.parametrize(
    ("crop", "left", "shape"),
    [("last_frame", 10, (31, 41)), ("clip_union", 6, (31, 45)), ("each_frame", 10, (31, 41))],
)
def test_the_card_of_a_probe_chooses_the_region_of_its_clips(crop, left, shape, waited):
    """The camera turns: objects move by 2 pixels a frame. Rows of the frames are swapped."""
    model, graph = RecordingModel(), of_pair()
    model.crop = crop
    graph.nodes_of_frame = lambda stamp_ns: [[1, 2], [2, 1]][stamp_ns % 2]
    graph.labels = {1: "table", 2: "cup"}
    graph.tentative = {1} if waited else set()
    stage = watching(graph, model)
    for stamp in range(1, 14 if waited else 4):
        boxes = np.array([[10, 20, 50, 40], [20, 10, 30, 22]]) - [2 * (3 - stamp), 0] * 2
        order = [1, 0] if stamp % 2 else [0, 1]
        shown = local_graph(stamp, boxes[order], [1.5, 1.5], np.array([1, 2])[order])
        stage.observe(shown if stamp < 4 else empty_graph(stamp), picture(stamp))
    graph.tentative = set()
    assert stage.work() is not None
    (request,) = model.requests[:1]
    assert request.clip.shape == (4, *shape, 3)
    corner = np.array([left, 10] * 2)
    boxes = [request.pairs[0].subject_box_xyxy, request.pairs[0].object_box_xyxy]
    assert {tuple(box + corner) for box in boxes} == {(10, 20, 50, 40), (20, 10, 30, 22)}
    for row, stamp in enumerate((1, 2, 3, 3)):
        x1 = left - 2 * (3 - stamp) * (crop == "each_frame")
        assert (request.clip[row] == picture(stamp)[10:41, x1 : x1 + shape[1]]).all()


def test_a_clip_that_waited_is_cut_to_its_valid_interval():
    """Its pixels were stored when its frames left the buffer."""
    model, graph = ValidIntervalModel(), of_pair()
    graph.nodes_of_frame = lambda stamp_ns: [1] if stamp_ns == 2 else [1, 2]
    graph.tentative = {1}
    stage = watching(graph, model)
    for stamp in range(1, 14):
        local = pair_graph(stamp) if stamp in (1, 3, 4) else crowd_graph(stamp, 1)
        stage.observe(local, picture(stamp))
    assert model.requests == []
    graph.tentative = set()
    assert stage.work() is not None
    assert shown_stamps(model) == [3, 4, 4, 4]
