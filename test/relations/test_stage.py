"""The reasoner: pairs at once, newest clips first, a bounded queue, every lost clip counted."""

from __future__ import annotations

import re

import numpy as np
import pytest
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

from deworldsg_ros.relations import ClassPairPrior, RelationReasoner, build_world_model
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import codec


def reasoner(model=None, queue_size=8):
    return RelationReasoner(
        config(), model or RecordingModel(), report=lambda _: None, queue_size=queue_size
    )


def observe(stage, *stamps):
    for stamp in stamps:
        evidence = stage.observe(pair_graph(stamp), picture(stamp))
    return evidence


def accounted(stage):
    counters = stage.counters()
    lost = sum(counters.dropped.values()) - counters.dropped.get("no_frame", 0)
    return counters.queued == counters.encoded + counters.pending + lost


@pytest.mark.parametrize("count", [0, 1])
def test_frame_without_a_pair_gives_empty_evidence(count):
    stage = reasoner()
    evidence = stage.observe(crowd_graph(5, count), picture(5))
    assert evidence.pairs.shape == (0, 2) and evidence.predictions.shape == (0, 4)
    assert stage.work() is None


def test_observe_gives_both_directions_without_predictions():
    evidence = observe(reasoner(), 7)
    assert evidence.stamp_ns == 7 and evidence.source == "fake"
    assert evidence.pairs.tolist() == [[0, 1], [1, 0]]
    assert evidence.pair_classes.tolist() == [[1, 2], [2, 1]]
    assert evidence.geo_costs[0] == evidence.geo_costs[1] < 0.45
    assert not evidence.predicted.any()


def test_distant_objects_are_not_a_pair():
    stage = reasoner()
    graph = local_graph(1, [[0, 0, 9, 9], [0, 0, 9, 9]], [1.0, 1.5], [0, 1])
    assert len(stage.observe(graph, picture(1)).pairs) == 0
    assert stage.counters().pending == 0


def test_work_predicts_both_directions_from_one_clip():
    model = RecordingModel()
    stage = reasoner(model)
    observe(stage, 7)
    evidence = stage.work()
    assert len(model.requests) == 1 and len(model.requests[0].pairs) == 2
    assert evidence.stamp_ns == 7 and evidence.pairs.tolist() == [[0, 1], [1, 0]]
    assert evidence.pair_classes.tolist() == [[1, 2], [2, 1]]
    assert evidence.predicted.all()
    np.testing.assert_allclose(evidence.predictions.sum(axis=1), 1.0)
    assert stage.work() is None
    assert codec.evidence_from_message(codec.evidence_to_message(evidence, "world")).predicted.all()


def test_the_world_model_is_given_the_union_crop_of_the_last_reliable_frame():
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
    model = RecordingModel()
    stage = reasoner(model)
    for stamp in (1, 2, 3, 4, 6):
        stage.observe(empty_graph(stamp), picture(stamp))
    stage.observe(pair_graph(5), picture(5))
    stage.work()
    for frame, stamp in zip(model.requests[0].clip, (2, 3, 4, 5)):
        assert (frame == picture(stamp)[10:41, 10:51]).all()


def test_newest_clip_is_first():
    stage = reasoner()
    observe(stage, 1, 2, 3)
    assert [evidence.stamp_ns for evidence in stage.drain()] == [3, 2, 1]


def test_within_a_frame_the_nearest_pair_is_first():
    stage = reasoner(queue_size=100)
    stage.observe(crowd_graph(1, 6), picture(1))
    costs = [evidence.geo_costs[0] for evidence in stage.drain()]
    assert len(costs) == 15 and costs == sorted(costs)


def test_full_queue_loses_the_oldest_and_counts_it():
    stage = reasoner(queue_size=2)
    observe(stage, 1, 2, 3, 4)
    assert stage.counters().pending == 2
    assert [evidence.stamp_ns for evidence in stage.drain()] == [4, 3]
    assert stage.counters().dropped == {"queue_full": 2} and accounted(stage)


def test_clip_whose_frames_have_left_is_stale():
    stage = reasoner()
    observe(stage, 1)
    for stamp in range(2, 10):  # the buffer holds two clip lengths
        stage.observe(empty_graph(stamp), picture(stamp))
    assert stage.work() is None
    assert stage.counters().dropped == {"stale": 1} and accounted(stage)


def test_clip_does_not_depend_on_when_it_is_encoded():
    early, late = RecordingModel(), RecordingModel()
    for model, more in ((early, ()), (late, (5, 6, 7, 8))):
        stage = reasoner(model)
        observe(stage, 1, 2, 3, 4)
        for stamp in more:
            stage.observe(empty_graph(stamp), picture(stamp))
        stage.work()
    assert (early.requests[0].clip == late.requests[0].clip).all()


@pytest.mark.parametrize("image", [picture(3)[::2], picture(3)[::2, ::2]])
def test_pair_in_an_image_of_another_size_is_found_and_its_clip_counted(image):
    stage = reasoner()
    assert len(stage.observe(pair_graph(3), image).pairs) == 2
    assert stage.counters().dropped == {"no_frame": 1} and stage.counters().queued == 0


def test_without_a_world_model_pairs_are_found_and_no_image_is_kept():
    stage = RelationReasoner(config(world_model="none"), None)
    evidence = observe(stage, 1)
    assert len(evidence.pairs) == 2 and evidence.source == "none"
    assert stage.work() is None and stage.drain() == []
    counters = stage.counters()
    assert (counters.queued, counters.pending, counters.dropped) == (0, 0, {})


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
        (RuntimeError("out of memory"), "world model 'fake' failed: RuntimeError: out of memory"),
        (np.zeros((0, 4)), r"output has shape \(0, 4\): expected \(2, 4\)"),
        (np.full((2, 3), 1 / 3), r"output has shape \(2, 3\): expected \(2, 4\)"),
        (np.full((2, 4), np.nan), "expected rows >= 0 that sum to one"),
        (np.full((2, 4), 0.3), "expected rows >= 0 that sum to one"),
        (np.array([[2.0, -1, 0, 0]] * 2), "expected rows >= 0 that sum to one"),
    ],
)
def test_a_failing_world_model_costs_only_its_clip(failure, message):
    reports = []
    stage = RelationReasoner(config(), BrokenModel(failure), report=reports.append)
    observe(stage, 1, 2)
    assert stage.work().stamp_ns == 1  # the newer one failed
    assert stage.counters().dropped == {"world_model_error": 1} and accounted(stage)
    assert len(reports) == 1 and re.search(message, reports[0])


def test_a_repeated_failure_is_reported_once_and_counted_each_time():
    reports = []
    failures = [RuntimeError("no memory")] * 3 + [RuntimeError("other")]
    stage = RelationReasoner(config(), BrokenModel(*failures), report=reports.append)
    observe(stage, 1, 2, 3, 4)
    assert stage.drain() == []
    assert stage.counters().dropped == {"world_model_error": 4} and len(reports) == 2


def test_single_precision_outputs_become_distributions_in_double_precision():
    output = np.full((2, 4), 0.25, np.float32) * np.float32(1 + 1e-5)
    stage = reasoner(BrokenModel(output))
    observe(stage, 1)
    predictions = stage.work().predictions
    assert predictions.dtype == np.float64
    np.testing.assert_allclose(predictions.sum(axis=1), 1.0, rtol=1e-15)


def test_clear_drops_images_and_counts_clips():
    stage = reasoner()
    observe(stage, 10, 11)
    stage.clear()
    assert stage.work() is None and stage.counters().dropped == {"cleared": 2}
    observe(stage, 1)  # time has jumped back
    assert stage.work().stamp_ns == 1 and accounted(stage)


def test_clip_length_must_be_that_of_the_world_model():
    with pytest.raises(ConfigurationError, match="clip_length is 8: .*'fake' expects 4; set it"):
        RelationReasoner(config(clip_length=8), RecordingModel(clip_length=4))


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
