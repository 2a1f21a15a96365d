"""Stage d: pairs at once, clips in a thread of their own, every lost clip counted."""

import re
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from support.relations import (
    VOCABULARY,
    GatedModel,
    RecordingModel,
    config,
    crowd_graph,
    empty_graph,
    local_graph,
    pair_graph,
    picture,
)

from deworldsg_ros.config import RelationsConfig, from_mapping
from deworldsg_ros.relations import (
    WORLD_MODELS,
    ClassPairPrior,
    EvidenceWorker,
    RelationReasoner,
    build_world_model,
)
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import codec


def reasoner(model=None, queue_size=8, report=lambda _: None):
    return RelationReasoner(config(), model or RecordingModel(), report, queue_size=queue_size)


def observe(stage, *stamps):
    for stamp in stamps:
        evidence = stage.observe(pair_graph(stamp), picture(stamp))
    return evidence


def stamps_of(evidence):
    return [item.stamp_ns for item in evidence]


def accounted(stage):
    counters = stage.counters()
    lost = sum(counters.dropped.values()) - counters.dropped.get("no_frame", 0)
    return counters.queued == counters.encoded + counters.pending + lost


# --- pairs and clips -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "graph",
    [
        crowd_graph(5, 0),
        crowd_graph(5, 1),
        local_graph(5, [[0, 0, 9, 9], [0, 0, 9, 9]], [1.0, 1.5], [0, 1]),  # far apart
    ],
)
def test_a_frame_without_a_pair_gives_empty_evidence(graph):
    stage = reasoner()
    evidence = stage.observe(graph, picture(5))
    assert evidence.pairs.shape == (0, 2) and evidence.predictions.shape == (0, 4)
    assert stage.work() is None and stage.counters().pending == 0


def test_both_directions_are_predicted_from_one_clip():
    model = RecordingModel()
    stage = reasoner(model)
    observed, worked = observe(stage, 7), stage.work()
    assert len(model.requests) == 1 and len(model.requests[0].pairs) == 2
    for evidence in (observed, worked):
        assert evidence.stamp_ns == 7 and evidence.source == "fake"
        assert evidence.pairs.tolist() == [[0, 1], [1, 0]]
        assert evidence.pair_classes.tolist() == [[1, 2], [2, 1]]
        assert evidence.geo_costs[0] == evidence.geo_costs[1] < 0.45
    assert not observed.predicted.any() and worked.predicted.all()
    np.testing.assert_allclose(worked.predictions.sum(axis=1), 1.0)
    assert stage.work() is None
    sent = codec.evidence_from_message(codec.evidence_to_message(worked, "world"))
    assert sent.predicted.all()


def test_the_world_model_is_given_the_union_crop_of_the_last_reliable_frames():
    model = RecordingModel()
    stage = reasoner(model)
    observe(stage, 1, 2)
    stage.work()
    (request,) = model.requests
    # The union of (10, 20, 50, 40) and (20, 10, 30.5, 22).
    assert request.clip.shape == (4, 31, 41, 3)
    for frame, stamp in zip(request.clip, (1, 2, 2, 2)):
        assert (frame == picture(stamp)[10:41, 10:51]).all()
    table_first, cup_first = request.pairs
    assert (table_first.subject_name, table_first.object_name) == ("table", "cup")
    assert (cup_first.subject_class, cup_first.object_class) == (2, 1)
    assert table_first.subject_box_xyxy.tolist() == [0, 10, 40, 30]
    assert table_first.object_box_xyxy.tolist() == [10, 0, 20.5, 12]
    assert cup_first.object_box_xyxy.tolist() == [0, 10, 40, 30]


def test_frames_without_objects_are_in_the_clip_and_later_frames_are_not():
    """So a clip does not depend on when it is encoded."""
    model = RecordingModel()
    stage = reasoner(model)
    for stamp in (1, 2, 3, 4, 6):
        stage.observe(empty_graph(stamp), picture(stamp))
    observe(stage, 5)
    stage.work()
    for frame, stamp in zip(model.requests[0].clip, (2, 3, 4, 5)):
        assert (frame == picture(stamp)[10:41, 10:51]).all()


def test_lost_clips_are_counted():
    stage = reasoner(queue_size=2)
    observe(stage, 1, 2, 3, 4)
    assert stage.counters().pending == 2
    assert stamps_of(stage.drain()) == [4, 3]  # the newest clip is first
    assert stage.counters().dropped == {"queue_full": 2} and accounted(stage)
    observe(stage, 5)
    for stamp in range(6, 14):  # the buffer holds two clip lengths
        stage.observe(empty_graph(stamp), picture(stamp))
    assert stage.work() is None
    assert stage.counters().dropped == {"queue_full": 2, "stale": 1} and accounted(stage)
    observe(stage, 20, 21)
    stage.clear()
    assert stage.work() is None
    observe(stage, 1)  # time has jumped back
    assert stage.work().stamp_ns == 1
    for image in (picture(3)[::2], picture(3)[::2, ::2]):  # of another size than the boxes
        assert len(stage.observe(pair_graph(3), image).pairs) == 2
    lost = {"queue_full": 2, "stale": 1, "cleared": 2, "no_frame": 2}
    assert stage.counters().dropped == lost and accounted(stage)


def test_without_a_world_model_pairs_are_found_and_no_image_is_kept():
    stage = RelationReasoner(config(world_model="none"), None)
    evidence = observe(stage, 1)
    assert len(evidence.pairs) == 2 and evidence.source == "none"
    assert stage.work() is None and stage.drain() == []
    counters = stage.counters()
    assert (counters.queued, counters.pending, counters.dropped) == (0, 0, {})


def test_same_frames_give_the_same_prior():
    def run():
        settings = config()
        stage = RelationReasoner(settings, build_world_model(settings), queue_size=4)
        prior = ClassPairPrior(len(VOCABULARY.classes), len(VOCABULARY.predicates))
        for stamp in range(12):
            stage.observe(crowd_graph(stamp, 4), picture(stamp))
            for evidence in stage.drain():
                prior.update(evidence.pair_classes, evidence.predictions)
        return prior.to_state()

    assert run() == run()


# --- failing world models ------------------------------------------------------------------------


class BrokenModel(RecordingModel):
    """A world model that first fails in given ways: by an exception, or by a wrong output."""

    def __init__(self, *failures):
        super().__init__()
        self.failures = list(failures)

    def predict(self, request):
        failure = self.failures.pop(0) if self.failures else None
        if isinstance(failure, Exception):
            raise failure
        return super().predict(request) if failure is None else failure


@pytest.mark.parametrize(
    ("failure", "message"),
    [
        (RuntimeError("out of memory"), "'fake' failed: RuntimeError: out of memory"),
        (np.zeros((0, 4)), r"shape \(0, 4\): expected \(2, 4\)"),
        (np.full((2, 3), 1 / 3), r"shape \(2, 3\): expected \(2, 4\)"),
        (np.full((2, 4), np.nan), "sum to one"),
        (np.full((2, 4), 0.3), "sum to one"),
        (np.array([[2.0, -1, 0, 0]] * 2), "sum to one"),
    ],
)
def test_a_failing_world_model_costs_only_its_clip(failure, message):
    reports = []
    stage = reasoner(BrokenModel(failure, failure), report=reports.append)
    observe(stage, 1, 2, 3)
    assert stamps_of(stage.drain()) == [1]  # the newer ones failed
    assert stage.counters().dropped == {"world_model_error": 2} and accounted(stage)
    # A repeated failure is reported once.
    assert len(reports) == 1 and re.search(message, reports[0])


def test_single_precision_outputs_become_distributions_in_double_precision():
    stage = reasoner(BrokenModel(np.full((2, 4), 0.25, np.float32) * np.float32(1 + 1e-5)))
    observe(stage, 1)
    predictions = stage.work().predictions
    assert predictions.dtype == np.float64
    np.testing.assert_allclose(predictions.sum(axis=1), 1.0, rtol=1e-15)


# --- the worker's thread -------------------------------------------------------------------------

LONG_S = 30.0


class Receiver:
    """Collects what the worker delivers, and the threads in which it does."""

    def __init__(self):
        self.evidence = []
        self.threads = set()

    def __call__(self, evidence):
        self.evidence.append(evidence)
        self.threads.add(threading.get_ident())


@contextmanager
def started(model, receiver, report=lambda _: None, queue_size=8):
    worker = EvidenceWorker(reasoner(model, queue_size, report), receiver, report)
    worker.start()
    try:
        yield worker
    finally:
        if isinstance(model, GatedModel):
            model.allowed.release()
        assert worker.stop(LONG_S)


@pytest.mark.parametrize("observers", [1, 3])
def test_every_prediction_is_delivered_in_a_thread_of_its_own(observers):
    receiver = Receiver()

    def see(number):
        for stamp in range(3 * number, 3 * number + 3):
            assert not worker.observe(crowd_graph(stamp, 4), picture(stamp)).predicted.any()

    with started(RecordingModel(), receiver, queue_size=100) as worker:
        threads = [threading.Thread(target=see, args=(n,)) for n in range(observers)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LONG_S)
        assert worker.wait_idle(LONG_S)
    counters = worker.reasoner.counters()
    assert counters.queued == 18 * observers == counters.encoded + sum(counters.dropped.values())
    assert len(receiver.evidence) == counters.encoded
    assert all(evidence.predicted.all() for evidence in receiver.evidence)
    assert threading.get_ident() not in receiver.threads


def test_a_slow_world_model_delays_no_frame_and_lost_clips_are_counted():
    model, receiver = GatedModel(), Receiver()
    with started(model, receiver, queue_size=2) as worker:
        worker.observe(pair_graph(0), picture(0))
        assert model.begun.acquire(timeout=LONG_S)
        for stamp in range(1, 6):  # the model holds the first clip all the while
            assert len(worker.observe(pair_graph(stamp), picture(stamp)).pairs) == 2
        assert receiver.evidence == [] and not worker.wait_idle(0.01)
        counters = worker.reasoner.counters()
        assert counters.pending == 2 and counters.dropped == {"queue_full": 3}
        for _ in range(3):
            model.allowed.release()
        assert worker.wait_idle(LONG_S)
    assert stamps_of(receiver.evidence) == [0, 5, 4]


def test_stop_returns_though_the_world_model_hangs_and_nothing_is_delivered_after_it():
    model, receiver = GatedModel(), Receiver()
    with started(model, receiver) as worker:
        observe(worker, 0, 1)
        assert model.begun.acquire(timeout=LONG_S)
        assert not worker.stop(0.05)
        model.allowed.release()
    assert receiver.evidence == [] and worker.reasoner.counters().pending == 0
    unused = EvidenceWorker(reasoner(), receiver)
    assert worker.stop(LONG_S) and unused.stop(LONG_S)


def test_the_worker_survives_failures(monkeypatch):
    """Of the world model, the receiver, and the reasoner itself."""
    reports, delivered, mistakes = [], [], []

    def deliver(evidence):
        if evidence.stamp_ns == 1:
            raise RuntimeError("publisher is gone")
        delivered.append(evidence)

    with started(BrokenModel(RuntimeError("not loaded")), deliver, reports.append) as worker:
        work = worker.reasoner.work

        def work_or_fail():
            if mistakes:
                raise mistakes.pop()
            return work()

        monkeypatch.setattr(worker.reasoner, "work", work_or_fail)
        for stamp in range(4):
            if stamp == 2:
                mistakes.append(IndexError("a mistake"))
            observe(worker, stamp)
            assert worker.wait_idle(LONG_S)
    assert stamps_of(delivered) == [3, 2]  # the clip of the mistake waited
    assert [report.partition(": ")[2] for report in reports] == [
        "RuntimeError: not loaded",
        "RuntimeError: publisher is gone",
        "IndexError: a mistake",
    ]


# --- world models by name ------------------------------------------------------------------------


def test_world_models_are_chosen_by_name():
    assert {"none", "fake"} <= set(WORLD_MODELS)
    assert build_world_model(RelationsConfig()) is None
    model = build_world_model(RelationsConfig(world_model="fake", clip_length=8))
    assert isinstance(model, FakeWorldModel) and model.name == "fake" and model.clip_length == 8
    with pytest.raises(ConfigurationError, match="clip_length is 8: .*'fake' expects 4"):
        RelationReasoner(config(clip_length=8), RecordingModel(clip_length=4))
    for name in ("", "fakes", "__init__", "..evidence"):
        with pytest.raises(ConfigurationError, match="expected one of .*fake, none"):
            build_world_model(RelationsConfig(world_model=name))
    for key in ("encode", "clips_per_s", "model_path", "batch_size", "seed"):  # of old releases
        with pytest.raises(ConfigurationError, match=rf"\w+\.{key}\b"):
            from_mapping({"relations": {key: 1}})
