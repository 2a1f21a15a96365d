"""Detectors of free text on torch: OWLv2, Grounding DINO, OmDet-Turbo, and SAM 3's concepts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
import transformers

from deworldsg_ros.checkpoints.cards import DETECTOR_CARD, read_detector_card
from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
    in_best_precision,
    noise_pattern,
    require_finite,
)
from deworldsg_ros.config import MAX_WORDS, PerceptionConfig
from deworldsg_ros.perception.backends.embedded import SoftmaxCalibration, combine
from deworldsg_ros.perception.backends.image_tensors import Preprocessing, resize
from deworldsg_ros.perception.backends.sam import as_patch
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.scene.arrays import Float64, Int64, UInt8, corners_of
from deworldsg_ros.scene.camera import MaskPatch
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.limits import MAX_NAMES, check_names

# --- Four networks: words become a prompt, once; an image and a prompt become boxes with scores.


class Candidates(NamedTuple):
    """What a network found in an image.

    Attributes:
        boxes_xyxy: (k, 4) float64 pixels, pixel centres at integers.
        scores: (k, W) float64 in [0, 1], of each word.
        masks: k masks; None = the network has none.
    """

    boxes_xyxy: Float64
    scores: Float64
    masks: tuple[MaskPatch, ...] | None = None


class TextNetwork(ABC):
    """A network that finds what a text names.

    Args:
        source: its checkpoint.
        config: configuration of the checkpoint.
        device: where it runs.

    Raises:
        ConfigurationError: the checkpoint is not complete, or there is too little memory.

    Attributes:
        model_class: class of `transformers`.
        threshold: minimum score that transformers' own post-processing has by default.
        wide_range: whether the network was trained in bfloat16 and runs in it on CUDA.
        max_tokens: maximum number of tokens of a word.
    """

    model_class: Any = transformers.AutoModelForZeroShotObjectDetection
    threshold = 0.25
    wide_range = False
    max_tokens = 77

    def __init__(self, source: CheckpointSource, config: Any, device: torch.device) -> None:
        self.device = device
        self.preprocess = Preprocessing.of_checkpoint(source, None)
        self.tokenizer = source.tokenizer()
        self.model = source.load(self.model_class, config)
        with enough_memory("loading the detector", "choose a smaller perception.detector_path"):
            half = choose_dtype(device, wide_range=self.wide_range)
            self.model, self.dtype = in_best_precision(
                self.model, device, half, self._test_scores, "the detector"
            )

    @abstractmethod
    def encode(self, words: Sequence[str]) -> Any:
        """The prompt of the words."""

    @abstractmethod
    def find(self, rgb: UInt8, prompt: Any, threshold: float) -> Candidates:
        """What `rgb`, (H, W, 3) uint8, shows of a prompt; scores below a threshold may be left out.

        Raises:
            RefusedInput: ``detector_error``.
        """

    def check(self, words: Sequence[str]) -> None:
        """Raise ConfigurationError for a word with too many tokens, or none."""
        for word, tokens in zip(words, self.tokenizer(list(words))["input_ids"]):
            if len(tokens) > self.max_tokens:
                raise ConfigurationError(
                    f"perception.words '{word}' has {len(tokens)} tokens, expected at most "
                    f"{self.max_tokens} of this detector: use a shorter one"
                )

    def tokens(self, texts: Sequence[str], length: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Token ids and attention mask, (n, length) int64, of texts; longer ones are cut."""
        made = self.tokenizer(
            list(texts),
            padding="max_length",
            truncation=True,
            max_length=length,
            return_tensors="pt",
        )
        return made["input_ids"].to(self.device), made["attention_mask"].to(self.device)

    def pixels(self, rgb: UInt8) -> torch.Tensor:
        """(1, 3, height, width) input of an image."""
        return self.preprocess(rgb, self.device, self.dtype)

    @torch.inference_mode()
    def _test_scores(self, model: Any, dtype: torch.dtype) -> torch.Tensor:
        """Sorted scores of two words in a fixed image."""
        self.model, self.dtype = model, dtype
        prompt = self.encode(("chair", "table"))
        image = noise_pattern(*self.preprocess.size_of(480, 640), 3).numpy()
        return torch.from_numpy(self.find(image, prompt, 0.0).scores).amax(dim=1).sort().values


class Owlv2(TextNetwork):
    """OWLv2: an image becomes a square, each patch is rated with each word."""

    threshold = 0.1

    def __init__(self, source: CheckpointSource, config: Any, device: torch.device) -> None:
        self.max_tokens = int(config.text_config.max_position_embeddings)
        super().__init__(source, config, device)

    def check(self, words: Sequence[str]) -> None:
        """As `TextNetwork`, for the whole text."""
        super().check([_photo(word) for word in words])

    @torch.inference_mode()
    def encode(self, words: Sequence[str]) -> Any:
        """(1, W, d) embeddings."""
        ids, mask = self.tokens([_photo(word) for word in words], self.max_tokens)
        texts = self.model.owlv2.get_text_features(ids, mask).pooler_output
        return (texts / torch.linalg.norm(texts, dim=-1, keepdim=True))[None]

    @torch.inference_mode()
    def find(self, rgb: UInt8, prompt: Any, threshold: float) -> Candidates:
        """One candidate for each patch; see `TextNetwork`."""
        features, _ = self.model.image_embedder(self.pixels(rgb))
        patches = features.flatten(1, 2)
        logits, _ = self.model.class_predictor(patches, prompt)
        side = max(rgb.shape[:2])
        boxes = self.model.box_predictor(patches, features)
        return _candidates(boxes[0], logits[0], side, side)


class GroundingDino(TextNetwork):
    """Grounding DINO and MM Grounding DINO: all words are one text, joined by full stops.

    The logit of a word is the largest of its tokens, as for transformers; full stops, which have
    logits, too, are left out.
    """

    def __init__(self, source: CheckpointSource, config: Any, device: torch.device) -> None:
        self.max_tokens = int(config.max_text_len)
        super().__init__(source, config, device)
        backbone = self.model.model.text_backbone
        self.model.model.text_backbone = _LastResult(backbone)

    def check(self, words: Sequence[str]) -> None:
        """Raise ConfigurationError for words without tokens, or with too many as a whole."""
        ids, spans = self._text(words)
        for word, (start, end) in zip(words, spans):
            if start == end:
                raise ConfigurationError(f"perception.words '{word}' has no token: use another")
        if len(ids) > self.max_tokens:
            raise ConfigurationError(
                f"perception.words has {len(words)} words with {len(ids)} tokens, expected at most "
                f"{self.max_tokens} tokens of this detector: name fewer"
            )

    def encode(self, words: Sequence[str]) -> Any:
        """Token ids (1, T), and the first and last token of each word."""
        ids, spans = self._text(words)
        return torch.tensor([ids], device=self.device), spans

    @torch.inference_mode()
    def find(self, rgb: UInt8, prompt: Any, threshold: float) -> Candidates:
        """One candidate for each query; see `TextNetwork`."""
        ids, spans = prompt
        output = self.model(
            pixel_values=self.pixels(rgb), input_ids=ids, attention_mask=torch.ones_like(ids)
        )
        words = [output.logits[0, :, start:end].amax(dim=1) for start, end in spans]
        height, width = rgb.shape[:2]
        return _candidates(output.pred_boxes[0], torch.stack(words, dim=1), width, height)

    def _text(self, words: Sequence[str]) -> tuple[list[int], list[tuple[int, int]]]:
        tokenizer = self.tokenizer
        # These two end a phrase.
        phrases = [word.lower().replace(".", " ").replace("?", " ") for word in words]
        stop = tokenizer.convert_tokens_to_ids(".")
        ids, spans = [tokenizer.cls_token_id], []
        for tokens in tokenizer(phrases, add_special_tokens=False)["input_ids"]:
            spans.append((len(ids), len(ids) + len(tokens)))
            ids += [*tokens, stop]
        return [*ids, tokenizer.sep_token_id], spans


class OmDetTurbo(TextNetwork):
    """OmDet-Turbo: words and a task; it keeps the embeddings of words by itself."""

    threshold = 0.3

    def __init__(self, source: CheckpointSource, config: Any, device: torch.device) -> None:
        config.cache_size = MAX_WORDS
        super().__init__(source, config, device)

    def encode(self, words: Sequence[str]) -> Any:
        """Arguments of the network."""
        classes, classes_mask = self.tokens(words, self.max_tokens)
        task, task_mask = self.tokens([f"Detect {', '.join(words)}."], self.max_tokens)
        return {
            **{"classes_input_ids": classes, "classes_attention_mask": classes_mask},
            **{"tasks_input_ids": task, "tasks_attention_mask": task_mask},
            "classes_structure": torch.tensor([len(words)], device=self.device),
        }

    @torch.inference_mode()
    def find(self, rgb: UInt8, prompt: Any, threshold: float) -> Candidates:
        """One candidate for each query; see `TextNetwork`."""
        output = self.model(pixel_values=self.pixels(rgb), **prompt)
        boxes, logits = output.decoder_coord_logits[0], output.decoder_class_logits[0]
        return _candidates(boxes, logits, rgb.shape[1], rgb.shape[0])


class Sam3Concepts(TextNetwork):
    """The part of SAM 3 that finds all objects of a concept, with their masks.

    An image is encoded once, and searched for one word after the other.
    """

    model_class = transformers.Sam3Model
    threshold = 0.5
    wide_range = True
    max_tokens = 32

    @torch.inference_mode()
    def encode(self, words: Sequence[str]) -> Any:
        """Features and attention mask of each word."""
        ids, mask = self.tokens(words, self.max_tokens)
        features = self.model.get_text_features(ids, mask)
        return [
            (transformers.modeling_outputs.BaseModelOutputWithPooling(pooler_output=text), used)
            for text, used in zip(features.pooler_output.split(1), mask.split(1))
        ]

    @torch.inference_mode()
    def find(self, rgb: UInt8, prompt: Any, threshold: float) -> Candidates:
        """One candidate for each word and query with that score; see `TextNetwork`."""
        height, width = rgb.shape[:2]
        image = self.model.get_vision_features(self.pixels(rgb))
        boxes, scores, masks = [np.zeros((0, 4))], [np.zeros((0, len(prompt)))], []
        for column, (text, used) in enumerate(prompt):
            output = self.model(vision_embeds=image, text_embeds=text, attention_mask=used)
            rated = output.pred_logits[0].sigmoid() * output.presence_logits[0].sigmoid()
            require_finite(rated, "detector_error", "the scores")
            require_finite(output.pred_boxes, "detector_error", "the boxes")
            rows = torch.nonzero(rated >= threshold)[:, 0]
            found = np.zeros((len(rows), len(prompt)))
            found[:, column] = rated[rows].double().cpu().numpy()
            scores.append(found)
            corners = output.pred_boxes[0][rows].double().cpu().numpy()
            boxes.append(corners * [width, height, width, height] - 0.5)
            inside = output.pred_masks[0][rows][None].float().sigmoid()
            if len(rows):
                whole = resize(inside, (height, width))[0] > 0.5
                masks += [as_patch(mask) for mask in whole.cpu().numpy()]
        return Candidates(np.concatenate(boxes), np.concatenate(scores), tuple(masks))


class _LastResult(torch.nn.Module):
    """A text backbone that keeps its result until the tokens change."""

    def __init__(self, backbone: torch.nn.Module) -> None:
        super().__init__()
        self._backbone = backbone
        self._ids = torch.empty(0)
        self._result: Any = None

    def forward(self, ids: torch.Tensor, *rest: Any, **options: Any) -> Any:
        if self._result is None or not torch.equal(self._ids, ids):
            self._ids, self._result = ids, self._backbone(ids, *rest, **options)
        return self._result


def _photo(word: str) -> str:
    """The text that OWLv2 was trained with."""
    return f"a photo of a {word}"


def _candidates(
    boxes_cxcywh: torch.Tensor, logits: torch.Tensor, width: int, height: int
) -> Candidates:
    """Boxes (k, 4) in [0, 1] and logits (k, W) as candidates in an image of this size."""
    require_finite(logits, "detector_error", "the class logits")
    require_finite(boxes_cxcywh, "detector_error", "the boxes")
    corners = corners_of(boxes_cxcywh.double().cpu().numpy())
    scores = logits.float().sigmoid().double().cpu().numpy()
    return Candidates(corners * [width, height, width, height] - 0.5, scores)


NETWORKS: dict[str, type[TextNetwork]] = {
    "owlv2": Owlv2,
    "grounding-dino": GroundingDino,
    "mm-grounding-dino": GroundingDino,
    "omdet-turbo": OmDetTurbo,
    "sam3": Sam3Concepts,
    "sam3_video": Sam3Concepts,
}

# --- The detector: words that may change, and columns that stay.

# Not fitted: there are no words to fit it to.
CALIBRATION = SoftmaxCalibration(temperature=1.0)


class Search(NamedTuple):
    """What the detector looks for.

    Attributes:
        words: names of the prompt.
        classes: names of the columns: all words so far.
        columns: (W,) int64, column of each word.
        prompt: of the network.
    """

    words: tuple[str, ...]
    classes: tuple[str, ...]
    columns: Int64
    prompt: Any


class OpenVocabularyDetector:
    """Detector of what words name; the words may change between two frames.

    A word that was once used keeps its column. Words that are no longer used get no probability.
    Boxes that nearly coincide are one object, even if one is a "mug" and one a "red mug".

    Args:
        config: the section `perception`: `detector_path`, `device` and `words`.

    Raises:
        ConfigurationError: no checkpoint, another architecture, no CUDA, no memory, or words that
            cannot be used.

    Attributes:
        default_score_threshold: minimum score of an object, of the card or of the architecture.
        network: the network.
    """

    def __init__(self, config: PerceptionConfig) -> None:
        source = CheckpointSource.find("perception.detector_path", config.detector_path)
        device = choose_device("perception.device", config.device)
        found = source.config(NETWORKS)
        card = read_detector_card(source.file(DETECTOR_CARD))
        self.network = NETWORKS[found.model_type](source, found, device)
        self.default_score_threshold = (
            self.network.threshold if card.score_threshold is None else card.score_threshold
        )
        self._search = Search((), (), np.zeros(0, np.int64), None)
        self.use_words(config.words)
        # The first pass allocates memory and tunes kernels; do it at start-up.
        self.detect(np.zeros((480, 640, 3), np.uint8), 1.0)

    @property
    def classes(self) -> tuple[str, ...]:
        """All words so far, in the order of the distributions."""
        return self._search.classes

    def check_words(self, words: Sequence[str]) -> None:
        """Raise ConfigurationError for words that cannot be used, and name the first."""
        if not words:
            raise ConfigurationError(
                "perception.words is empty: name what the detector shall look for, as in [mug, "
                "red mug, drill]"
            )
        repeated = next((word for word in words if words.count(word) > 1), None)
        if repeated is not None:
            raise ConfigurationError(f"perception.words names '{repeated}' twice: name it once")
        try:
            check_names(words)
        except ValueError as error:
            raise ConfigurationError(f"perception.words: {error}") from error
        if len({*self.classes, *words}) > MAX_NAMES:
            raise ConfigurationError(
                f"perception.words: more than {MAX_NAMES} words since the start: start again"
            )
        self.network.check(words)

    def use_words(self, words: Sequence[str], before: Sequence[str] = ()) -> None:
        """Look for other words from the next frame on.

        Args:
            words: all of them.
            before: classes that keep their columns: those of another detector, which this replaces.

        Raises:
            ConfigurationError: as `check_words`; the old words stay.
        """
        self.check_words(words)
        classes = tuple(dict.fromkeys([*before, *self.classes, *words]))
        columns = np.array([classes.index(word) for word in words], np.int64)
        self._search = Search(tuple(words), classes, columns, self.network.encode(words))

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """Objects of `rgb`, (H, W, 3) uint8, with score >= `score_threshold`, best first."""
        search = self._search
        boxes, scores, masks = self.network.find(rgb, search.prompt, score_threshold)
        found = combine(boxes, scores, score_threshold, CALIBRATION, masks)
        probabilities = np.zeros((len(found), len(search.classes)))
        probabilities[:, search.columns] = found.class_probabilities
        return replace(found, class_probabilities=probabilities, classes=search.classes)
