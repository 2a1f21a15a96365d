"""The EGTR relation head on torch: it reads the queries of the detector `rtdetr`."""

from __future__ import annotations

import numpy as np
import torch
from safetensors.torch import load_file

from deworldsg_ros.checkpoints.architectures import HEAD_FILE
from deworldsg_ros.checkpoints.card import CARD_FILE
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.checkpoints.loading import CheckpointSource, enough_memory
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.rtdetr import RtDetrDetector
from deworldsg_ros.perception.protocols import Detector, SegmentedObjects
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import Relations
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS


class EgtrRelationHead:
    """Relations from the attention between the detector's queries.

    The logits of a pair are the head's relation logits, before the sigmoid, with the class-pair
    statistics where the checkpoint uses them. Pairs are ranked by
    max_r sigmoid(relation) sigmoid(connectivity) s_i s_j.

    Args:
        config: the section `perception`: `predicate_set`.
        detector: an `RtDetrDetector` whose checkpoint folder also contains the head. From now on
            it records its queries.

    Raises:
        ConfigurationError: another detector, no head in its folder, or a head that was trained
            on other queries, classes or predicates.

    Attributes:
        predicates: names, in the order of the logits.
    """

    def __init__(self, config: PerceptionConfig, detector: Detector) -> None:
        if not isinstance(detector, RtDetrDetector):
            raise ConfigurationError(
                f"perception.detector is '{config.detector}', but perception.relation_head 'egtr' "
                "reads the queries of the detector 'rtdetr': set perception.detector to 'rtdetr', "
                "or perception.relation_head to 'geometric'"
            )
        self._network = _load(detector.source)
        self._device = detector.device
        self._index = {name: index for index, name in enumerate(detector.classes)}
        self._frequency_bias = detector.card.frequency_bias
        self.predicates = _checked_predicates(self._network, config.predicate_set, detector)
        _check_detector(self._network, detector)
        detector.record_queries()
        with enough_memory("loading the relation head"):
            self._network.to(self._device)

    def relate(self, objects: SegmentedObjects, max_relations: int) -> Relations:
        """The best ordered pairs, best first; see `RelationHead`.

        Raises:
            ValueError: the objects have no query features.
        """
        if len(objects) < 2 or max_relations < 1:
            return Relations.none(len(self.predicates))
        if objects.features is None:
            raise ValueError("objects without query features, expected those of rtdetr")
        classes = None
        with torch.inference_mode():
            if self._frequency_bias:
                indices = [self._index[name] for name in objects.class_names]
                classes = torch.tensor(indices, device=self._device)
            found = self._network(torch.from_numpy(objects.features).to(self._device), classes)
            relations, connectivity = (part.cpu().double() for part in found)
            ranks = torch.sigmoid(relations).amax(dim=2) * torch.sigmoid(connectivity)
        return best_pairs(relations.numpy(), ranks.numpy(), objects.scores, max_relations)


def best_pairs(logits: Float64, ranks: Float64, scores: Float64, top: int) -> Relations:
    """The `top` ordered pairs of two objects by rank s_i s_j, best first.

    Args:
        logits: (n, n, R) pre-sigmoid, subject first.
        ranks: (n, n) in [0, 1].
        scores: (n,) of the objects, in [0, 1].
        top: maximum number of pairs.
    """
    count = len(scores)
    pair_scores = ranks * np.outer(scores, scores)
    np.fill_diagonal(pair_scores, -1.0)
    # Pairs of an object with itself come last, and are cut off.
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
    network: EgtrNetwork, predicate_set: str, detector: RtDetrDetector
) -> tuple[str, ...]:
    """Names of the head's predicates, if they are those of the predicate set."""
    name, names = detector.source.name, detector.card.predicates
    if len(names) != network.predicates:
        raise ConfigurationError(
            f"{CARD_FILE} of '{name}' names {len(names)} predicates, expected one for each of the "
            f"{network.predicates} of its relation head: name each in `predicates`"
        )
    if predicate_set != "checkpoint" and names != PREDICATE_SETS[predicate_set]:
        matching = [key for key, known in PREDICATE_SETS.items() if known == names]
        raise ConfigurationError(
            f"perception.predicate_set is '{predicate_set}', but the relation head of '{name}' "
            f"was trained on {len(names)} other predicates ({', '.join(names[:3])}, …): set it to "
            f"'{matching[0] if matching else 'checkpoint'}'"
        )
    return names


def _check_detector(network: EgtrNetwork, detector: RtDetrDetector) -> None:
    """Refuse a detector with other queries, layers or classes than those of the head's training."""
    name = detector.source.name
    expected = network.final_sub_proj.in_features, len(network.proj_q)
    found = detector.model.config.d_model, len(detector.model.model.decoder.layers)
    if found[0] != expected[0] or found[1] > expected[1]:
        raise ConfigurationError(
            f"detector of '{name}' has {found[1]} layers of {found[0]} features, but its relation "
            f"head reads {expected[1]} layers of {expected[0]}: take both from one checkpoint"
        )
    if not detector.card.frequency_bias:
        return
    if not hasattr(network, "triplet_dist"):
        raise ConfigurationError(
            f"relation head of '{name}' has no class-pair statistics (triplet_dist): set "
            f"`frequency_bias` in its {CARD_FILE} to false"
        )
    classes = len(detector.classes)
    # Published heads count "no class", too.
    if network.triplet_dist.shape[0] not in (classes, classes + 1):
        raise ConfigurationError(
            f"detector of '{name}' has {classes} classes, but its relation head was trained on "
            f"{network.triplet_dist.shape[0]}: take both from one checkpoint"
        )
