"""Files that appear complete or not at all, and files from outside, read within bounds."""

from __future__ import annotations

import errno
import os
import stat
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


def open_regular(path: Path, max_bytes: int) -> BinaryIO:
    """Open a file for reading.

    Raises:
        OSError: it cannot be read, is larger than this, or is no regular file: a pipe or a device
            may block, or never end. `strerror` has the reason in words.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for its writer.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a name with a null byte or half a character
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    status = os.fstat(descriptor)
    problem = ""
    if stat.S_ISDIR(status.st_mode):
        problem = "it is a folder: expected a file"
    elif not stat.S_ISREG(status.st_mode):
        problem = "it is a pipe or a device: expected a regular file"
    elif status.st_size > max_bytes:
        problem = f"it has {status.st_size} bytes: expected at most {max_bytes}"
    if problem:
        os.close(descriptor)
        raise OSError(errno.EINVAL, problem, str(path))
    return os.fdopen(descriptor, "rb")


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Content of a file; errors as `open_regular`."""
    with open_regular(path, max_bytes) as file:
        # One byte more: the file may grow.
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EINVAL, f"it has more than {max_bytes} bytes", str(path))
    return content


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
