"""The probe: saved, loaded, imported from the published file; misfits are refused."""

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from support.checkpoints import config_of, request, save_random_probe, save_vjepa2, torch
from support.relations import VOCABULARY

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard, read_probe_card
from deworldsg_ros.checkpoints.probe_network import (
    PUBLISHED_BACKBONE,
    Probe,
    build_network,
    import_published,
    load_probe,
    save_probe,
)
from deworldsg_ros.relations import build_world_model, clip_models
from deworldsg_ros.relations.world_model import require_predicates
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models

BACKBONE = BackboneIdentity("vjepa2", 48, 32, 4, "0123456789abcdef", "stretch")
PREDICATES = tuple(f"predicate {n}" for n in range(7))


def refused(match, function, *arguments):
    with pytest.raises(ConfigurationError, match=match) as refusal:
        function(*arguments)
    return str(refusal.value)


@pytest.mark.parametrize("layout", ["two_layer", "batch_norm"])
@pytest.mark.parametrize(("inputs", "input_dim"), [("clip", 48), ("clip_and_boxes", 56)])
def test_a_probe_predicts_the_same_after_saving_and_loading(tmp_path, layout, inputs, input_dim):
    card = ProbeCard(BACKBONE, PREDICATES, layout, inputs, training={"seed": 3})
    assert card.input_dim == input_dim
    probe = Probe(card, build_network(card).eval())
    save_probe(tmp_path / "probe", probe)
    loaded = load_probe(tmp_path / "probe")
    assert loaded.card == card
    generator = np.random.default_rng(0)
    features = generator.normal(size=(5, 48)).astype(np.float32)
    boxes = generator.random((5, 8)).astype(np.float32)
    predicted = loaded.predict(features, boxes)
    assert predicted.shape == (5, 7) and predicted.dtype == np.float64
    np.testing.assert_allclose(predicted.sum(axis=1), 1)
    assert (predicted == probe.predict(features, boxes)).all()
    assert loaded.predict(features[:0], boxes[:0]).shape == (0, 7)


def published_state(feature_dim=1408, predicate_count=7, **changes):
    """Every key of the published file, as torch saves it, and the network."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.BatchNorm1d(feature_dim),
        torch.nn.Linear(feature_dim, 512),
        torch.nn.ReLU(),
        torch.nn.BatchNorm1d(512),
        torch.nn.Dropout(0.2),
        torch.nn.Linear(512, predicate_count),
    )
    network(torch.randn(64, feature_dim))  # running statistics that are not the initial ones
    state = {f"net.{name}": value for name, value in network.state_dict().items()}
    return {
        name: value for name, value in {**state, **changes}.items() if value is not None
    }, network


def test_the_published_file_is_imported(tmp_path):
    state, network = published_state()
    torch.save(state, tmp_path / "vjepa_probe_mlp.pt")
    probe = import_published(tmp_path / "vjepa_probe_mlp.pt", PREDICATES)
    assert probe.card.backbone == PUBLISHED_BACKBONE and probe.card.layout == "batch_norm"
    save_probe(tmp_path / "probe", probe)
    features = np.random.default_rng(0).normal(size=(3, 1408)).astype(np.float32)
    with torch.inference_mode():
        expected = torch.softmax(network.eval()(torch.from_numpy(features)), dim=1)
    predicted = load_probe(tmp_path / "probe").predict(features, np.zeros((3, 8), np.float32))
    np.testing.assert_allclose(predicted, expected, atol=1e-6)


class Trap:
    """What a pickle may do when it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"net.3.running_var": None}, r"missing \(net.3.running_var\)"),
        ({"net.6.weight": torch.zeros(2)}, r"unknown \(net.6.weight\)"),
        ({"net.5.bias": torch.zeros(9)}, r"net.5.bias has shape \(9,"),
        ({"net.0.weight": 3}, "dictionary of tensors"),
        ({"feature_dim": 1024}, r"\(1024,\), expected \(1408,\)"),
        ({"predicate_count": 50}, "7 predicates"),
        ({"net.0.weight": Trap}, "save its tensors alone"),
    ],
)
def test_a_published_file_that_does_not_fit_is_refused_and_not_run(tmp_path, changes, message):
    path, trapped = tmp_path / "probe.pt", tmp_path / "trapped"
    refused("no such file", import_published, path, PREDICATES)
    state, _ = published_state(**changes)
    torch.save({n: Trap(trapped) if value is Trap else value for n, value in state.items()}, path)
    refused(message, import_published, path, PREDICATES)
    assert not trapped.exists()


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        ({}, True),
        ({"fingerprint": ""}, True),  # unknown weights
        ({"fingerprint": "fedcba9876543210"}, False),
        ({"family": "dinov2"}, False),
        ({"clip_length": 16}, False),
    ],
)
def test_a_probe_accepts_only_the_backbone_of_its_training(changes, fits):
    card, other = ProbeCard(BACKBONE, PREDICATES), msgspec.structs.replace(BACKBONE, **changes)
    if fits:
        card.require_backbone(other)
    else:
        assert str(other) in refused("vjepa2 with 48 features", card.require_backbone, other)


def test_folders_that_are_incomplete_damaged_or_old_are_refused(tmp_path):
    card_file, model = tmp_path / "config.json", tmp_path / "model.safetensors"
    refused("no config.json", load_probe, tmp_path)
    save_random_probe(tmp_path, BACKBONE)
    assert read_probe_card(tmp_path).predicates == VOCABULARY.predicates
    # A card of version 0.2 has no field `fit`: its probe was trained on the middle of crops.
    text = card_file.read_text()
    card = json.loads(text)
    assert card["backbone"].pop("fit") == "stretch"
    card_file.write_text(json.dumps(card))
    refused("'centre', .* 'stretch'", load_probe(tmp_path).card.require_backbone, BACKBONE)
    card_file.write_text(text)
    model.unlink()
    refused("no model.safetensors", load_probe, tmp_path)
    model.write_bytes(b"nothing")
    refused("cannot be read", load_probe, tmp_path)
    card_file.write_text(json.dumps({**card, "layout": "three_layer"}))
    refused("layout", load_probe, tmp_path)


@pytest.fixture(scope="module")
def backbone(tmp_path_factory):
    return save_vjepa2(tmp_path_factory.mktemp("backbone"))


@pytest.mark.parametrize(
    ("identity", "inputs", "edge_belief", "told"),
    [
        ({"fingerprint": ""}, "clip", "robust", ["does not know the weights of its backbone"]),
        ({}, "clip_and_boxes", "robust", []),
        ({}, "clip", "paper", []),
        ({}, "clip_and_boxes", "paper", ["The paper's probe gets the clip only"]),
    ],
)
def test_warnings_at_the_start(backbone, tmp_path, caplog, identity, inputs, edge_belief, told):
    known = clip_models.load_vjepa2(config_of("vjepa2", backbone)).identity
    save_random_probe(tmp_path, msgspec.structs.replace(known, **identity), inputs=inputs)
    more = {"probe_path": str(tmp_path), "edge_belief": edge_belief}
    build_world_model(config_of("vjepa2", backbone, **more))
    assert len(caplog.messages) == len(told)
    assert all(words in message for words, message in zip(told, caplog.messages))


def test_a_world_model_refuses_another_backbone_and_other_predicates(backbone, tmp_path):
    def build(family="vjepa2", **paths):
        return build_world_model(config_of(family, backbone, **paths))

    refused("probe_path is empty.*train-probe", build)
    probe_path = str(save_random_probe(tmp_path / "other", BACKBONE))
    refused("weights 0123456789abcdef", lambda: build(probe_path=probe_path))
    refused("world_model 'dinov2'", lambda: build("dinov2", probe_path=probe_path))
    unknown = msgspec.structs.replace(BACKBONE, fingerprint="")
    model = build(probe_path=str(save_random_probe(tmp_path / "probe", unknown)))
    require_predicates(model, VOCABULARY.predicates)
    require_predicates(None, ("on",))
    refused("4 predicates and the graph has 1", require_predicates, model, ("on",))
    refused("another order", require_predicates, model, VOCABULARY.predicates[::-1])
    # And during a run.
    asked = replace(request(), vocabulary=replace(VOCABULARY, predicates=("on", "near")))
    refused("4 predicates and the graph has 2", model.predict, asked)
