"""Import of the published probe of V-JEPA 2, `vjepa_probe_mlp.pt`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from deworldsg_ros.checkpoints.loading import read_tensors
from deworldsg_ros.checkpoints.probe_card import BackboneIdentity, ProbeCard
from deworldsg_ros.checkpoints.probe_network import Probe, with_weights

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
