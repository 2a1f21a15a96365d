"""The choice of clips: uncertain pairs, each once, within the budget; every lost clip counted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.relations import (
    VOCABULARY,
    RecordingModel,
    config,
    crowd_graph,
    empty_graph,
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


@pytest.mark.parametrize(("entropy_nats", "encoded"), [(0.99, 0), (1.0, 0), (1.01, 1), (1e9, 1)])
def test_only_pairs_above_the_entropy_threshold_are_encoded(entropy_nats, encoded):
    graph = of_pair()
    graph.entropies[1, 2] = entropy_nats
    stage = watching(graph)
    assert encoded_clips(stage, 1) == [encoded]
    assert stage.counters().dropped == ({} if encoded else {"certain": 1})


def test_with_two_predicates_the_prior_never_enters_and_no_clip_is_encoded():
    graph = of_pair()
    stage = watching(graph)
    local = pair_graph(1)
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


def test_a_clip_is_dropped_if_frame_and_graph_disagree_on_a_class():
    graph = of_pair()
    graph.labels[1] = "chair"
    stage = watching(graph)
    assert encoded_clips(stage, 1) == [0] and stage.counters().dropped == {"other_class": 1}
    graph.labels[1] = "table"  # the graph has changed its class: another class pair
    assert encoded_clips(stage, 2, 3) == [1, 0]


@pytest.mark.parametrize("frames", [1, 40])
def test_the_clip_of_a_tentative_pair_waits(frames):
    """40 frames are more than the buffer holds: the clip is cut before they leave."""
    early, late = RecordingModel(), RecordingModel()
    assert encoded_clips(watching(of_pair(), early), 1) == [1]
    graph = of_pair()
    graph.tentative = {2}
    stage = watching(graph, late)
    assert encoded_clips(stage, 1) == [0]
    for stamp in range(2, frames):
        stage.observe(empty_graph(stamp), picture(stamp))
    assert stage.drain() == [] and stage.counters().ready == 0
    graph.tentative.clear()
    (evidence,) = stage.drain()
    assert evidence.stamp_ns == 1 and evidence.pairs.tolist() == [[0, 1], [1, 0]]
    assert (late.requests[0].clip == early.requests[0].clip).all()


def test_a_clip_waits_until_the_graph_has_merged_its_frame():
    graph = of_pair()
    graph.newest_ns, graph.unknown = 5, {6}
    stage = watching(graph)
    assert encoded_clips(stage, 6) == [0] and stage.counters().pending == 1
    graph.unknown.clear()
    assert len(stage.drain()) == 1


def test_clips_of_a_frame_that_the_graph_refused_are_dropped():
    graph = of_pair()
    graph.newest_ns, graph.unknown = 7, {6}
    stage = watching(graph)
    assert encoded_clips(stage, 6) == [0] and stage.counters().dropped == {"node_removed": 1}


@pytest.mark.parametrize("rows", [[0, 1], [1, 1], [1]])
def test_clips_of_removed_or_merged_nodes_are_dropped(rows):
    graph = of_pair()
    graph.rows = rows
    stage = watching(graph)
    assert encoded_clips(stage, 1) == [0] and stage.counters().dropped == {"node_removed": 1}


def test_clips_are_ranked_by_the_current_nodes():
    """A merge may turn a queued pair into one that was encoded already."""
    graph = of_pair()
    stage = watching(graph)
    assert encoded_clips(stage, 1) == [1]
    graph.labels.update({3: "cup"})
    graph.observations[3] = 3
    graph.rows, graph.tentative = [1, 3], {3}
    assert encoded_clips(stage, 2) == [0]
    graph.rows = [1, 2]  # merged
    assert stage.drain() == [] and stage.counters().dropped == {"already_encoded": 1}


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


def test_order_class_pairs_without_a_prior_then_uncertainty_then_observations():
    graph = Graph(6)
    graph.entropies = {(1, 2): 1.1, (4, 5): 1.3, (1, 3): 1.2, (2, 3): 1.2, (5, 6): 1.35}
    graph.observations.update({1: 9, 3: 9})
    uncertain = set(graph.entropies)
    graph.entropies.update(
        {(a, b): 0.0 for a in range(1, 7) for b in range(a + 1, 7) if (a, b) not in uncertain}
    )
    stage = watching(graph)
    stage.observe(crowd_graph(1, 6), picture(1))
    order = [tuple(row + 1 for row in item.pairs[0].tolist()) for item in stage.drain()]
    # (2, 3) and (5, 6) have one class pair, and so do (1, 2) and (4, 5).
    assert order == [(5, 6), (4, 5), (1, 3), (2, 3), (1, 2)]


def test_the_more_observed_of_two_equally_uncertain_pairs_is_first():
    graph = Graph(4)
    graph.entropies = {(1, 2): 0.0, (2, 3): 0.0, (2, 4): 0.0, (3, 4): 0.0, (1, 4): 1.2, (1, 3): 1.2}
    graph.observations.update({1: 9, 3: 8})
    stage = watching(graph)
    stage.observe(crowd_graph(1, 4), picture(1))
    assert [item.pairs[0].tolist() for item in stage.drain()] == [[0, 2], [0, 3]]


@settings(max_examples=25)
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


def frames_of_last_clip(model, alone, stamps=(1, 2, 3, 4), **changes):
    """Stamps of the frames in the clip of the last frame; frames `alone` show one object."""
    graph = of_pair()
    graph.nodes_of_frame = lambda stamp_ns: [1] if stamp_ns in alone else [1, 2]
    stage = watching(graph, model, **changes)
    for stamp in stamps:
        if stamp in alone:
            stage.observe(crowd_graph(stamp, 1), picture(stamp))
        else:
            stage.observe(pair_graph(stamp), picture(stamp))
    while stage.work() is not None:
        pass
    # The clip of the newest frame comes first.
    x1, y1 = 10, 10
    shown = model.requests[0].clip
    height, width = shown.shape[1:3]
    crops = {s: picture(s)[y1 : y1 + height, x1 : x1 + width] for s in stamps}
    return [next(s for s, crop in crops.items() if (crop == frame).all()) for frame in shown]


@pytest.mark.parametrize("every_clip", [{}, {"max_clips_per_s": 0.0}])
def test_a_clip_of_the_valid_interval_begins_after_the_last_gap(every_clip):
    """A probe's card says which frames its clips have; the graph knows what a frame shows."""
    model = ValidIntervalModel()
    assert frames_of_last_clip(model, {2}, **every_clip) == [3, 4, 4, 4]
    assert frames_of_last_clip(ValidIntervalModel(), set(), **every_clip) == [1, 2, 3, 4]
    assert frames_of_last_clip(RecordingModel(), {2}, **every_clip) == [1, 2, 3, 4]


def test_without_a_graph_every_frame_is_valid():
    model = ValidIntervalModel()
    stage = RelationReasoner(config(), model, report=lambda _: None)
    for stamp in (1, 2, 3, 4):
        stage.observe(pair_graph(stamp), picture(stamp))
    stage.drain()
    assert len(np.unique(model.requests[0].clip, axis=0)) == 4


def test_a_clip_that_waited_is_cut_to_its_valid_interval():
    """Its pixels were stored when its frames left the buffer."""
    model = ValidIntervalModel()
    graph = of_pair()
    graph.nodes_of_frame = lambda stamp_ns: [1] if stamp_ns == 2 else [1, 2]
    graph.tentative = {1}
    stage = watching(graph, model)
    stage.observe(pair_graph(1), picture(1))
    stage.observe(crowd_graph(2, 1), picture(2))
    for stamp in (3, 4):
        stage.observe(pair_graph(stamp), picture(stamp))
    for stamp in range(5, 14):
        stage.observe(crowd_graph(stamp, 1), picture(stamp))
    assert model.requests == []
    graph.tentative = set()
    assert stage.work() is not None
    x1, y1, shown = 10, 10, model.requests[0].clip
    height, width = shown.shape[1:3]
    for frame, stamp in zip(shown, (3, 4, 4, 4)):
        assert (frame == picture(stamp)[y1 : y1 + height, x1 : x1 + width]).all()
