"""Pretrained networks on torch: where they are, what they are, and on which device they run.

Imported by a backend that needs torch, and only when it is chosen.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import transformers

from deworldsg_ros.scene.errors import ConfigurationError


@dataclass(frozen=True)
class CheckpointSource:
    """Where a checkpoint comes from.

    Attributes:
        parameter: the parameter that names it, for messages.
        name: folder, or hub id.
        local_files_only: whether a hub id is looked for in the local cache only.
    """

    parameter: str
    name: str
    local_files_only: bool = True

    @staticmethod
    def find(parameter: str, name: str, *, local_files_only: bool = True) -> CheckpointSource:
        """The source that a parameter names; raises ConfigurationError where there is none."""
        if not name:
            raise ConfigurationError(
                f"{parameter} is empty: set it to the folder or hub id of a checkpoint; "
                "docs/models.md tells where to get one"
            )
        folder = Path(name).expanduser()
        if folder.is_dir():
            return CheckpointSource(parameter, str(folder), local_files_only)
        if name.startswith(("/", "~", ".")) or name.count("/") != 1:
            raise ConfigurationError(
                f"{parameter} '{name}': there is no such folder; wanted one with config.json and "
                "model.safetensors, or a hub id"
            )
        return CheckpointSource(parameter, name, local_files_only)

    def file(self, name: str) -> Path | None:
        """A file of the checkpoint beside its weights; None where it has none of that name."""
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
            families: the model types that will do.

        Raises:
            ConfigurationError: nothing there, or another architecture.
        """
        try:
            found = transformers.AutoConfig.from_pretrained(
                self.name, local_files_only=self.local_files_only
            )
        except Exception as error:  # transformers raises whatever its parts raise
            raise ConfigurationError(self._cannot_load(error)) from error
        if found.model_type not in families:
            raise ConfigurationError(
                f"{self.parameter} '{self.name}' is a checkpoint of {found.model_type}: wanted "
                f"{' or '.join(sorted(families))}"
            )
        return found

    def load(self, model_class: Any, config: Any, unused: Sequence[str] = ()) -> Any:
        """The network, whole, frozen, in float32 on the CPU.

        Args:
            model_class: of transformers.
            config: the checkpoint's, from `config`.
            unused: prefixes of parameters that need not be there.

        Raises:
            ConfigurationError: it cannot be read, or is not whole.
        """
        logging: Any = transformers.utils.logging
        logging.disable_progress_bar()
        with enough_memory(f"loading '{self.name}'"):
            try:
                model, report = model_class.from_pretrained(
                    self.name,
                    config=config,
                    dtype=torch.float32,
                    local_files_only=self.local_files_only,
                    output_loading_info=True,
                )
            except (MemoryError, torch.OutOfMemoryError):
                raise
            except Exception as error:
                raise ConfigurationError(self._cannot_load(error)) from error
        missing = sorted(key for key in report["missing_keys"] if not key.startswith(tuple(unused)))
        if missing:
            raise ConfigurationError(
                f"{self.parameter} '{self.name}' lacks {len(missing)} parameters of "
                f"{model_class.__name__}, first '{missing[0]}': get the checkpoint again, or the "
                "one of the whole network"
            )
        return model.eval().requires_grad_(False)

    def _cannot_load(self, error: Exception) -> str:
        first_line = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        reason = f"{self.parameter} '{self.name}' cannot be loaded ({first_line})"
        folder = "a folder with config.json and model.safetensors of transformers' format"
        if Path(self.name).is_dir():
            return f"{reason}, expected {folder}: download the checkpoint again"
        if self.local_files_only:
            return f"{reason}: run `hf download {self.name}`, or name {folder}"
        return f"{reason}: check the id and the network, or name {folder}"


def choose_device(parameter: str, wanted: str) -> torch.device:
    """`auto`, `cpu` or `cuda` as a device; raises ConfigurationError where there is no CUDA."""
    there = torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise ConfigurationError(
            f"{parameter} is 'cuda' and torch {torch.__version__} finds no CUDA device: set it to "
            "'auto' or 'cpu', or install a CUDA build of torch and its driver"
        )
    return torch.device("cuda" if there and wanted != "cpu" else "cpu")


def choose_dtype(device: torch.device) -> torch.dtype:
    """float16 on CUDA, float32 on a CPU, for every network.

    Of the two half precisions float16 has the finer numbers, which boxes and masks need, and every
    CUDA device computes with it; bfloat16 is emulated before Ampere.
    """
    return torch.float16 if device.type == "cuda" else torch.float32


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a device has too little memory."""
    text = str(error)
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or (
        isinstance(error, RuntimeError)
        and ("can't allocate memory" in text or "out of memory" in text)
    )


@contextmanager
def enough_memory(what: str, remedy: str = "") -> Iterator[None]:
    """Turn running out of memory, of whichever device, into a ConfigurationError."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        remedy = remedy or "choose a smaller checkpoint, or free the device"
        raise ConfigurationError(f"out of memory while {what}: {remedy}") from error
