"""Counts, and the names that misspelt ones may mean."""

from __future__ import annotations

import pytest

from deworldsg_ros.words import counted, suggestion

KNOWN = ["perception.score_threshold", "perception.threads", "lifting.tau", "save_path"]


def test_one_is_singular() -> None:
    assert [counted(n, "frame") for n in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("lifting.tua", "lifting.tau"),
        ("tau", "lifting.tau"),
        ("merging.tau", "lifting.tau"),
        ("threshold", "perception.score_threshold"),
        ("perception.treshold", "perception.score_threshold"),
        ("savepath", "save_path"),
        ("colour.of.the.sky", None),
        ("", None),
    ],
)
def test_the_nearest_name_is_suggested(name: str, meant: str | None) -> None:
    assert suggestion(name, KNOWN) == (f" (did you mean {meant}?)" if meant else "")
    assert suggestion(name, []) == ""
