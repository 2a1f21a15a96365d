"""The recipes of docs/dev/models.md with small networks of random weights from a local hub."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from support.checkpoints import config_of, save_vjepa2
from support.cli import DEMO_ROOM, invoke, printed
from support.fake_hub import FakeHub
from support.torch_models import PREDICATES, save_paper_checkpoint, save_sam2, torch
from typer.testing import Result

from deworldsg_ros.checkpoints.cards import ProbeCard
from deworldsg_ros.checkpoints.probe_network import Probe, build_network, save_probe
from deworldsg_ros.relations import clip_models

pytestmark = pytest.mark.models


def get(repository: str, source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`deworldsg models get` from a hub that has the files of a folder."""
    files = {path.name: path.read_bytes() for path in source.iterdir() if path.is_file()}
    with FakeHub(repository, files).serving() as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        printed("models", "get", repository.partition("/")[2])


def run_paper(root_dir: Path, out: str) -> Result:
    return invoke(
        *("run", DEMO_ROOM, "--out", out, "--max-frames", 3),
        *("--config", root_dir / "config" / "paper.yaml"),
        # Scores of random weights are low.
        *("--set", "perception.score_threshold=0.3"),
    )


@pytest.mark.timeout(600)
def test_the_paper_runs_with_models_of_a_hub_and_on_a_machine_without_network(
    root_dir, tmp_path, monkeypatch
):
    here, robot = tmp_path / "here", tmp_path / "robot"
    here.mkdir()
    monkeypatch.chdir(here)
    refused = run_paper(root_dir, "out")
    assert refused.exit_code == 2 and "deworldsg models get sam2.1-hiera-tiny" in refused.stderr

    # Recipe 2: two models from the hub; detector, relation head and probe are not there.
    get("facebook/sam2.1-hiera-tiny", save_sam2(tmp_path / "sam2", video=True), monkeypatch)
    world_model = save_vjepa2(tmp_path / "vjepa2")
    get("facebook/vjepa2-vitg-fpc64-384", world_model, monkeypatch)
    save_paper_checkpoint(here / "models" / "fross_3dssg")
    identity = clip_models.load_vjepa2(config_of("vjepa2", world_model, clip_length=16)).identity
    torch.manual_seed(0)
    card = ProbeCard(identity, PREDICATES)
    save_probe(here / "models" / "probe_3dssg", Probe(card, build_network(card).eval()))
    listed = printed("models", "list")
    for name in ("sam2.1-hiera-tiny", "vjepa2-vitg-fpc64-384", "fross_3dssg", "probe_3dssg"):
        assert f"there      {name}" in listed
    done = run_paper(root_dir, "out")
    assert done.exit_code == 0, done.stderr
    graph = json.loads((here / "out" / "scene_graph.json").read_text())
    assert graph["nodes"]

    # Recipe 3: the folder on a machine without network gives the same graph.
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    shutil.copytree(here / "models", robot / "models")
    for name in ("sam2.1-hiera-tiny", "vjepa2-vitg-fpc64-384"):
        subprocess.run(["sha256sum", "-c", f"{name}.sha256"], cwd=robot / "models", check=True)
    monkeypatch.chdir(robot)
    assert run_paper(root_dir, "out").exit_code == 0
    copied = json.loads((robot / "out" / "scene_graph.json").read_text())
    assert copied["nodes"] == graph["nodes"] and copied["edges"] == graph["edges"]
