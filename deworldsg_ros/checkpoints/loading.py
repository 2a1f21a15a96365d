"""Pretrained networks on torch: find a checkpoint, load it, choose device and precision."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
import transformers

from deworldsg_ros.checkpoints.catalogue import is_hub_id
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

# --- Detectors of `transformers`, and the file name of the relation head.

# Detectors of `AutoModelForObjectDetection` that transformers reads alike, by the model type in
# config.json: a sigmoid for each class, or a softmax with "no object" as the last class. The others
# find text and layouts of documents.
DETECTORS = {
    **dict.fromkeys(("rt_detr", "rt_detr_v2", "d_fine", "deimv2", "rf_detr", "lw_detr"), "sigmoid"),
    **dict.fromkeys(("conditional_detr", "dab-detr", "deformable_detr"), "sigmoid"),
    **dict.fromkeys(("detr", "table-transformer", "yolos"), "softmax"),
}
# File of the relation head, beside the detector's weights.
HEAD_FILE = "egtr_head.safetensors"


# --- Pretrained networks on torch: find a checkpoint, load it, choose device and data type.
#
# Only backends that need torch import this module, and only when they are chosen.

NONE: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class CheckpointSource:
    """The folder or hub id of a checkpoint.

    Attributes:
        parameter: configuration option with this value, for messages.
        name: folder, or hub id.
        local_files_only: whether a hub id is only searched in the local cache.
    """

    parameter: str
    name: str
    local_files_only: bool = True

    @staticmethod
    def find(parameter: str, name: str, *, local_files_only: bool = True) -> CheckpointSource:
        """The source with this folder or hub id; raises ConfigurationError if there is none."""
        if not name:
            raise ConfigurationError(
                f"{parameter} is empty: set it to the folder or hub id of a checkpoint; "
                "docs/dev/models.md lists sources"
            )
        folder = Path(name).expanduser()
        if folder.is_dir():
            return CheckpointSource(parameter, str(folder), local_files_only)
        if not is_hub_id(name):
            raise ConfigurationError(
                f"{parameter} '{name}': there is no such folder; expected a folder with "
                "config.json and model.safetensors, or a hub id"
            )
        return CheckpointSource(parameter, name, local_files_only)

    def file(self, name: str) -> Path | None:
        """The path of a file of the checkpoint; None if it has no file of this name."""
        if Path(self.name).is_dir():
            path = Path(self.name) / name
            return path if path.is_file() else None
        try:
            hub: Any = transformers.utils.hub
            found = hub.cached_file(
                self.name,
                name,
                local_files_only=self.local_files_only,
                _raise_exceptions_for_missing_entries=False,
                _raise_exceptions_for_connection_errors=False,
            )
        except OSError:
            return None
        return Path(found) if found else None

    def config(self, families: Collection[str]) -> Any:
        """The checkpoint's own configuration.

        Args:
            families: accepted model types.

        Raises:
            ConfigurationError: no checkpoint, or one of another model type.
        """
        try:
            found = transformers.AutoConfig.from_pretrained(
                self.name, local_files_only=self.local_files_only
            )
        except Exception as error:  # transformers raises errors of many types
            raise ConfigurationError(self._cannot_load(error)) from error
        if found.model_type not in families:
            raise ConfigurationError(
                f"{self.parameter} '{self.name}' is a checkpoint of {found.model_type}: expected "
                f"{' or '.join(sorted(families))}"
            )
        return found

    def load(
        self,
        model_class: Any,
        config: Any,
        unused: Sequence[str] = (),
        copies: Mapping[str, str] = NONE,
        renamed: Mapping[str, str] = NONE,
    ) -> Any:
        """The network, complete and frozen, in float32 on the CPU.

        Args:
            model_class: class of `transformers` to load it into.
            config: configuration of the checkpoint, from `config`.
            unused: prefixes of parameters that the checkpoint may lack.
            copies: buffers that the checkpoint may lack, with the buffer that has their values.
            renamed: regular expressions of names in the checkpoint, with those of the network.

        Raises:
            ConfigurationError: the checkpoint cannot be read, or lacks parameters.
        """
        logging: Any = transformers.utils.logging
        logging.disable_progress_bar()
        with enough_memory(f"loading '{self.name}'"):
            try:
                model, report = model_class.from_pretrained(
                    self.name,
                    config=config,
                    dtype=torch.float32,
                    use_safetensors=True,  # never a pickle
                    local_files_only=self.local_files_only,
                    output_loading_info=True,
                    key_mapping=dict(renamed) or None,
                )
            except (MemoryError, torch.OutOfMemoryError):
                raise
            except Exception as error:
                raise ConfigurationError(self._cannot_load(error)) from error
        absent = set(report["missing_keys"])
        for name, origin in copies.items():
            if name in absent and origin not in absent:
                model.get_buffer(name).copy_(model.get_buffer(origin))
                absent.remove(name)
        missing = sorted(key for key in absent if not key.startswith(tuple(unused)))
        if missing:
            raise ConfigurationError(
                f"{self.parameter} '{self.name}' lacks {len(missing)} parameters of "
                f"{model_class.__name__}, first '{missing[0]}': download the checkpoint again, or "
                "choose one of the complete network"
            )
        return model.eval().requires_grad_(False)

    def tokenizer(self) -> Any:
        """The tokenizer of a checkpoint that reads text; raises ConfigurationError."""
        try:
            return transformers.AutoTokenizer.from_pretrained(
                self.name, local_files_only=self.local_files_only
            )
        except Exception as error:  # transformers raises errors of many types
            raise ConfigurationError(
                f"{self.parameter} '{self.name}' has no tokenizer ({first_line(error)}), expected "
                "tokenizer.json or its parts: download the checkpoint again"
            ) from error

    def _cannot_load(self, error: Exception) -> str:
        reason = f"{self.parameter} '{self.name}' cannot be loaded ({first_line(error)})"
        folder = "a folder with config.json and model.safetensors of transformers' format"
        if Path(self.name).is_dir():
            return f"{reason}, expected {folder}: download the checkpoint again"
        if self.local_files_only:
            return f"{reason}: run `hf download {self.name}`, or name {folder}"
        return f"{reason}: check the id and the network, or name {folder}"


def read_tensors(path: Path, key: str = "") -> dict[str, torch.Tensor]:
    """A dictionary of tensors that torch saved; code in the file is not executed.

    Args:
        path: the file.
        key: entry of the saved dictionary that holds the tensors; empty = the dictionary itself.

    Raises:
        ConfigurationError: no such file, or its content is not a dictionary of tensors.
    """
    if not path.is_file():
        raise ConfigurationError(f"checkpoint {path}: no such file")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip and torch each have errors of their own
        raise ConfigurationError(
            f"checkpoint {path} cannot be read ({first_line(error)}): expected a file that torch "
            "saved; if it contains more than tensors, save its tensors alone"
        ) from error
    if key:
        content = content.get(key) if isinstance(content, dict) else None
    if not isinstance(content, dict) or not all(map(torch.is_tensor, content.values())):
        expected = (
            f"an entry `{key}`, a dictionary of tensors" if key else "a dictionary of tensors"
        )
        raise ConfigurationError(f"checkpoint {path} has other content: expected {expected}")
    return content


def check_names(found: Collection[str], expected: Collection[str], where: str) -> None:
    """Compare names of parameters.

    Args:
        found: names in a file.
        expected: names of the network.
        where: origin of the parameters, for messages.

    Raises:
        ConfigurationError: names are missing or unknown.
    """
    differences = {
        "missing": sorted(set(expected) - set(found)),
        "unknown": sorted(set(found) - set(expected)),
    }
    parts = [
        f"{len(names)} {kind} ({', '.join(names[:5])}{', …' if len(names) > 5 else ''})"
        for kind, names in differences.items()
        if names
    ]
    if parts:
        raise ConfigurationError(f"{where} has unexpected parameters: {', '.join(parts)}")


def first_line(error: Exception) -> str:
    """The first line of an error's message, or the name of its type."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


def choose_device(parameter: str, choice: str) -> torch.device:
    """The device for `auto`, `cpu` or `cuda`; raises ConfigurationError without a CUDA device."""
    available = torch.cuda.is_available()
    if choice == "cuda" and not available:
        raise ConfigurationError(
            f"{parameter} is 'cuda' and torch {torch.__version__} finds no CUDA device: set it to "
            "'auto' or 'cpu', or install a CUDA build of torch and its driver"
        )
    return torch.device("cuda" if available and choice != "cpu" else "cpu")


def choose_dtype(device: torch.device, *, wide_range: bool = False) -> torch.dtype:
    """float16 on CUDA, float32 on a CPU.

    float16 has more mantissa bits than bfloat16, which boxes need, and all CUDA devices support it.

    Args:
        device: of the network.
        wide_range: prefer bfloat16, in which SAM 2 and 3 were trained and published, if the device
            has it (Ampere and later); it cannot overflow.
    """
    if device.type != "cuda":
        return torch.float32
    # Before Ampere, bfloat16 is emulated.
    native = wide_range and torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.bfloat16 if native else torch.float16


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that a device has too little memory."""
    text = str(error)
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or (
        isinstance(error, RuntimeError)
        and ("can't allocate memory" in text or "out of memory" in text)
    )


@contextmanager
def enough_memory(action: str, remedy: str = "") -> Iterator[None]:
    """Raise ConfigurationError if the block runs out of memory, on the CPU or a GPU.

    Args:
        action: what the block does, for the message.
        remedy: the advice in the message.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        remedy = remedy or "choose a smaller checkpoint, or free memory of the device"
        raise ConfigurationError(f"out of memory while {action}: {remedy}") from error


# --- Half precision is used only if it gives the results of single precision; NaN is an error.

logger = logging.getLogger(__name__)

# Relative error of the results in half precision (of norms). Measured on the small networks of the
# tests, with random weights: float16 0.05 % (V-JEPA 2, DINOv2), 0.2 % (SAM 2, SAM 3), 0.3 %
# (RT-DETR), 2 % (SAM), 10 % (RT-DETRv2); bfloat16 1 % (SAM 3), 4 % (SAM 2), 47 % (SAM). Trained
# networks were not measured. A network that overflows gives NaN.
MAX_RELATIVE_ERROR = 0.1
# A network, its data type → some of its results on an input that `run` makes, any shape.
Run = Callable[[Any, torch.dtype], torch.Tensor]


def in_best_precision(
    model: Any, device: torch.device, half: torch.dtype, run: Run, what: str
) -> tuple[Any, torch.dtype]:
    """The network on its device: in half precision if that is exact enough, else in single.

    Both precisions run once. The network is twice in memory until this function returns.

    Args:
        model: in float32.
        device: where it runs.
        half: float16 or bfloat16; float32 = no comparison.
        run: results of a network on an image or a clip.
        what: name of the network, for the log.
    """
    single = model.to(device, torch.float32)
    if half == torch.float32:
        return single, half
    expected = run(single, torch.float32).detach().float()
    error = _error(single, half, run, expected)
    if error <= MAX_RELATIVE_ERROR:
        return single.to(half), half
    reason = "NaN or infinity" if error == float("inf") else f"a relative error of {error:.1%}"
    logger.warning(
        "%s: %s gives %s against float32 on the test input; it runs in float32, which is slower "
        "and takes twice the memory",
        *(what, str(half).removeprefix("torch."), reason),
    )
    return single, torch.float32


def _error(single: Any, half: torch.dtype, run: Run, expected: torch.Tensor) -> float:
    """Relative error of the results in half precision; infinity if they are not finite."""
    try:
        found = run(copy.deepcopy(single).to(half), half).detach().float()
    except RuntimeError as error:
        if is_out_of_memory(error):
            raise
        logger.warning("%s is not supported here (%s)", half, str(error).splitlines()[0])
        return float("inf")
    if not bool(torch.isfinite(found).all()):
        return float("inf")
    return float((found - expected).norm() / expected.norm().clamp_min(1e-12))


def require_finite(values: torch.Tensor, reason: str, what: str) -> None:
    """Refuse results with NaN or infinity, which would pass for "nothing found".

    Raises:
        RefusedInput: under `reason`.
    """
    bad = int((~torch.isfinite(values)).sum())
    if bad:
        raise RefusedInput(
            reason,
            f"{bad} of {values.numel()} values of {what} are NaN or infinite in "
            f"{str(values.dtype).removeprefix('torch.')}: run on the CPU (perception.device: cpu), "
            "or report it with `deworldsg models inspect`",
        )


def noise_pattern(*shape: int) -> torch.Tensor:
    """uint8 values of a fixed random image or clip, on the CPU."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
