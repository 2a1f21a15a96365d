"""Decompression of the chunks of an MCAP file, up to the size that the chunk declares.

rosbags hands the declared size to its decompressors, and these ignore it: a chunk of 1 MB may
unpack to gigabytes. `bound_chunks` replaces them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import lz4.frame
from rosbags.rosbag2 import storage_mcap

# Recorders begin a new chunk after some MB. One message may be larger: a raw 8K image has 100 MB.
MAX_CHUNK_BYTES = 512 << 20


def decompress(compression: str, packed: bytes, size: int) -> bytes:
    """The content of a chunk; ValueError or an error of the decompressor if it is damaged."""
    return storage_mcap.DECOMPRESSORS[compression](packed, size)


def bound_chunks() -> None:
    """Let rosbags unpack no more than a chunk declares, and `MAX_CHUNK_BYTES`."""
    storage_mcap.DECOMPRESSORS["lz4"] = partial(_bounded, lz4.frame.LZ4FrameDecompressor)
    # Old versions of rosbags use another library for zstd.
    zstd: Any = getattr(storage_mcap, "zstd", None)
    if zstd is not None:
        storage_mcap.DECOMPRESSORS["zstd"] = partial(_bounded, zstd.ZstdDecompressor)


def _bounded(make: Callable[[], Any], packed: bytes, size: int) -> bytes:
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes: expected at most {MAX_CHUNK_BYTES}")
    decompressor = make()
    # One byte more than declared shows that there is more.
    raw: bytes = decompressor.decompress(packed, max_length=size + 1)
    if len(raw) != size or not decompressor.eof:
        raise ValueError(f"a chunk unpacks to other than the {size} bytes that it declares")
    return raw
