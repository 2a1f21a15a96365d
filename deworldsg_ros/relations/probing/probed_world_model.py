"""A world model made of a frozen backbone and a trained probe."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deworldsg_ros.checkpoints.probe_card import relative_box_pair
from deworldsg_ros.checkpoints.probe_network import Probe, load_probe
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.backbone import FrozenBackbone
from deworldsg_ros.relations.world_model import ClipRequest
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError

logger = logging.getLogger(__name__)


class ProbedWorldModel:
    """Maps clips to the probe's predicate distributions.

    Attributes:
        name: family of the backbone.
        clip_length: T, frames of a clip.
        predicates: names of the probe's outputs.
        window: frames of a clip, see `ProbeCard`.

    Raises:
        ConfigurationError: the probe was trained on another backbone.
    """

    def __init__(self, backbone: FrozenBackbone, probe: Probe) -> None:
        probe.card.require_backbone(backbone.identity)
        self.name = backbone.identity.family
        self.clip_length = backbone.identity.clip_length
        self.predicates = probe.card.predicates
        self.window = probe.card.window
        self._backbone = backbone
        self._probe = probe

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        """Raise ConfigurationError unless the probe has exactly these predicates, in this order."""
        self._probe.card.require_predicates(predicates)

    def predict(self, request: ClipRequest) -> Float64:
        """(pairs, R) float64, rows sum to one.

        Raises:
            ConfigurationError: the vocabulary has other predicates than the probe, or the device
                has too little memory.
        """
        self.require_predicates(request.vocabulary.predicates)
        boxes = relative_boxes(request)
        features = np.repeat(self._backbone.encode([request.clip]), len(boxes), axis=0)
        return self._probe.predict(features, boxes)


def relative_boxes(request: ClipRequest) -> Float32:
    """(pairs, 8) float32: corners of subject and object as fractions of the crop's size."""
    height, width = request.clip.shape[1:3]
    rows = [
        relative_box_pair(pair.subject_box_xyxy, pair.object_box_xyxy, width, height)
        for pair in request.pairs
    ]
    return np.array(rows, np.float32).reshape(len(rows), 8)


def build_probed(
    config: RelationsConfig, load_backbone: Callable[..., FrozenBackbone], device: str
) -> ProbedWorldModel:
    """The configured backbone and probe.

    Raises:
        ConfigurationError: one of them is missing, or they do not fit each other.
    """
    if not config.probe_path:
        raise ConfigurationError(
            f"relations.probe_path is empty: world model '{config.world_model}' needs the folder "
            "of a probe; train one with `deworldsg train-probe`"
        )
    # The probe is small: an error in it is reported before the long load of the backbone.
    probe = load_probe(Path(config.probe_path).expanduser())
    if probe.card.backbone.family != config.world_model:
        raise ConfigurationError(
            f"relations.probe_path '{config.probe_path}' was trained on {probe.card.backbone}: "
            f"relations.world_model '{config.world_model}' needs another probe"
        )
    model = ProbedWorldModel(load_backbone(config, device=device), probe)
    if not probe.card.backbone.fingerprint:
        logger.warning(
            "probe %s does not know the weights of its backbone, so '%s' is not compared with "
            "them: with other weights its predictions mean nothing (docs/dev/models.md, The "
            "published probe)",
            config.probe_path,
            config.world_model_path,
        )
    if config.edge_belief == "paper" and probe.card.inputs != "clip":
        logger.warning(
            "probe %s gets '%s'. The paper's probe gets the clip only: these are not the paper's "
            "results. For those, use a probe trained with --inputs clip",
            config.probe_path,
            probe.card.inputs,
        )
    return model
