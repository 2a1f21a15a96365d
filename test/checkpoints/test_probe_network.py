"""The probe: saved, loaded, imported from the published file; misfits are refused."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from support.checkpoints import (  # noqa: E402  after the guards
    config_of,
    request,
    save_random_probe,
    save_vjepa2,
)
from support.relations import VOCABULARY  # noqa: E402

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard, read_probe_card  # noqa: E402
from deworldsg_ros.checkpoints.probe_network import (  # noqa: E402
    PUBLISHED_BACKBONE,
    Probe,
    build_network,
    import_published,
    load_probe,
    save_probe,
)
from deworldsg_ros.relations import build_world_model, clip_models  # noqa: E402
from deworldsg_ros.relations.world_model import require_predicates  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402

BACKBONE = BackboneIdentity("vjepa2", 48, 32, 4, "0123456789abcdef", "stretch")
PREDICATES = tuple(f"predicate {n}" for n in range(7))


def published_state(feature_dim=1408, hidden_dim=512, predicate_count=7, seed=0):
    """Every key of the published file, as torch saves it."""
    torch.manual_seed(seed)
    network = torch.nn.Sequential(
        torch.nn.BatchNorm1d(feature_dim),
        torch.nn.Linear(feature_dim, hidden_dim),
        torch.nn.ReLU(),
        torch.nn.BatchNorm1d(hidden_dim),
        torch.nn.Dropout(0.2),
        torch.nn.Linear(hidden_dim, predicate_count),
    )
    network(torch.randn(64, feature_dim))  # running statistics that are not the initial ones
    state = {f"net.{name}": value for name, value in network.state_dict().items()}
    return network.eval(), state


@pytest.mark.parametrize("layout", ["two_layer", "batch_norm"])
@pytest.mark.parametrize("inputs, input_dim", [("clip", 48), ("clip_and_boxes", 56)])
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


def test_the_papers_probe_is_two_fully_connected_layers():
    network = build_network(ProbeCard(BACKBONE, PREDICATES))
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert shapes == {
        "net.0.weight": (512, 48),
        "net.0.bias": (512,),
        "net.2.weight": (7, 512),
        "net.2.bias": (7,),
    }


def test_the_published_file_is_imported(tmp_path):
    network, state = published_state()
    torch.save(state, tmp_path / "vjepa_probe_mlp.pt")
    probe = import_published(tmp_path / "vjepa_probe_mlp.pt", PREDICATES)
    assert probe.card.backbone == PUBLISHED_BACKBONE and probe.card.layout == "batch_norm"
    save_probe(tmp_path / "probe", probe)
    features = np.random.default_rng(0).normal(size=(3, 1408)).astype(np.float32)
    with torch.inference_mode():
        expected = torch.softmax(network(torch.from_numpy(features)), dim=1)
    predicted = load_probe(tmp_path / "probe").predict(features, np.zeros((3, 8), np.float32))
    np.testing.assert_allclose(predicted, expected, atol=1e-6)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda state: state.pop("net.3.running_var"), r"1 missing \(net.3.running_var\)"),
        (
            lambda state: state.update({"net.6.weight": torch.zeros(2)}),
            r"1 unknown \(net.6.weight\)",
        ),
        (lambda state: state.update({"net.5.bias": torch.zeros(9)}), r"net.5.bias has shape \(9,"),
        (lambda state: state.update({"net.0.weight": 3}), "expected a dictionary of tensors"),
    ],
)
def test_a_published_file_with_other_parameters_is_refused_by_name(tmp_path, change, message):
    _, state = published_state()
    change(state)
    torch.save(state, tmp_path / "probe.pt")
    with pytest.raises(ConfigurationError, match=message):
        import_published(tmp_path / "probe.pt", PREDICATES)


def test_a_published_file_for_other_predicates_or_features_is_refused(tmp_path):
    torch.save(published_state(feature_dim=1024)[1], tmp_path / "probe.pt")
    with pytest.raises(ConfigurationError, match=r"shape \(1024,\), expected \(1408,\)"):
        import_published(tmp_path / "probe.pt", PREDICATES)
    torch.save(published_state(predicate_count=50)[1], tmp_path / "probe.pt")
    with pytest.raises(ConfigurationError, match="7 predicates"):
        import_published(tmp_path / "probe.pt", PREDICATES)


def test_code_in_a_published_file_is_not_executed(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "trapped"), "w"))

    torch.save({"net.0.weight": Trap()}, tmp_path / "probe.pt")
    with pytest.raises(ConfigurationError, match="save its tensors alone"):
        import_published(tmp_path / "probe.pt", PREDICATES)
    assert not (tmp_path / "trapped").exists()
    with pytest.raises(ConfigurationError, match="no such file"):
        import_published(tmp_path / "absent.pt", PREDICATES)


@pytest.mark.parametrize(
    "changes, fits",
    [
        ({}, True),
        ({"fingerprint": ""}, True),  # unknown weights
        ({"fingerprint": "fedcba9876543210"}, False),
        ({"family": "dinov2"}, False),
        ({"feature_dim": 64}, False),
        ({"image_size": 64}, False),
        ({"clip_length": 16}, False),
    ],
)
def test_a_probe_accepts_only_the_backbone_of_its_training(changes, fits):
    card = ProbeCard(BACKBONE, PREDICATES)
    other = msgspec.structs.replace(BACKBONE, **changes)
    if fits:
        card.require_backbone(other)
        return
    with pytest.raises(ConfigurationError, match="trained on vjepa2 with 48 features") as refusal:
        card.require_backbone(other)
    assert str(other) in str(refusal.value)


def test_a_probe_of_version_0_2_is_refused(tmp_path):
    """Its card has no field `fit`: it was trained on the middle of crops."""
    save_random_probe(tmp_path, BACKBONE)
    card = json.loads((tmp_path / "config.json").read_text())
    assert card["backbone"].pop("fit") == "stretch"
    (tmp_path / "config.json").write_text(json.dumps(card))
    with pytest.raises(ConfigurationError, match="by 'centre', and this version uses 'stretch'"):
        load_probe(tmp_path).card.require_backbone(BACKBONE)


def warnings_of(tmp_path, caplog, identity_changes, edge_belief="robust", **card_changes):
    """Warnings at the start of a world model with a probe."""
    folder = save_vjepa2(tmp_path / "backbone")
    identity = clip_models.load_vjepa2(config_of("vjepa2", folder)).identity
    identity = msgspec.structs.replace(identity, **identity_changes)
    probe = save_random_probe(tmp_path / "probe", identity, **card_changes)
    config = config_of("vjepa2", folder, probe_path=str(probe), edge_belief=edge_belief)
    build_world_model(config)
    return [record.getMessage() for record in caplog.records]


def test_a_probe_without_a_fingerprint_is_told(tmp_path, caplog):
    assert warnings_of(tmp_path / "a", caplog, {}) == []
    (told,) = warnings_of(tmp_path / "b", caplog, {"fingerprint": ""})
    assert "does not know the weights of its backbone" in told


def test_a_probe_that_knows_the_subject_is_told_beside_the_papers_rule(tmp_path, caplog):
    boxes = {"inputs": "clip_and_boxes"}
    assert warnings_of(tmp_path / "a", caplog, {}, **boxes) == []
    assert warnings_of(tmp_path / "b", caplog, {}, "paper") == []
    (told,) = warnings_of(tmp_path / "c", caplog, {}, "paper", **boxes)
    assert "The paper's probe gets the clip only" in told


@pytest.mark.parametrize(
    "predicates, message",
    [
        (("on", "near"), "lacks 'on', 'near' and has 'predicate 0', "),
        ((*PREDICATES, "on"), "lacks 'on';"),
        (PREDICATES[:6], "has 'predicate 6';"),
        (PREDICATES[::-1], "another order"),
    ],
)
def test_a_probe_accepts_only_the_predicates_of_its_training(predicates, message):
    card = ProbeCard(BACKBONE, PREDICATES)
    card.require_predicates(PREDICATES)
    with pytest.raises(ConfigurationError, match=message):
        card.require_predicates(predicates)


def test_incomplete_folders_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="has no config.json"):
        load_probe(tmp_path)
    save_random_probe(tmp_path, BACKBONE)
    assert read_probe_card(tmp_path).predicates == VOCABULARY.predicates
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(ConfigurationError, match="has no model.safetensors"):
        load_probe(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_probe(tmp_path)
    card = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**card, "layout": "three_layer"}))
    with pytest.raises(ConfigurationError, match="layout"):
        load_probe(tmp_path)


def test_a_world_model_refuses_a_probe_of_another_backbone(tmp_path):
    folder = save_vjepa2(tmp_path / "backbone")
    config = config_of("vjepa2", folder)
    with pytest.raises(ConfigurationError, match="probe_path is empty.*train-probe"):
        build_world_model(config)
    probe_folder = save_random_probe(tmp_path / "probe", BACKBONE)
    config = config_of("vjepa2", folder, probe_path=str(probe_folder))
    with pytest.raises(ConfigurationError, match="weights 0123456789abcdef, and the backbone is"):
        build_world_model(config)
    with pytest.raises(ConfigurationError, match="world_model 'dinov2' needs another"):
        build_world_model(config_of("dinov2", folder, probe_path=str(probe_folder)))


def test_other_predicates_are_refused_at_the_start_and_during_a_run(tmp_path):
    folder = save_vjepa2(tmp_path / "backbone")
    unknown = msgspec.structs.replace(BACKBONE, fingerprint="")
    probe_folder = save_random_probe(tmp_path / "probe", unknown)
    model = build_world_model(config_of("vjepa2", folder, probe_path=str(probe_folder)))
    require_predicates(model, VOCABULARY.predicates)
    require_predicates(None, ("on",))
    with pytest.raises(ConfigurationError, match="trained for 4 predicates and the graph has 1"):
        require_predicates(model, ("on",))
    asked = request()
    other = type(VOCABULARY)(VOCABULARY.classes, ("on", "near"))
    with pytest.raises(ConfigurationError, match="trained for 4 predicates and the graph has 2"):
        model.predict(type(asked)(asked.clip, asked.pairs, other))
