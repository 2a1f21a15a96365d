"""The probe on torch: a small network that maps a clip's feature to a predicate distribution."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import safetensors
import torch
from safetensors.torch import load_file, save

from deworldsg_ros.base.files import together, write_atomically
from deworldsg_ros.checkpoints.cards import (
    PROBE_CARD,
    WEIGHTS_FILE,
    BackboneIdentity,
    ProbeCard,
    read_probe_card,
    write_probe_card,
)
from deworldsg_ros.checkpoints.loading import check_names, read_tensors
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError

# --- The probe on torch: a small network that maps a clip's feature to a predicate distribution.

PROBE_FILES = (WEIGHTS_FILE, PROBE_CARD)


def build_network(card: ProbeCard) -> torch.nn.Sequential:
    """The network (n, input_dim) → logits (n, R), with random weights.

    The parameters have the names of the published file: `net.0.weight`, ….
    """
    first = torch.nn.Linear(card.input_dim, card.hidden_dim)
    last = torch.nn.Linear(card.hidden_dim, len(card.predicates))
    layers: list[torch.nn.Module] = [first, torch.nn.ReLU(), last]
    if card.layout == "batch_norm":
        layers = [
            torch.nn.BatchNorm1d(card.input_dim),
            first,
            torch.nn.ReLU(),
            torch.nn.BatchNorm1d(card.hidden_dim),
            torch.nn.Dropout(0.2),  # as in the published probe
            last,
        ]
    return torch.nn.Sequential(OrderedDict(net=torch.nn.Sequential(*layers)))


@dataclass(frozen=True)
class Probe:
    """A trained probe: its card and its network, in evaluation mode on the CPU."""

    card: ProbeCard
    network: torch.nn.Sequential

    def predict(self, features: Float32, boxes: Float32) -> Float64:
        """Predicate distributions.

        Args:
            features: (n, d) float32 of the backbone.
            boxes: (n, 8) float32, used if the card's inputs contain boxes.

        Returns:
            (n, R) float64, rows sum to one.
        """
        return self.distributions(probe_inputs(self.card, features, boxes))

    def distributions(self, inputs: Float32) -> Float64:
        """(n, R) float64 predicate distributions of inputs (n, input_dim) float32."""
        with torch.inference_mode():
            logits = self.network(torch.from_numpy(inputs)).to(torch.float64)
            distributions: Float64 = torch.softmax(logits, dim=1).numpy()
        return distributions


def probe_inputs(card: ProbeCard, features: Float32, boxes: Float32) -> Float32:
    """(n, input_dim) float32: the features, followed by the boxes if the card has them."""
    parts = [features, boxes] if card.inputs == "clip_and_boxes" else [features]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def save_probe(folder: Path, probe: Probe) -> None:
    """Write a probe's folder, complete or not at all; raises OSError."""
    with together(folder, PROBE_FILES) as staged:
        write_probe(staged, probe)


def write_probe(folder: Path, probe: Probe) -> None:
    """Write a probe's files into a folder that exists; raises OSError."""
    state = {name: value.contiguous() for name, value in probe.network.state_dict().items()}
    write_atomically(folder / WEIGHTS_FILE, save(state))
    write_probe_card(folder, probe.card)


def load_probe(folder: Path) -> Probe:
    """Read a probe's folder.

    Raises:
        ConfigurationError: a file is missing, or the weights do not fit the card.
    """
    card = read_probe_card(folder)
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise ConfigurationError(f"probe '{folder}' has no {WEIGHTS_FILE}: save it again")
    try:
        state = load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise ConfigurationError(f"probe weights {path} cannot be read: {error}") from error
    return with_weights(card, state, f"probe weights {path}")


def with_weights(card: ProbeCard, state: dict[str, torch.Tensor], where: str) -> Probe:
    """A probe with given weights.

    Args:
        card: of the probe.
        state: parameters by name.
        where: origin of the parameters, for messages.

    Raises:
        ConfigurationError: parameters are missing or unknown, or one has another shape.
    """
    network = build_network(card)
    expected = network.state_dict()
    check_names(state, expected, where)
    for name, value in state.items():
        if value.shape != expected[name].shape:
            raise ConfigurationError(
                f"{where}: {name} has shape {tuple(value.shape)}, expected "
                f"{tuple(expected[name].shape)} for {card.backbone} and {len(card.predicates)} "
                "predicates"
            )
    network.load_state_dict(state)
    return Probe(card, network.eval().requires_grad_(False))


# --- Import of the published probe of V-JEPA 2, `vjepa_probe_mlp.pt`.

# The backbone of the published probe: V-JEPA 2 ViT-g, 1408 features of 16 frames at 384 pixels.
# The released code stretches the crops.
PUBLISHED_BACKBONE = BackboneIdentity("vjepa2", 1408, 384, 16, fit="stretch")


def import_published(path: Path, predicates: tuple[str, ...]) -> Probe:
    """The probe in a published file, a plain dictionary of tensors.

    Args:
        path: the file; its code is not executed.
        predicates: names of its outputs, in order; the file does not contain them.

    Raises:
        ConfigurationError: the file has another layout, with the names of its parameters.
    """
    state = read_tensors(path)
    card = ProbeCard(
        PUBLISHED_BACKBONE,
        predicates,
        layout="batch_norm",
        training={"imported_from": path.name},
    )
    first = state.get("net.1.weight")
    if first is not None and first.ndim == 2:
        card = msgspec.structs.replace(card, hidden_dim=first.shape[0])
    return with_weights(card, state, f"published probe {path}")
