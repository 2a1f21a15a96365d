"""Classes of objects whose relations the layout alone cannot show."""

from __future__ import annotations

CONTAINERS = frozenset(
    [
        "vase", "pot", "basket", "bowl", "cup", "sink", "bag", "box", "drawer", "backpack",
        "handbag", "suitcase", "bathtub",
    ]
)  # fmt: skip
TABLES = frozenset({"table", "dining table", "desk", "counter", "bench"})
SEATS = frozenset({"chair", "couch", "seat", "sofa", "stool"})
# Classes that are furniture even if only a small part is visible.
FURNITURE = (
    TABLES
    | SEATS
    | frozenset(
        [
            "bathtub", "bed", "bookshelf", "cabinet", "curtain", "door", "oven", "refridgerator",
            "refrigerator", "screen", "shelf", "sink", "stand", "toilet", "tv", "window",
        ]
    )
)  # fmt: skip
# Classes that stand on the floor, and on nothing else that is furniture.
FLOOR_STANDING = (TABLES - {"counter"}) | SEATS | frozenset({"bed", "bathtub", "toilet"})
PLANTS = frozenset({"plant", "potted plant", "flower"})
# Classes of the objects that a class is fixed to. The layout cannot show it.
FIXED_TO = {
    "sink": frozenset({"counter", "cabinet"}),
    "curtain": frozenset({"window", "wall"}),
    "shower curtain": frozenset({"wall", "bathtub"}),
    "picture": frozenset({"wall"}),
    "window": frozenset({"wall"}),
    "door": frozenset({"wall"}),
    "handle": frozenset({"door", "cabinet", "drawer"}),
}
BUILT_IN = frozenset({"sink", "window"})
FLOORS = frozenset({"floor"})
WALLS = frozenset({"wall"})
# Classes of objects that hang on walls.
HUNG = frozenset({"board", "clock", "picture", "sign"})
