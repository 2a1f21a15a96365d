"""Training of probes: features on disk, split, fit, record, accuracy."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.checkpoints import config_of, save_vjepa2, torch
from support.evaluation import PREDICATES as CHANCE
from support.evaluation import write_dataset
from support.pair_rooms import PREDICATES, render_room
from support.sequences import BLOCKS, HEIGHT, WIDTH, write_sequence, write_surface

from deworldsg_ros.checkpoints.cards import BackboneIdentity, FitOptions, ProbeCard, TrainingOptions
from deworldsg_ros.checkpoints.probe_network import load_probe
from deworldsg_ros.relations import clip_models, union_box
from deworldsg_ros.relations.clip_models import FrozenBackbone
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.training.clips import ClipChoice, read_clip_folder, read_clips
from deworldsg_ros.training.train import (
    FeatureCache,
    class_weights,
    extract_features,
    fit_probe,
    score,
    split_by_group,
    train_probe,
)

pytestmark = pytest.mark.models

LENGTH = 4
ROOMS, PAIRS = 8, 20


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """PREDICATE/ROOM__N.npz, crops of drawn rooms."""
    folder = tmp_path_factory.mktemp("clips")
    for room in range(ROOMS):
        for number, pair in enumerate(render_room(room, PAIRS, LENGTH)):
            height, width = pair.frames.shape[1:3]
            x1, y1, x2, y2 = union_box(*pair.boxes_xyxy, width, height)
            path = folder / pair.predicate / f"room{room}__{number:02}.npz"
            path.parent.mkdir(exist_ok=True)
            np.savez(path, frames=pair.frames[:, y1:y2, x1:x2])
    return read_clip_folder(folder)


@pytest.fixture(scope="module")
def backbone(tmp_path_factory):
    folder = save_vjepa2(tmp_path_factory.mktemp("backbone"), crop_size=48)
    return clip_models.load_vjepa2(config_of("vjepa2", folder))


@pytest.fixture(scope="module")
def train(backbone, clips, tmp_path_factory):
    cache = tmp_path_factory.mktemp("features")

    def run(out, predicates=PREDICATES, **changes):
        held_out = ("room0", "room1")
        fit = FitOptions(seed=1)
        options = TrainingOptions(held_out_groups=held_out, batch_size=16, fit=fit, **changes)
        return train_probe(backbone, clips, predicates, out, options, cache=cache)

    return run


@pytest.mark.parametrize("layout", ["two_layer", "batch_norm"])
def test_the_saved_probe_has_the_reported_accuracy(train, backbone, clips, tmp_path, layout):
    """Standardisation is folded into the weights: the probe takes raw features."""
    held_out = train(tmp_path, layout=layout)["held_out"]
    held = [clip for clip in clips if clip.group in ("room0", "room1")]
    assert held_out["clips"] == len(held) == 2 * PAIRS
    features = backbone.encode([clip.read() for clip in held])
    answers = load_probe(tmp_path).predict(features, np.zeros((len(held), 8), np.float32))
    labels = np.array([PREDICATES.index(*clip.predicates) for clip in held])
    right = int((answers.argmax(axis=1) == labels).sum())
    assert right == round(held_out["micro_accuracy"] * len(held))


def test_a_probe_is_better_than_chance_on_held_out_rooms_and_has_a_record(
    train, backbone, tmp_path
):
    runs = [train(tmp_path / name) for name in ("a", "b")]
    held_out = runs[0]["held_out"]
    assert held_out["chance_macro"] == pytest.approx(0.2)
    assert held_out["macro_accuracy"] > 0.3 and held_out["micro_accuracy"] > 0.3
    probe, same = (load_probe(tmp_path / name) for name in ("a", "b"))
    assert probe.card.backbone == backbone.identity and probe.card.predicates == PREDICATES
    training = probe.card.training
    assert training["held_out_groups"] == ["room0", "room1"]
    assert probe.card.seen_groups == {f"room{n}" for n in range(2, ROOMS)}
    assert probe.card.crop == "last_frame"
    assert training["options"]["fit"]["seed"] == 1 and training["validation_by"] == "group"
    saved = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert saved["held_out"] == held_out
    assert cv2.imread(str(tmp_path / "a" / "confusion.png")).ndim == 3
    # The same seed gives the same probe.
    assert runs[0] == runs[1]
    states = probe.network.state_dict(), same.network.state_dict()
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


def test_unknown_predicates_and_missing_boxes_are_refused(train, tmp_path):
    with pytest.raises(ConfigurationError, match="32 clips have the predicate 'behind'"):
        train(tmp_path, ("on", "under", "near", "in"))
    with pytest.raises(ConfigurationError, match="some clips have no boxes"):
        train(tmp_path, inputs="clip_and_boxes")


class CountingBackbone:
    def __init__(self, backbone, fail_after=10**9):
        self.identity, self.description = backbone.identity, backbone.description
        self.encoded, self._backbone, self._fail_after = 0, backbone, fail_after

    def encode(self, clips):
        if self.encoded + len(clips) > self._fail_after:
            raise KeyboardInterrupt
        self.encoded += len(clips)
        return self._backbone.encode(clips)


def test_features_are_extracted_once_and_an_interrupted_run_continues(backbone, clips, tmp_path):
    clips = clips[:20]

    def extract(clips, name="a", **advance):
        counting = CountingBackbone(backbone)
        cache = FeatureCache(tmp_path, name)
        return extract_features(counting, clips, cache, batch_size=4, **advance), counting.encoded

    stopped = CountingBackbone(backbone, fail_after=9)
    with pytest.raises(KeyboardInterrupt):
        extract_features(stopped, clips, FeatureCache(tmp_path, "a"), batch_size=4)
    assert stopped.encoded == 8
    reported = []
    features, encoded = extract(clips, advance=reported.append)
    assert encoded == 12 and reported == [8, 4, 4, 4]
    np.testing.assert_allclose(features, backbone.encode([c.read() for c in clips]), atol=1e-5)
    assert extract(clips)[1] == 0
    assert extract(clips[:4], "other preprocessing")[1] == 4
    # Damaged files are extracted again.
    for shard in tmp_path.glob("*/*.npz"):
        shard.write_bytes(shard.read_bytes()[:100])
    assert extract(clips[:4])[1] == 4


def test_no_room_is_on_two_sides_and_clips_of_a_pair_stay_together():
    groups = [f"room {n % 6}" for n in range(60)]
    pairs = [f"{group} {n}" for n, group in enumerate(groups)]
    split = split_by_group(groups, pairs, held_out_fraction=0.3, seed=2)
    rows = (split.train, split.validation, split.held_out)
    parts = [{groups[row] for row in part} for part in rows]
    assert all(parts) and sum(len(part) for part in parts) == 6
    assert parts[2] == set(split.held_out_groups) and len(parts[2]) == 2
    assert sorted(np.concatenate(rows).tolist()) == list(range(60))
    # With one room to train on, pairs are divided.
    groups = ["a"] * 20 + ["b"] * 20
    pairs = [f"{group} {n // 4}" for n, group in enumerate(groups)]
    split = split_by_group(groups, pairs, held_out_fraction=0.2, held_out_groups=["b"])
    assert split.validation_by == "pair" and set(split.held_out.tolist()) == set(range(20, 40))
    assert not {pairs[row] for row in split.train} & {pairs[row] for row in split.validation}

    for groups, held_out, reported in (
        (["a"] * 4, (), "1 group.*or a held-out fraction of 0"),
        (["a", "b"], ("c",), "held-out groups c have no clips"),
        (["a", "b"], ("a", "b"), "2 of them held out"),
    ):
        with pytest.raises(ConfigurationError, match=reported):
            split_by_group(groups, groups, held_out_fraction=0.2, held_out_groups=held_out)
    split = split_by_group(["a"] * 4, ["a"] * 4, held_out_fraction=0)
    assert list(split.parts()) == ["train"] and len(split.train) == 4


def room_colours(folder, seed=0):
    """3RScan's layout: 12 rooms with three scans each, whose pictures and labels are random."""
    generator = np.random.default_rng(seed)
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    scans, rooms, pictures = {}, [], {}
    for room in range(12):
        names = [f"scan {room} {n}" for n in range(3)]
        labels = [CHANCE[index] for index in generator.integers(0, len(CHANCE), 2)]
        scans |= dict.fromkeys(names, (objects, [(1, 2, labels[0]), (3, 2, labels[1])]))
        rooms.append({"reference": names[0], "scans": [{"reference": n} for n in names[1:]]})
        picture = generator.integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
        pictures |= dict.fromkeys(names, cv2.resize(picture, (WIDTH, HEIGHT)))
    root = write_dataset(folder, scans, layout="3rscan", split_scans=())
    (root / "3DSSG_subset" / "train_scans.txt").write_text("\n".join(scans))
    (root / "3RScan.json").write_text(json.dumps(rooms))
    for name, picture in pictures.items():
        write_surface(write_sequence(root / "data" / name, frames=1))
        cv2.imwrite(str(root / "data" / name / "sequence/frame-000000.color.jpg"), picture)
    return root


def test_labels_without_signal_are_predicted_by_chance_in_held_out_rooms(tmp_path):
    """A rescan of a room in the training would give its labels away."""

    def pixels(videos):
        return torch.nn.functional.adaptive_avg_pool2d(videos.mean(dim=1), 6).flatten(1)

    identity = BackboneIdentity("vjepa2", 108, 24, 2, fit="stretch")
    geometry = clip_models.ClipGeometry(24, "bilinear")
    backbone = FrozenBackbone(identity, geometry, torch.device("cpu"), torch.float32, pixels)
    clips = read_clips(room_colours(tmp_path / "set"), ClipChoice(2, 1))
    assert len(clips) == 72 and len({clip.group for clip in clips}) == 12
    options = TrainingOptions(held_out_fraction=0.4, batch_size=16)
    accuracy = {}
    for name, by in {"rooms": clips, "scans": [replace(c, group=c.scan) for c in clips]}.items():
        metrics = train_probe(backbone, by, CHANCE, tmp_path / name, options)
        accuracy[name] = metrics["held_out"]["micro_accuracy"]
    assert accuracy["rooms"] < 0.5 and accuracy["scans"] > 0.7


def fit(inputs, labels, rows, split, options):
    names = tuple(f"predicate {n}" for n in range(labels.max() + 1))
    card = ProbeCard(BackboneIdentity("vjepa2", inputs.shape[1], 32, 4), names)
    return fit_probe(card, inputs, one_hot(labels), rows[:split], rows[split:], options)


def one_hot(labels, count=None):
    return np.eye(count or labels.max() + 1, dtype=np.float32)[labels]


@pytest.mark.parametrize(("weights", "rare"), [("none", 0.1), ("inverse_frequency", 0.5)])
def test_a_probe_learns_how_frequent_predicates_are_unless_they_are_weighted(weights, rare):
    """Labels that the features do not tell: a probability is a frequency (Eq. 10)."""
    generator = np.random.default_rng(0)
    labels = (np.arange(600) % 10 == 0).astype(np.int64)
    inputs = generator.normal(size=(600, 4)).astype(np.float32)
    rows = generator.permutation(600)
    options = FitOptions(patience=5, learning_rate=1e-4, class_weights=weights)
    found = fit(inputs, labels, rows, 400, options)
    answers = found.probe.predict(inputs, np.zeros((600, 8), np.float32))
    assert answers[:, 1].mean() == pytest.approx(rare, abs=0.07)


def test_all_rooms_are_trained_on_and_a_pair_has_all_its_predicates(backbone, clips, tmp_path):
    both = [replace(clip, predicates=("on", "near")) for clip in clips[:24]]
    options = TrainingOptions(held_out_fraction=0, batch_size=16, fit=FitOptions(epochs=30))
    metrics = train_probe(backbone, both, PREDICATES, tmp_path, options)
    assert "held_out" not in metrics and metrics["train"]["clips"] == 24
    assert (len(metrics["train_losses"]), metrics["validation_losses"]) == (30, [])
    assert metrics["best_epoch"] == 29 and metrics["train"]["micro_accuracy"] == 1
    assert metrics["train"]["log_loss_nats"] == pytest.approx(np.log(2), abs=0.05)
    probe = load_probe(tmp_path)
    assert probe.card.training["validation_by"] == "none"
    features = backbone.encode([clip.read() for clip in both])
    answers = probe.predict(features, np.zeros((24, 8), np.float32))
    np.testing.assert_allclose(answers[:, [0, 2]], 0.5, atol=0.15)


def test_a_rare_predicate_is_learnt_besides_a_frequent_one():
    weights = class_weights(one_hot(np.array([0, 0, 0, 2]), 4))
    np.testing.assert_allclose(weights, [2 / 3, 0, 2, 0])
    generator = np.random.default_rng(0)
    labels = np.array([0] * 190 + [1] * 10)
    inputs = generator.normal(size=(200, 6)).astype(np.float32)
    inputs[:, 0] += 3 * labels
    found = fit(inputs, labels, generator.permutation(200), 150, FitOptions(epochs=60))
    assert len(found.train_losses) == len(found.validation_losses) <= 60
    answers = found.probe.predict(inputs, np.zeros((200, 8), np.float32))
    assert score(answers, one_hot(labels), one_hot(labels)).macro_accuracy > 0.85
    # Training stops where there is nothing to learn.
    inputs = generator.normal(size=(60, 8)).astype(np.float32)
    found = fit(inputs, generator.integers(0, 3, 60), np.arange(60), 40, FitOptions(patience=3))
    assert len(found.validation_losses) == found.best_epoch + 4 < 100


def test_scores_are_micro_and_macro():
    answers = np.eye(3)[[0, 0, 0, 1]] * 0.8 + 0.2 / 3
    targets = one_hot(np.array([0, 0, 1, 1]), 3)
    found = score(answers, targets, one_hot(np.array([0, 0, 0, 1]), 3))
    assert found.confusion.tolist() == [[2, 0, 0], [1, 1, 0], [0, 0, 0]]
    assert (found.micro_accuracy, found.macro_accuracy) == (0.75, 0.75)
    assert (found.chance_macro, found.majority_micro) == (0.5, 0.5)
    right, wrong = -np.log(0.8 + 0.2 / 3), -np.log(0.2 / 3)
    assert found.log_loss_nats == pytest.approx((3 * right + wrong) / 4)
    # A clip with two predicates is right with either.
    targets[2] = [0.5, 0.5, 0]
    assert score(answers, targets, targets).micro_accuracy == 1
