"""Detectors of fixed classes on torch, and EGTR, the relation head on queries.

RT-DETR with EGTR is the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import transformers
from safetensors.torch import load_file

from deworldsg_ros.checkpoints.cards import (
    DEFAULT_SCORE_THRESHOLD,
    DETECTOR_CARD,
    CheckpointCard,
    read_detector_card,
)
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.checkpoints.loading import (
    DETECTORS,
    HEAD_FILE,
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
    in_best_precision,
    noise_pattern,
    require_finite,
)
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.backends.image_tensors import Preprocessing
from deworldsg_ros.perception.protocols import Detections, Detector, SegmentedObjects
from deworldsg_ros.scene.arrays import Float64, Int64, UInt8, corners_of
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import Relations
from deworldsg_ros.scene.vocabulary import PREDICATE_SETS

# --- Detectors that `AutoModelForObjectDetection` loads; RT-DETR is the paper's.
#
# Each object is one query of the decoder. Overlapping boxes are not suppressed.

# The public checkpoints of RT-DETR take 640 x 640 images, scaled to [0, 1] and not normalised.
PUBLIC_PREPROCESSING = Preprocessing(640, 640)
RT_DETR = ("rt_detr", "rt_detr_v2", "d_fine")
# Outputs without a class, as the ids of COCO have them.
NO_CLASS = ("n/a", "background", "")


class ClosedSetDetector:
    """Detector on a checkpoint of fixed classes: RT-DETR, D-FINE, RF-DETR and others.

    Args:
        config: the section `perception`: `detector_path` and `device`.

    Raises:
        ConfigurationError: no checkpoint, another architecture, no CUDA, no memory.

    Attributes:
        classes: names, in the order of the distributions.
        default_score_threshold: minimum score of an object, of the card or of its kind of scores.
        card: settings of the checkpoint.
        source: folder or hub id of the checkpoint.
        device: device of the network.
        preprocess: makes the network's input of an image.
        model: the network.
    """

    def __init__(self, config: PerceptionConfig) -> None:
        self.source = CheckpointSource.find(
            "perception.detector_path",
            config.detector_path,
        )
        self.device = choose_device("perception.device", config.device)
        network = self.source.config(DETECTORS)
        self.card = read_detector_card(self.source.file(DETECTOR_CARD))
        self.reading = ClassReading.of(network, self.card, self.source)
        self.classes = self.reading.classes
        self.default_score_threshold = (
            DEFAULT_SCORE_THRESHOLD[self.card.class_scores]
            if self.card.score_threshold is None
            else self.card.score_threshold
        )
        is_rt_detr = network.model_type in RT_DETR
        self.preprocess = Preprocessing.of_checkpoint(
            self.source, PUBLIC_PREPROCESSING if is_rt_detr else None
        )
        model = self.source.load(transformers.AutoModelForObjectDetection, network)
        _use_layers(model, self.card.decoder_layers, self.source)
        self._recorder: QueryRecorder | None = None
        with enough_memory("loading the detector", "choose a smaller perception.detector_path"):
            model, self.dtype = in_best_precision(
                model, self.device, choose_dtype(self.device), self._test_scores, "the detector"
            )
            self.model = model.to(memory_format=torch.channels_last)
            # The first pass allocates memory and tunes kernels; do it at start-up.
            self._forward(np.zeros((self.preprocess.height, self.preprocess.width, 3), np.uint8))

    def record_queries(self) -> None:
        """From now on, `detect` also returns the query features of each object."""
        if self._recorder is None:
            self._recorder = QueryRecorder(self.model)

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        output = self._forward(rgb)
        require_finite(output.logits, "detector_error", "the class logits")
        require_finite(output.pred_boxes, "detector_error", "the boxes")
        probabilities, scores = self.reading(output.logits[0].float())
        rows = torch.nonzero(scores >= score_threshold)[:, 0]
        rows = rows[torch.argsort(scores[rows], descending=True, stable=True)]
        features = None
        if self._recorder is not None:
            features = self._recorder.features(output, rows).cpu().numpy()
        height, width = rgb.shape[:2]
        return Detections(
            _pixel_boxes(_numpy(output.pred_boxes[0][rows]), width, height),
            _normalised(_numpy(probabilities[rows])),
            _numpy(scores[rows]),
            features,
        )

    @torch.inference_mode()
    def _test_scores(self, model: Any, dtype: torch.dtype) -> torch.Tensor:
        """Sorted scores of the queries for a fixed image; their order may differ by rounding."""
        image = noise_pattern(self.preprocess.height, self.preprocess.width, 3).numpy()
        logits: torch.Tensor = model(self.preprocess(image, self.device, dtype)).logits
        return logits.float().amax(dim=-1).sort().values

    @torch.inference_mode()
    def _forward(self, rgb: UInt8) -> Any:
        pixels = self.preprocess(rgb, self.device, self.dtype)
        return self.model(pixels.contiguous(memory_format=torch.channels_last))


class QueryRecorder:
    """Keeps the queries and keys that the decoder's self-attention projects; EGTR reads them.

    Args:
        model: an RT-DETR.
    """

    def __init__(self, model: Any) -> None:
        self._queries: list[torch.Tensor] = []
        self._keys: list[torch.Tensor] = []
        layers = model.model.decoder.layers
        self._queries, self._keys = [torch.empty(0)] * len(layers), [torch.empty(0)] * len(layers)
        for index, layer in enumerate(layers):
            layer.self_attn.q_proj.register_forward_hook(self._keeping(self._queries, index))
            layer.self_attn.k_proj.register_forward_hook(self._keeping(self._keys, index))

    def features(self, output: Any, rows: torch.Tensor) -> torch.Tensor:
        """(n, 2 L + 1, d) float32: projected queries, projected keys, last hidden state.

        Args:
            output: of the last pass.
            rows: (n,) indices of the queries.
        """
        slots = [*self._queries, *self._keys, output.last_hidden_state]
        return torch.stack([slot[0, rows] for slot in slots], dim=1).float()

    @staticmethod
    def _keeping(kept: list[torch.Tensor], index: int) -> Any:
        def keep(module: Any, inputs: Any, output: torch.Tensor) -> None:
            kept[index] = output.detach()

        return keep


@dataclass(frozen=True)
class ClassReading:
    """How class logits become class distributions and scores.

    The distribution is softmax(logits / temperature). Normalised sigmoids are no alternative:
    many small ones would outweigh the correct one (Eq. 5). The score of a softmax checkpoint is
    the maximum of the distribution, as in FROSS and the paper; if its last output is "no object",
    that of the distribution with this output. The score of a sigmoid checkpoint is its largest
    sigmoid.

    Attributes:
        classes: names.
        columns: (C,) int64, output of each class.
        card: settings of the checkpoint.
        no_object: whether the last output is "no object".
    """

    classes: tuple[str, ...]
    columns: Int64
    card: CheckpointCard
    no_object: bool

    @staticmethod
    def of(network: Any, card: CheckpointCard, source: CheckpointSource) -> ClassReading:
        """The reading of a checkpoint; raises ConfigurationError if it does not name its classes.

        Args:
            network: configuration of the checkpoint.
            card: settings of the checkpoint.
            source: for messages.
        """
        names = card.classes or tuple(name for _, name in sorted(network.id2label.items()))
        columns = [k for k, name in enumerate(names) if str(name).lower() not in NO_CLASS]
        classes = tuple(str(names[column]) for column in columns)
        numbered = card.classes or sorted(network.id2label) == list(range(network.num_labels))
        if len(names) != network.num_labels or len(set(classes)) < len(classes) or not numbered:
            raise ConfigurationError(
                f"{source.parameter} '{source.name}' names {len(set(classes))} classes, expected "
                f"one for each of its {network.num_labels} outputs: name each once, in `classes` "
                f"of {DETECTOR_CARD} or in `id2label` of config.json"
            )
        if all(name == f"LABEL_{index}" for index, name in enumerate(names)):
            raise ConfigurationError(
                f"{source.parameter} '{source.name}' does not name its {len(names)} classes: name "
                f"them in `classes` of {DETECTOR_CARD} in its folder"
            )
        no_object = DETECTORS[network.model_type] == "softmax"
        return ClassReading(classes, np.array(columns, np.int64), card, no_object)

    def __call__(self, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Class distributions (n, C) and scores (n,) of all outputs (n, C + …)."""
        columns = torch.from_numpy(self.columns).to(logits.device)
        used = logits[:, columns]
        probabilities = torch.softmax(used / self.card.temperature, dim=-1)
        if self.no_object:
            scores = torch.softmax(logits, dim=-1)[:, columns]
        elif self.card.class_scores == "softmax":
            scores = probabilities
        else:
            scores = torch.sigmoid(used)
        return probabilities, scores.amax(dim=-1)


def _use_layers(model: Any, used: int, source: CheckpointSource) -> None:
    """Drop the later layers of the decoder; each layer has class and box heads of its own."""
    if not used:
        return
    decoder: Any = getattr(model.model, "decoder", None)
    if not hasattr(decoder, "class_embed"):
        raise ConfigurationError(
            f"{source.parameter} '{source.name}': decoder_layers in {DETECTOR_CARD} is {used}, but "
            f"layers of a {type(model).__name__} cannot be dropped: set it to 0"
        )
    count = len(decoder.layers)
    if used > count:
        raise ConfigurationError(
            f"{source.parameter} '{source.name}': decoder_layers in {DETECTOR_CARD} is {used}, "
            f"expected at most the {count} of the network: lower it, or set it to 0 for all"
        )
    for part in ("layers", "class_embed", "bbox_embed"):
        setattr(decoder, part, getattr(decoder, part)[:used])


def _pixel_boxes(boxes_cxcywh: Float64, width: int, height: int) -> Any:
    """Centre, width and height in [0, 1] to corners in pixels, pixel centres at integers."""
    return corners_of(boxes_cxcywh) * [width, height, width, height] - 0.5


def _normalised(probabilities: Float64) -> Any:
    return probabilities / probabilities.sum(axis=1, keepdims=True)


def _numpy(tensor: torch.Tensor) -> Float64:
    return tensor.detach().cpu().double().numpy()


# --- The EGTR relation head on torch: it reads the queries of an RT-DETR.


class EgtrRelationHead:
    """Relations from the attention between the detector's queries.

    The logits of a pair are the head's relation logits, before the sigmoid, with the class-pair
    statistics where the checkpoint uses them. Pairs are ranked by
    max_r sigmoid(relation) sigmoid(connectivity) s_i s_j.

    Args:
        config: the section `perception`: `predicate_set`.
        detector: an `ClosedSetDetector` whose checkpoint folder also contains the head. From now on
            it records its queries.

    Raises:
        ConfigurationError: another detector, no head in its folder, or a head that was trained
            on other queries, classes or predicates.

    Attributes:
        predicates: names, in the order of the logits.
    """

    def __init__(self, config: PerceptionConfig, detector: Detector) -> None:
        if not isinstance(detector, ClosedSetDetector):
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
    network: EgtrNetwork, predicate_set: str, detector: ClosedSetDetector
) -> tuple[str, ...]:
    """Names of the head's predicates, if they are those of the predicate set."""
    name, names = detector.source.name, detector.card.predicates
    if len(names) != network.predicates:
        raise ConfigurationError(
            f"{DETECTOR_CARD} of '{name}' names {len(names)} predicates, expected one for each of "
            f"the {network.predicates} of its relation head: name each in `predicates`"
        )
    if predicate_set != "checkpoint" and names != PREDICATE_SETS[predicate_set]:
        matching = [key for key, known in PREDICATE_SETS.items() if known == names]
        raise ConfigurationError(
            f"perception.predicate_set is '{predicate_set}', but the relation head of '{name}' "
            f"was trained on {len(names)} other predicates ({', '.join(names[:3])}, …): set it to "
            f"'{matching[0] if matching else 'checkpoint'}'"
        )
    return names


def _check_detector(network: EgtrNetwork, detector: ClosedSetDetector) -> None:
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
            f"`frequency_bias` in its {DETECTOR_CARD} to false"
        )
    classes = len(detector.classes)
    # Published heads count "no class", too.
    if network.triplet_dist.shape[0] not in (classes, classes + 1):
        raise ConfigurationError(
            f"detector of '{name}' has {classes} classes, but its relation head was trained on "
            f"{network.triplet_dist.shape[0]}: take both from one checkpoint"
        )
