"""`deworldsg train-probe` and `import-probe`, from a folder of clips and from a data set."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from support.checkpoints import save_vjepa2  # noqa: E402  after the guards
from support.pair_rooms import render_room  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

from deworldsg_ros.checkpoints.cards import CheckpointCard, write_detector_card  # noqa: E402
from deworldsg_ros.checkpoints.probe_network import load_probe  # noqa: E402
from deworldsg_ros.cli.app import app  # noqa: E402
from deworldsg_ros.cli.probe import read_predicates  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES  # noqa: E402

NAMES = ("above", "on")


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def write_data_set(root, scans=3, frames=6):
    """ReplicaSSG's layout: one pair above the other in each scan, both directions annotated."""
    annotations = root / "ReplicaSSG"
    annotations.mkdir(parents=True)
    names = [f"scan_{n}" for n in range(scans)]
    objects = [{"label": "cup", "id": "1"}, {"label": "table", "id": "2"}]
    lines = [[1, 2, 1, "on"], [2, 1, 0, "above"]]
    files = {
        "objects.json": {"scans": [{"scan": name, "objects": objects} for name in names]},
        "relationships.json": {"scans": [{"scan": n, "relationships": lines} for n in names]},
        "replica_to_visual_genome.json": {
            "Replica2VisualGenome": {"cup": "cup", "table": "table"},
            "VisualGenome_list": ["cup", "table"],
            "VisualGenome_rel": list(NAMES),
        },
    }
    for name, content in files.items():
        (annotations / name).write_text(json.dumps(content))
    (annotations / "train_scans.txt").write_text("\n".join(names))
    (annotations / "test_scans.txt").write_text("")
    for seed, name in enumerate(names):
        sequence = root / "data" / name / "sequence"
        sequence.mkdir(parents=True)
        _, pair = render_room(seed, 2, frames)
        for number, frame in enumerate(pair.frames):
            stem = str(sequence / f"frame-{number:06}")
            cv2.imwrite(f"{stem}.color.jpg", frame[..., ::-1])
            rows = [f"{i + 1} {' '.join(map(str, box))}" for i, box in enumerate(pair.boxes_xyxy)]
            (sequence / f"frame-{number:06}.bb.txt").write_text("\n".join(rows))
    return root


def options(tmp_path, **changes):
    model = tmp_path / "model"
    if not model.exists():
        save_vjepa2(model)
    settings = {"out": tmp_path / "probe", "model": model, "clip-length": 4, "device": "cpu"}
    settings = {**settings, "epochs": 3, **changes}
    return [word for name, value in settings.items() for word in (f"--{name}", value)]


def test_a_probe_from_a_data_set(tmp_path):
    data = write_data_set(tmp_path / "data_set")
    arguments = options(tmp_path, **{"held-out": "scan_1", "inputs": "clip_and_boxes"})
    result = run("train-probe", data, *arguments)
    assert result.exit_code == 0, result.output
    assert "held-out rooms: macro accuracy" in result.output
    card = load_probe(tmp_path / "probe").card
    assert card.predicates == REPLICA_SSG_PREDICATES
    assert card.training["clips"] == {"train": 8, "validation": 8, "held_out": 8}
    assert card.training["held_out_groups"] == ["scan_1"]
    assert card.training["data_split"] == "train" and card.window == "last_frames"
    assert card.training["groups_by_part"]["held_out"] == ["scan_1"]
    assert card.seen_groups == {"scan_0", "scan_2"}


def test_scans_of_another_split_need_a_word(tmp_path):
    data = write_data_set(tmp_path / "data_set")
    lists = data / "ReplicaSSG"
    (lists / "train_scans.txt").rename(lists / "validation_scans.txt")
    refused = run("train-probe", data, *options(tmp_path))
    assert refused.exit_code == 2 and "has no scans of the split 'train'" in refused.output
    told = run("train-probe", data, *options(tmp_path, split="validation"))
    assert told.exit_code == 0, told.output
    assert load_probe(tmp_path / "probe").card.training["data_split"] == "validation"


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"device": "cuda"}, "--device is 'cuda'"),
        ({"model": "/absent"}, "--model '/absent': there is no such folder"),
        ({"world-model": "fake"}, "expected vjepa2 or dinov2"),
        ({"layout": "three"}, "expected two_layer or batch_norm"),
        ({"window": "all"}, "expected last_frames or valid_interval"),
        ({"split": "all"}, "expected train or validation or test"),
        ({"predicates": "/absent"}, "expected replica_ssg, 3dssg, a file"),
        ({"predicates": "3dssg"}, "which is not one of the 7 of the chosen set"),
    ],
)
def test_errors_are_one_sentence(tmp_path, changes, message, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    data = write_data_set(tmp_path / "data_set", scans=2, frames=4)
    result = run("train-probe", data, *options(tmp_path, **changes))
    assert result.exit_code == 2 and message in result.output and "Traceback" not in result.output


def test_a_published_probe_is_imported(tmp_path):
    predicates = tmp_path / "names.txt"
    predicates.write_text("on\nnear\n")
    shapes = {
        "net.0.weight": 1408,
        "net.0.bias": 1408,
        "net.0.running_mean": 1408,
        "net.0.running_var": 1408,
        "net.0.num_batches_tracked": (),
        "net.1.weight": (512, 1408),
        "net.1.bias": 512,
        "net.3.weight": 512,
        "net.3.bias": 512,
        "net.3.running_mean": 512,
        "net.3.running_var": 512,
        "net.3.num_batches_tracked": (),
        "net.5.weight": (2, 512),
        "net.5.bias": 2,
    }
    torch.save({name: torch.ones(shape) for name, shape in shapes.items()}, tmp_path / "p.pt")
    result = run("import-probe", tmp_path / "p.pt", tmp_path / "out", "--predicates", predicates)
    assert result.exit_code == 0, result.output
    probe = load_probe(tmp_path / "out")
    assert probe.card.predicates == ("on", "near")
    assert "does not know the weights of its backbone" in result.output
    rows = probe.predict(np.zeros((1, 1408), np.float32), np.zeros((1, 8), np.float32))
    assert rows.shape == (1, 2)
    wrong = run("import-probe", tmp_path / "p.pt", tmp_path / "out2")
    assert wrong.exit_code == 2 and "7 predicates" in wrong.output
    assert not (tmp_path / "out2").exists()


def test_predicates_are_those_of_an_imported_checkpoint(tmp_path):
    write_detector_card(tmp_path / "deworldsg.json", CheckpointCard(predicates=("on", "near")))
    assert read_predicates(str(tmp_path)) == ("on", "near")
    write_detector_card(tmp_path / "deworldsg.json", CheckpointCard())
    with pytest.raises(ConfigurationError, match="checkpoint with a relation head"):
        read_predicates(str(tmp_path))
