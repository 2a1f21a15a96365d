"""The probe's network on torch: built, saved, loaded, and taken over from a published file."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import safetensors
import torch
from safetensors.torch import load_file, save_file

from deworldsg_ros.checkpoints.probe_card import (
    WEIGHTS_FILE,
    BackboneIdentity,
    ProbeCard,
    read_card,
    write_card,
)
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError

DROPOUT = 0.2

# What the published probe was trained on: V-JEPA 2 ViT-g at 384 pixels, 16 frames.
PUBLISHED_BACKBONE = BackboneIdentity("vjepa2", 1408, 384, 16)
PUBLISHED_HIDDEN_DIM = 512
# A probe has 14 at most.
MOST_NAMED_KEYS = 14


def build_network(card: ProbeCard) -> torch.nn.Sequential:
    """(n, input_dim) to logits (n, R); parameters named as published, `net.0` on."""
    first = torch.nn.Linear(card.input_dim, card.hidden_dim)
    last = torch.nn.Linear(card.hidden_dim, len(card.predicates))
    layers: list[torch.nn.Module] = [first, torch.nn.ReLU(), last]
    if card.layout == "batch_norm":
        layers = [
            torch.nn.BatchNorm1d(card.input_dim),
            first,
            torch.nn.ReLU(),
            torch.nn.BatchNorm1d(card.hidden_dim),
            torch.nn.Dropout(DROPOUT),
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
            boxes: (n, 8) float32, read where the card's inputs have boxes.

        Returns:
            (n, R) float64, rows sum to one.
        """
        inputs = probe_inputs(self.card, features, boxes)
        with torch.inference_mode():
            logits = self.network(torch.from_numpy(inputs)).to(torch.float64)
            distributions: Float64 = torch.softmax(logits, dim=1).numpy()
        return distributions


def probe_inputs(card: ProbeCard, features: Float32, boxes: Float32) -> Float32:
    """(n, input_dim) float32 out of features and boxes."""
    parts = [features, boxes] if card.inputs == "clip_and_boxes" else [features]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def save_probe(folder: Path, probe: Probe) -> None:
    """Write a probe's folder, the card last: a folder with a card is whole."""
    folder.mkdir(parents=True, exist_ok=True)
    state = {name: value.contiguous() for name, value in probe.network.state_dict().items()}
    save_file(state, folder / WEIGHTS_FILE)
    write_card(folder, probe.card)


def load_probe(folder: Path) -> Probe:
    """Read a probe's folder.

    Raises:
        ConfigurationError: where a file is missing, or weights and card do not fit.
    """
    card = read_card(folder)
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise ConfigurationError(f"probe '{folder}' has no {WEIGHTS_FILE}: save it again")
    try:
        state = load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise ConfigurationError(f"probe weights {path} cannot be read: {error}") from error
    return with_weights(card, state, str(path))


def _first_of(names: list[str]) -> str:
    """The names; of more than a probe has, the first ones."""
    more = len(names) - MOST_NAMED_KEYS
    return ", ".join(names[:MOST_NAMED_KEYS]) + (f" and {more} more" if more > 0 else "")


def with_weights(card: ProbeCard, state: dict[str, torch.Tensor], source: str) -> Probe:
    """A probe of given weights.

    Raises:
        ConfigurationError: naming the first key that is missing, unknown or of another shape.
    """
    network = build_network(card)
    wanted = network.state_dict()
    missing = sorted(wanted.keys() - state.keys())
    unknown = sorted(state.keys() - wanted.keys())
    if missing or unknown:
        parts = [f"lacks {_first_of(missing)}"] if missing else []
        parts += [f"has unknown {_first_of(unknown)}"] if unknown else []
        raise ConfigurationError(
            f"probe weights {source}: wanted the keys of layout '{card.layout}'; the file "
            f"{' and '.join(parts)}"
        )
    for name, value in state.items():
        if value.shape != wanted[name].shape:
            raise ConfigurationError(
                f"probe weights {source}: {name} has shape {tuple(value.shape)}, wanted "
                f"{tuple(wanted[name].shape)} for {card.backbone} and {len(card.predicates)} "
                "predicates"
            )
    network.load_state_dict(state)
    return Probe(card, network.eval().requires_grad_(False))


def import_published(
    path: Path,
    predicates: tuple[str, ...],
    backbone: BackboneIdentity = PUBLISHED_BACKBONE,
) -> Probe:
    """The probe of a published `vjepa_probe_mlp.pt`, a plain dictionary of tensors.

    Args:
        path: the file; nothing in it is executed.
        predicates: names of its outputs, in order: the file does not hold them.
        backbone: what it was trained on; the file does not tell.

    Raises:
        ConfigurationError: where the file is not of that layout, by the names of its keys.
    """
    if not path.is_file():
        raise ConfigurationError(f"'{path}' is no file: wanted a published vjepa_probe_mlp.pt")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip and torch each have their own
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ConfigurationError(f"'{path}' is no file of tensors: {reason}") from error
    if not (
        isinstance(content, dict)
        and all(isinstance(value, torch.Tensor) for value in content.values())
    ):
        raise ConfigurationError(f"'{path}': wanted a state dictionary of tensors by name")
    card = ProbeCard(
        backbone,
        predicates,
        layout="batch_norm",
        hidden_dim=PUBLISHED_HIDDEN_DIM,
        training={"imported_from": path.name},
    )
    first = content.get("net.1.weight")
    if first is not None and first.ndim == 2:
        card = msgspec.structs.replace(card, hidden_dim=first.shape[0])
    return with_weights(card, content, str(path))
