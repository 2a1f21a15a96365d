"""Training of probes: clips, features on disk, split, fit, record, accuracy."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from support.checkpoints import config_of, save_vjepa2  # noqa: E402  after the guards
from support.pair_rooms import PREDICATES, render_room  # noqa: E402

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard  # noqa: E402
from deworldsg_ros.checkpoints.probe_network import load_probe  # noqa: E402
from deworldsg_ros.relations import clip_models, union_box  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput  # noqa: E402
from deworldsg_ros.training.clips import (  # noqa: E402
    cut_clips,
    of_length,
    read_boxes,
    read_clip_folder,
    read_frames,
)
from deworldsg_ros.training.options import FitOptions, TrainingOptions  # noqa: E402
from deworldsg_ros.training.train import (  # noqa: E402  # noqa: E402
    INCHES_PER_PREDICATE,
    MARGIN_INCHES,
    FeatureCache,
    class_weights,
    extract_features,
    fit_probe,
    score,
    split_by_group,
    train_probe,
    write_confusion,
)

LENGTH = 4
ROOMS, PAIRS = 8, 20


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory):
    """PREDICATE/ROOM__N.npz, crops of drawn rooms."""
    folder = tmp_path_factory.mktemp("clips")
    for room in range(ROOMS):
        for number, pair in enumerate(render_room(room, PAIRS, LENGTH)):
            height, width = pair.frames.shape[1:3]
            x1, y1, x2, y2 = union_box(*pair.boxes_xyxy, width, height)
            path = folder / pair.predicate / f"room{room}__{number:02}.npz"
            path.parent.mkdir(exist_ok=True)
            np.savez(path, frames=pair.frames[:, y1:y2, x1:x2])
    return folder


@pytest.fixture(scope="module")
def backbone(tmp_path_factory):
    folder = save_vjepa2(tmp_path_factory.mktemp("backbone"), crop_size=48)
    return clip_models.load_vjepa2(config_of("vjepa2", folder))


@pytest.fixture(scope="module")
def features_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("features")


def train(backbone, clip_folder, out, features_folder, **changes):
    options = TrainingOptions(
        held_out_groups=("room0", "room1"), batch_size=16, fit=FitOptions(seed=1), **changes
    )
    clips = read_clip_folder(clip_folder)
    return train_probe(backbone, clips, PREDICATES, out, options, cache=features_folder)


def test_a_trained_probe_is_better_than_chance_on_held_out_rooms(
    backbone, clip_folder, features_folder, tmp_path
):
    metrics = train(backbone, clip_folder, tmp_path / "probe", features_folder)
    held_out = metrics["held_out"]
    assert held_out["clips"] == 2 * PAIRS
    assert held_out["chance_macro"] == pytest.approx(0.2)
    assert held_out["macro_accuracy"] > 0.3 and held_out["micro_accuracy"] > 0.3
    probe = load_probe(tmp_path / "probe")
    assert probe.card.backbone == backbone.identity and probe.card.predicates == PREDICATES
    training = probe.card.training
    assert training["held_out_groups"] == ["room0", "room1"]
    assert probe.card.seen_groups == {f"room{n}" for n in range(2, ROOMS)}
    assert training["options"]["fit"]["seed"] == 1 and training["validation_by"] == "group"
    saved = json.loads((tmp_path / "probe" / "metrics.json").read_text())
    assert saved["held_out"] == held_out
    assert cv2.imread(str(tmp_path / "probe" / "confusion.png")).ndim == 3


def test_the_saved_probe_has_the_reported_accuracy(
    backbone, clip_folder, features_folder, tmp_path
):
    """Standardisation is folded into the weights: the probe takes raw features."""
    for layout in ("two_layer", "batch_norm"):
        metrics = train(backbone, clip_folder, tmp_path, features_folder, layout=layout)
        held = [clip for clip in read_clip_folder(clip_folder) if clip.group in ("room0", "room1")]
        features = backbone.encode([clip.read() for clip in held])
        answers = load_probe(tmp_path).predict(features, np.zeros((len(held), 8), np.float32))
        labels = np.array([PREDICATES.index(clip.predicate) for clip in held])
        right = int((answers.argmax(axis=1) == labels).sum())
        assert right == round(metrics["held_out"]["micro_accuracy"] * len(held))


def test_the_same_seed_gives_the_same_probe(backbone, clip_folder, features_folder, tmp_path):
    runs = [train(backbone, clip_folder, tmp_path / n, features_folder) for n in ("a", "b")]
    assert runs[0] == runs[1]
    states = [load_probe(tmp_path / name).network.state_dict() for name in ("a", "b")]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


class CountingBackbone:
    def __init__(self, backbone, fail_after=10**9):
        self.identity, self.description = backbone.identity, backbone.description
        self.encoded, self._backbone, self._fail_after = 0, backbone, fail_after

    def encode(self, clips):
        if self.encoded + len(clips) > self._fail_after:
            raise KeyboardInterrupt
        self.encoded += len(clips)
        return self._backbone.encode(clips)


def test_features_are_extracted_once_and_an_interrupted_run_continues(
    backbone, clip_folder, tmp_path
):
    clips = read_clip_folder(clip_folder)[:20]
    stopped = CountingBackbone(backbone, fail_after=9)
    with pytest.raises(KeyboardInterrupt):
        extract_features(stopped, clips, FeatureCache(tmp_path, "a"), batch_size=4)
    assert stopped.encoded == 8
    rest, reported = CountingBackbone(backbone), []
    features = extract_features(
        rest, clips, FeatureCache(tmp_path, "a"), batch_size=4, advance=reported.append
    )
    assert rest.encoded == 12 and reported == [8, 4, 4, 4]
    np.testing.assert_allclose(features, backbone.encode([c.read() for c in clips]), atol=1e-5)
    again = CountingBackbone(backbone)
    extract_features(again, clips, FeatureCache(tmp_path, "a"), batch_size=4)
    assert again.encoded == 0
    extract_features(again, clips[:4], FeatureCache(tmp_path, "other preprocessing"), batch_size=4)
    assert again.encoded == 4


def test_a_damaged_file_of_features_is_extracted_again(backbone, clip_folder, tmp_path):
    clips = read_clip_folder(clip_folder)[:4]
    extract_features(backbone, clips, FeatureCache(tmp_path, "a"), batch_size=4)
    (shard,) = tmp_path.glob("*/*.npz")
    shard.write_bytes(shard.read_bytes()[:100])
    counting = CountingBackbone(backbone)
    extract_features(counting, clips, FeatureCache(tmp_path, "a"), batch_size=4)
    assert counting.encoded == 4


def test_no_room_is_on_two_sides():
    groups = [f"room {n % 6}" for n in range(60)]
    pairs = [f"{group} {n}" for n, group in enumerate(groups)]
    split = split_by_group(groups, pairs, held_out_fraction=0.3, seed=2)
    parts = [
        {groups[row] for row in rows} for rows in (split.train, split.validation, split.held_out)
    ]
    assert all(parts) and sum(len(part) for part in parts) == 6
    assert parts[2] == set(split.held_out_groups) and len(parts[2]) == 2
    rows = np.concatenate([split.train, split.validation, split.held_out])
    assert sorted(rows.tolist()) == list(range(60))


def test_with_one_room_to_train_on_the_clips_of_a_pair_stay_together():
    groups = ["a"] * 20 + ["b"] * 20
    pairs = [f"{group} {n // 4}" for n, group in enumerate(groups)]
    split = split_by_group(groups, pairs, held_out_fraction=0.2, held_out_groups=["b"])
    assert split.validation_by == "pair" and set(split.held_out.tolist()) == set(range(20, 40))
    assert not {pairs[row] for row in split.train} & {pairs[row] for row in split.validation}


@pytest.mark.parametrize(
    "groups, held_out, reported",
    [
        (["a"] * 4, (), "1 group"),
        (["a", "b"], ("c",), "held-out groups c have no clips"),
        (["a", "b"], ("a", "b"), "2 of them held out"),
    ],
)
def test_clips_that_cannot_be_split_are_refused(groups, held_out, reported):
    with pytest.raises(ConfigurationError, match=reported):
        split_by_group(groups, groups, held_out_fraction=0.2, held_out_groups=held_out)


def test_rare_predicates_have_a_greater_weight():
    weights = class_weights(np.array([0, 0, 0, 2]), 4)
    np.testing.assert_allclose(weights, [2 / 3, 0, 2, 0])
    assert weights[[0, 0, 0, 2]].mean() == pytest.approx(1)


def test_a_rare_predicate_is_learnt_besides_a_frequent_one():
    generator = np.random.default_rng(0)
    labels = np.array([0] * 190 + [1] * 10)
    inputs = generator.normal(size=(200, 6)).astype(np.float32)
    inputs[:, 0] += 3 * labels
    card = ProbeCard(BackboneIdentity("vjepa2", 6, 32, 4), ("often", "rarely"))
    rows = generator.permutation(200)
    fit = fit_probe(card, inputs, labels, rows[:150], rows[150:], FitOptions(epochs=60))
    assert len(fit.train_losses) == len(fit.validation_losses) <= 60
    answers = fit.probe.predict(inputs, np.zeros((200, 8), np.float32))
    assert score(answers, labels, labels).macro_accuracy > 0.85


def test_training_stops_if_the_validation_loss_does_not_fall():
    generator = np.random.default_rng(0)
    inputs = generator.normal(size=(60, 8)).astype(np.float32)
    labels = generator.integers(0, 3, 60)  # nothing to learn
    card = ProbeCard(BackboneIdentity("vjepa2", 8, 32, 4), ("a", "b", "c"))
    rows = np.arange(60)
    fit = fit_probe(card, inputs, labels, rows[:40], rows[40:], FitOptions(patience=3))
    assert len(fit.validation_losses) == fit.best_epoch + 4 < 100


def test_scores_are_micro_and_macro():
    answers = np.eye(3)[[0, 0, 0, 1]]
    found = score(answers, np.array([0, 0, 1, 1]), np.array([0, 0, 0, 1]))
    assert found.confusion.tolist() == [[2, 0, 0], [1, 1, 0], [0, 0, 0]]
    assert (found.micro_accuracy, found.macro_accuracy) == (0.75, 0.75)
    assert (found.chance_macro, found.majority_micro) == (0.5, 0.5)


def test_index_names_groups_and_boxes(tmp_path):
    np.savez(tmp_path / "a.npz", frames=np.zeros((3, 8, 9, 3), np.uint8))
    line = {"clip": "a.npz", "predicate": "on", "group": "room 1", "pair": "1 2"}
    boxes = {"subject_box": [0, 0, 0.5, 0.5], "object_box": [0, 0.5, 1, 1]}
    (tmp_path / "index.jsonl").write_text(json.dumps({**line, **boxes}) + "\n\n")
    (clip,) = read_clip_folder(tmp_path)
    assert (clip.group, clip.pair, clip.predicate) == ("room 1", "room 1 1 2", "on")
    assert clip.boxes.tolist() == [0, 0, 0.5, 0.5, 0, 0.5, 1, 1]
    assert of_length(clip.read(), 4).shape == (4, 8, 9, 3)
    for wrong, reported in (
        ({"clip": "b.npz"}, "line 2: there is no clip 'b.npz'"),
        ({"group": 3}, "line 2"),
        ({"colour": "red"}, "line 2"),
        ({"subject_box": [0, 0, 9, 9]}, "line 2"),
    ):
        text = f"{json.dumps(line)}\n{json.dumps({**line, **wrong})}\n"
        (tmp_path / "index.jsonl").write_text(text)
        with pytest.raises(ConfigurationError, match=reported):
            read_clip_folder(tmp_path)


def test_short_clips_repeat_their_last_frame_and_long_ones_keep_their_last_frames():
    frames = np.arange(5, dtype=np.uint8).reshape(5, 1, 1, 1) * np.ones((1, 2, 2, 3), np.uint8)
    assert of_length(frames, 3)[:, 0, 0, 0].tolist() == [2, 3, 4]
    assert of_length(frames, 7)[:, 0, 0, 0].tolist() == [0, 1, 2, 3, 4, 4, 4]


def test_videos_are_read_as_rgb(tmp_path):
    path = tmp_path / "on" / "room__1.avi"
    path.parent.mkdir()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 24))
    for _ in range(3):
        writer.write(np.full((24, 32, 3), (0, 0, 250), np.uint8))  # red, in BGR
    writer.release()
    (clip,) = read_clip_folder(tmp_path)
    assert clip.group == "room" and clip.predicate == "on"
    frames = clip.read()
    assert frames.shape == (3, 24, 32, 3)
    assert frames[..., 0].min() > 200 and frames[..., 2].max() < 60


@pytest.mark.parametrize(
    "content, reported",
    [
        ({"frames": np.zeros((2, 3, 3), np.uint8)}, "expected uint8"),
        ({"other": np.zeros(2)}, "array"),
    ],
)
def test_unreadable_clips_are_refused(tmp_path, content, reported):
    np.savez(tmp_path / "a.npz", **content)
    with pytest.raises(RefusedInput, match=reported):
        read_frames(tmp_path / "a.npz")
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(RefusedInput, match="no frame"):
        read_frames(tmp_path / "a.mp4")


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="contains no clips"):
        read_clip_folder(tmp_path)
    with pytest.raises(ConfigurationError, match="is not a folder"):
        read_clip_folder(tmp_path / "absent")


def test_unknown_predicate_or_missing_boxes_are_refused(
    backbone, clip_folder, features_folder, tmp_path
):
    clips = read_clip_folder(clip_folder)
    with pytest.raises(ConfigurationError, match="32 clips have the predicate 'behind'"):
        train_probe(backbone, clips, ("on", "under", "near", "in"), tmp_path, TrainingOptions())
    with pytest.raises(ConfigurationError, match="some clips have no boxes"):
        train(backbone, clip_folder, tmp_path, features_folder, inputs="clip_and_boxes")


def test_clips_are_cropped_from_scans_as_at_run_time(tmp_path):
    frames = []
    for number in range(6):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), np.full((40, 60, 3), 10 * number, np.uint8))
        boxes = {1: np.array([5.0, 5, 25, 20]), 2: np.array([20.0 + number, 10, 50, 35])}
        if number == 5:
            del boxes[2]
        frames.append((path, boxes))
    relations = [(2, 1, "on"), (1, 9, "near")]
    options = {"clip_length": 4, "clips_per_pair": 2}
    clips = cut_clips("scan", frames, (60, 40), relations, **options)
    assert [(c.group, c.pair, c.predicate) for c in clips] == [("scan", "scan 1 2", "on")] * 2
    first, last = (clip.read() for clip in clips)
    assert first.shape == (4, 31, 46, 3)  # pixels 5 to 50 by 5 to 35, the union
    assert first[:, 0, 0, 0].tolist() == [0, 10, 10, 10]
    assert last[:, 0, 0, 0].tolist() == [0, 10, 20, 30]
    np.testing.assert_allclose(clips[0].boxes[4:], [0, 0, 20 / 46, 15 / 31])
    assert len({clip.key for clip in clips}) == 2
    assert cut_clips("scan", [], (60, 40), relations, **options) == []


def test_the_valid_interval_begins_when_both_objects_are_seen(tmp_path):
    """Frame 2 shows one object, frame 4 is not annotated."""
    frames = []
    for number in range(7):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), np.full((40, 60, 3), 10 * number, np.uint8))
        boxes = {1: np.array([5.0, 5, 25, 20]), 2: np.array([20.0, 10, 50, 35])}
        if number == 2:
            del boxes[2]
        frames.append((path, None if number == 4 else boxes))
    options = {"clip_length": 6, "clips_per_pair": 9}

    def last(window):
        clip = cut_clips("scan", frames, (60, 40), [(2, 1, "on")], **options, window=window)[-1]
        return clip.read()[:, 0, 0, 0].tolist()

    assert last("last_frames") == [10, 20, 30, 40, 50, 60]
    assert last("valid_interval") == [30, 40, 50, 60, 60, 60]


def test_boxes_of_a_frame(tmp_path):
    path = tmp_path / "bb.txt"
    assert read_boxes(path) == {}
    path.write_text("3 1 2 30 40\n\n")
    assert read_boxes(path)[3].tolist() == [1, 2, 30, 40]
    path.write_text("3 1 2 30\n")
    with pytest.raises(RefusedInput, match="line 1: .*, expected id"):
        read_boxes(path)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_confusion_picture_shows_the_predicates_that_occur(count, tmp_path):
    confusion = np.zeros((5, 5), np.int64)
    confusion[:count, :count] = np.arange(count * count).reshape(count, count) + 1
    write_confusion(tmp_path / "confusion.png", confusion, PREDICATES)
    picture = cv2.imread(str(tmp_path / "confusion.png")).astype(int)
    height, width, _ = picture.shape
    assert height == width >= 100 * (MARGIN_INCHES + INCHES_PER_PREDICATE * count) - 1
    blue = (picture[..., 0] > picture[..., 2] + 40).any()  # cells, coloured by their fraction
    assert blue == (count > 0)
