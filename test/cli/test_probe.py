"""`deworldsg train-probe` and `import-probe`, from a folder of clips and from a data set."""

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from support.checkpoints import save_vjepa2  # noqa: E402  after the guards
from support.cli import invoke, printed, refusal  # noqa: E402
from support.evaluation import write_dataset, write_ply  # noqa: E402
from support.pair_rooms import render_room  # noqa: E402
from support.sequences import write_info, write_pgm  # noqa: E402

from deworldsg_ros.checkpoints.cards import CheckpointCard, write_detector_card  # noqa: E402
from deworldsg_ros.checkpoints.probe_network import load_probe  # noqa: E402
from deworldsg_ros.cli.probe import read_predicates  # noqa: E402
from deworldsg_ros.scene.camera import Intrinsics  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES  # noqa: E402


def write_data_set(root, scans=3, frames=6):
    """ReplicaSSG's layout: one pair above the other in each scan, both directions annotated."""
    content = ([("chair", 1), ("table", 2)], [(1, 2, "on"), (2, 1, "near")])
    names = [f"scan_{n}" for n in range(scans)]
    write_dataset(root, dict.fromkeys(names, content), split_scans=())
    camera = Intrinsics(150.0, 150.0, 79.5, 59.5, 160, 120)
    (root / "ReplicaSSG" / "train_scans.txt").write_text("\n".join(names))
    for seed, name in enumerate(names):
        sequence = root / "data" / name / "sequence"
        write_info(sequence / "_info.txt", camera, camera)
        _, pair = render_room(seed, 2, frames)
        # Surface points 2 m in front of the camera.
        points, ids = np.zeros((40, 3)), np.repeat([1, 2], 20)
        points[:, 0], points[:, 2] = np.linspace(-0.4, 0.4, 40), 2
        write_ply(root / "data" / name / "labels.instances.annotated.v2.ply", points, ids)
        for number, frame in enumerate(pair.frames):
            cv2.imwrite(str(sequence / f"frame-{number:06}.color.jpg"), frame[..., ::-1])
            rows = [f"{i + 1} {' '.join(map(str, box))}" for i, box in enumerate(pair.boxes_xyxy)]
            (sequence / f"frame-{number:06}.bb.txt").write_text("\n".join(rows))
            np.savetxt(sequence / f"frame-{number:06}.pose.txt", np.eye(4))
            depth = np.full((120, 160), 2000, np.uint16)
            write_pgm(sequence / f"frame-{number:06}.depth.pgm", depth)
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
    assert "held-out rooms: macro accuracy" in printed("train-probe", data, *arguments)
    card = load_probe(tmp_path / "probe").card
    assert card.predicates == REPLICA_SSG_PREDICATES
    assert card.training["clips"] == {"train": 8, "validation": 8, "held_out": 8}
    assert card.training["held_out_groups"] == ["scan_1"]
    assert card.training["data_split"] == "train" and card.window == "last_frames"
    assert card.training["groups_by_part"]["held_out"] == ["scan_1"]
    assert card.seen_groups == {"scan_0", "scan_2"}
    assert card.training["scans_by_part"]["validation"] in (["scan_0"], ["scan_2"])


def test_a_probe_of_all_rooms_has_a_fixed_number_of_epochs(tmp_path):
    data = write_data_set(tmp_path / "data_set", scans=1)
    words = ("train-probe", data, *options(tmp_path, **{"held-out-fraction": 0}))
    extra = ("--crop", "each_frame", "--class-weights", "inverse_frequency")
    assert "trained on all 8 clips for 3 epochs" in printed(*words, *extra)
    card = load_probe(tmp_path / "probe").card
    assert card.crop == "each_frame" and card.training["clips"] == {"train": 8}
    epochs = words.index("--epochs")
    assert "give --epochs" in refusal(*words[:epochs], *words[epochs + 2 :])
    # Both objects are equally far away: only a cost of 0 refuses the pair.
    assert "below 0.001 (Eq. 8)" in refusal(*words, "--geo-cost-threshold", 0.001)


def test_scans_of_another_split_need_a_word(tmp_path):
    data = write_data_set(tmp_path / "data_set")
    lists = data / "ReplicaSSG"
    (lists / "train_scans.txt").rename(lists / "validation_scans.txt")
    assert "'train'" in refusal("train-probe", data, *options(tmp_path))
    printed("train-probe", data, *options(tmp_path, split="validation"))
    assert load_probe(tmp_path / "probe").card.training["data_split"] == "validation"


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"device": "cuda"}, "'cuda'"),
        ({"model": "/absent"}, "'/absent'"),
        ({"world-model": "fake"}, "vjepa2 or dinov2"),
        ({"layout": "three"}, "two_layer or batch_norm"),
        ({"window": "all"}, "last_frames or valid_interval"),
        ({"crop": "all"}, "last_frame or clip_union or each_frame"),
        ({"class-weights": "all"}, "none or inverse_frequency"),
        ({"geo-cost-threshold": -1}, "relations.geo_cost_threshold"),
        ({"split": "all"}, "train or validation or test"),
        ({"predicates": "/absent"}, "replica_ssg, 3dssg, a file"),
        ({"predicates": "3dssg"}, "one of the 7"),
    ],
)
def test_what_is_refused(tmp_path, changes, message, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    data = write_data_set(tmp_path / "data_set", scans=2, frames=4)
    assert message in refusal("train-probe", data, *options(tmp_path, **changes))


def test_a_published_probe_is_imported(tmp_path):
    predicates = tmp_path / "names.txt"
    predicates.write_text("on\nnear\n")
    norm = ("weight", "bias", "running_mean", "running_var")
    shapes = {
        **{f"net.0.{name}": (1408,) for name in norm},
        "net.0.num_batches_tracked": (),
        **{"net.1.weight": (512, 1408), "net.1.bias": (512,)},
        **{f"net.3.{name}": (512,) for name in norm},
        "net.3.num_batches_tracked": (),
        **{"net.5.weight": (2, 512), "net.5.bias": (2,)},
    }
    torch.save({name: torch.ones(shape) for name, shape in shapes.items()}, tmp_path / "p.pt")
    command = ("import-probe", tmp_path / "p.pt", tmp_path / "out")
    result = invoke(*command, "--predicates", predicates)
    assert result.exit_code == 0 and "does not know the weights" in result.output
    probe = load_probe(tmp_path / "out")
    assert probe.card.predicates == ("on", "near")
    rows = probe.predict(np.zeros((1, 1408), np.float32), np.zeros((1, 8), np.float32))
    assert rows.shape == (1, 2)
    assert "7 predicates" in refusal("import-probe", tmp_path / "p.pt", tmp_path / "out2")
    assert not (tmp_path / "out2").exists()


def test_predicates_are_those_of_an_imported_checkpoint(tmp_path):
    write_detector_card(tmp_path / "deworldsg.json", CheckpointCard(predicates=("on", "near")))
    assert read_predicates(str(tmp_path)) == ("on", "near")
    write_detector_card(tmp_path / "deworldsg.json", CheckpointCard())
    with pytest.raises(ConfigurationError, match="checkpoint with a relation head"):
        read_predicates(str(tmp_path))
