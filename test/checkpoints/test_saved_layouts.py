"""Checkpoints that older versions of transformers saved give the outputs of these versions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.torch_models import settings, torch

from deworldsg_ros.checkpoints.loading import DETECTORS, CheckpointSource
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models

SAVED = sorted((Path(__file__).parent / "saved").glob("*/*.json"))
SHARED = "prompt_encoder.shared_embedding.positional_embedding"
# Boxes of SAM 2: see test_the_boxes_of_sam2_have_a_padding_point_since_transformers_5.
CHANGED = {"sam2": {"boxes"}, "sam2_video": {"boxes"}}


def saved_id(path: Path) -> str:
    return f"{path.parent.name}-{path.stem}"


def load(name: str, folder: Path):
    """The network of a checkpoint, by the loader of its backend."""
    if name.startswith("sam"):
        from deworldsg_ros.perception.backends.sam import Sam2Segmenter, SamSegmenter

        backend = SamSegmenter if name == "sam" else Sam2Segmenter
        return backend(settings(segmenter_path=str(folder))).model
    source = CheckpointSource.find("perception.detector_path", str(folder))
    if name.startswith("rtdetr"):
        config = source.config(DETECTORS)
        return source.load(DETECTORS[config.model_type], config)
    from transformers import Dinov2Model, VJEPA2Model

    family = VJEPA2Model if name == "vjepa2" else Dinov2Model
    return source.load(family, source.config([name]), ("predictor.", "embeddings.mask_token"))


@pytest.mark.parametrize("path", SAVED, ids=saved_id)
def test_a_checkpoint_of_an_older_version_gives_its_outputs(path: Path, tmp_path: Path) -> None:
    from support.saved_layouts import outputs, write_checkpoint

    content = json.loads(path.read_text(encoding="utf-8"))
    found = outputs(path.stem, load(path.stem, write_checkpoint(tmp_path / "saved", content)))
    assert found.keys() == content["outputs"].keys()
    for key, expected in content["outputs"].items():
        assert np.std(expected) > 1e-3, key
        if key not in CHANGED.get(path.stem, set()):
            np.testing.assert_allclose(found[key], expected, atol=1e-4, err_msg=key)


def test_every_model_is_there_from_two_versions() -> None:
    names = {saved_id(path) for path in SAVED}
    every = {"rtdetr", "rtdetr_v2", "sam", "vjepa2", "dinov2"}
    assert {f"transformers-4.53.3-{name}" for name in every} <= names
    assert {f"transformers-4.56.2-{name}" for name in {*every, "sam2", "sam2_video"}} <= names


def test_sam2_of_4_56_lacks_the_embedding_of_its_prompts(tmp_path: Path) -> None:
    from support.saved_layouts import write_checkpoint

    path = next(path for path in SAVED if path.stem == "sam2_video")
    content = json.loads(path.read_text(encoding="utf-8"))
    assert SHARED not in content["parameters"]
    folder = write_checkpoint(tmp_path / "saved", content)
    model = load("sam2_video", folder)
    one, other = model.get_buffer(SHARED), model.shared_image_embedding.positional_embedding
    assert torch.equal(one, other) and one.abs().max() > 0
    # Without the one that it is copied from, the checkpoint is incomplete.
    content["parameters"].pop("shared_image_embedding.positional_embedding")
    broken = write_checkpoint(tmp_path / "broken", content)
    with pytest.raises(ConfigurationError, match="lacks 2 parameters"):
        load("sam2_video", broken)


def test_the_boxes_of_sam2_have_a_padding_point_since_transformers_5(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The only difference between 4.56 and 5: like the original SAM 2, 5 adds an empty point."""
    from support.saved_layouts import outputs, write_checkpoint

    path = next(path for path in SAVED if path.stem == "sam2")
    content = json.loads(path.read_text(encoding="utf-8"))
    model = load("sam2", write_checkpoint(tmp_path / "saved", content))
    expected = np.array(content["outputs"]["boxes"])
    found = np.array(outputs("sam2", model)["boxes"])
    assert np.abs(found - expected).max() > 1e-3
    embed = type(model.prompt_encoder)._embed_boxes
    monkeypatch.setattr(
        type(model.prompt_encoder), "_embed_boxes", lambda self, boxes: embed(self, boxes)[:, :, :2]
    )
    np.testing.assert_allclose(outputs("sam2", model)["boxes"], expected, atol=1e-4)
