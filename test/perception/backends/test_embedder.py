"""CLIP and SigLIP: the vectors of images and texts are those of transformers."""

import json

import numpy as np
import pytest
from support.torch_models import IMAGENET, image, save_dfine, save_two_towers, settings, torch
from support.view import SAVED

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.questions import ask
from deworldsg_ros.graph.embeddings import Looks, embed_text
from deworldsg_ros.perception import build_perception
from deworldsg_ros.perception.backends.embedder import ImageEmbedder
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models


@pytest.fixture(scope="module")
def room():
    return SceneGraph.load(SAVED)


FAMILIES = pytest.mark.parametrize("family", ["clip", "siglip"])


def unit(vector):
    return vector / np.linalg.norm(vector)


@FAMILIES
def test_vectors_of_images_are_those_of_transformers(tmp_path, family):
    model = save_two_towers(tmp_path, family)
    crops = [image(32, 32, seed) for seed in range(3)]
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in IMAGENET.values())
    pixels = [(torch.from_numpy(c).permute(2, 0, 1) / 255 - mean) / std for c in crops]
    with torch.inference_mode():
        expected = model.get_image_features(pixel_values=torch.stack(pixels)).pooler_output
    embedder = ImageEmbedder(settings(embedder=str(tmp_path)))
    np.testing.assert_allclose(embedder.embed(crops), expected.numpy(), atol=1e-4)
    assert embedder.model_name == str(tmp_path)
    assert embedder.embed([image(50, 20)]).shape == (1, expected.shape[1])  # of any size

    # The size as one number, as in the oldest checkpoints.
    content = {"size": 32, "do_normalize": False}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(content))
    found = ImageEmbedder(settings(embedder=str(tmp_path))).embed(crops[:1])
    with torch.inference_mode():
        plain = torch.from_numpy(crops[0]).permute(2, 0, 1)[None] / 255
        expected = model.get_image_features(pixel_values=plain).pooler_output
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-4)


@FAMILIES
def test_texts_find_the_objects_that_look_like_them(tmp_path, family, room):
    model = save_two_towers(tmp_path, family)
    tokens = [2, 4, 6, 5, 3] + ([0] * 4 if family == "siglip" else [])  # <s> a red cup </s>
    with torch.inference_mode():
        expected = model.get_text_features(input_ids=torch.tensor([tokens])).pooler_output[0]
    np.testing.assert_allclose(embed_text(str(tmp_path), "A red cup"), expected.numpy(), atol=1e-4)

    sofa = unit(embed_text(str(tmp_path), "sofa"))
    graph = SceneGraph(room.message)
    graph.looks = Looks(str(tmp_path), {13: unit(expected.numpy()), 39: sofa, 10**6: sofa})
    assert [item.id for item, _ in graph.like("a red cup", 1)] == [13]
    found = graph.like("sofa")
    assert found[0] == (graph[39], pytest.approx(1.0, abs=1e-4)) and len(found) == 2
    answers = ask(graph, 'like "sofa"')
    assert [answer.item.id for answer in answers.found] == [39, 13]
    assert "cosine 1.000" in answers.found[0].evidence and str(tmp_path) in answers.notes[0]
    drink = unit(embed_text(str(tmp_path), "drink"))
    best = max(graph.labels, key=lambda name: drink @ unit(embed_text(str(tmp_path), name)))
    with pytest.raises(
        ClientError, match=f"'drink' is the name of no .*closest in meaning: {best}"
    ):
        graph.understand("drink")


def test_models_that_cannot_be_used_are_named(tmp_path, room):
    graph = SceneGraph(room.message)
    with pytest.raises(ClientError, match="no object of the graph has an embedding"):
        graph.like("sofa")
    graph.looks = Looks("someone/clip", {13: np.eye(3, dtype=np.float32)[0]})
    with pytest.raises(ClientError, match=r"someone/clip.*hf download someone/clip"):
        ask(graph, "like sofa")
    with pytest.raises(ClientError, match="text of 0 characters"):
        ask(graph, "like")
    save_dfine(tmp_path)
    with pytest.raises(ClientError, match="d_fine: expected CLIP or SigLIP"):
        graph.like("sofa", model=str(tmp_path))
    with pytest.raises(ConfigurationError, match="d_fine: expected clip or siglip"):
        ImageEmbedder(settings(embedder=str(tmp_path)))
    with pytest.raises(ConfigurationError, match=r"perception\.embedder.*no such folder"):
        build_perception(settings(embedder="nowhere"))
