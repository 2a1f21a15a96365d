"""Names, dtypes and shapes of a checkpoint's parameters, without its weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.errors import ConfigurationError

# A longer header is not one: that of a network of 40 thousand parameters has 6 MB.
MAX_HEADER_BYTES = 100_000_000
DTYPES = {"F64": "float64", "F32": "float32", "F16": "float16", "BF16": "bfloat16", "I64": "int64"}


@dataclass(frozen=True)
class ParameterHeader:
    """Name, dtype and shape of a parameter."""

    name: str
    dtype: str
    shape: tuple[int, ...]


class _Entry(msgspec.Struct):
    """A parameter in the header of a file of safetensors."""

    dtype: str
    shape: tuple[Annotated[int, msgspec.Meta(ge=0)], ...]


def read_headers(path: Path) -> list[ParameterHeader]:
    """Parameters of a file of safetensors or torch, in the order of their names.

    Weights are not read, and code in the file is not executed.

    Raises:
        ConfigurationError: no such file, or another format.
    """
    if not path.is_file():
        raise ConfigurationError(f"checkpoint {path}: no such file")
    if path.suffix == ".safetensors":
        return _safetensors(path)
    return _torch(path)


def _safetensors(path: Path) -> list[ParameterHeader]:
    try:
        with path.open("rb") as opened:
            length = int.from_bytes(opened.read(8), "little")
            text = opened.read(length) if length < MAX_HEADER_BYTES else b""
        entries = parse_json(text, dict[str, Any])
        entries.pop("__metadata__", None)
        found = msgspec.convert(entries, dict[str, _Entry])
        return [
            ParameterHeader(name, DTYPES.get(entry.dtype, entry.dtype), entry.shape)
            for name, entry in sorted(found.items())
        ]
    except (OSError, ValueError, msgspec.ValidationError) as error:
        raise ConfigurationError(
            f"{path} is no complete safetensors file ({error}): get it again"
        ) from error


def _torch(path: Path) -> list[ParameterHeader]:
    try:
        import torch
    except ImportError as error:
        raise ConfigurationError(f"{path} needs torch ({error}): pip install torch") from error
    try:
        content = torch.load(path, map_location="meta", weights_only=True)
    except Exception as error:  # pickle, zip and torch each have errors of their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ConfigurationError(
            f"{path} cannot be read without executing code in it ({reason}): expected a file of "
            "safetensors, or tensors that torch saved"
        ) from error
    found: list[ParameterHeader] = []
    pending = [("", content)]
    while pending:
        name, value = pending.pop()
        if torch.is_tensor(value):
            dtype = str(value.dtype).removeprefix("torch.")
            found.append(ParameterHeader(name, dtype, tuple(value.shape)))
        elif isinstance(value, dict):
            pending += [
                (f"{name}.{key}" if name else str(key), part) for key, part in value.items()
            ]
    return sorted(found, key=lambda header: header.name)
