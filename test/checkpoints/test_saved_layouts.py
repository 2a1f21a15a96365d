"""Checkpoints that older versions of transformers saved give the outputs of these versions."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.torch_models import settings, torch, transformers

from deworldsg_ros.checkpoints.loading import DETECTORS, CheckpointSource
from deworldsg_ros.perception.backends.sam import Sam2Segmenter, SamSegmenter
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models

SAVED = {
    f"{path.parent.name}-{path.stem}": path
    for path in sorted((Path(__file__).parent / "saved").glob("*/*.json"))
}
SHARED = "prompt_encoder.shared_embedding.positional_embedding"


def read(name):
    return json.loads(SAVED[name].read_text(encoding="utf-8"))


def load(model, folder, content):
    """The network of a checkpoint with this content, by the loader of its backend."""
    from support.saved_layouts import write_checkpoint

    path = str(write_checkpoint(folder / "saved", content))
    if model.startswith("sam"):
        backend = SamSegmenter if model == "sam" else Sam2Segmenter
        return backend(settings(segmenter_path=path)).model
    source = CheckpointSource.find("perception.detector_path", path)
    if model.startswith("rtdetr"):
        config = source.config(DETECTORS)
        return source.load(transformers.AutoModelForObjectDetection, config)
    families = {"vjepa2": transformers.VJEPA2Model, "dinov2": transformers.Dinov2Model}
    ignored = ("predictor.", "embeddings.mask_token")
    return source.load(families[model], source.config([model]), ignored)


@pytest.mark.parametrize("name", SAVED)
def test_a_checkpoint_of_an_older_version_gives_its_outputs(tmp_path, monkeypatch, name):
    from support.saved_layouts import outputs

    content, model = read(name), SAVED[name].stem
    network = load(model, tmp_path, content)
    if model.startswith("sam2"):
        # The only difference between 4.56 and 5: like the original SAM 2, 5 adds an empty point to
        # boxes.
        boxes = np.array(outputs(model, network)["boxes"])
        assert np.abs(boxes - content["outputs"]["boxes"]).max() > 1e-3
        encoder = type(network.prompt_encoder)
        embed = encoder._embed_boxes
        monkeypatch.setattr(encoder, "_embed_boxes", lambda self, b: embed(self, b)[:, :, :2])
    found = outputs(model, network)
    assert found.keys() == content["outputs"].keys()
    for key, expected in content["outputs"].items():
        assert np.std(expected) > 1e-3, key
        np.testing.assert_allclose(found[key], expected, atol=1e-4, err_msg=key)


def test_sam2_of_4_56_lacks_the_embedding_of_its_prompts(tmp_path):
    content = read("transformers-4.56.2-sam2_video")
    assert SHARED not in content["parameters"]
    model = load("sam2_video", tmp_path / "a", content)
    one, other = model.get_buffer(SHARED), model.shared_image_embedding.positional_embedding
    assert torch.equal(one, other) and one.abs().max() > 0
    # Without the one that it is copied from, the checkpoint is incomplete.
    content["parameters"].pop("shared_image_embedding.positional_embedding")
    with pytest.raises(ConfigurationError, match="lacks 2 parameters"):
        load("sam2_video", tmp_path / "b", content)
