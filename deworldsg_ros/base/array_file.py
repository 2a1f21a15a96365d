"""Named arrays in one file: .npy files in a zip archive without compression (numpy's .npz).

Equal arrays give equal bytes. A file is data from outside, so it is read without numpy's own
reader, which allocates what a header claims and evaluates its text.
"""

from __future__ import annotations

import math
import re
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.files import open_regular, write_atomically

Arrays = dict[str, NDArray[Any]]

# 10^5 nodes with 512 surface points and all their cells take about 3 GB.
MAX_FILE_BYTES = 16 << 30
# A map has 40 arrays.
MAX_ARRAYS = 256
# A header of numpy has 118 bytes, and that of the largest record 800.
MAX_HEADER_BYTES = 10_000
# numpy's own limit is 64. No array here has more than four axes.
MAX_AXES = 8

# Bytes that are read at a time.
_PART = 1 << 20

_MAGIC = re.compile(rb"\x93NUMPY([\x01-\x03])\x00")
_HEADER = re.compile(
    r"\{'descr': ('[^']*'|\[.*\]), 'fortran_order': (False|True), 'shape': \(([\d, ]*)\), \} *\n"
)
_NUMBER = re.compile(r"[|<][bif]\d{1,2}|[|<]u\d{1,2}")
_FIELD = re.compile(r"\('(\w*)', '([^']*)'(?:, \(([\d, ]*)\))?\)")


def write_arrays(path: Path, arrays: Arrays, *, previous: Path | None = None) -> None:
    """Write arrays; as `write_atomically`."""
    write_atomically(
        path,
        lambda file: np.savez(file, **arrays),  # type: ignore[arg-type]  # names of its options
        previous=previous,
    )


def read_arrays(path: Path) -> Arrays:
    """Read what `write_arrays` wrote. The checksum of each array is compared.

    Memory stays in proportion to the size of the file.

    Raises:
        OSError: the file cannot be read, is no regular file, or is too large.
        ValueError: it is no such file, or its content is damaged.
    """
    with open_regular(path, MAX_FILE_BYTES) as file:
        if not zipfile.is_zipfile(file):
            raise ValueError("not an .npz archive; expected a saved graph or map")
        try:
            return _read_archive(file)
        except (OSError, ValueError):
            raise
        except Exception as error:  # zipfile raises errors of many types
            raise ValueError(f"damaged archive ({type(error).__name__}: {error})") from error


def _read_archive(file: BinaryIO) -> Arrays:
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        names = [member.filename.removesuffix(".npy") for member in members]
        if len(members) > MAX_ARRAYS or len(set(names)) < len(names):
            raise ValueError(
                f"{len(members)} arrays, {len(set(names))} names: expected different names, at "
                f"most {MAX_ARRAYS}"
            )
        size = file.seek(0, 2)
        stored = all(
            member.compress_type == zipfile.ZIP_STORED and member.file_size == member.compress_size
            for member in members
        )
        # A small compressed file may unpack to any size.
        if not stored or sum(member.file_size for member in members) > size:
            raise ValueError("its arrays are compressed: expected them as `np.savez` stores them")
        return {
            name: _parse(name, _content(archive, member)) for name, member in zip(names, members)
        }


def _content(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> memoryview:
    """The bytes of a stored member."""
    # Not a bytearray, which is filled with zeros first.
    content = np.empty(member.file_size, np.uint8).data
    # In parts: `archive.read` takes the memory twice.
    with archive.open(member) as file:
        for start in range(0, len(content), _PART):
            part = file.read(_PART)
            content[start : start + len(part)] = part
    return content


def _parse(name: str, content: memoryview) -> NDArray[Any]:
    """The array of a .npy file, a view of its bytes."""
    magic = _MAGIC.match(content)
    width = 2 if magic and magic[1] == b"\x01" else 4
    length = int.from_bytes(content[8 : 8 + width], "little")
    start = 8 + width + length
    if not magic or length > MAX_HEADER_BYTES:
        raise ValueError(f"array {name} has no header of numpy")
    header = _HEADER.fullmatch(str(content[8 + width : start], "latin1"))
    if header is None:
        raise ValueError(f"array {name} has a header that is not understood")
    dtype, shape = _dtype(header[1]), _shape(header[3])
    if len(content) - start != math.prod(shape) * dtype.itemsize:
        raise ValueError(
            f"array {name} has {len(content) - start} bytes: expected {shape} of {dtype}"
        )
    flat = np.frombuffer(content, dtype, offset=start)
    return flat.reshape(shape, order="F" if header[2] == "True" else "C")


def _shape(text: str) -> tuple[int, ...]:
    sides = tuple(int(side[:19]) for side in text.replace(" ", "").split(",") if side)
    if len(sides) > MAX_AXES:
        raise ValueError(f"array with {len(sides)} axes: expected at most {MAX_AXES}")
    return sides


def _dtype(text: str) -> np.dtype[Any]:
    """The type of numbers, or of records of numbers."""
    if text.startswith("'"):
        if not _NUMBER.fullmatch(text[1:-1]):
            raise ValueError(f"array of {text}: expected numbers, little-endian")
        return _number(text[1:-1])
    fields = _FIELD.findall(text)
    if "[" + ", ".join(match[0] for match in _FIELD.finditer(text)) + "]" != text:
        raise ValueError("record of an unknown layout")
    names, formats, offsets, offset = [], [], [], 0
    for name, kind, shape in fields:
        is_padding = re.fullmatch(r"\|V\d{1,3}", kind) and not name
        item = np.dtype((np.void, int(kind[2:]))) if is_padding else _number(kind)
        if name:
            names.append(name)
            formats.append((item, _shape(shape)))
            offsets.append(offset)
        offset += item.itemsize * math.prod(_shape(shape))
    record: np.dtype[Any] = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": offset}
    )
    return record


def _number(text: str) -> np.dtype[Any]:
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"array of {text}: expected numbers, little-endian")
    try:
        return np.dtype(text)
    except TypeError as error:
        raise ValueError(f"array of {text}: unknown") from error
