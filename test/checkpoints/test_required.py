"""Checkpoints that a configuration needs: what is missing is named before anything is loaded."""

import msgspec
import pytest
from support.cli import invoke

from deworldsg_ros.checkpoints.catalogue import require_checkpoints
from deworldsg_ros.config import Config, PerceptionConfig, load_config

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
    result = invoke(*command)
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
