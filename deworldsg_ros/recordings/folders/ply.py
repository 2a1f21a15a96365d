"""Vertices of a PLY file: ASCII, binary little-endian and binary big-endian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import read_file
from deworldsg_ros.scene.arrays import Float64

Columns = dict[str, NDArray[Any]]

# PLY has two names for each type.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str = ""  # of the length of a list property; empty for a scalar


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(item.count_dtype for item in self.properties)

    def row_dtype(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(item.name, order + item.dtype) for item in self.properties])


def read_vertices(path: Path, names: Sequence[str]) -> Columns:
    """Scalar properties of the element ``vertex``, (n,) each, in the type that the file declares.

    Memory stays in proportion to the size of the file, even if its header declares more.

    Raises:
        RecordingError: for a file that cannot be read, is no PLY, ends early, or whose vertices
            lack a property or have lists.
    """
    content = read_file(path)
    order, elements, start = _read_header(content, path)
    place = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if place is None:
        raise RecordingError(f"{path}: its header has no element vertex: expected one")
    _check_properties(elements[place], names, path)
    read = _ascii_vertices if order == "=" else _binary_vertices
    columns = read(content[start:], order, elements[: place + 1], path)
    return {name: columns[name] for name in names}


def _check_properties(vertex: _Element, names: Sequence[str], path: Path) -> None:
    found = [item.name for item in vertex.properties]
    if missing := [name for name in names if name not in found]:
        raise RecordingError(
            f"{path}: its vertices have no property {', '.join(missing)}; expected "
            f"{', '.join(names)}"
        )
    if vertex.has_lists or len(set(found)) < len(found):
        raise RecordingError(
            f"{path}: its vertices have the properties {', '.join(found)}, with lists or twice the "
            "same name; expected distinct scalars"
        )


def _read_header(content: bytes, path: Path) -> tuple[str, list[_Element], int]:
    """Byte order, elements, and the position where the data starts."""
    end = content.find(b"end_header")
    if not content.startswith(b"ply") or end < 0:
        raise RecordingError(f"{path} is no PLY file: expected a header from 'ply' to 'end_header'")
    order = ""
    elements: list[_Element] = []
    for line in content[:end].decode("ascii", errors="replace").splitlines():
        try:
            order = _read_header_line(line.split(), elements) or order
        except (IndexError, KeyError, ValueError) as error:
            raise RecordingError(
                f"{path}: header line '{line}' is not understood: expected 'format', 'element' or "
                "'property' of a known type"
            ) from error
    if not order:
        raise RecordingError(
            f"{path}: its header has no format: expected {', '.join(_BYTE_ORDERS)}"
        )
    return order, elements, content.find(b"\n", end) + 1


def _read_header_line(words: list[str], elements: list[_Element]) -> str:
    """Add the line's element or property to the elements; returns the byte order of a format."""
    keyword = words[0] if words else ""
    if keyword == "format":
        return _BYTE_ORDERS[words[1]]
    if keyword == "element":
        count = int(words[2])
        if count < 0:
            raise ValueError("negative count")
        elements.append(_Element(words[1], count))
    elif words[:2] == ["property", "list"]:
        count_dtype = _TYPES[words[2]]
        if count_dtype.startswith("f"):
            raise ValueError("the length of a list is no whole number")
        elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], count_dtype))
    elif keyword == "property":
        elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
    return ""


def _ascii_vertices(body: bytes, order: str, elements: list[_Element], path: Path) -> Columns:
    """Columns of the last element; every row is a line."""
    lines = [line for line in body.splitlines() if line.strip()]
    rows: list[bytes] = []
    for element in elements:
        rows, lines = lines[: element.count], lines[element.count :]
        if len(rows) < element.count:
            raise _too_short(path, element, len(rows))
    properties = elements[-1].properties
    try:
        # Parsed as float64 and then converted, as a reader that declares float32 parses it.
        table = np.array(b" ".join(rows).split(), np.float64).reshape(len(rows), len(properties))
    except ValueError as error:
        raise RecordingError(
            f"{path}: a vertex does not have {len(properties)} numbers, as its header declares"
        ) from error
    return {item.name: _typed(table[:, i], item, path) for i, item in enumerate(properties)}


def _typed(values: Float64, item: _Property, path: Path) -> NDArray[Any]:
    dtype = np.dtype(item.dtype)
    if dtype.kind in "iu" and len(values):
        limits = np.iinfo(dtype)
        if not (values.min() >= limits.min and values.max() <= limits.max):
            raise RecordingError(
                f"{path}: {item.name} is {values.min():g} to {values.max():g}: expected {dtype}"
            )
    with np.errstate(over="ignore"):
        return values.astype(dtype)


def _binary_vertices(body: bytes, order: str, elements: list[_Element], path: Path) -> Columns:
    """Columns of the last element, in native byte order."""
    start = 0
    for element in elements[:-1]:
        start = _skip(body, start, order, element, path)
    vertex = elements[-1]
    dtype = vertex.row_dtype(order)
    _check_length(body, start, dtype, vertex, path)
    table = np.frombuffer(body, dtype, vertex.count, start)
    return {name: table[name].astype(dtype[name].newbyteorder("=")) for name in dtype.names or ()}


def _skip(body: bytes, start: int, order: str, element: _Element, path: Path) -> int:
    """Position after an element."""
    if not element.has_lists:
        dtype = element.row_dtype(order)
        _check_length(body, start, dtype, element, path)
        return start + dtype.itemsize * element.count
    for row in range(element.count):
        for item in element.properties:
            kind = np.dtype(order + (item.count_dtype or item.dtype))
            if start + kind.itemsize > len(body):
                raise _too_short(path, element, row)
            if item.count_dtype:
                length = max(int(np.frombuffer(body, kind, 1, start)[0]), 0)
                start += length * np.dtype(item.dtype).itemsize
            start += kind.itemsize
        if start > len(body):
            raise _too_short(path, element, row)
    return start


def _check_length(
    body: bytes, start: int, dtype: np.dtype[np.void], element: _Element, path: Path
) -> None:
    if dtype.itemsize * element.count > len(body) - start:
        raise _too_short(path, element, (len(body) - start) // dtype.itemsize)


def _too_short(path: Path, element: _Element, found: int) -> RecordingError:
    return RecordingError(
        f"{path} ends early: {found} of {element.count} rows of the element {element.name}. "
        "Download it again"
    )
