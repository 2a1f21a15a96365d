"""Ground truth of a data set in one of the two official layouts: objects, relations, points.

docs/dev/evaluation/protocol.md lists the rules of the official evaluation program followed here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import read_json, read_text
from deworldsg_ros.recordings.folders.ply import read_vertices
from deworldsg_ros.recordings.folders.rooms import read_ground_truth
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.frame_graph import Vocabulary

SPLIT_FILES = {
    "train": "train_scans.txt",
    "validation": "validation_scans.txt",
    "val": "validation_scans.txt",
    "test": "test_scans.txt",
}
PLY_NAME = "labels.instances.annotated.v2.ply"
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
        "from https://github.com/Howardkhh/FROSS",
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
