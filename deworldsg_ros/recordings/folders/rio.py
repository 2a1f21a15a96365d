"""3RScan with annotations of 3DSSG: data/SCAN/sequence, images rotated upright by 90 degrees.

The phone was held upright but its images are stored in landscape format: they are rotated
clockwise, with the intrinsics and the poses (`rotated_intrinsics`, `rotated_pose`). Depth is
rendered from the mesh if such files exist (``frame-*.rendered.depth.png``, as in published
results), else it is of the sensor; `DatasetOptions.depth_source` selects it.
"""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.recordings.folders.replica import belongs_to_replica
from deworldsg_ros.recordings.folders.rooms import belongs_to_rooms
from deworldsg_ros.recordings.folders.sequence import (
    RENDERED_DEPTH,
    SequenceDataset,
    looks_like_scan,
)


class RioScan(SequenceDataset):
    """One scan of 3RScan."""

    kind = "3rscan"
    expects = "sequence/_info.txt and sequence/frame-NNNNNN.{color.jpg,depth.pgm,pose.txt}"
    default_rate_hz = 10.0
    rotated = True
    how_to_get = (
        "agree to the terms at https://github.com/WaldJohannaU/3RScan, download the scan and "
        "unpack its sequence.zip into sequence/"
    )

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether it is a scan that is neither of ReplicaSSG nor a rendered room."""
        return looks_like_scan(path) and not belongs_to_replica(path) and not belongs_to_rooms(path)

    def _choose_depth(self, first: int) -> str:
        if self.options.depth_source == "auto" and self.file(first, RENDERED_DEPTH).exists():
            return RENDERED_DEPTH
        return super()._choose_depth(first)
