"""Front ends that are replayed or made: what they hand to lifting, and their seeded faults."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.sequences import (
    BLOCKS,
    HEIGHT,
    ROWS,
    WIDTH,
    instance_image,
    write_pgm,
    write_room,
)

from deworldsg_ros.config import Config, PerceptionConfig
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.injection import logits, spread, visible_box
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.sequence import SequenceDataset
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.errors import EvaluationError


def perceived(root: Path, choice: FrontEndChoice, config: Config = Config()) -> list[Perceived]:
    recording = open_recording(root / "data" / "room_0")
    assert isinstance(recording.source, SequenceDataset)
    annotations = Annotations(root, "replica")
    front_end = build_front_end(choice, annotations, "room_0", recording.source, config)
    return [front_end.perceive(frame) for frame in recording.frames()]


def test_spread_and_logits() -> None:
    np.testing.assert_allclose(spread({1: 0.8}, 5), [0.05, 0.8, 0.05, 0.05, 0.05])
    np.testing.assert_allclose(spread({0: 0.5, 1: 0.5}, 2), [0.5, 0.5])
    assert spread({0: 1.0}, 3).tolist() == [1, 0, 0]
    np.testing.assert_allclose(logits(np.array([0.5, 0.9])), [0, np.log(9)])
    assert np.isfinite(logits(np.array([0.0, 1.0]))).all()


def test_recorded(tmp_path: Path) -> None:
    seen = perceived(write_room(tmp_path), FrontEndChoice("recorded"))
    assert len(seen) == 3
    graph, instances = seen[0].frame_graph, seen[0].instances
    # Best score first: the blocks in reverse.
    np.testing.assert_allclose(graph.scores, [0.9, 0.85, 0.8])
    assert graph.class_probabilities.argmax(axis=1).tolist() == [0, 2, 1]
    np.testing.assert_allclose(graph.class_probabilities[0], [0.9, 0.05, 0.05])
    assert graph.boxes_xyxy[0].tolist() == [68.0, 20.0, 91.0, 49.0]
    for row, (object_id, _, _, _) in enumerate(reversed(BLOCKS)):
        assert ((instances == row + 1) == (instance_image() == object_id)).all()
    # Relations best first, between rows; logits of stated and spread probabilities.
    assert graph.relations.pairs.tolist() == [[0, 1], [2, 1]]
    np.testing.assert_allclose(
        graph.relations.logits[1], np.log(np.array([9, 0.05 / 0.95, 0.05 / 0.95]))
    )


def test_recorded_flips(tmp_path: Path) -> None:
    root = write_room(tmp_path)
    graph = perceived(root, FrontEndChoice("recorded", flip=0.1))[0].frame_graph
    assert graph.class_probabilities.argmax(axis=1).tolist() == [2, 0, 1]
    with pytest.raises(EvaluationError, match="not recorded: expected 0, 0.1"):
        perceived(root, FrontEndChoice("recorded", flip=0.2))


def test_a_bad_recording_is_named(tmp_path: Path) -> None:
    root = write_room(tmp_path)
    path = root / "data/room_0/sequence/frame-000001.frontend.json"
    content = json.loads(path.read_text())
    for bad in ({**content, "version": 2}, {**content, "detections": [{}]}, []):
        path.write_text(json.dumps(bad))
        with pytest.raises(EvaluationError, match=r"frame-000001\.frontend\.json"):
            perceived(root, FrontEndChoice("recorded"))


@pytest.mark.parametrize("with_images", [True, False])
def test_perfect_ground_truth(tmp_path: Path, with_images: bool) -> None:
    root = write_room(tmp_path)
    if not with_images:
        for path in (root / "data/room_0/sequence").glob("*.instance.png"):
            path.unlink()
    first = perceived(root, FrontEndChoice("ground-truth"))[0]
    graph = first.frame_graph
    assert graph.class_probabilities.argmax(axis=1).tolist() == [1, 2, 0]
    for row, (object_id, _, left, right) in enumerate(BLOCKS):
        expected = [left, ROWS[0], right - 1, ROWS[1] - 1]
        # Without instance images every other pixel is looked at.
        np.testing.assert_allclose(graph.boxes_xyxy[row], expected, atol=0 if with_images else 1)
        agree = (first.instances == row + 1) == (instance_image() == object_id)
        assert agree.mean() > (0.999 if with_images else 0.97)
    pairs = {tuple(pair) for pair in graph.relations.pairs.tolist()}
    assert pairs == {(0, 1), (2, 1)}
    best = dict(zip(map(tuple, graph.relations.pairs.tolist()), graph.relations.logits.argmax(1)))
    assert best == {(0, 1): 0, (2, 1): 1}


def test_faults_are_seeded_and_have_the_chosen_rates(tmp_path: Path) -> None:
    root = write_room(tmp_path, frames=40)
    choice = FrontEndChoice("ground-truth", flip=0.3, miss=0.2, jitter_px=1.5, seed=5)
    runs = [perceived(root, choice), perceived(root, choice)]
    for ours, again in zip(*runs):
        assert (ours.frame_graph.boxes_xyxy == again.frame_graph.boxes_xyxy).all()
        assert (ours.instances == again.instances).all()
    other = perceived(root, FrontEndChoice("ground-truth", flip=0.3, miss=0.2, jitter_px=1.5))
    assert [len(item.frame_graph) for item in other] != [len(item.frame_graph) for item in runs[0]]
    kept = sum(len(item.frame_graph) for item in runs[0])
    assert 0.65 < kept / 120 < 0.92
    perfect = perceived(root, FrontEndChoice("ground-truth"))
    missed = perceived(root, FrontEndChoice("ground-truth", miss=1.0))
    assert all(len(item.frame_graph) == 3 for item in perfect)
    assert all(len(item.frame_graph) == 0 for item in missed)
    flipped = perceived(root, FrontEndChoice("ground-truth", flip=1.0))
    for right, wrong in zip(perfect, flipped):
        classes = (item.frame_graph.class_probabilities.argmax(1) for item in (right, wrong))
        assert np.not_equal(*classes).all()


def test_small_objects_are_not_detected() -> None:
    image = np.zeros((50, 50), np.uint16)
    image[0:9, 0:40] = 1
    image[10:24, 0:14] = 2
    image[10:30, 20:40] = 3
    assert visible_box(image, 1) is None
    assert visible_box(image, 2) is None
    assert visible_box(image, 4) is None
    box = visible_box(image, 3)
    assert box is not None
    assert box.tolist() == [20, 10, 39, 29]


@pytest.mark.parametrize(
    "faults", [{"kind": "video"}, {"flip": -0.1}, {"miss": 1.1}, {"jitter_px": -1.0}]
)
def test_bad_choices_are_refused(faults: dict[str, object]) -> None:
    with pytest.raises(EvaluationError, match="expected"):
        FrontEndChoice(**faults)  # type: ignore[arg-type]


def test_boxes_are_true_and_masks_are_those_of_the_segmenter(tmp_path: Path) -> None:
    root = write_room(tmp_path)
    first = perceived(root, FrontEndChoice("boxes", jitter_px=0))[0]
    graph = first.frame_graph
    assert graph.vocabulary.classes == ("book", "chair", "table")
    assert graph.class_probabilities.argmax(axis=1).tolist() == [1, 2, 0]
    np.testing.assert_allclose(graph.class_probabilities.max(axis=1), 0.9)
    np.testing.assert_allclose(graph.scores, 0.9)
    for row, (object_id, _, left, right) in enumerate(BLOCKS):
        assert graph.boxes_xyxy[row].tolist() == [left, ROWS[0], right - 1, ROWS[1] - 1]
        mask, true = first.instances == row + 1, instance_image() == object_id
        # The depth separates block and background, but a segmenter is not exact.
        assert (mask & true).sum() / (mask | true).sum() > 0.6
    # The images, not the annotation, decide about masks.
    for path in (root / "data/room_0/sequence").glob("*.depth.pgm"):
        write_pgm(path, np.zeros((HEIGHT, WIDTH), np.uint16))
    blind = perceived(root, FrontEndChoice("boxes", jitter_px=0))[0]
    assert len(blind.frame_graph) == 3
    assert not (blind.instances == first.instances).all()


def test_relations_of_boxes_are_those_of_the_relation_head(tmp_path: Path) -> None:
    root = write_room(tmp_path)
    graph = perceived(root, FrontEndChoice("boxes"))[0].frame_graph
    # The annotated "book on table" does not hold in the images: the blocks float side by side.
    best = graph.relations.logits.argmax(axis=1)
    names = {graph.vocabulary.predicates[index] for index in best}
    assert names
    assert "on" not in names
    with pytest.raises(EvaluationError, match="set perception.relation_head to geometric"):
        perceived(
            root, FrontEndChoice("boxes"), Config(perception=PerceptionConfig(relation_head="egtr"))
        )


def test_boxes_are_jittered_by_two_pixels_by_default(tmp_path: Path) -> None:
    root = write_room(tmp_path, frames=30)
    choice = FrontEndChoice("boxes")
    assert choice.describe() == "boxes jitter 2"
    boxes = [item.frame_graph.boxes_xyxy for item in perceived(root, choice)]
    again = [item.frame_graph.boxes_xyxy for item in perceived(root, choice)]
    assert all((one == two).all() for one, two in zip(boxes, again))
    true = np.array([[left, ROWS[0], right - 1, ROWS[1] - 1] for _, _, left, right in BLOCKS])
    errors = np.concatenate([item - true for item in boxes if len(item) == 3])
    assert abs(errors.mean()) < 0.4
    assert 1.7 < errors.std() < 2.3
    other = perceived(root, FrontEndChoice("boxes", seed=1))[0].frame_graph.boxes_xyxy
    assert not np.array_equal(other, boxes[0])


def test_faults_of_boxes(tmp_path: Path) -> None:
    root = write_room(tmp_path)
    missed = perceived(root, FrontEndChoice("boxes", miss=1.0))
    assert all(len(item.frame_graph) == 0 for item in missed)
    for item in perceived(root, FrontEndChoice("boxes", flip=1.0)):
        assert (item.frame_graph.class_probabilities.argmax(axis=1) != [1, 2, 0]).all()
    false = perceived(root, FrontEndChoice("boxes", faults=Faults(false=8)))
    assert max(len(item.frame_graph) for item in false) > 3
    for name in ("bleed", "merge", "cut"):
        with pytest.raises(EvaluationError, match=f"boxes with {name} 0.1: the masks are those"):
            FrontEndChoice("boxes", faults=Faults(**{name: 0.1}))
