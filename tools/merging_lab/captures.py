"""The files of captures: the local graphs of one recording, lifted once."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path

from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.frame_graph import LocalGraph

SUFFIX = ".pkl"


@dataclass(frozen=True)
class Capture:
    """The local graphs of one recording, one kind of detections and one kind of poses.

    Attributes:
        name: ``SCENE.KIND``, the name of its file.
        root: path of the data set or recording.
        layout: ``replica``, ``3rscan`` or ``recording``; empty = no annotation.
        scan: id of the scan; empty without an annotation.
        relation_head: of the visual relations, as `perception.relation_head`.
        local_graphs: of the frames, in order.
        object_ids: for each frame, the id of the annotated object with most pixels in each row's
            mask, 0 = none; empty without instance images.
    """

    name: str
    root: Path
    layout: str
    scan: str
    relation_head: str
    local_graphs: list[LocalGraph]
    object_ids: list[Int64]

    @property
    def scene(self) -> str:
        """The name without the kind."""
        return self.name.partition(".")[0]

    @property
    def kind(self) -> str:
        """The name without the scene."""
        return self.name.partition(".")[2]


def write_capture(folder: Path, capture: Capture) -> Path:
    """Write a capture to its file; an interrupted write leaves no file of that name."""
    path = folder / f"{capture.name}{SUFFIX}"
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_bytes(pickle.dumps(capture, protocol=pickle.HIGHEST_PROTOCOL))
    unfinished.rename(path)
    return path


def read_capture(path: Path) -> Capture:
    """Read a capture. Only for files of your own: pickle runs what a file says.

    Raises:
        TypeError: the file contains something else.
    """
    capture = pickle.loads(path.read_bytes())
    if not isinstance(capture, Capture):
        raise TypeError(f"{path} contains a {type(capture).__name__}: expected a Capture")
    return capture
