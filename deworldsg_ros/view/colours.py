"""One colour per class: the same in every view, and stable while a graph grows."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping

Rgb = tuple[float, float, float]

PALETTE = (
    "#3b6fb6", "#e07b28", "#3f9b4f", "#d1495b", "#8e5ea2", "#8c6d53", "#c9a227", "#3aa6a0",
    "#d6679a", "#5b6c7d", "#7fa23a", "#b5542f", "#5360c4", "#2f8f8f", "#a83f6f", "#6f7f2f",
    "#4aa3d8", "#e2965a", "#77b255", "#a78bd0",
)  # fmt: skip

PREDICATE_PALETTE = (
    "#2f6fab", "#c2571a", "#2e8b57", "#8a4fbf", "#b8336a", "#8a7a1f", "#1f8a8a", "#7a4a2b",
)  # fmt: skip
# So frequent that its arrows are grey.
QUIET = frozenset({"near"})
GREY = "#8d93a5"


def class_colours(labels: Iterable[str]) -> dict[str, str]:
    """#rrggbb of each label.

    A label has a preferred colour; if an earlier label uses it, the next free one is taken. With
    labels in the order of node ids, a new label changes no colour.
    """
    colours: dict[str, str] = {}
    for label in labels:
        if label in colours:
            continue
        start = zlib.crc32(label.encode())
        order = [PALETTE[(start + step) % len(PALETTE)] for step in range(len(PALETTE))]
        taken = set(colours.values())
        colours[label] = next((colour for colour in order if colour not in taken), order[0])
    return colours


def to_rgb(colour: str) -> Rgb:
    """Red, green and blue from 0 to 1, of #rrggbb."""
    red, green, blue = (int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return red, green, blue


def predicate_colours(counts: Mapping[str, int]) -> dict[str, str]:
    """#rrggbb of each predicate, most frequent first; grey beyond the palette."""
    ordered = sorted(counts, key=lambda name: (-counts[name], name))
    colours = dict.fromkeys(ordered, GREY)
    loud = [name for name in ordered if name not in QUIET]
    colours.update(zip(loud, PREDICATE_PALETTE))
    return colours


def shade(colour: str, factor: float) -> str:
    """A darker #rrggbb: each channel times a factor below one."""
    return "#" + "".join(f"{round(255 * factor * value):02x}" for value in to_rgb(colour))
