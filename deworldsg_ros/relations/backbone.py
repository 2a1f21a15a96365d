"""Frozen backbones on torch: device, precision, loading, and clips in, features out."""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from numpy.typing import NDArray

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.preprocessing import ClipGeometry, normalise, resize_and_crop
from deworldsg_ros.relations.probe import BackboneIdentity
from deworldsg_ros.scene.errors import ConfigurationError

Float32 = NDArray[np.float32]

# Values of each tensor that its fingerprint is made of.
FINGERPRINT_SAMPLES = 64


@dataclass(frozen=True)
class FrozenBackbone:
    """A pretrained network that is only read.

    Attributes:
        identity: what a probe is bound to.
        geometry: how frames are resized.
        device: where it runs.
        dtype: of its activations.
        features: (B, T, 3, S, S) normalised to (B, d), the network itself.
        quantised: whether its linear layers are in 8-bit integers.
    """

    identity: BackboneIdentity
    geometry: ClipGeometry
    device: torch.device
    dtype: torch.dtype
    features: Callable[[torch.Tensor], torch.Tensor]
    quantised: bool = False

    @property
    def description(self) -> str:
        """Everything that a feature depends on besides the clip, but for the device."""
        number = "int8" if self.quantised else str(self.dtype).removeprefix("torch.")
        return f"{self.identity}; {self.geometry}; {number}"

    def encode(self, clips: Sequence[NDArray[np.uint8]]) -> Float32:
        """Features of clips, all of them in one batch.

        Args:
            clips: each (T, h, w, 3) uint8 RGB; sizes may differ.

        Returns:
            (n, d) float32.

        Raises:
            ConfigurationError: where the device has too little memory for the batch.
            ValueError: for a clip of another length.
        """
        wanted = self.identity.clip_length
        for clip in clips:
            if len(clip) != wanted:
                raise ValueError(f"clip of {len(clip)} frames: wanted {wanted}")
        if not clips:
            return np.zeros((0, self.identity.feature_dim), np.float32)
        on_cuda = self.device.type == "cuda"
        with enough_memory(f"encoding {len(clips)} clips"), torch.inference_mode():
            images = torch.stack([resize_and_crop(clip, self.geometry) for clip in clips])
            if on_cuda:
                images = images.pin_memory().to(self.device, non_blocking=True)
            features = self.features(normalise(images, self.dtype))
            return features.to("cpu", torch.float32).numpy()


def choose_device(wanted: str) -> torch.device:
    """`auto`, `cpu` or `cuda` as a device; raises ConfigurationError where there is no CUDA."""
    there = torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise ConfigurationError(
            f"relations.device is 'cuda' and torch {torch.__version__} finds no CUDA device: set "
            "it to 'auto' or 'cpu', or install a CUDA build of torch and its driver"
        )
    return torch.device("cuda" if there and wanted != "cpu" else "cpu")


def choose_dtype(device: torch.device) -> torch.dtype:
    """Half precision on CUDA, of the kind that the device computes with; float32 on a CPU."""
    if device.type != "cuda":
        return torch.float32
    # The backbones were trained in bfloat16; before Ampere it is only emulated.
    major, _ = torch.cuda.get_device_capability(device)
    return torch.bfloat16 if major >= 8 else torch.float16


def load_checkpoint(
    config: RelationsConfig,
    family: str,
    model_class: Any,
    changes: Callable[[Any], dict[str, int]] = lambda _: {},
    unused: Sequence[str] = (),
) -> torch.nn.Module:
    """A pretrained model of `transformers`, whole and frozen, on the CPU in float32.

    Args:
        config: section ``relations``.
        family: model type that the checkpoint must have.
        model_class: class that it is loaded into.
        changes: fields of its configuration to set, given that configuration.
        unused: prefixes of parameters that need not be there.

    Raises:
        ConfigurationError: where there is no checkpoint, or it is another model's, or not whole.
    """
    source = _source(config)
    options = {"local_files_only": config.local_files_only}
    logging: Any = transformers.utils.logging
    logging.disable_progress_bar()
    with enough_memory(f"loading '{source}'"):
        try:
            found = transformers.AutoConfig.from_pretrained(source, **options)
        except Exception as error:  # transformers raises whatever its parts raise
            raise ConfigurationError(_cannot_load(config, source, error)) from error
        if found.model_type != family:
            raise ConfigurationError(
                f"relations.model_path '{source}' is a {found.model_type} checkpoint: world model "
                f"'{family}' wants one of {family}"
            )
        try:
            model, report = model_class.from_pretrained(
                source,
                **options,
                **changes(found),
                dtype=torch.float32,
                output_loading_info=True,
            )
        except (ConfigurationError, MemoryError, torch.OutOfMemoryError):
            raise
        except Exception as error:
            raise ConfigurationError(_cannot_load(config, source, error)) from error
    missing = sorted(key for key in report["missing_keys"] if not key.startswith(tuple(unused)))
    if missing:
        raise ConfigurationError(
            f"checkpoint '{source}' lacks {len(missing)} parameters of {model_class.__name__}, "
            f"first '{missing[0]}': get it again, or choose the checkpoint of the whole backbone"
        )
    module: torch.nn.Module = model
    return module.eval().requires_grad_(False)


def place(
    config: RelationsConfig, model: torch.nn.Module
) -> tuple[torch.nn.Module, torch.device, torch.dtype]:
    """The model on its device, in its precision, quantised where that is configured.

    Raises:
        ConfigurationError: no CUDA, no memory, or quantisation that is not to be had.
    """
    device = choose_device(config.device)
    dtype = choose_dtype(device)
    if config.quantise:
        return quantise(model, device), device, dtype
    with enough_memory(f"moving the backbone to {device}"):
        return model.to(device, dtype), device, dtype


def quantise(model: torch.nn.Module, device: torch.device) -> torch.nn.Module:
    """Linear layers in 8-bit integers, activations quantised as they come."""
    if device.type != "cpu":
        raise ConfigurationError(
            "relations.quantise is for the CPU: set relations.device to 'cpu', or quantise to false"
        )
    try:
        quantization: Any = importlib.import_module("torch.ao.quantization")
    except ImportError as error:
        raise ConfigurationError(
            f"torch {torch.__version__} has no dynamic quantisation: set relations.quantise to "
            "false, or install torch 2.13 or older"
        ) from error
    quantised: torch.nn.Module = quantization.quantize_dynamic(
        model, {torch.nn.Linear}, dtype=torch.qint8
    )
    return quantised


def fingerprint(model: torch.nn.Module) -> str:
    """16 hexadecimal digits that depend on names, shapes and a sample of all parameters."""
    digest = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        flat = value.detach().flatten()
        step = max(1, flat.numel() // FINGERPRINT_SAMPLES)
        sample = flat[::step][:FINGERPRINT_SAMPLES].to("cpu", torch.float32).numpy()
        digest.update(f"{name} {tuple(value.shape)}".encode())
        digest.update(sample.astype("<f4").tobytes())
    return digest.hexdigest()[:16]


@contextmanager
def enough_memory(what: str) -> Iterator[None]:
    """Turn running out of memory, of whichever device, into a ConfigurationError."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, (MemoryError, torch.OutOfMemoryError)) or (
            "can't allocate memory" in str(error) or "out of memory" in str(error)
        ):
            raise ConfigurationError(
                f"out of memory while {what}: lower relations.batch_size or relations.image_size, "
                "choose a smaller checkpoint, or free the device"
            ) from error
        raise


def _source(config: RelationsConfig) -> str:
    path = config.model_path
    if not path:
        raise ConfigurationError(
            f"relations.model_path is empty: world model '{config.world_model}' wants the folder "
            "or hub id of a checkpoint; docs/models.md tells where to get one"
        )
    folder = Path(path).expanduser()
    if folder.is_dir():
        return str(folder)
    if path.startswith(("/", "~", ".")) or path.count("/") != 1:
        raise ConfigurationError(
            f"relations.model_path '{path}': there is no such folder; wanted one with config.json "
            "and model.safetensors, or a hub id"
        )
    return path


def _cannot_load(config: RelationsConfig, source: str, error: Exception) -> str:
    first_line = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
    hint = "wanted a folder with config.json and model.safetensors of transformers' format"
    if not Path(source).is_dir():
        hint = "download it to a folder and name that"
        if config.local_files_only:
            hint += ", or set relations.local_files_only to false"
    return f"checkpoint '{source}' cannot be loaded ({first_line}): {hint}"
