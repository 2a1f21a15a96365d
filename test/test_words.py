"""Counts, the names that misspelt ones may mean, text of others, and numbers."""

import json

import pytest

from deworldsg_ros.base.words import suggestion, visible, whole_number

KNOWN = ["perception.score_threshold", "perception.threads", "lifting.tau", "save_path"]


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


@pytest.mark.parametrize(
    "text",
    ["cup\x1b[2J", "a\nb", "\x00", "\x7f", "\x9b31m", "\u2028", "\u202e", "\ud800", "\uffff"],
)
def test_what_is_no_character_to_see_is_an_escape(text: str) -> None:
    shown = visible(text)
    assert shown.isprintable() and "\\u" in shown
    assert json.loads(f'"{shown}"') == text


def test_only_ascii_digits_write_a_number() -> None:
    assert [whole_number(text) for text in ("0", "13", "007")] == [0, 13, 7]
    assert whole_number(str(2**63 - 1)) == 2**63 - 1
    for text in ("", "²", "٣", "-1", "1_0", " 1", "1.0", "9" * 5000):
        assert whole_number(text) is None
