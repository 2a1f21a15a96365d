"""Kinds of classes by name, for the classes of COCO, Visual Genome and ScanNet.

A kind says how objects of a class usually rest, contain or hang.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64

TABLES = frozenset({"table", "dining table", "desk", "counter", "bench"})
SEATS = frozenset({"chair", "couch", "seat", "sofa", "stool"})
STORAGE = frozenset(
    [
        "bookshelf", "cabinet", "drawer", "oven", "refridgerator", "refrigerator", "shelf",
        "stand", "microwave", "toaster",
    ]
)  # fmt: skip
CONTAINERS = frozenset(
    [
        "vase", "pot", "basket", "bowl", "cup", "sink", "bag", "box", "drawer", "backpack",
        "handbag", "suitcase", "bathtub", "glass", "wine glass",
    ]
)  # fmt: skip
PLANTS = frozenset({"plant", "potted plant", "flower", "tree", "leaf", "branch"})
ON_WALLS = frozenset(
    [
        "picture", "clock", "window", "curtain", "shower curtain", "door", "sign", "board",
        "poster", "logo", "flag", "railing",
    ]
)  # fmt: skip
SCREENS = frozenset({"screen", "tv", "laptop"})
SOFT = frozenset(
    [
        "pillow", "towel", "jacket", "coat", "shirt", "blanket", "bag", "handbag", "backpack",
        "teddy bear", "hat", "cap", "glove", "sock", "pant", "jean",
    ]
)  # fmt: skip
FLAT = frozenset({"book", "plate", "paper", "letter", "keyboard", "remote", "tile", "fork"})
BEDS = frozenset({"bed", "bathtub", "toilet"})
KINDS: tuple[frozenset[str], ...] = (
    TABLES, SEATS, STORAGE, CONTAINERS, PLANTS, ON_WALLS, SCREENS, SOFT, FLAT, BEDS,
)  # fmt: skip

# Classes of the objects that a class is fixed to.
FIXED_TO = {
    "sink": frozenset({"counter", "cabinet", "table"}),
    "curtain": frozenset({"window", "wall"}),
    "shower curtain": frozenset({"wall", "bathtub"}),
    "picture": frozenset({"wall"}),
    "window": frozenset({"wall"}),
    "door": frozenset({"wall"}),
    "handle": frozenset({"door", "cabinet", "drawer"}),
}


def kind_table(classes: Sequence[str]) -> Float64:
    """(C, len(KINDS)) float64: 1 for each kind of a class."""
    table = [[float(name in kind) for kind in KINDS] for name in classes]
    return np.array(table, np.float64).reshape(-1, len(KINDS))


def fixed_table(classes: Sequence[str]) -> Bool:
    """(C, C) bool: the class of the row is usually fixed to the class of the column."""
    table = [[name in FIXED_TO.get(subject, ()) for name in classes] for subject in classes]
    return np.array(table, np.bool_).reshape(len(classes), len(classes))
