"""Data set folders as recordings; one data set a file, found by what the folder holds."""

from deworldsg_ros.recordings.folders.registry import dataset_names, detect_dataset, open_dataset

__all__ = ["dataset_names", "detect_dataset", "open_dataset"]
