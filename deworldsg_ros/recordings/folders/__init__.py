"""Data set folders as recordings: one module per data set, detected by the files of the folder.

`dataset` is the base class, `registry` finds the data sets. `frame_files` reads folders with a few
files per frame: `seven_scenes`, and via `sequence` the layout of 3RScan: `rio`, `replica`, `rooms`.
`tum` reads TUM RGB-D. `annotations`, `instances` and `ply` read the ground truth.
"""

from deworldsg_ros.recordings.folders.dataset import detect_dataset, open_dataset

__all__ = ["detect_dataset", "open_dataset"]
