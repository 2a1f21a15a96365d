"""Names, dtypes and shapes of a checkpoint's parameters, without its weights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.errors import ConfigurationError

# A longer header is not one: that of a network of 40 thousand parameters has 6 MB.
MAX_HEADER_BYTES = 100_000_000
# A small file can have a dictionary that contains itself, or one that it contains very often.
MAX_DEPTH = 32
MAX_ENTRIES = 1_000_000
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
    try:
        found = [
            ParameterHeader(name, str(value.dtype).removeprefix("torch."), tuple(value.shape))
            for name, value in _entries(content)
            if torch.is_tensor(value)
        ]
    except ValueError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    return sorted(found, key=lambda header: header.name)


def _entries(content: Any) -> Iterator[tuple[str, Any]]:
    """Values of nested dictionaries, by name; ValueError if they are too many or too deep."""
    pending = [("", content, 0)]
    for _ in range(MAX_ENTRIES):
        if not pending:
            return
        name, value, depth = pending.pop()
        if not isinstance(value, dict):
            yield name, value
        elif depth == MAX_DEPTH:
            raise ValueError(f"its dictionaries are nested more than {MAX_DEPTH} deep")
        else:
            pending += [
                (f"{name}.{key}" if name else str(key), part, depth + 1)
                for key, part in value.items()
            ]
    raise ValueError(f"its dictionaries have more than {MAX_ENTRIES} entries")
