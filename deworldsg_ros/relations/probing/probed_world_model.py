"""A frozen backbone and a trained probe are a world model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from deworldsg_ros.checkpoints.probe_card import relative_box_pair
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.probing.backbone import FrozenBackbone
from deworldsg_ros.relations.probing.probe_network import Probe, load_probe
from deworldsg_ros.relations.world_model import ClipRequest
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ConfigurationError


class ProbedWorldModel:
    """Clips in, the probe's predicate distributions out.

    Attributes:
        name: the backbone's family.
        clip_length: T, frames that it wants in a clip.
        predicates: names that the probe answers over.

    Raises:
        ConfigurationError: where the probe was trained on another backbone.
    """

    def __init__(self, backbone: FrozenBackbone, probe: Probe) -> None:
        probe.card.require_backbone(backbone.identity)
        self.name = backbone.identity.family
        self.clip_length = backbone.identity.clip_length
        self.predicates = probe.card.predicates
        self._backbone = backbone
        self._probe = probe

    def require_predicates(self, predicates: tuple[str, ...]) -> None:
        """Raise ConfigurationError unless the probe answers over just these predicates."""
        self._probe.card.require_predicates(predicates)

    def predict_batch(self, requests: Sequence[ClipRequest]) -> list[Float64]:
        """(pairs, R) float64 for each request; all clips are encoded at once.

        Raises:
            ConfigurationError: where a vocabulary has other predicates than the probe.
        """
        for request in requests:
            self.require_predicates(request.vocabulary.predicates)
        features = self._backbone.encode([request.clip for request in requests])
        answers = []
        for feature, request in zip(features, requests):
            boxes = relative_boxes(request)
            rows = np.repeat(feature[None], len(boxes), axis=0)
            answers.append(self._probe.predict(rows, boxes))
        return answers


def relative_boxes(request: ClipRequest) -> Float32:
    """(pairs, 8) float32: corners of subject and object as shares of the crop."""
    height, width = request.clip.shape[1:3]
    rows = [
        relative_box_pair(pair.subject_box_xyxy, pair.object_box_xyxy, width, height)
        for pair in request.pairs
    ]
    return np.array(rows, np.float32).reshape(len(rows), 8)


def build_probed(
    config: RelationsConfig, load_backbone: Callable[[RelationsConfig], FrozenBackbone]
) -> ProbedWorldModel:
    """The configured backbone and probe.

    Raises:
        ConfigurationError: in one sentence, where one is missing, or they do not fit.
    """
    if not config.probe_path:
        raise ConfigurationError(
            f"relations.probe_path is empty: world model '{config.world_model}' wants the folder "
            "of a probe; train one with `deworldsg train-probe`"
        )
    # The probe first: it is small, and what is wrong with it is told before the wait.
    probe = load_probe(Path(config.probe_path).expanduser())
    if probe.card.backbone.family != config.world_model:
        raise ConfigurationError(
            f"the probe in '{config.probe_path}' was trained on {probe.card.backbone}: "
            f"relations.world_model '{config.world_model}' wants another"
        )
    return ProbedWorldModel(load_backbone(config), probe)
