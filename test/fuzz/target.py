"""A reader under test, with good files to start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

from deworldsg_ros.scene.errors import DeWorldSGError


@dataclass(frozen=True)
class Target:
    """A reader of data from outside.

    A case replaces the content of one file of the good ones. The reader may accept it or raise one
    of the documented errors. Everything else is a failure: other exceptions (also AssertionError,
    for content that should not have been accepted), too much memory or time, a dead process.

    Attributes:
        name: of the folder of its corpus.
        make: writes the good files into an empty folder.
        read: reads the folder, uses what it read as the program does, and asserts what the schema
            promises.
        errors: documented errors of the reader.
        files: names of the files that cases damage; empty = all that `make` wrote.
        documents: whole contents of the files as a hypothesis strategy; None = mutations only.
        weight: number of cases in proportion to other targets.
    """

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]
    errors: tuple[type[Exception], ...] = (DeWorldSGError,)
    files: tuple[str, ...] = ()
    documents: st.SearchStrategy[bytes] | None = None
    weight: int = 1

    def members(self, folder: Path) -> list[str]:
        """Names of the files that cases may replace, relative to the folder that `make` filled."""
        if self.files:
            return list(self.files)
        found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
        return sorted(map(str, found))
