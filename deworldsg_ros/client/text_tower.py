"""Texts as vectors of CLIP or SigLIP, to compare with what objects look like."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from deworldsg_ros.scene.arrays import Float32
from deworldsg_ros.scene.errors import ClientError

# A longer text is cut by the networks, which take 64 or 77 tokens.
MAX_TEXT = 500


def embed_text(model: str, text: str) -> Float32:
    """The vector (D,) of a text, not scaled.

    Args:
        model: of the embeddings: CLIP, SigLIP or SigLIP 2, a folder or a hub id in the local cache.
        text: what is looked for, e.g. "something to drink from".

    Raises:
        ClientError: without torch and transformers, or without the model.
    """
    if not text.strip() or len(text) > MAX_TEXT:
        raise ClientError(f"text of {len(text)} characters: expected 1 to {MAX_TEXT}")
    network, tokenizer, padding = _tower(model)
    import torch

    length = network.config.max_position_embeddings
    tokens = tokenizer(
        text.lower(), padding=padding, truncation=True, max_length=length, return_tensors="pt"
    )
    with torch.inference_mode():
        # SigLIP was trained without a mask of the padding.
        output = network(input_ids=tokens["input_ids"])
    found = getattr(output, "text_embeds", None)
    features = output.pooler_output if found is None else found
    return np.asarray(features[0].float().numpy(), np.float32)


@contextmanager
def one_tower() -> Iterator[None]:
    """Load one of the two towers of a checkpoint, without a list of the other one in the log."""
    logger = logging.getLogger("transformers")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


@functools.lru_cache(maxsize=2)
def _tower(model: str) -> tuple[Any, Any, Any]:
    """The network of texts, its tokenizer, and the padding of its training."""
    try:
        import torch
        import transformers
    except ImportError as error:
        raise ClientError(
            f"texts are compared with objects by torch and transformers ({error}): pip install "
            "torch transformers"
        ) from error
    families = {
        "clip": transformers.CLIPTextModelWithProjection,
        "siglip": transformers.SiglipTextModel,
    }
    try:
        with one_tower():
            return _load(transformers, model, families, torch.float32)
    except ClientError:
        raise
    except Exception as error:  # transformers raises errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise ClientError(
            f"the embeddings are of {model!r}, whose texts cannot be loaded ({reason}): expected a "
            f"folder or hub id in the local cache (hf download {model}), with its tokenizer"
        ) from error


def _load(
    transformers: Any, model: str, families: dict[str, Any], dtype: Any
) -> tuple[Any, Any, Any]:
    """See `_tower`; raises errors of many types."""
    transformers.utils.logging.disable_progress_bar()
    whole = transformers.AutoConfig.from_pretrained(model, local_files_only=True)
    if whole.model_type not in families:
        raise ClientError(
            f"the embeddings are of {model!r}, a checkpoint of {whole.model_type}: expected "
            "CLIP or SigLIP, which have texts, too"
        )
    config = whole.text_config
    if whole.model_type == "clip":
        config.projection_dim = whole.projection_dim
    network = families[whole.model_type].from_pretrained(
        model, config=config, dtype=dtype, use_safetensors=True, local_files_only=True
    )
    tokenizer = transformers.AutoTokenizer.from_pretrained(model, local_files_only=True)
    padding = "max_length" if whole.model_type == "siglip" else False
    return network.eval(), tokenizer, padding
