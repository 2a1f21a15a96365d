"""The data sets of this folder: each class that derives from `Dataset` is found automatically.

A new data set is one new module; no other file changes.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from inspect import isabstract
from pathlib import Path
from types import GenericAlias
from typing import Any, TypeGuard

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import Dataset, DatasetOptions


def _is_dataset(item: Any) -> TypeGuard[type[Dataset]]:
    # In Python 3.10, an alias such as list[int] is a type, but issubclass() refuses it.
    is_class = isinstance(item, type) and not isinstance(item, GenericAlias)
    return is_class and issubclass(item, Dataset) and not isabstract(item)


@functools.lru_cache(maxsize=1)
def _datasets() -> dict[str, type[Dataset]]:
    package = importlib.import_module(__package__ or "deworldsg_ros.recordings.folders")
    found: dict[str, type[Dataset]] = {}
    for module in pkgutil.iter_modules(package.__path__):
        content = vars(importlib.import_module(f"{package.__name__}.{module.name}"))
        for item in content.values():
            if _is_dataset(item):
                found[item.kind] = item
    return dict(sorted(found.items()))


def detect_dataset(path: Path) -> str | None:
    """Name of the data set of a folder; None if it is of none of them.

    Raises:
        RecordingError: for the root of a data set of many scans.
    """
    scans = sorted(folder.parent.name for folder in path.glob("data/*/sequence"))
    if scans:
        shown = ", ".join(scans[:3]) + (", …" if len(scans) > 3 else "")
        raise RecordingError(
            f"recording {path}: it is a data set with the scans {shown}; expected one of them, "
            f"e.g. {path / 'data' / scans[0]}"
        )
    return next((name for name, kind in _datasets().items() if kind.looks_like(path)), None)


def open_dataset(name: str, path: Path, options: DatasetOptions | None = None) -> Dataset:
    """Open a folder as a data set.

    Raises:
        RecordingError: for an unknown name, a missing folder or a missing file.
    """
    if name not in _datasets():
        raise RecordingError(
            f"format '{name}' is unknown: expected {', '.join(_datasets())}, rosbag2 or auto"
        )
    if not path.is_dir():
        raise RecordingError(f"recording {path}: there is no such folder")
    return _datasets()[name](path, options or DatasetOptions())


def expectations() -> str:
    """Files of a folder of each data set, in words."""
    return "; ".join(f"{name}: {kind.expects}" for name, kind in _datasets().items())
