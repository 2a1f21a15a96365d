"""Download of published models, and a look at a checkpoint without its weights."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import msgspec

from deworldsg_ros.base.files import confined, parse_json, read_regular, write_atomically
from deworldsg_ros.checkpoints.catalogue import INDEX_FILE, is_hub_id
from deworldsg_ros.scene.errors import ConfigurationError

# --- Names, dtypes and shapes of a checkpoint's parameters, without its weights.

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
            left = max(path.stat().st_size - 8, 0)
            if length > min(left, MAX_HEADER_BYTES):
                raise ValueError(f"its header has {length} bytes, of which {left} are there")
            text = opened.read(length)
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


# --- Download of a model from the Hugging Face hub: only what is used, resumed and verified.

# Of a lock: a line for each of some ten files.
MAX_LOCK_BYTES = 100_000
_LOCKED = re.compile(r"(?P<sum>[0-9a-f]{64})  (?P<of>[^/]+)/(?P<name>[^/]+)")
NO_SUMS: Mapping[str, str] = MappingProxyType({})
# Configuration, weights in safetensors (no pickles), preprocessing, tokenizer, licence.
USED_FILES = (
    "config.json",
    "model*.safetensors",
    INDEX_FILE,
    "pre*processor_config.json",
    "processor_config.json",
    # Of texts.
    *("tokenizer*.json", "special_tokens_map.json", "added_tokens.json"),
    *("vocab.json", "vocab.txt", "merges.txt"),
    "LICENSE*",
    "README.md",
)
CHUNK_BYTES = 1 << 22


@dataclass(frozen=True)
class Lock:
    """What the first download of a model brought: `NAME.sha256` beside its folder.

    The file has a line ``# REPOSITORY COMMIT`` and those of `sha256sum -c`. A later download is of
    this commit, and of this content.

    Attributes:
        repository, commit: of the hub.
        sums: SHA-256 by file name.
    """

    repository: str
    commit: str
    sums: dict[str, str]

    @staticmethod
    def path(folder: Path) -> Path:
        """The file of the lock of a model's folder."""
        return folder.with_name(f"{folder.name}.sha256")

    @staticmethod
    def read(folder: Path) -> Lock | None:
        """The lock of a model's folder; None if it has none.

        Raises:
            ConfigurationError: a file that cannot be read, or is no lock.
        """
        path = Lock.path(folder)
        try:
            first, *lines = read_regular(path, MAX_LOCK_BYTES).decode().splitlines()
            mark, repository, commit = first.split(" ")
            found = [_LOCKED.fullmatch(line) for line in lines]
            sums = {
                item["name"]: item["sum"] for item in found if item and item["of"] == folder.name
            }
            if mark != "#" or not sums or len(sums) != len(lines):
                raise ValueError("other lines")
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"{path}: {error}; expected '# OWNER/NAME COMMIT' and lines of sha256sum for files "
                f"of {folder.name}/: remove it if you trust the next download"
            ) from error
        return Lock(repository, commit, sums)

    def write(self, folder: Path) -> None:
        """Write the lock beside a model's folder."""
        lines = [f"{value}  {folder.name}/{name}\n" for name, value in self.sums.items()]
        text = "".join([f"# {self.repository} {self.commit}\n", *lines])
        write_atomically(Lock.path(folder), text)

    def holds(self, folder: Path) -> bool:
        """Whether the folder has every file, with its content."""
        paths = {folder / name: value for name, value in self.sums.items()}
        return all(path.is_file() and sha256(path) == value for path, value in paths.items())


@dataclass(frozen=True)
class RemoteFile:
    """A file on the hub: name, bytes, and its checksum as ``sha256:…`` or ``git:…``."""

    name: str
    size: int
    checksum: str


@dataclass(frozen=True)
class RemoteModel:
    """A model on the hub: id, commit, licence, and the files that are used."""

    repository: str
    commit: str
    licence: str
    files: tuple[RemoteFile, ...]

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files)


class Hub:
    """The Hugging Face hub, or the mirror that the environment variable HF_ENDPOINT names.

    Raises:
        ConfigurationError: huggingface_hub is not installed.
    """

    def __init__(self) -> None:
        try:
            from huggingface_hub import HfApi
        except ImportError as error:
            raise ConfigurationError(
                f"the download needs huggingface_hub ({error}): pip install huggingface_hub"
            ) from error
        self._api: Any = HfApi(endpoint=os.environ.get("HF_ENDPOINT") or None)

    def find(self, repository: str, revision: str = "") -> RemoteModel:
        """Commit, licence and files of a model; raises ConfigurationError.

        Args:
            repository: id on the hub.
            revision: commit; empty = the newest.
        """
        try:
            info = self._api.model_info(repository, revision=revision or None, files_metadata=True)
        except Exception as error:  # the hub's client has many errors, and those of its transport
            raise ConfigurationError(_advice(repository, error)) from error
        card = info.card_data or {}
        files = tuple(
            RemoteFile(
                file.rfilename,
                int(file.size or 0),
                f"sha256:{file.lfs.sha256}" if file.lfs else f"git:{file.blob_id}",
            )
            for file in info.siblings or ()
            if "/" not in file.rfilename
            and any(fnmatch(file.rfilename, pattern) for pattern in USED_FILES)
        )
        if not any(file.name.endswith(".safetensors") for file in files):
            raise ConfigurationError(
                f"model '{repository}' has no model.safetensors on the hub: expected a model in "
                "the format of transformers"
            )
        licence = card.get("license_name") or card.get("license") or "not stated"
        return RemoteModel(repository, str(info.sha), str(licence), files)

    def fetch(
        self,
        model: RemoteModel,
        folder: Path,
        report: Callable[[str], None] = lambda line: None,
        sums: Mapping[str, str] = NO_SUMS,
        source: str = "the catalogue",
    ) -> None:
        """Download the files into a folder, verify them, and write their lock.

        A file that is there and has its checksum is kept; a partial download continues.

        Args:
            model: result of `find`.
            folder: created if missing.
            report: gets a line for each file.
            sums: SHA-256 by name; other files may have any content that the hub names.
            source: of `sums`, for messages.

        Raises:
            ConfigurationError: no access, no network, or a file with another checksum.
        """
        for file in model.files:
            if file.checksum.startswith("sha256:"):
                _check(model, file, file.checksum[7:], sums, source)
        found = {}
        for file in model.files:
            path = confined(folder, file.name)
            known = path.is_file() and _matches(path, file.checksum)
            if not known:
                # The client keeps a file that was changed a second ago.
                path.unlink(missing_ok=True)
                self._download(model, file, folder)
                if not _matches(path, file.checksum):
                    path.unlink(missing_ok=True)
                    raise ConfigurationError(
                        f"{path} has another checksum than {file.checksum} of the hub, and was "
                        "removed: run the command again"
                    )
            found[file.name] = sha256(path)
            try:
                _check(model, file, found[file.name], sums, source)
            except ConfigurationError:  # of a small file, the hub has no SHA-256
                path.unlink()
                raise
            report(f"{file.name}: {file.size / 1e6:.1f} MB, {'was there' if known else 'verified'}")
        Lock(model.repository, model.commit, found).write(folder)

    def _download(self, model: RemoteModel, file: RemoteFile, folder: Path) -> None:
        try:
            self._api.hf_hub_download(
                model.repository, file.name, revision=model.commit, local_dir=folder
            )
        except Exception as error:  # see find
            raise ConfigurationError(_advice(model.repository, error)) from error


def _check(
    model: RemoteModel, file: RemoteFile, found: str, sums: Mapping[str, str], source: str
) -> None:
    expected = sums.get(file.name, found)
    if found != expected:
        raise ConfigurationError(
            f"{model.repository}, commit {model.commit}: {file.name} has sha256:{found} on the "
            f"hub, and {source} expects sha256:{expected}: it is not used. If its authors changed "
            f"it and you trust them, remove its .sha256 file and name it as {model.repository}"
        )


def sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    return _digest(path, hashlib.sha256())


def fingerprint_of(name: str) -> dict[str, str]:
    """SHA-256 of each file of a checkpoint by its name; empty if it is not here.

    Hidden files and folders are no part of a checkpoint. A file is hashed once in a process, and
    again if it was written since.

    Args:
        name: a folder, or a hub id whose files are in the local cache.
    """
    folder = Path(name).expanduser()
    if not folder.is_dir() and is_hub_id(name):
        with suppress(ImportError):
            from huggingface_hub import try_to_load_from_cache

            found = try_to_load_from_cache(name, "config.json")
            folder = Path(found).parent if isinstance(found, str) else folder
    paths = [path for path in sorted(folder.glob("[!.]*")) if path.is_file()]
    return {path.name: _sha256_as_written(path, *_written(path)) for path in paths}


def _written(path: Path) -> tuple[int, ...]:
    """What differs between two contents of a path."""
    found = path.stat()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


@lru_cache(1024)
def _sha256_as_written(path: Path, *written: int) -> str:
    return sha256(path)


def _matches(path: Path, checksum: str) -> bool:
    kind, _, expected = checksum.partition(":")
    if kind == "sha256":
        return sha256(path) == expected
    # git's name of a blob. It identifies small files and is no protection against forgery.
    header = f"blob {path.stat().st_size}\0".encode()
    return _digest(path, hashlib.sha1(header, usedforsecurity=False)) == expected


def _digest(path: Path, digest: Any) -> str:
    with path.open("rb") as opened:
        while chunk := opened.read(CHUNK_BYTES):
            digest.update(chunk)
    return str(digest.hexdigest())


def _advice(repository: str, error: Exception) -> str:
    reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
    return (
        f"model '{repository}' cannot be fetched ({reason}): check the network and the id; if its "
        "licence has to be accepted, accept it on the hub and run `hf auth login`; for a machine "
        "without network see `deworldsg models list`"
    )
