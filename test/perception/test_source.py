"""Class distributions of a detector that sends names and scores."""

import numpy as np
import pytest
from support.detections import wire_message

from deworldsg_ros.perception import source as of_source
from deworldsg_ros.perception.source import DetectionSource
from deworldsg_ros.streams.detections import sent_detections

HERE, THERE = [10.0, 10.0, 50.0, 50.0], [60.0, 10.0, 99.0, 90.0]


def take(source, *named, threshold=0.0):
    return source.take(sent_detections(wire_message(named), 100, 100), threshold)


def probability(found, row, name):
    return found.class_probabilities[row, found.classes.index(name)]


def test_names_are_learned_in_lower_case_and_stay_in_order():
    source = DetectionSource()
    assert take(source).classes == ("object",)  # nothing yet
    assert take(source, (HERE, {"Red_Mug": 0.6})).classes == ("red mug",)
    found = take(source, (THERE, {"desk": 0.5, "table": 0.2}), (HERE, {"red mug": 0.9}))
    assert found.classes == source.classes == ("red mug", "desk", "table")
    assert found.scores.tolist() == [0.9, 0.5]  # best first
    assert np.allclose(found.class_probabilities.sum(axis=1), 1.0)
    assert take(source, (HERE, {"mug": 0.3}), threshold=0.4).classes == source.classes


def test_numbers_of_classes_have_names():
    source = DetectionSource(["person", "Red_Mug"])
    found = take(source, (HERE, {"1": 0.6}), (THERE, {"2": 0.5}))
    assert found.classes == ("red mug", "2")
    source.use_words(["a", "b", "c"], before=("desk",))
    assert take(source, (HERE, {"2": 0.6})).classes == ("red mug", "2", "desk", "c")


def test_scores_that_sum_to_one_are_the_distribution():
    found = take(DetectionSource(), (HERE, {"cup": 0.25, "mug": 0.7, "bowl": 0.05}))
    assert found.class_probabilities.tolist() == [[0.25, 0.7, 0.05]]


def test_what_a_score_leaves_open_goes_to_the_names_that_are_confused():
    source = DetectionSource()
    take(source, (THERE, {"a": 0.5}), (HERE, {"b": 0.5}))
    before = take(source, (THERE, {"a": 0.5}), (HERE, {"cup": 0.5}))
    assert probability(before, 1, "cup") > 0.5 + 0.5 * 0.4
    for turn in range(40):  # one object, which is called a cup and a mug in turn
        found = take(source, (HERE, {("cup", "mug")[turn % 2]: 0.5}), (THERE, {"a": 0.5}))
    assert found.classes == ("a", "b", "cup", "mug")
    # Here it is a mug: the score says half, and the rest is a cup nearly always.
    row = int(np.argmax(found.class_probabilities[:, 3]))
    assert probability(found, row, "mug") > 0.5 and probability(found, row, "cup") > 0.3
    assert probability(found, row, "a") < 0.05
    # What it always calls by one name is certain.
    assert probability(found, 1 - row, "a") > 0.9


def test_an_object_that_is_named_twice_in_one_image_is_one():
    shifted = [value + 1.0 for value in HERE]
    found = take(
        DetectionSource(), (HERE, {"cup": 0.4}), (shifted, {"mug": 0.5}), (THERE, {"a": 1})
    )
    assert found.scores.tolist() == [1.0, 0.5]
    assert found.boxes_xyxy[1].tolist() == shifted
    assert probability(found, 1, "mug") > probability(found, 1, "cup") > 0.35


def test_names_without_end_are_counted_and_left_out(monkeypatch):
    monkeypatch.setattr(of_source, "MAX_SOURCE_NAMES", 3)
    source = DetectionSource()
    for number in range(6):
        found = take(source, (HERE, {f"thing {number}": 0.9}), (THERE, {"thing 0": 0.8}))
        assert len(found) == (2 if number < 3 else 1)
    assert len(source.classes) == 3
    assert source.take_drops() == {"over_max_names": 3} and not source.take_drops()


def test_there_is_nothing_to_detect_without_them():
    with pytest.raises(Exception, match="without detections"):
        DetectionSource().detect(np.zeros((4, 4, 3), np.uint8), 0.5)
