"""Faults that persist over frames do what they say, as often as asked, the same each time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from deworldsg_ros.evaluation.front_ends import Faults, parse_faults
from deworldsg_ros.evaluation.injection import (
    Detection,
    FrameDetections,
    FrameFaults,
    Injection,
    Relation,
    spread,
)
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary

HEIGHT, WIDTH, RATE_HZ = 120, 160, 10.0
CAMERA = Intrinsics(120.0, 120.0, 79.5, 59.5, WIDTH, HEIGHT)
VOCABULARY = Vocabulary(tuple("abcdef"), ("near", "on"))
CLASSES = (0, 1, 2)
# Rows and columns of three things; the first two touch.
PLACES = (
    (slice(20, 60), slice(10, 40)),
    (slice(30, 60), slice(40, 80)),
    (slice(70, 110), slice(100, 140)),
)
FRAMES = 600


def frame(number: int) -> RgbdFrame:
    return RgbdFrame(
        stamp_ns=10**9 + round(number * 1e9 / RATE_HZ),
        rgb=np.zeros((HEIGHT, WIDTH, 3), np.uint8),
        depth_m=np.full((HEIGHT, WIDTH), 2.0, np.float32),
        intrinsics=CAMERA,
        T_world_camera=np.eye(4),
    )


def seen() -> FrameDetections:
    image = np.zeros((HEIGHT, WIDTH), np.uint16)
    detections = []
    for index, (rows, columns) in enumerate(PLACES):
        image[rows, columns] = index + 1
        box = np.array([columns.start, rows.start, columns.stop - 1, rows.stop - 1], np.float64)
        detections.append(Detection(box, spread({index: 0.9}, 6), 0.9, index + 1))
    return FrameDetections(detections, [Relation(0, 1, 0.9, spread({0: 0.9}, 2))], image)


def run(
    frames: int = FRAMES, seed: int = 0, once: FrameDetections | None = None, **faults: float
) -> list[FrameDetections]:
    injection = Injection(VOCABULARY, CLASSES, FrameFaults(), Faults(**faults), seed)
    given = once or seen()
    return [injection.apply(given, frame(number), number) for number in range(frames)]


def labels(item: FrameDetections) -> dict[int, int]:
    return {part.instance: int(part.class_probabilities.argmax()) for part in item.detections}


def areas(items: list[FrameDetections], value: int) -> np.ndarray:
    return np.array([np.count_nonzero(item.instance_image == value) for item in items])


def lengths(affected: list[bool]) -> list[int]:
    """Lengths of the runs of frames that are affected, save for the ends of the recording."""
    text = "".join("x" if item else "." for item in affected)
    return [len(part) for part in text.strip("x").split(".") if part]


def test_without_faults_nothing_changes() -> None:
    for item in run(5):
        assert labels(item) == {1: 0, 2: 1, 3: 2}
        assert (item.instance_image == seen().instance_image).all()
        assert len(item.relations) == 1


def test_a_wrong_label_lasts_a_spell_and_has_the_chosen_rate() -> None:
    items = run(label=0.2)
    wrong = [[labels(item)[value] != value - 1 for item in items] for value in (1, 2, 3)]
    assert 0.1 < np.mean(wrong) < 0.3
    assert wrong[0] != wrong[1]
    for of_object in wrong:
        assert all(length % 20 == 0 for length in lengths(of_object))
    for item in items:
        for part in item.detections:
            # Another class of the room, as surely as the right one would be.
            assert labels(item)[part.instance] in CLASSES
            assert part.class_probabilities.max() == pytest.approx(0.9)
    short = [labels(item)[1] != 0 for item in run(label=0.2, spell_s=0.5)]
    assert min(lengths(short)) == 5


def test_a_wrong_label_is_a_second_choice_of_the_detection() -> None:
    given = seen()
    named = replace(given.detections[0], class_probabilities=spread({0: 0.7, 4: 0.2}, 6))
    items = run(60, once=replace(given, detections=[named, *given.detections[1:]]), label=1.0)
    assert {labels(item)[1] for item in items} == {4}
    assert items[0].detections[0].class_probabilities[[0, 4]].tolist() == [0.2, 0.7]


def test_false_boxes_last_and_are_on_the_background() -> None:
    items = run(false=2.0)
    objects = seen().instance_image > 0
    counts = []
    for item in items:
        false = item.detections[3:]
        counts.append(len(false))
        for part in false:
            mask = item.instance_image == part.instance
            assert np.count_nonzero(mask) >= 200
            assert not (mask & objects).any()
            assert int(part.class_probabilities.argmax()) in CLASSES
    # Fewer than asked for: some are too small to be seen, or lie on the objects.
    assert 0.7 < np.mean(counts) <= 2.3
    value = next(part.instance for item in items for part in item.detections[3:])
    there = [any(part.instance == value for part in item.detections) for item in items]
    assert np.median(lengths(there)) >= 3
    boxes = [part.box_xyxy for item in items for part in item.detections if part.instance == value]
    steps = np.abs(np.diff(boxes, axis=0)).max(axis=1)
    assert (steps == 0).any()
    assert (steps > 5).any()


def test_a_static_false_box_has_one_position_in_the_room() -> None:
    injection = Injection(VOCABULARY, CLASSES, FrameFaults(), Faults(false=8.0, false_s=100.0), 3)
    centres = []
    for number in (0, 1):
        item = frame(number)
        T = np.eye(4)
        T[0, 3] = 0.1 * number
        moved = injection.apply(seen(), replace(item, T_world_camera=T), number)
        centres.append({part.instance: part.box_xyxy[:2] for part in moved.detections[3:]})
    shifts = [
        centres[1][value][0] - centres[0][value][0] for value in centres[0] if value in centres[1]
    ]
    # 10 cm at 2 m are six pixels.
    assert sum(abs(shift + 6) <= 1 for shift in shifts) >= 2


def test_a_bleeding_mask_includes_a_strip_around_the_object() -> None:
    always = run(2, bleed=1.0)[0]
    image = always.instance_image
    # The last one bleeds over the background, as far as the strip is wide.
    assert (image[70:110, 90:100] == 3).all()
    assert not (image[70:110, 80:89] == 3).any()
    # Of two that bleed into one another the second keeps what it took.
    assert (image[35:55, 31:40] == 2).all()
    assert always.detections[2].box_xyxy.tolist() == [90, 60, 149, 119]
    share = (areas(run(bleed=0.3), 3) > 40 * 40).mean()
    assert 0.15 < share < 0.45


def test_a_merged_mask_removes_the_neighbour_and_its_relations() -> None:
    once = run(1, merge=1.0)[0]
    assert [part.instance for part in once.detections] == [1, 3]
    assert once.detections[0].box_xyxy.tolist() == [10, 20, 79, 59]
    assert not once.relations
    assert (once.instance_image[PLACES[1]] == 1).all()
    assert areas(run(50, merge=1.0), 3).tolist() == [40 * 40] * 50


def test_a_cut_mask_covers_a_part_of_its_object_for_a_spell() -> None:
    whole = 40 * 40
    share = areas(run(cut=0.3), 3) / whole
    cut = share < 1
    assert 0.15 < cut.mean() < 0.45
    assert ((share[cut] > 0.35) & (share[cut] < 0.75)).all()
    for item in run(3, cut=1.0):
        for part in item.detections:
            rows, columns = np.nonzero(item.instance_image == part.instance)
            expected = [columns.min(), rows.min(), columns.max(), rows.max()]
            assert part.box_xyxy.tolist() == expected


def test_faults_are_independent_of_the_frames_processed_before() -> None:
    everything = {"label": 0.3, "bleed": 0.3, "merge": 0.3, "cut": 0.3}
    whole = run(60, **everything)
    injection = Injection(VOCABULARY, CLASSES, FrameFaults(), Faults(**everything), 0)
    for number in range(59, 0, -7):
        again = injection.apply(seen(), frame(number), number)
        assert (again.instance_image == whole[number].instance_image).all()
        assert labels(again) == labels(whole[number])
    other = run(60, seed=1, **everything)
    assert any(labels(a) != labels(b) for a, b in zip(whole, other))
    # One fault does not change another.
    alone = run(60, label=0.3)
    assert all(labels(a).items() <= labels(b).items() for a, b in zip(whole, alone))


def test_faults_are_parsed_described_and_checked() -> None:
    assert parse_faults("") == Faults()
    assert parse_faults("label=0.1, false=2,spell_s=1") == Faults(0.1, 2.0, spell_s=1.0)
    assert Faults().describe() == ""
    assert parse_faults("cut=0.25,spell_s=1").describe() == "cut 0.25 spell_s 1"
    for text, expected in (
        ("lable=1", "'lable=1'.* NAME=NUMBER, NAME one of label"),
        ("label", "NAME=NUMBER"),
        ("label=x", "NAME=NUMBER"),
    ):
        with pytest.raises(ConfigurationError, match=expected):
            parse_faults(text)
    for text in ("label=1.1", "cut=-0.1", "merge=nan", "false=9", "spell_s=0", "false_s=inf"):
        with pytest.raises(EvaluationError, match=rf"fault {text.split('=')[0]}=.*expected"):
            parse_faults(text)
