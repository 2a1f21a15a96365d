"""Vertices of a PLY file: ASCII, binary little-endian and binary big-endian."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import read_file
from deworldsg_ros.scene.arrays import Float64

# Both families of names that PLY knows.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass
class _Property:
    name: str
    dtype: str
    count_dtype: str = ""  # of a list property; empty for a plain one


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def is_plain(self) -> bool:
        return not any(item.count_dtype for item in self.properties)

    def row_dtype(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(item.name, order + item.dtype) for item in self.properties])


def read_vertices(path: Path, wanted: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Columns of the element ``vertex``, each in the type that the file declares.

    Args:
        path: PLY file.
        wanted: names of scalar properties.

    Raises:
        RecordingError: for a file that is absent, is no PLY, ends early, or lacks a property.
    """
    content = read_file(path)
    order, elements, start = _read_header(content, path)
    for element in elements:
        if element.name == "vertex":
            missing = [
                name
                for name in wanted
                if name not in {item.name for item in element.properties if not item.count_dtype}
            ]
            if missing:
                raise RecordingError(
                    f"{path}: its vertices have no property {', '.join(missing)}; "
                    f"wanted {', '.join(wanted)}"
                )
    reader = _read_ascii if order == "=" else _read_binary
    columns = reader(content[start:], order, elements, path)
    return {name: columns[name] for name in wanted}


def _read_header(content: bytes, path: Path) -> tuple[str, list[_Element], int]:
    end = content.find(b"end_header")
    if not content.startswith(b"ply") or end < 0:
        raise RecordingError(f"{path} is no PLY file: wanted a header from 'ply' to 'end_header'")
    start = content.find(b"\n", end) + 1
    order = ""
    elements: list[_Element] = []
    for line in content[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = _BYTE_ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                item = _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
                elements[-1].properties.append(item)
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
        except (IndexError, KeyError, ValueError) as error:
            raise RecordingError(f"{path}: header line '{line}' is not understood") from error
    if not order or not any(element.name == "vertex" for element in elements):
        raise RecordingError(f"{path}: its header lacks a format or the element vertex")
    return order, elements, start


def _read_ascii(
    body: bytes, order: str, elements: list[_Element], path: Path
) -> dict[str, NDArray[np.generic]]:
    lines = [line for line in body.splitlines() if line.strip()]
    for element in elements:
        rows, lines = lines[: element.count], lines[element.count :]
        if len(rows) < element.count:
            raise _too_short(path, element, len(rows))
        if element.name == "vertex":
            return _ascii_columns(rows, element, path)
    raise AssertionError("the header names an element vertex")


def _ascii_columns(
    rows: list[bytes], element: _Element, path: Path
) -> dict[str, NDArray[np.generic]]:
    try:
        if element.is_plain():
            width = len(element.properties)
            table = np.array(b" ".join(rows).split(), np.float64).reshape(-1, width)
            values = [table[:, column] for column in range(width)]
        else:
            values = _ascii_with_lists(rows, element)
    except (IndexError, ValueError) as error:
        raise RecordingError(f"{path}: a vertex does not have the declared numbers") from error
    # Through float64: as a reader that declares float32 parses it.
    return {
        item.name: column.astype(item.dtype)
        for item, column in zip(element.properties, values)
        if not item.count_dtype
    }


def _ascii_with_lists(rows: list[bytes], element: _Element) -> list[Float64]:
    values = np.zeros((len(element.properties), len(rows)))
    for number, row in enumerate(rows):
        words = iter(row.split())
        for column, item in enumerate(element.properties):
            if not item.count_dtype:
                values[column, number] = float(_next(words))
                continue
            for _ in range(int(_next(words))):
                _next(words)
    return list(values)


def _next(words: object) -> bytes:
    word: bytes | None = next(words, None)  # type: ignore[call-overload]
    if word is None:
        raise IndexError("row ends early")
    return word


def _read_binary(
    body: bytes, order: str, elements: list[_Element], path: Path
) -> dict[str, NDArray[np.generic]]:
    start = 0
    for element in elements:
        if element.is_plain():
            dtype = element.row_dtype(order)
            stop = start + dtype.itemsize * element.count
            if stop > len(body):
                raise _too_short(path, element, (len(body) - start) // max(dtype.itemsize, 1))
            if element.name == "vertex":
                table = np.frombuffer(body[start:stop], dtype)
                return {
                    name: table[name].astype(table[name].dtype.newbyteorder("="))
                    for name in dtype.names or ()
                }
            start = stop
            continue
        columns, start = _binary_with_lists(body, start, order, element, path)
        if element.name == "vertex":
            return columns
    raise AssertionError("the header names an element vertex")


def _binary_with_lists(
    body: bytes, start: int, order: str, element: _Element, path: Path
) -> tuple[dict[str, NDArray[np.generic]], int]:
    columns: dict[str, NDArray[np.generic]] = {
        item.name: np.zeros(element.count, item.dtype)
        for item in element.properties
        if not item.count_dtype
    }
    for row in range(element.count):
        for item in element.properties:
            kind = np.dtype(order + (item.count_dtype or item.dtype))
            if start + kind.itemsize > len(body):
                raise _too_short(path, element, row)
            value = np.frombuffer(body, kind, 1, start)[0]
            start += kind.itemsize
            if item.count_dtype:
                start += int(value) * np.dtype(item.dtype).itemsize
            else:
                columns[item.name][row] = value
    return columns, start


def _too_short(path: Path, element: _Element, found: int) -> RecordingError:
    return RecordingError(
        f"{path} ends early: {found} of {element.count} rows of the element {element.name}"
    )
