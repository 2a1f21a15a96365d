"""Makes cases for a target: damaged good files, and whole documents of hypothesis."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping

import hypothesis

from fuzz.mutations import mutate
from fuzz.target import Target

Use = Callable[[str, bytes], None]


def make_cases(target: Target, good: Mapping[str, bytes], seed: str, count: int, use: Use) -> None:
    """Give the name and the new content of one file, `count` times, to `use`.

    Args:
        target: what reads the files.
        good: contents of its good files by name.
        seed: the same seed makes the same cases.
        count: how many; hypothesis makes fewer if it knows no more.
        use: called with each case.
    """
    rng = random.Random(f"{target.name} {seed}")
    # Every third turn.
    if target.documents is not None and rng.randrange(3) == 0:
        _documents(target, rng.choice(list(good)), rng.randrange(2**32), count, use)
        return
    for _ in range(count):
        member = rng.choice(list(good))
        use(member, mutate(member, good[member], rng))


def _documents(target: Target, member: str, seed: int, count: int, use: Use) -> None:
    assert target.documents is not None

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        derandomize=False,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(target.documents)
    def each(content: bytes) -> None:
        use(member, content)

    each()
