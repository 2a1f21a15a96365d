"""Ground truth of a data set in one of the two official layouts: objects, relations, points."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.recordings.folders.dataset import read_file, read_json, read_text
from deworldsg_ros.recordings.folders.sequence import read_ground_truth
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.scene.frame_graph import Vocabulary

# --- Vertices of a PLY file: ASCII, binary little-endian and binary big-endian.

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


# --- Ground truth of a data set in one of the two official layouts: objects, relations, points.
#
# docs/dev/evaluation/protocol.md lists the rules of the official evaluation program followed here.

SPLIT_FILES = {
    "train": "train_scans.txt",
    "validation": "validation_scans.txt",
    "val": "validation_scans.txt",
    "test": "test_scans.txt",
}
PLY_NAME = "labels.instances.annotated.v2.ply"
FRL_APARTMENT = re.compile(r"\A(frl_apartment)_\d+\Z")
ALIGNED_PLY_NAME = "labels.instances.align.annotated.v2.ply"


@dataclass(frozen=True)
class Layout:
    """Files of the annotations of a data set, relative to its root, and their JSON keys.

    Attributes:
        name: for the command line.
        lists: folder of the split files.
        objects, relations, mapping: JSON files.
        label_map, classes, predicates: keys in the mapping file.
        how_to_get: where a missing file can be downloaded, one sentence.
        rooms: JSON file that says which scans show one room; empty = each scan is a room.
    """

    name: str
    lists: str
    objects: str
    relations: str
    mapping: str
    label_map: str
    classes: str
    predicates: str
    how_to_get: str
    rooms: str = ""


LAYOUTS = {
    "replica": Layout(
        "replica",
        "ReplicaSSG",
        "ReplicaSSG/objects.json",
        "ReplicaSSG/relationships.json",
        "ReplicaSSG/replica_to_visual_genome.json",
        "Replica2VisualGenome",
        "VisualGenome_list",
        "VisualGenome_rel",
        "ReplicaSSG/ comes from https://github.com/Howardkhh/ReplicaSSG; its scripts make data/ "
        "from the Replica download",
    ),
    "3rscan": Layout(
        "3rscan",
        "3DSSG_subset",
        "3DSSG/objects.json",
        "3DSSG_subset/relationships20.json",
        "3DSSG_subset/3dssg_to_scannet.json",
        "3DSSG2NYUv2",
        "ScanNet_list",
        "ScanNet_rel",
        "3DSSG/ comes from https://3dssg.github.io, data/ from 3RScan "
        "(https://github.com/WaldJohannaU/3RScan, after its terms are agreed to), 3DSSG_subset/ "
        "from https://github.com/Howardkhh/FROSS, 3RScan.json from the page of 3RScan",
        "3RScan.json",
    ),
}


@dataclass(frozen=True)
class ScanAnnotation:
    """The annotations of one scan, in file order.

    Attributes:
        scan: id of the scan.
        objects: index into the class list by object id; objects of other classes are left out.
        relations: (subject id, object id, index into the predicate list, or -1 if not in it).
        related_ids: ids in the *last* relation entry of the scan; None if it has no entry.
        notes: problems at which the official program stops, and their handling here.
    """

    scan: str
    objects: dict[int, int]
    relations: list[tuple[int, int, int]]
    related_ids: frozenset[int] | None
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class ScanPoints:
    """Annotated surface points: (n, 3) float64 metres, world; (n,) int64 object ids."""

    points_world: Float64
    object_ids: Int64


class Annotations:
    """The annotations of a data set.

    Args:
        root: folder of the data set.
        layout: ``replica`` or ``3rscan``.

    Raises:
        RecordingError: names the file that was expected, and how to get it.
    """

    def __init__(self, root: Path, layout: str) -> None:
        if layout not in LAYOUTS:
            raise RecordingError(
                f"layout '{layout}' is unknown: expected {', '.join(LAYOUTS)} or recording"
            )
        self.root = root
        self.layout = LAYOUTS[layout]
        mapping = self._read_json(self.layout.mapping)
        try:
            self.class_of_label: dict[str, str] = dict(mapping[self.layout.label_map])
            self.vocabulary = Vocabulary(
                tuple(mapping[self.layout.classes]), tuple(mapping[self.layout.predicates])
            )
            names = (*self.vocabulary.classes, *self.vocabulary.predicates)
            if not all(isinstance(name, str) for name in (*names, *self.class_of_label.values())):
                raise TypeError("a name is no text")
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(
                f"{root / self.layout.mapping}: expected the keys {self.layout.label_map}, "
                f"{self.layout.classes} and {self.layout.predicates}"
            ) from error
        self._objects = self._entries(self.layout.objects)
        self._relations = self._entries(self.layout.relations)

    def scans(self, split: str = "test") -> list[str]:
        """Ids of the scans of a split, in file order, with repetitions."""
        if split not in SPLIT_FILES:
            raise RecordingError(f"split '{split}' is unknown: expected {', '.join(SPLIT_FILES)}")
        text = read_text(self._existing(f"{self.layout.lists}/{SPLIT_FILES[split]}"))
        return [line.strip() for line in text.splitlines() if line.strip()]

    def room(self, scan: str) -> str:
        """The room of a scan: of 3RScan its reference scan; raises RecordingError.

        The six scans frl_apartment_N of Replica show one apartment with its furniture moved.
        """
        if not self.layout.rooms:
            return FRL_APARTMENT.sub(r"\1", scan)
        if scan not in self._room_of:
            raise RecordingError(
                f"{self.root / self.layout.rooms} does not list scan '{scan}': expected it as a "
                "reference scan or as one of its rescans"
            )
        return self._room_of[scan]

    @cached_property
    def _room_of(self) -> dict[str, str]:
        content = self._read_json(self.layout.rooms)
        try:
            return {
                str(scan["reference"]): str(room["reference"])
                for room in content
                for scan in (room, *room.get("scans", ()))
            }
        except (AttributeError, KeyError, TypeError) as error:
            raise RecordingError(
                f"{self.root / self.layout.rooms}: expected a list of rooms, each with the key "
                "reference, and scans, each with that key"
            ) from error

    def scan(self, scan: str) -> ScanAnnotation:
        """The annotations of one scan; raises RecordingError."""
        notes: list[str] = []
        objects = self._scan_objects(scan, notes)
        relations, related_ids = self._scan_relations(scan, objects, notes)
        return ScanAnnotation(scan, objects, relations, related_ids, notes)

    def points(self, scan: str, *, aligned: bool = False) -> ScanPoints:
        """All annotated surface points of a scan, including walls and ids that are not listed.

        Raises:
            RecordingError: for a missing or unreadable file.
        """
        path = self.ply_path(scan, aligned=aligned)
        if not path.exists():
            raise RecordingError(f"{path} is missing; {self.layout.how_to_get}")
        columns = read_vertices(path, ("x", "y", "z", "objectId"))
        points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        if not np.isfinite(points).all():
            raise RecordingError(f"{path}: a coordinate is no number: expected metres")
        return ScanPoints(points, columns["objectId"].astype(np.int64))

    def ply_path(self, scan: str, *, aligned: bool = False) -> Path:
        """PLY file with the surface points of a scan."""
        return self.scan_folder(scan) / (ALIGNED_PLY_NAME if aligned else PLY_NAME)

    def scan_folder(self, scan: str) -> Path:
        """Folder of a scan; raises RecordingError if the id is no name of a folder."""
        if scan in ("", ".", "..") or "/" in scan or "\0" in scan:
            raise RecordingError(f"scan '{scan}': expected the name of a folder in data/")
        return self.root / "data" / scan

    def ground_truth(self, scan: str) -> dict[str, Any] | None:
        """Content of the scan's gt.json; None if it has none."""
        return read_ground_truth(self.scan_folder(scan))

    def _scan_objects(self, scan: str, notes: list[str]) -> dict[int, int]:
        if scan not in self._objects:
            notes.append(f"{scan} is not in {self.layout.objects}: no objects")
            return {}
        index_of = _indices(self.vocabulary.classes)
        objects: dict[int, int] = {}
        try:
            # The last entry of a scan replaces the others.
            for item in self._objects[scan][-1]["objects"]:
                label = item["label"]
                if label not in self.class_of_label and self.layout.name == "3rscan":
                    notes.append(f"{scan}: label '{label}' is not in the mapping: left out")
                class_name = self.class_of_label.get(label, "")
                if class_name in index_of:
                    objects[int(item["id"])] = index_of[class_name]
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self.root / self.layout.objects}, scan {scan}: expected objects with a label "
                "and a whole number as id"
            ) from error
        return objects

    def _scan_relations(
        self, scan: str, objects: dict[int, int], notes: list[str]
    ) -> tuple[list[tuple[int, int, int]], frozenset[int] | None]:
        entries = self._relations.get(scan, [])
        index_of = _indices(self.vocabulary.predicates)
        relations: list[tuple[int, int, int]] = []
        related_ids: frozenset[int] | None = None
        try:
            for entry in entries:
                lines = entry["relationships"]
                related_ids = frozenset(int(end) for line in lines for end in line[:2])
                for subject, object_, _, name in lines:
                    relations.append((int(subject), int(object_), index_of.get(name, -1)))
                    if name not in index_of:
                        notes.append(
                            f"{scan}: predicate '{name}' is in no list: it counts as never found"
                        )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self.root / self.layout.relations}, scan {scan}: expected relationships "
                "[subject, object, number, name]"
            ) from error
        unknown = {end for line in relations for end in line[:2]} - set(objects)
        if unknown:
            notes.append(
                f"{scan}: relations name {sorted(unknown)}, no objects of a known class: "
                "they count as never found"
            )
        return relations, related_ids

    def _entries(self, name: str) -> dict[str, list[Any]]:
        content = self._read_json(name)
        entries: dict[str, list[Any]] = {}
        try:
            for entry in content["scans"]:
                entries.setdefault(str(entry["scan"]), []).append(entry)
        except (KeyError, TypeError) as error:
            raise RecordingError(
                f"{self.root / name}: expected a list 'scans', each with the key 'scan'"
            ) from error
        return entries

    def _read_json(self, name: str) -> Any:
        return read_json(self._existing(name))

    def _existing(self, name: str) -> Path:
        path = self.root / name
        if not path.exists():
            raise RecordingError(
                f"data set {self.root} in the layout {self.layout.name}: {path} is missing; "
                f"{self.layout.how_to_get}"
            )
        return path


def _indices(names: tuple[str, ...]) -> dict[str, int]:
    """Index of each name; of a repeated name, the first."""
    indices: dict[str, int] = {}
    for index, name in enumerate(names):
        indices.setdefault(name, index)
    return indices
