"""RT-DETR and RT-DETRv2 on torch: the paper's detector.

An object is one query of the decoder: there is no suppression of overlapping boxes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from deworldsg_ros.checkpoints.architectures import DETECTORS
from deworldsg_ros.checkpoints.card import (
    CARD_FILE,
    DEFAULT_SCORE_THRESHOLD,
    CheckpointCard,
    read_card,
)
from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
)
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.networks.image_tensors import Preprocessing
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.scene.errors import ConfigurationError

# The public checkpoints': no mean, no standard deviation.
PUBLIC_PREPROCESSING = Preprocessing(640, 640)


class RtDetrDetector:
    """Detector on an RT-DETR checkpoint.

    Args:
        config: the section `perception`: `detector_path`, `device`, `decoder_layers`,
            `class_scores`.

    Raises:
        ConfigurationError: no checkpoint, another architecture, no CUDA, no memory.

    Attributes:
        classes: names, in the order of the distributions.
        card: how the checkpoint is read, with the configuration's changes.
        source: where it came from.
        device: where it runs.
        model: the network.
    """

    def __init__(self, config: PerceptionConfig) -> None:
        self.source = CheckpointSource.find(
            "perception.detector_path",
            config.detector_path,
            local_files_only=config.local_files_only,
        )
        self.device = choose_device("perception.device", config.device)
        # Half precision: of the two kinds the one that still tells neighbouring pixels apart.
        self.dtype = choose_dtype(self.device)
        network = self.source.config(DETECTORS)
        self.card = _effective_card(read_card(self.source.file(CARD_FILE)), config)
        self.classes = _class_names(network, self.card, self.source)
        self.default_score_threshold = (
            DEFAULT_SCORE_THRESHOLD[self.card.class_scores]
            if self.card.score_threshold is None
            else self.card.score_threshold
        )
        self._preprocess = Preprocessing.of_checkpoint(self.source, PUBLIC_PREPROCESSING)
        model = self.source.load(DETECTORS[network.model_type], network)
        _use_layers(model, self.card.decoder_layers, network.decoder_layers)
        self._recorder: QueryRecorder | None = None
        with enough_memory("loading the detector", "choose a smaller perception.detector_path"):
            self.model = model.to(self.device, self.dtype, memory_format=torch.channels_last)
            # What is allocated and tuned at the first image is so now.
            self._forward(np.zeros((self._preprocess.height, self._preprocess.width, 3), np.uint8))

    def record_queries(self) -> None:
        """Give each object the features of its query, from now on; a relation head reads them."""
        if self._recorder is None:
            self._recorder = QueryRecorder(self.model)

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        output = self._forward(rgb)
        probabilities, scores = class_distributions(output.logits[0].float(), self.card)
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
    def _forward(self, rgb: UInt8) -> Any:
        pixels = self._preprocess(rgb, self.device, self.dtype)
        return self.model(pixels.contiguous(memory_format=torch.channels_last))


class QueryRecorder:
    """Keeps what the decoder's self-attention made of the queries (EGTR reads it).

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
            output: of the pass that was the last one.
            rows: (n,) the queries that are wanted.
        """
        slots = [*self._queries, *self._keys, output.last_hidden_state]
        return torch.stack([slot[0, rows] for slot in slots], dim=1).float()

    @staticmethod
    def _keeping(kept: list[torch.Tensor], index: int) -> Any:
        def keep(module: Any, inputs: Any, output: torch.Tensor) -> None:
            kept[index] = output.detach()

        return keep


def class_distributions(
    logits: torch.Tensor, card: CheckpointCard
) -> tuple[torch.Tensor, torch.Tensor]:
    """Class distributions (n, C) and scores (n,) of class logits (n, C).

    Softmax checkpoints: the score is the distribution's greatest value, as FROSS and the paper
    have it. Sigmoid checkpoints: the score is the greatest sigmoid, and the distribution the
    softmax of the logits over a temperature, as in `calibration.SoftmaxCalibration`: merely
    normalised, the many small sigmoids would outweigh the one that is right (Eq. 5).
    """
    probabilities = torch.softmax(logits / card.temperature, dim=-1)
    scores = probabilities if card.class_scores == "softmax" else torch.sigmoid(logits)
    return probabilities, scores.amax(dim=-1)


def _effective_card(card: CheckpointCard, config: PerceptionConfig) -> CheckpointCard:
    changes: dict[str, Any] = {}
    if config.class_scores != "auto" and config.class_scores != card.class_scores:
        # The checkpoint's threshold is one for the scores that it was made for.
        changes = {"class_scores": config.class_scores, "score_threshold": None}
    if config.class_temperature > 0:
        changes["temperature"] = config.class_temperature
    if config.decoder_layers > 0:
        changes["decoder_layers"] = config.decoder_layers
    return CheckpointCard(**{**{f: getattr(card, f) for f in card.__struct_fields__}, **changes})


def _class_names(network: Any, card: CheckpointCard, source: CheckpointSource) -> tuple[str, ...]:
    names = card.classes or tuple(name for _, name in sorted(network.id2label.items()))
    if len(names) != network.num_labels or len(set(names)) != len(names):
        raise ConfigurationError(
            f"{source.parameter} '{source.name}' names {len(set(names))} classes for "
            f"{network.num_labels} outputs: name each once, in `classes` of {CARD_FILE} or in "
            "`id2label` of config.json"
        )
    if all(name == f"LABEL_{index}" for index, name in enumerate(names)):
        raise ConfigurationError(
            f"{source.parameter} '{source.name}' does not name its {len(names)} classes: name them "
            f"in `classes` of {CARD_FILE} in its folder"
        )
    return names


def _use_layers(model: Any, wanted: int, there: int) -> None:
    """Leave out the decoder's later layers: each has class and box heads of its own."""
    if wanted > there:
        raise ConfigurationError(
            f"perception.decoder_layers is {wanted} and the checkpoint has {there}: wanted at most "
            "that, or 0 for what it was made for"
        )
    decoder = model.model.decoder
    for part in ("layers", "class_embed", "bbox_embed"):
        setattr(decoder, part, getattr(decoder, part)[: wanted or there])


def _pixel_boxes(boxes_cxcywh: Float64, width: int, height: int) -> Any:
    """Centre, width and height in [0, 1] to corners in pixels, pixel centres at integers."""
    centres, halves = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    corners = np.hstack([centres - halves, centres + halves])
    return corners * [width, height, width, height] - 0.5


def _normalised(probabilities: Float64) -> Any:
    return probabilities / probabilities.sum(axis=1, keepdims=True)


def _numpy(tensor: torch.Tensor) -> Float64:
    return tensor.detach().cpu().double().numpy()
