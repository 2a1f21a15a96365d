"""Classes of objects whose relations the layout alone cannot show."""

from __future__ import annotations

from deworldsg_ros.scene.class_kinds import SEATS, TABLES

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
BUILT_IN = frozenset({"sink", "window"})
FLOORS = frozenset({"floor"})
WALLS = frozenset({"wall"})
# Classes of objects that hang on walls.
HUNG = frozenset({"board", "clock", "picture", "sign"})
