"""`deworldsg models get`, `list` and `inspect`, against a hub on this machine."""

import hashlib
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cli import invoke, printed, refusal
from support.fake_hub import COMMIT, FakeHub

pytest.importorskip("huggingface_hub")
safetensors = pytest.importorskip("safetensors.numpy")

from deworldsg_ros.checkpoints.catalogue import CATALOGUE, GROUPS  # noqa: E402  after the guards
from deworldsg_ros.checkpoints.hub import read_headers  # noqa: E402
from deworldsg_ros.cli.demo import configuration_of  # noqa: E402
from deworldsg_ros.config import load_config  # noqa: E402
from deworldsg_ros.evaluation.rows import DINOV2  # noqa: E402
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
def hub(monkeypatch):
    with FakeHub("facebook/dinov2-small", dict(FILES)).serving() as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_HUB_DISABLE_XET", "1")
        yield hub


def get(into: Path, name: str = "dinov2-small") -> str:
    return printed("models", "get", name, "--into", into)


def test_a_model_is_fetched_verified_listed_and_kept(hub, tmp_path):
    shown = get(tmp_path)
    assert "licence mit" in shown and "commit 0123456789ab" in shown
    folder = tmp_path / "dinov2-small"
    for name, content in FILES.items():
        if name == "pytorch_model.bin":
            assert not (folder / name).exists()
        else:
            assert (folder / name).read_bytes() == content
    subprocess.run(["sha256sum", "-c", "dinov2-small.sha256"], cwd=tmp_path, check=True)
    first, *lines = (tmp_path / "dinov2-small.sha256").read_text().splitlines()
    assert first == f"# facebook/dinov2-small {COMMIT}" and len(lines) == 4
    listed = printed("models", "list", "--into", tmp_path)
    assert "there      dinov2-small" in listed and "missing    sam2.1-hiera-tiny" in listed
    assert "licence apache-2.0; 0.48 MB here" in listed
    for words in ("sha256sum -c", "import-fross", "import-probe", "licence mit"):
        assert words in listed


def test_a_folder_that_is_complete_needs_no_network(hub, tmp_path, monkeypatch):
    get(tmp_path)
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert "complete, and as" in get(tmp_path)
    assert "complete, and as" in get(tmp_path, "facebook/dinov2-small")
    lock, folder = tmp_path / "dinov2-small.sha256", tmp_path / "dinov2-small"
    kept = lock.read_text()
    lock.unlink()
    assert "complete, and not verified: no " in get(tmp_path)
    lock.write_text(kept.replace("#", "", 1))
    assert "expected '# OWNER/NAME COMMIT'" in refusal(
        "models", "get", "dinov2-small", "--into", tmp_path
    )
    # A file that is not as the first download brought it is not taken for it.
    lock.write_text(kept)
    (folder / "config.json").write_bytes(b"{}")
    assert "cannot be fetched" in refusal("models", "get", "dinov2-small", "--into", tmp_path)
    monkeypatch.setenv("HF_ENDPOINT", hub.url)
    hub.requested.clear()
    get(tmp_path)
    assert {name for _, name, _ in hub.requested} == {"config.json"}
    assert (folder / "config.json").read_bytes() == FILES["config.json"]


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_later_downloads_bring_what_the_first_one_brought(hub, tmp_path, name):
    """Also where the hub itself names the sum of another content, at the same commit."""
    get(tmp_path)
    shutil.rmtree(tmp_path / "dinov2-small")
    hub.files[name] = b"{}" if name == "config.json" else safetensors.save({"a": np.ones(2)})
    refused = refusal("models", "get", "dinov2-small", "--into", tmp_path)
    lock = tmp_path / "dinov2-small.sha256"
    assert f"{name} has sha256:" in refused and f"{lock} expects" in refused
    assert not (tmp_path / "dinov2-small" / name).exists()
    lock.unlink()
    get(tmp_path)
    assert hashlib.sha256(hub.files[name]).hexdigest() in lock.read_text()


def test_a_download_that_was_cut_continues_where_it_stopped(hub, tmp_path):
    # The client writes pieces of 10 MB.
    weights = safetensors.save({"layer.weight": np.ones((6000, 1000), np.float32)})
    hub.files["model.safetensors"] = weights
    hub.cut.add("model.safetensors")
    for _ in range(2):  # the client may continue by itself, or end with an error
        result = invoke("models", "get", "dinov2-small", "--into", tmp_path)
    assert result.exit_code == 0, result.stderr
    ranges = [asked for kind, name, asked in hub.requested if kind == "GET" and "model" in name]
    assert "bytes=10485760-" in ranges, ranges
    assert (tmp_path / "dinov2-small" / "model.safetensors").read_bytes() == weights


def test_a_damaged_file_is_removed_and_only_what_is_missing_is_fetched(hub, tmp_path):
    hub.damaged.add("model.safetensors")
    assert "checksum" in refusal("models", "get", "dinov2-small", "--into", tmp_path)
    assert not (tmp_path / "dinov2-small" / "model.safetensors").exists()
    hub.damaged.clear()
    get(tmp_path)
    (tmp_path / "dinov2-small" / "model.safetensors").unlink()
    hub.requested.clear()
    assert "incomplete dinov2-small" in printed("models", "list", "--into", tmp_path)
    get(tmp_path)
    assert {name for _, name, _ in hub.requested} == {"model.safetensors"}


def test_a_pinned_entry_is_fetched_and_another_content_refused(hub, tmp_path, monkeypatch):
    digest = hashlib.sha256(WEIGHTS).hexdigest()
    pinned = replace(CATALOGUE["dinov2-small"], revision=COMMIT, sha256=digest)
    monkeypatch.setitem(CATALOGUE, "dinov2-small", pinned)
    assert "licence apache-2.0; commit 0123456789ab and SHA-256" in get(tmp_path)
    # A lock of other weights than the catalogue now has counts for nothing.
    other = safetensors.save({"layer.weight": np.ones(2, np.float32)})
    hub.files["model.safetensors"] = other
    lock = tmp_path / "dinov2-small.sha256"
    lock.write_text(lock.read_text().replace(digest, hashlib.sha256(other).hexdigest()))
    hub.requested.clear()
    refused = refusal("models", "get", "dinov2-small", "--into", tmp_path)
    assert f"the catalogue expects sha256:{digest}" in refused and hub.requested == []
    assert (tmp_path / "dinov2-small/model.safetensors").read_bytes() == WEIGHTS
    lock.unlink()
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert "verified by the SHA-256 of its weights" in get(tmp_path)
    (tmp_path / "dinov2-small/model.safetensors").write_bytes(other)
    assert "cannot be fetched" in refusal("models", "get", "dinov2-small", "--into", tmp_path)
    monkeypatch.setenv("HF_ENDPOINT", hub.url)
    other = replace(pinned, revision="f" * 40)
    monkeypatch.setitem(CATALOGUE, "dinov2-small", other)
    assert "cannot be fetched" in refusal("models", "get", "dinov2-small", "--into", tmp_path)


def test_the_catalogue_says_what_a_model_is(tmp_path):
    listed = printed("models", "list", "--into", tmp_path)
    for words in (
        "dfine-small-obj2coco: perception.detector: transformers; 80 classes, AP 50.7 on COCO; 10 "
        "million parameters, about 40 MB; licence apache-2.0",
        "grounding-dino-tiny: perception.detector: open_vocabulary; free text, AP 48.4",
        "172 million parameters, about 688 MB; licence apache-2.0; commit a2bb814dd30d and SHA-256",
        "vjepa2-vitg-fpc64-384: relations.world_model: vjepa2, of the paper; 1034.6 million "
        "parameters, about 4.14 GB; licence mit",
    ):
        assert words in listed
    for model in CATALOGUE.values():
        assert len(model.revision) in (0, 40) and len(model.sha256) in (0, 64)
        assert "gpl" not in model.licence.lower()
    assert all(name in CATALOGUE for names in GROUPS.values() for name in names)


def test_errors_name_the_remedy(hub, tmp_path):
    hub.files.pop("model.safetensors")
    for name, words in (
        ("dino", "expected paper, embedded, detector, open-vocabulary, dfine"),
        ("nobody/nothing", "check the network and the id"),
        ("dinov2-small", "model.safetensors"),
    ):
        assert words in refusal("models", "get", name, "--into", tmp_path)


def test_the_groups_are_the_models_of_their_configurations(root_dir, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert "nothing to download" in get(tmp_path, "embedded")
    assert list(tmp_path.iterdir()) == []
    paper = root_dir / "config" / "paper.yaml"
    config = load_config(paper)
    paths = {config.perception.segmenter_path, config.relations.world_model_path}
    wanted = {f"./models/{name}" for name in GROUPS["paper"]}
    (of_row_d,) = wanted - paths
    assert paths < wanted and f"relations.world_model_path={of_row_d}" in DINOV2
    assert set(GROUPS["paper"]) <= CATALOGUE.keys()
    assert configuration_of("embedded", None) is None
    assert configuration_of("paper", None) == paper
    assert configuration_of("paper", tmp_path) == tmp_path
    with pytest.raises(ConfigurationError, match="embedded or paper"):
        configuration_of("large", None)
    refused = refusal("demo", "--models", "paper", "--out", tmp_path / "out")
    assert "deworldsg models get sam2.1-hiera-tiny" in refused


def test_inspect_prints_names_and_shapes(tmp_path):
    torch = pytest.importorskip("torch")
    (tmp_path / "model.safetensors").write_bytes(WEIGHTS)
    torch.save({"state_dict": {"a": torch.zeros(2, 3)}, "epoch": 3}, tmp_path / "model.ckpt")
    for path in (tmp_path, tmp_path / "model.safetensors"):
        shown = printed("models", "inspect", path)
        assert "1 parameters, 0.12 million values" in shown
        assert "layer.weight  float32  300 x 400" in shown
    assert "state_dict.a  float32  2 x 3" in printed("models", "inspect", tmp_path / "model.ckpt")


def test_inspect_refuses_other_files_and_dictionaries_without_end(tmp_path):
    torch = pytest.importorskip("torch")
    once = {"weight": torch.zeros(1)}
    itself: dict[str, object] = {**once}
    itself["a"] = itself
    often: dict[str, object] = {**once}
    for _ in range(30):
        often = {"a": often, "b": often}
    path = tmp_path / "model.pt"
    for content, words in ((itself, "32 deep"), (often, "1000000 entries")):
        torch.save(content, path)
        with pytest.raises(ConfigurationError, match=words):
            read_headers(path)
    torch.save({"a": once, "b": once}, path)
    assert [header.name for header in read_headers(path)] == ["a.weight", "b.weight"]
    for name, data, words in (
        ("cut.safetensors", WEIGHTS[:50], "no complete safetensors file"),
        ("evil.pt", b"cos\nsystem\n(S'true'\ntR.", "without executing code"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ConfigurationError, match=words):
            read_headers(tmp_path / name)
    assert "none.pt" in refusal("models", "inspect", tmp_path / "none.pt")
