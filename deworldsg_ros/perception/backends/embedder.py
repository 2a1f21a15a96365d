"""CLIP and SigLIP on torch: crops of objects become vectors, which texts can be compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from transformers import CLIPVisionModelWithProjection, SiglipVisionModel

from deworldsg_ros.checkpoints.loading import (
    CheckpointSource,
    choose_device,
    choose_dtype,
    enough_memory,
    in_best_precision,
    noise_pattern,
    require_finite,
)
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.graph.embeddings import one_tower
from deworldsg_ros.perception.backends.image_tensors import Preprocessing
from deworldsg_ros.scene.arrays import Float32, UInt8

# The networks of images, by the model type of the whole checkpoint. SigLIP 2 of a fixed size of
# image has the type of SigLIP.
FAMILIES: dict[str, Any] = {"clip": CLIPVisionModelWithProjection, "siglip": SiglipVisionModel}
# Published normalisations, for checkpoints without preprocessor_config.json.
CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
HALF = (0.5, 0.5, 0.5)
NORMALISATIONS = {"clip": (CLIP_MEAN, CLIP_STD), "siglip": (HALF, HALF)}


class ImageEmbedder:
    """See `protocols.Embedder`; on the image tower of CLIP, SigLIP, or SigLIP 2.

    Args:
        config: the section `perception`: `embedder` and `device`.

    Raises:
        ConfigurationError: no checkpoint, another architecture, no CUDA, no memory.
    """

    def __init__(self, config: PerceptionConfig) -> None:
        source = CheckpointSource.find("perception.embedder", config.embedder)
        self.model_name = config.embedder
        whole = source.config(FAMILIES)
        vision, kind = whole.vision_config, whole.model_type
        if kind == "clip":
            vision.projection_dim = whole.projection_dim
        side = vision.image_size
        mean, std = NORMALISATIONS[kind]
        default = Preprocessing(side, side, mean, std)
        found = Preprocessing.of_checkpoint(source, default)
        # The crops are squares, and the network has one size.
        self._preprocessing = replace(default, mean=found.mean, std=found.std)
        self._device = choose_device("perception.device", config.device)
        with one_tower():
            model = source.load(FAMILIES[kind], vision)
        with enough_memory("loading the embedder", "choose a smaller perception.embedder"):
            half = choose_dtype(self._device)
            self._model, self._dtype = in_best_precision(
                model, self._device, half, self._test, "the embedder"
            )

    def embed(self, crops: Sequence[UInt8]) -> Float32:
        """See `protocols.Embedder`."""
        return self._features(self._model, self._dtype, crops).cpu().numpy()

    def _test(self, model: Any, dtype: torch.dtype) -> torch.Tensor:
        return self._features(model, dtype, [noise_pattern(64, 64, 3).numpy()])

    @torch.inference_mode()
    def _features(self, model: Any, dtype: torch.dtype, crops: Sequence[UInt8]) -> torch.Tensor:
        pixels = [self._preprocessing(crop, self._device, dtype) for crop in crops]
        output = model(pixel_values=torch.cat(pixels))
        found = getattr(output, "image_embeds", None)
        features: torch.Tensor = (output.pooler_output if found is None else found).float()
        require_finite(features, "embedder_error", "the embeddings")
        return features
