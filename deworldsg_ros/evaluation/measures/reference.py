"""Annotated positions of the objects of a scan, for the measures beside the protocol."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.annotations import Annotations, ScanPoints
from deworldsg_ros.recordings.folders.rooms import GROUND_TRUTH_NAME
from deworldsg_ros.scene.arrays import Float64


@dataclass(frozen=True)
class ReferenceScene:
    """The n objects of a scan that can be detected, and their relations.

    Attributes:
        ids: ids of the annotation.
        labels: class names.
        boxes_min, boxes_max: (n, 3) float64, metres, world: axis-aligned boxes.
        centroids: (n, 3) float64, metres, world: centroid of the visible surface, or of the whole
            surface if the visible part is unknown.
        relations: (subject id, object id, predicate name) of every true relation.
        exact: True if boxes and centroids come from the ground truth of a rendered room, False if
            they come from annotated surface points.
    """

    ids: list[int]
    labels: list[str]
    boxes_min: Float64
    boxes_max: Float64
    centroids: Float64
    relations: frozenset[tuple[int, int, str]]
    exact: bool

    def __len__(self) -> int:
        return len(self.ids)


def read_reference(annotations: Annotations, scan: str, points: ScanPoints) -> ReferenceScene:
    """The reference of a scan: from its gt.json, or else from the annotated surface points.

    An object without surface points is left out.

    Raises:
        RecordingError: a field of gt.json is missing or invalid.
    """
    content = annotations.ground_truth(scan)
    if content is None:
        return _from_points(annotations, scan, points)
    try:
        objects = [item for item in content["objects"] if item["vg"] and item["detectable"]]
        boxes = np.array([item["aabb"] for item in objects], np.float64).reshape(-1, 2, 3)
        centroids = np.array([item["visible_centroid"] for item in objects], np.float64)
        return ReferenceScene(
            [int(item["id"]) for item in objects],
            [str(item["vg"]) for item in objects],
            boxes[:, 0],
            boxes[:, 1],
            centroids.reshape(-1, 3),
            frozenset((int(s), int(o), str(name)) for s, o, _, name in content["relationships"]),
            exact=True,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{annotations.scan_folder(scan) / GROUND_TRUTH_NAME}: {type(error).__name__}: {error}"
        ) from error


def _from_points(annotations: Annotations, scan: str, points: ScanPoints) -> ReferenceScene:
    annotation = annotations.scan(scan)
    vocabulary = annotations.vocabulary
    finite = np.isfinite(points.points_world).all(axis=1)
    surfaces = {
        number: points.points_world[finite & (points.object_ids == number)]
        for number in annotation.objects
    }
    surfaces = {number: surface for number, surface in surfaces.items() if len(surface)}
    return ReferenceScene(
        list(surfaces),
        [vocabulary.classes[annotation.objects[number]] for number in surfaces],
        np.array([surface.min(axis=0) for surface in surfaces.values()]).reshape(-1, 3),
        np.array([surface.max(axis=0) for surface in surfaces.values()]).reshape(-1, 3),
        np.array([surface.mean(axis=0) for surface in surfaces.values()]).reshape(-1, 3),
        frozenset(
            (subject, object_, vocabulary.predicates[predicate])
            for subject, object_, predicate in annotation.relations
            if predicate >= 0
        ),
        exact=False,
    )
