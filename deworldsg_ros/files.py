"""Files that appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4


def write_atomically(path: Path, content: bytes | Callable[[BinaryIO], object]) -> None:
    """Write a file; after a failure or a power cut, the old file is still there.

    Args:
        path: of the file; its folder exists.
        content: the bytes, or a function that writes them to an open file.

    Raises:
        OSError: if the file cannot be written. Errors of `content` pass through.
    """
    partial = _partial(path)
    try:
        with partial.open("xb") as file:
            if isinstance(content, bytes):
                file.write(content)
            else:
                content(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def check_writable(path: Path) -> None:
    """Make the folder of a file and test that `write_atomically` can write there.

    Raises:
        OSError: if it cannot.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = _partial(path)
    partial.touch(exist_ok=False)
    partial.unlink()


def _partial(path: Path) -> Path:
    # Beside the target: a rename is atomic only within one file system. The name is unique, so that
    # two writers of one file do not write into each other's.
    return path.with_name(f".{path.name}.{uuid4().hex}.partial")


def _sync_folder(folder: Path) -> None:
    """Make the new name durable."""
    # Some network file systems cannot sync a folder. The file is complete without it.
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
