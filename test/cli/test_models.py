"""`deworldsg models get`, `list` and `inspect`, against a hub on this machine."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.fake_hub import FakeHub
from typer.testing import CliRunner, Result

pytest.importorskip("huggingface_hub")
safetensors = pytest.importorskip("safetensors.numpy")

from deworldsg_ros.checkpoints.catalogue import CATALOGUE, GROUPS  # noqa: E402  after the guards
from deworldsg_ros.checkpoints.hub import read_headers  # noqa: E402
from deworldsg_ros.cli.app import app  # noqa: E402
from deworldsg_ros.cli.demo import configuration_of  # noqa: E402
from deworldsg_ros.config import load_config  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402

pytestmark = pytest.mark.models

WEIGHTS = safetensors.save({"layer.weight": np.zeros((300, 400), np.float32)})
FILES = {
    "config.json": b'{"model_type": "dinov2"}',
    "model.safetensors": WEIGHTS,
    "preprocessor_config.json": b"{}",
    "README.md": b"---\nlicense: mit\n---\n",
    "pytorch_model.bin": b"a pickle, which is not fetched",
}


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch):
    with FakeHub("facebook/dinov2-small", dict(FILES)).serving() as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_HUB_DISABLE_XET", "1")
        yield hub


def models(*words: object) -> Result:
    return CliRunner().invoke(app, ["models", *(str(word) for word in words)])


def test_a_model_is_fetched_verified_and_kept(hub: FakeHub, tmp_path: Path) -> None:
    result = models("get", "dinov2-small", "--into", tmp_path)
    assert result.exit_code == 0, result.output
    assert "licence mit" in result.output and "commit 0123456789ab" in result.output
    folder = tmp_path / "dinov2-small"
    for name, content in FILES.items():
        if name == "pytorch_model.bin":
            assert not (folder / name).exists()
        else:
            assert (folder / name).read_bytes() == content
    checked = subprocess.run(
        ["sha256sum", "-c", "SHA256SUMS"], cwd=folder, capture_output=True, text=True, check=True
    )
    assert checked.stdout.count(": OK") == 4
    hub.requested.clear()
    result = models("get", "facebook/dinov2-small", "--into", tmp_path)
    assert result.exit_code == 0 and "was there" in result.output
    assert hub.requested == []


def test_a_download_that_was_cut_continues_where_it_stopped(hub: FakeHub, tmp_path: Path) -> None:
    # The client writes pieces of 10 MB.
    weights = safetensors.save({"layer.weight": np.ones((6000, 1000), np.float32)})
    hub.files["model.safetensors"] = weights
    hub.cut.add("model.safetensors")
    for _ in range(2):  # the client may continue by itself, or end with an error
        result = models("get", "dinov2-small", "--into", tmp_path)
    assert result.exit_code == 0, result.stderr
    ranges = [asked for kind, name, asked in hub.requested if kind == "GET" and "model" in name]
    assert "bytes=10485760-" in ranges, ranges
    assert (tmp_path / "dinov2-small" / "model.safetensors").read_bytes() == weights


def test_only_missing_files_are_fetched(hub: FakeHub, tmp_path: Path) -> None:
    models("get", "dinov2-small", "--into", tmp_path)
    (tmp_path / "dinov2-small" / "model.safetensors").unlink()
    hub.requested.clear()
    assert "incomplete dinov2-small" in models("list", "--into", tmp_path).output
    assert models("get", "dinov2-small", "--into", tmp_path).exit_code == 0
    assert {name for _, name, _ in hub.requested} == {"model.safetensors"}


def test_a_damaged_file_is_removed_and_reported(hub: FakeHub, tmp_path: Path) -> None:
    hub.damaged.add("model.safetensors")
    result = models("get", "dinov2-small", "--into", tmp_path)
    assert result.exit_code == 2
    assert "has another checksum" in result.stderr and "run the command again" in result.stderr
    assert not (tmp_path / "dinov2-small" / "model.safetensors").exists()
    hub.damaged.clear()
    assert models("get", "dinov2-small", "--into", tmp_path).exit_code == 0


def test_errors_name_the_remedy(hub: FakeHub, tmp_path: Path) -> None:
    unknown = models("get", "dino", "--into", tmp_path)
    assert unknown.exit_code == 2 and "expected paper, embedded, rtdetr_r18vd" in unknown.stderr
    absent = models("get", "nobody/nothing", "--into", tmp_path)
    assert absent.exit_code == 2 and "check the network and the id" in absent.stderr
    hub.files.pop("model.safetensors")
    pickles = models("get", "dinov2-small", "--into", tmp_path)
    assert "has no model.safetensors" in pickles.stderr


def test_the_embedded_models_need_no_network(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    result = models("get", "embedded", "--into", tmp_path)
    assert result.exit_code == 0 and "nothing to download" in result.output
    assert list(tmp_path.iterdir()) == []


def test_the_list_says_what_is_there_and_how_to_get_the_rest(hub: FakeHub, tmp_path: Path) -> None:
    models("get", "dinov2-small", "--into", tmp_path)
    lines = models("list", "--into", tmp_path).output.splitlines()
    assert any(line.startswith("there      dinov2-small") for line in lines)
    assert any(line.startswith("missing    sam2.1-hiera-tiny") for line in lines)
    text = " ".join(lines)
    for words in ("without network", "sha256sum -c", "import-fross", "import-probe", "licence mit"):
        assert words in text


def test_the_paper_is_the_hub_models_and_the_files_of_paper_yaml(root_dir: Path) -> None:
    config = load_config(root_dir / "config" / "paper.yaml")
    paths = {config.perception.segmenter_path, config.relations.world_model_path}
    assert paths == {f"./models/{name}" for name in GROUPS["paper"]}
    assert set(GROUPS["paper"]) <= CATALOGUE.keys()


def test_the_demo_takes_the_configuration_of_the_models(root_dir: Path, tmp_path: Path) -> None:
    assert configuration_of("embedded", None) is None
    assert configuration_of("paper", None) == root_dir / "config" / "paper.yaml"
    assert configuration_of("paper", tmp_path) == tmp_path
    with pytest.raises(ConfigurationError, match="expected embedded or paper"):
        configuration_of("large", None)
    result = CliRunner().invoke(app, ["demo", "--models", "paper", "--out", str(tmp_path / "out")])
    assert result.exit_code == 2 and "deworldsg models get sam2.1-hiera-tiny" in result.stderr


def test_inspect_prints_names_and_shapes(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    (tmp_path / "model.safetensors").write_bytes(WEIGHTS)
    torch.save({"state_dict": {"a": torch.zeros(2, 3)}, "epoch": 3}, tmp_path / "model.ckpt")
    for path in (tmp_path, tmp_path / "model.safetensors"):
        result = models("inspect", path)
        assert result.exit_code == 0
        assert "1 parameters, 0.12 million values" in result.output
        assert "layer.weight  float32  300 x 400" in result.output
    assert "state_dict.a  float32  2 x 3" in models("inspect", tmp_path / "model.ckpt").output


def test_inspect_ends_on_dictionaries_without_end(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    path = tmp_path / "model.pt"
    itself: dict[str, object] = {"weight": torch.zeros(1)}
    itself["a"] = itself
    torch.save(itself, path)
    with pytest.raises(ConfigurationError, match="nested more than 32 deep"):
        read_headers(path)
    often: dict[str, object] = {"weight": torch.zeros(1)}
    for _ in range(30):
        often = {"a": often, "b": often}
    torch.save(often, path)
    with pytest.raises(ConfigurationError, match="more than 1000000 entries"):
        read_headers(path)
    once = {"weight": torch.zeros(1)}
    torch.save({"a": once, "b": once}, path)
    assert [header.name for header in read_headers(path)] == ["a.weight", "b.weight"]


def test_inspect_refuses_other_files(tmp_path: Path) -> None:
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(WEIGHTS[:50])
    with pytest.raises(ConfigurationError, match="no complete safetensors file"):
        read_headers(cut)
    pickled = tmp_path / "evil.pt"
    pickled.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(ConfigurationError, match="without executing code"):
        read_headers(pickled)
    result = models("inspect", tmp_path / "none.pt")
    assert result.exit_code == 2 and "no such file" in result.stderr
