"""Decompression for bags, within bounds.

rosbags hands the size that a chunk declares to its decompressors, and these ignore it; the size of
a compressed message or file is not declared. 1 MB may unpack to gigabytes. `bound_decompression`
replaces these decompressors.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any, BinaryIO, cast

import lz4.frame
from rosbags.rosbag2 import reader, storage_mcap

from deworldsg_ros.recordings.errors import RecordingError

# Recorders begin a new chunk after some MB. One message may be larger: a raw 8K image has 100 MB.
MAX_CHUNK_BYTES = 512 << 20
# Of a file that is compressed as a whole. Raw depth images take a tenth of their size.
MAX_FILE_RATIO = 100
# This much is read of any file: an almost empty database has a larger ratio.
MIN_FILE_BYTES = 64 << 20
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# The zstd of Python 3.14, or its backport.
zstd: Any = cast(Any, storage_mcap).zstd


def decompress(compression: str, packed: bytes, size: int) -> bytes:
    """The content of a chunk; ValueError or an error of the decompressor if it is damaged."""
    return storage_mcap.DECOMPRESSORS[compression](packed, size)


def decompress_message(packed: bytes) -> bytes:
    """A message that is compressed by itself; errors as `decompress`."""
    decompressor = zstd.ZstdDecompressor()
    raw: bytes = decompressor.decompress(packed, max_length=MAX_CHUNK_BYTES + 1)
    if len(raw) > MAX_CHUNK_BYTES or not decompressor.eof:
        raise ValueError(f"a message is cut, or unpacks to more than {MAX_CHUNK_BYTES} bytes")
    return raw


class _File(zstd.ZstdFile):
    """A compressed file. It unpacks to `MAX_FILE_RATIO` times its size at most."""

    def __init__(self, file: BinaryIO, mode: str) -> None:
        super().__init__(file, mode)
        self._path = file.name
        packed = os.fstat(file.fileno()).st_size
        self._left = self._limit = max(MAX_FILE_RATIO * packed, MIN_FILE_BYTES)

    def read(self, size: int | None = -1) -> bytes:
        """The next bytes; RecordingError after too many."""
        data: bytes = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise RecordingError(
                f"recording {self._path}: it unpacks to more than {self._limit} bytes; if you "
                "trust it, unpack it with `zstd -d`, and run `ros2 bag reindex` on the folder"
            )
        return data


def bound_decompression() -> None:
    """Let rosbags unpack no more than a chunk declares, and than the constants above."""
    storage_mcap.DECOMPRESSORS["lz4"] = partial(_bounded, lz4.frame.LZ4FrameDecompressor)
    storage_mcap.DECOMPRESSORS["zstd"] = partial(_bounded, zstd.ZstdDecompressor)
    # Of messages and of files: rosbags calls these two functions of the module.
    bounded = SimpleNamespace(decompress=decompress_message, open=_File)
    cast(Any, reader).zstd = bounded


def _bounded(make: Callable[[], Any], packed: bytes, size: int) -> bytes:
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes: expected at most {MAX_CHUNK_BYTES}")
    decompressor = make()
    # One byte more than declared shows that there is more.
    raw: bytes = decompressor.decompress(packed, max_length=size + 1)
    if len(raw) != size or not decompressor.eof:
        raise ValueError(f"a chunk unpacks to other than the {size} bytes that it declares")
    return raw
