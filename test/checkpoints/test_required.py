"""Checkpoints that a configuration needs: what is missing is named before anything is loaded."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from deworldsg_ros.checkpoints.catalogue import require_checkpoints
from deworldsg_ros.cli.app import app
from deworldsg_ros.config import Config, PerceptionConfig, load_config, to_mapping


def paper(root_dir: Path) -> Config:
    return load_config(root_dir / "config" / "paper.yaml")


def test_the_paper_without_weights_names_each_network_in_a_line(root_dir: Path) -> None:
    config = paper(root_dir)
    with pytest.raises(Exception, match="checkpoints of the configuration are missing") as error:
        require_checkpoints(config.perception, config.relations)
    _, detector, segmenter, world_model = str(error.value).splitlines()
    assert detector.startswith(
        "RT-DETR and EGTR of FROSS (perception.detector_path './models/fross_3dssg')"
    )
    assert "models import-fross" in detector
    assert "deworldsg models get sam2.1-hiera-tiny`" in segmenter
    assert "deworldsg models get vjepa2-vitg-fpc64-384`" in world_model
    assert segmenter.startswith("SAM 2 (perception.segmenter_path './models/sam2.1-hiera-tiny')")
    assert world_model.startswith("V-JEPA 2 (relations.world_model_path './models/vjepa2-vitg-")
    assert "relations.probe_path './models/probe_3dssg'" in world_model
    assert "import-probe" in world_model and "train-probe" in world_model


def test_each_program_refuses_the_paper_without_weights(root_dir: Path, tmp_path: Path) -> None:
    """Every program says it at once, before a model is loaded or a process starts."""
    recording, config = root_dir / "bags" / "demo_room", root_dir / "config" / "paper.yaml"
    for words in (("run", recording), ("demo", recording)):
        command = [*words, "--config", config, "--out", tmp_path / "out"]
        result = CliRunner().invoke(app, [str(word) for word in command])
        assert result.exit_code == 2
        for name in ("fross_3dssg", "sam2.1-hiera-tiny", "vjepa2-vitg-fpc64-384", "probe_3dssg"):
            assert f"./models/{name}" in result.stderr
    words = ("evaluate", "run", "--layout", "recording", recording, "--config", config)
    result = CliRunner().invoke(app, [str(word) for word in (*words, "--out", tmp_path / "out")])
    assert result.exit_code == 1
    assert "EGTR" in result.output and "SAM 2" in result.output and "V-JEPA 2" in result.output


def test_existing_folders_hub_ids_and_embedded_models_pass(root_dir: Path, tmp_path: Path) -> None:
    require_checkpoints(Config().perception, Config().relations)
    config, here = paper(root_dir), str(tmp_path)
    require_checkpoints(
        msgspec.structs.replace(config.perception, detector_path="a/b", segmenter_path=here),
        msgspec.structs.replace(config.relations, world_model_path="a/b", probe_path=here),
    )
    with pytest.raises(Exception, match=r"RT-DETR \(perception.detector_path ''\)"):
        require_checkpoints(PerceptionConfig(detector="rtdetr"))


def test_the_two_files_of_the_paper_have_the_same_rules(root_dir: Path) -> None:
    """paper.yaml adds networks, their paths and the score threshold of softmax scores only."""
    whole, rules = (
        to_mapping(load_config(root_dir / "config" / name))
        for name in ("paper.yaml", "paper_rules.yaml")
    )
    different = {
        f"{section}.{field}"
        for section, values in whole.items()
        for field, value in values.items()
        if value != rules[section][field]
    }
    assert different == {
        *("perception.detector", "perception.detector_path", "perception.segmenter"),
        *("perception.segmenter_path", "perception.relation_head", "perception.predicate_set"),
        *("perception.score_threshold", "relations.world_model", "relations.world_model_path"),
        "relations.probe_path",
    }
