"""A reader under test: its good files, and cases made from them."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hypothesis
from hypothesis import strategies as st

from fuzz.mutations import mutate


@dataclass(frozen=True)
class Target:
    """A reader of data from outside.

    A case replaces the content of one file of the good ones. The reader may accept it or raise a
    DeWorldSGError. Everything else is a failure: other exceptions (also AssertionError,
    for content that should not have been accepted), too much memory or time, a dead process.

    `make` writes the good files into an empty folder, or the one `file`. `read` uses what it read
    as the program does, and asserts what the schema promises. `documents` are whole contents as a
    strategy, besides mutations; `weight` is the number of cases in proportion to other targets.
    """

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]
    file: str = ""
    documents: st.SearchStrategy[bytes] | None = None
    weight: int = 1

    def good_files(self, folder: Path) -> dict[str, bytes]:
        """Make the good files; returns the contents that cases may replace, by name."""
        self.make(folder / self.file)
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        return {str(path.relative_to(folder)): path.read_bytes() for path in paths}

    def make_cases(
        self, good: dict[str, bytes], seed: str, count: int, use: Callable[[str, bytes], None]
    ) -> None:
        """Give the name and the new content of a file to `use`, `count` times.

        The same seed makes the same cases. Hypothesis makes fewer if it knows no more.
        """
        rng = random.Random(f"{self.name} {seed}")
        names = list(good)
        # Every third turn.
        if self.documents is None or rng.randrange(3):
            for name in rng.choices(names, k=count):
                use(name, mutate(name, good[name], rng))
            return
        name = rng.choice(names)
        known = hypothesis.settings(
            max_examples=count,
            database=None,
            derandomize=False,
            phases=[hypothesis.Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )
        each = hypothesis.given(self.documents)(lambda content: use(name, content))
        hypothesis.seed(rng.randrange(2**32))(known(each))()
