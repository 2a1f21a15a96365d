"""ReplicaSSG over Replica: data/SCAN/sequence, 960x540, no rotation."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.recordings.folders.rooms import belongs_to_rooms
from deworldsg_ros.recordings.folders.sequence import SequenceDataset, dataset_root, looks_like_scan


def belongs_to_replica(path: Path) -> bool:
    """Whether the data set of a scan has the annotations of ReplicaSSG."""
    return (dataset_root(path) / "ReplicaSSG").is_dir()


class ReplicaScan(SequenceDataset):
    """One scene of ReplicaSSG."""

    kind = "replica"
    expects = (
        "sequence/_info.txt and sequence/frame-NNNNNN.{color.jpg,depth.pgm,pose.txt}, with "
        "ReplicaSSG/ beside data/"
    )
    default_rate_hz = 30.0
    how_to_get = (
        "download Replica (https://github.com/facebookresearch/Replica-Dataset) and run the "
        "scripts of https://github.com/Howardkhh/ReplicaSSG, which render the frames"
    )

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether it is a scan of a data set with ReplicaSSG/, but no rendered room."""
        return looks_like_scan(path) and belongs_to_replica(path) and not belongs_to_rooms(path)
