"""The EGTR relation head as a backend: it reads the queries of the detector `rtdetr`."""

from __future__ import annotations

import numpy as np
import torch
from safetensors.torch import load_file

from deworldsg_ros.checkpoints.architectures import HEAD_FILE
from deworldsg_ros.checkpoints.card import CARD_FILE, CheckpointCard, read_card
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.checkpoints.loading import CheckpointSource, enough_memory
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.rtdetr import RtDetrDetector
from deworldsg_ros.perception.protocols import Detector
from deworldsg_ros.scene.arrays import Float32, Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import Relations
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS


class EgtrRelationHead:
    """Relations from the attention between the detector's queries.

    The logits of a pair are the head's relation logits, before the sigmoid, with the class-pair
    statistics where the checkpoint uses them. Pairs are ranked by
    max_r sigmoid(relation) sigmoid(connectivity) s_i s_j.

    Args:
        config: the section `perception`: `relation_head_path` (empty = the detector's checkpoint).
        detector: the one that finds the objects; told to record its queries.

    Raises:
        ConfigurationError: another detector, no head, a head for other queries, or for another
            label set.

    Attributes:
        predicates: names, in the order of the logits.
    """

    def __init__(self, config: PerceptionConfig, detector: Detector) -> None:
        if not isinstance(detector, RtDetrDetector):
            raise ConfigurationError(
                "perception.relation_head 'egtr' reads the queries of the detector 'rtdetr', and "
                f"perception.detector is '{config.detector}': set it to 'rtdetr', or the head to "
                "'geometric'"
            )
        source, card = detector.source, detector.card
        if config.relation_head_path:
            source = CheckpointSource.find(
                "perception.relation_head_path",
                config.relation_head_path,
                local_files_only=config.local_files_only,
            )
            card = read_card(source.file(CARD_FILE))
        self._network = _load(source)
        self._device = detector.device
        self._index = {name: index for index, name in enumerate(detector.classes)}
        self._frequency_bias = card.frequency_bias
        self.predicates = _checked_predicates(self._network, card, config.predicate_set, source)
        _check_detector(self._network, card, detector, source)
        detector.record_queries()
        with enough_memory("loading the relation head"):
            self._network.to(self._device)

    def relate(
        self,
        depth_m: Float32,
        intrinsics: Intrinsics,
        boxes_xyxy: Float64,
        class_names: list[str],
        scores: Float64,
        instances: UInt16,
        up_camera: Float64 | None,
        top_relations: int,
        features: Float32 | None = None,
    ) -> Relations:
        """The best ordered pairs, best first; see `RelationHead`. Needs nothing but `features`."""
        if len(scores) < 2 or top_relations < 1:
            return Relations.none(len(self.predicates))
        if features is None:
            raise ValueError("objects without features of their queries: wanted those of rtdetr")
        classes = None
        with torch.inference_mode():
            if self._frequency_bias:
                indices = [self._index[name] for name in class_names]
                classes = torch.tensor(indices, device=self._device)
            found = self._network(torch.from_numpy(features).to(self._device), classes)
            relations, connectivity = (part.cpu().double() for part in found)
            ranks = torch.sigmoid(relations).amax(dim=2) * torch.sigmoid(connectivity)
        return best_pairs(relations.numpy(), ranks.numpy(), scores, top_relations)


def best_pairs(logits: Float64, ranks: Float64, scores: Float64, top: int) -> Relations:
    """The `top` ordered pairs by rank times both scores, without those of one object.

    Args:
        logits: (n, n, R) pre-sigmoid, subject first.
        ranks: (n, n) in [0, 1].
        scores: (n,) of the objects, in [0, 1].
        top: most pairs.
    """
    count = len(scores)
    pair_scores = ranks * np.outer(scores, scores)
    np.fill_diagonal(pair_scores, -1.0)
    # The pairs of an object with itself come last.
    order = np.argsort(-pair_scores, axis=None, kind="stable")[: min(top, count * (count - 1))]
    pairs = np.stack(np.unravel_index(order, pair_scores.shape), axis=1).astype(np.int64)
    subjects, objects = pairs.T
    return Relations(pairs, logits[subjects, objects], pair_scores[subjects, objects])


def _load(source: CheckpointSource) -> EgtrNetwork:
    path = source.file(HEAD_FILE)
    if path is None:
        raise ConfigurationError(
            f"{source.parameter} '{source.name}' has no {HEAD_FILE}: make it from a published "
            "checkpoint with `deworldsg models import-fross`, or set perception.relation_head to "
            "'geometric'"
        )
    try:
        parameters = load_file(path)
    except Exception as error:  # safetensors raises an error of its own, and OSError
        raise ConfigurationError(f"{path} cannot be read ({error}): get it again") from error
    return EgtrNetwork.for_parameters(parameters, str(path))


def _checked_predicates(
    network: EgtrNetwork, card: CheckpointCard, predicate_set: str, source: CheckpointSource
) -> tuple[str, ...]:
    there = network.predicates
    names = card.predicates
    if len(names) != there:
        raise ConfigurationError(
            f"relation head of '{source.name}' has {there} predicates and its {CARD_FILE} names "
            f"{len(names)}: name each in `predicates` there"
        )
    if predicate_set != "checkpoint" and names != PREDICATE_SETS[predicate_set]:
        fitting = [name for name, known in PREDICATE_SETS.items() if known == names]
        raise ConfigurationError(
            f"perception.predicate_set is '{predicate_set}' and the relation head of "
            f"'{source.name}' was trained on {there} others ({', '.join(names[:3])}, …): set it to "
            f"'{fitting[0] if fitting else 'checkpoint'}'"
        )
    return names


def _check_detector(
    network: EgtrNetwork, card: CheckpointCard, detector: RtDetrDetector, source: CheckpointSource
) -> None:
    """Refuse a detector whose queries, layers or classes are not what the head was trained on."""
    width, layers = network.final_sub_proj.in_features, len(network.proj_q)
    found = detector.model.config.d_model, len(detector.model.model.decoder.layers)
    if found[0] != width or found[1] > layers:
        raise ConfigurationError(
            f"relation head of '{source.name}' reads {layers} layers of {width} features and the "
            f"detector '{detector.source.name}' has {found[1]} of {found[0]}: take both from one "
            "checkpoint"
        )
    classes = len(detector.classes)
    if card.classes and card.classes != detector.classes:
        raise ConfigurationError(
            f"relation head of '{source.name}' was trained on other classes than the detector "
            f"'{detector.source.name}' has: take both from one checkpoint"
        )
    if not card.frequency_bias:
        return
    if not hasattr(network, "triplet_dist"):
        raise ConfigurationError(
            f"relation head of '{source.name}' has no class-pair statistics (triplet_dist): set "
            f"`frequency_bias` in its {CARD_FILE} to false"
        )
    if network.triplet_dist.shape[0] not in (classes, classes + 1):
        raise ConfigurationError(
            f"relation head of '{source.name}' was trained on {network.triplet_dist.shape[0]} "
            f"classes and the detector '{detector.source.name}' has {classes}: take both from one "
            "checkpoint"
        )
