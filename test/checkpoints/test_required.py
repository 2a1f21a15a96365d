"""Checkpoints that a configuration needs: what is missing is named before anything is loaded."""

import json
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from deworldsg_ros.checkpoints.catalogue import (
    INDEX_FILE,
    detector_of,
    is_complete,
    require_checkpoints,
    unused_detector,
)
from deworldsg_ros.cli.app import app
from deworldsg_ros.config import Config, PerceptionConfig, load_config, to_mapping

FOLDERS = ("fross_3dssg", "sam2.1-hiera-tiny", "vjepa2-vitg-fpc64-384", "probe_3dssg")


def test_the_paper_without_weights_names_each_network_in_a_line(root_dir):
    config = load_config(root_dir / "config" / "paper.yaml")
    with pytest.raises(Exception, match="checkpoints of the configuration") as error:
        require_checkpoints(config.perception, config.relations)
    _, detector, segmenter, world_model = str(error.value).splitlines()
    fross, sam2, vjepa2, probe = (f"./models/{name}" for name in FOLDERS)
    for line, words in (
        (detector, ("RT-DETR and EGTR of FROSS", f"detector_path '{fross}'", "import-fross")),
        (segmenter, ("SAM 2", f"segmenter_path '{sam2}'", "models get sam2.1-hiera-tiny`")),
        (world_model, ("V-JEPA 2", f"world_model_path '{vjepa2}'", f"get {FOLDERS[2]}`")),
        (world_model, (f"relations.probe_path '{probe}'", "import-probe", "train-probe")),
    ):
        assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("words", "code"),
    [(["run"], 2), (["demo"], 2), (["evaluate", "run", "--layout", "recording"], 1)],
)
def test_each_program_refuses_the_paper_without_weights(root_dir, tmp_path, words, code):
    """Every program says it at once, before a model is loaded or a process starts."""
    recording, config = root_dir / "bags" / "demo_room", root_dir / "config" / "paper.yaml"
    command = [*words, recording, "--config", config, "--out", tmp_path / "out"]
    result = CliRunner().invoke(app, [str(word) for word in command])
    assert result.exit_code == code
    assert all(name in result.output for name in ("EGTR", "SAM 2", "V-JEPA 2"))


def test_existing_folders_hub_ids_and_embedded_models_pass(root_dir, tmp_path):
    require_checkpoints(Config().perception, Config().relations)
    config, here = load_config(root_dir / "config" / "paper.yaml"), str(tmp_path)
    require_checkpoints(
        msgspec.structs.replace(config.perception, detector_path="a/b", segmenter_path=here),
        msgspec.structs.replace(config.relations, world_model_path="a/b", probe_path=here),
    )
    with pytest.raises(Exception, match=r"RT-DETR \(perception.detector_path ''\)"):
        require_checkpoints(PerceptionConfig(detector="rtdetr"))


def test_an_exported_detector_is_named_by_its_command():
    with pytest.raises(Exception, match="models export NAME x/y/z`"):
        require_checkpoints(PerceptionConfig(detector="onnx", detector_path="x/y/z"))


def test_a_stronger_detector_that_lies_there_is_noticed(tmp_path):
    def noticed(**changes):
        return unused_detector(PerceptionConfig(**changes), tmp_path)

    assert noticed() == unused_detector(PerceptionConfig(), tmp_path / "none") == ("", "")
    for name, content in (
        ("dfine-small-obj365", {"config.json": '{"model_type": "d_fine"}'}),  # without weights
        ("sam-vit-base", {"config.json": '{"model_type": "sam"}', "model.safetensors": ""}),
        ("zz_exported", {"model.onnx": "", "model.json": "{}"}),
    ):
        (tmp_path / name).mkdir()
        for file, text in content.items():
            (tmp_path / name / file).write_text(text)
    exported = str(tmp_path / "zz_exported")
    assert noticed() == (
        exported,
        f"--set perception.detector=onnx --set perception.detector_path={exported}",
    )
    (tmp_path / "dfine-small-obj365" / "model.safetensors").write_text("")
    folder, settings = noticed()
    assert folder == str(tmp_path / "dfine-small-obj365") and "=transformers " in settings
    assert noticed(detector="transformers") == ("", "")
    # Its configuration tells the backend of a folder.
    (tmp_path / "sam-vit-base" / "config.json").write_text('{"model_type": "owlv2"}')
    assert detector_of(tmp_path / "sam-vit-base") == "open_vocabulary"
    (tmp_path / "sam-vit-base" / "config.json").write_text("[1]")
    assert detector_of(tmp_path / "sam-vit-base") == detector_of(tmp_path) == "transformers"


def test_a_folder_with_some_of_its_shards_is_not_complete(tmp_path):
    shards = [f"model-0000{number}-of-00004.safetensors" for number in (1, 2, 3, 4)]
    index = {"weight_map": {f"layer.{number}": name for number, name in enumerate(shards)}}
    found = []
    for name, text in (
        *(("config.json", "{}"), (shards[0], ""), (INDEX_FILE, json.dumps(index))),
        *((shard, "") for shard in shards[1:]),
    ):
        (tmp_path / name).write_text(text)
        found.append(is_complete(tmp_path))
    assert found == [False] * 5 + [True]
    (tmp_path / INDEX_FILE).write_text("[]")
    assert not is_complete(tmp_path)
    (tmp_path / "model.safetensors").write_text("")
    assert is_complete(tmp_path)


def test_weights_in_the_layout_of_their_authors_are_named_with_the_way_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = tmp_path / "models" / "sam2.1_hiera_base_plus.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"")
    for path, model in (
        ("models/sam2.1_hiera_base_plus.pt", "sam2.1-hiera-base-plus"),  # not an id of the hub
        ("./models/sam2.1_hiera_base_plus.pt", "sam2.1-hiera-base-plus"),
        ("models", "sam2.1-hiera-tiny"),
    ):
        with pytest.raises(Exception, match="its authors' own layout") as error:
            require_checkpoints(PerceptionConfig(segmenter="sam2", segmenter_path=path))
        assert f"models get {model}" in str(error.value)
        assert str(error.value).endswith(f"set the option to {Path(path).parent / model}")
    (weights.parent / "config.json").write_text("{}")
    require_checkpoints(PerceptionConfig(segmenter="sam2", segmenter_path="models"))


def test_a_probe_of_dinov2_is_trained_and_not_imported(root_dir):
    config = load_config(root_dir / "config" / "paper.yaml")
    relations = msgspec.structs.replace(config.relations, world_model="dinov2")
    with pytest.raises(Exception, match="train-probe CLIPS --world-model dinov2") as error:
        require_checkpoints(relations=relations)
    assert "import-probe" not in str(error.value)


def test_a_detector_of_free_text_is_measured_with_words(root_dir, tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "grounding-dino"}')
    command = ["models", "measure", str(tmp_path), str(root_dir / "bags" / "demo_room")]
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2 and "give --words 'mug, drill'" in refused.output


def test_the_files_of_the_paper_differ_only_where_they_have_to(root_dir):
    def added(one, other):
        one, other = (to_mapping(load_config(root_dir / "config" / name)) for name in (one, other))
        values = [(s, f, value) for s, fields in one.items() for f, value in fields.items()]
        return {f"{s}.{f}": value for s, f, value in values if value != other[s][f]}

    # Networks, their paths and the score threshold of softmax scores.
    assert added("paper.yaml", "paper_rules.yaml").keys() == {
        *("perception.detector", "perception.detector_path", "perception.segmenter"),
        *("perception.segmenter_path", "perception.relation_head", "perception.predicate_set"),
        *("perception.score_threshold", "relations.world_model", "relations.world_model_path"),
        "relations.probe_path",
    }
    # Networks that were trained for a data set.
    assert added("paper_replica.yaml", "paper.yaml") == {
        "perception.detector_path": "./models/fross_vg",
        "relations.probe_path": "./models/probe_replica",
    }
    # What options can say of the released predictions.
    assert added("released.yaml", "paper.yaml") == {
        "perception.segmenter": "sam3",
        "perception.segmenter_path": "./models/sam3",
        "relations.entropy_threshold_nats": 0.0,
        "relations.edge_belief": "all_pairs",
    }
