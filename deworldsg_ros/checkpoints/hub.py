"""Download of a model from the Hugging Face hub: only what is used, resumed and verified."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from deworldsg_ros.files import confined, write_atomically
from deworldsg_ros.scene.errors import ConfigurationError

# Configuration, weights in safetensors (no pickles), preprocessing, licence.
USED_FILES = (
    "config.json",
    "model*.safetensors",
    "model.safetensors.index.json",
    "pre*processor_config.json",
    "processor_config.json",
    "LICENSE*",
    "README.md",
)
# Checksums of a folder, for `sha256sum -c` on another machine.
SUMS_FILE = "SHA256SUMS"
CHUNK_BYTES = 1 << 22


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

    def find(self, repository: str) -> RemoteModel:
        """Commit, licence and files of a model; raises ConfigurationError."""
        try:
            info = self._api.model_info(repository, files_metadata=True)
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
            if any(fnmatch(file.rfilename, pattern) for pattern in USED_FILES)
        )
        if not any(file.name.endswith(".safetensors") for file in files):
            raise ConfigurationError(
                f"model '{repository}' has no model.safetensors on the hub: expected a model in "
                "the format of transformers"
            )
        licence = card.get("license_name") or card.get("license") or "not stated"
        return RemoteModel(repository, str(info.sha), str(licence), files)

    def fetch(
        self, model: RemoteModel, folder: Path, report: Callable[[str], None] = lambda line: None
    ) -> None:
        """Download the files into a folder, verify them, and write SHA256SUMS.

        A file that is there and has its checksum is kept; a partial download continues.

        Args:
            model: result of `find`.
            folder: created if missing.
            report: gets a line for each file.

        Raises:
            ConfigurationError: no access, no network, or a file with another checksum.
        """
        sums = []
        for file in model.files:
            path = confined(folder, file.name)
            known = path.is_file() and _matches(path, file.checksum)
            if not known:
                self._download(model, file, folder)
                if not _matches(path, file.checksum):
                    path.unlink(missing_ok=True)
                    raise ConfigurationError(
                        f"{path} has another checksum than {file.checksum} of the hub, and was "
                        "removed: run the command again"
                    )
            report(f"{file.name}: {file.size / 1e6:.1f} MB, {'was there' if known else 'verified'}")
            sums.append(f"{sha256(path)}  {file.name}\n")
        write_atomically(folder / SUMS_FILE, "".join(sums))

    def _download(self, model: RemoteModel, file: RemoteFile, folder: Path) -> None:
        try:
            self._api.hf_hub_download(
                model.repository, file.name, revision=model.commit, local_dir=folder
            )
        except Exception as error:  # see find
            raise ConfigurationError(_advice(model.repository, error)) from error


def sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    return _digest(path, hashlib.sha256())


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
