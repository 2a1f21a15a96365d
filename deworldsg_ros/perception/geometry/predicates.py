"""Logits of predicates for each ordered pair of objects, from their metric layout.

A predicate is a conjunction of soft conditions, and its logit is the weakest of them. A condition
compares a length or a fraction with a `Limit`: its logit is the margin divided by the tolerance.
bench/relation_head.py measures the agreement with the annotated relations of rendered rooms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.perception.geometry.layout import Layout
from deworldsg_ros.scene.arrays import Bool, Float64

# Logit of predicates that the layout cannot judge. The softmax of 50 logits at -6 beside one at 3
# gives that one 99.4 % of the mass. Sums over frames (Eq. 9) stay of the order of a network's.
FLOOR_LOGIT = -6.0
CEILING_LOGIT = 3.0
# A general predicate counts less than a specific one for the same pair.
GENERAL_PENALTY_LOGIT = 0.5
# "attached to" counts less for objects close to a wall: furniture stands there, too.
WALL_PENALTY_LOGIT = 1.0


class Limit(NamedTuple):
    """A soft threshold.

    Attributes:
        value: the threshold, in the unit of the constant's name.
        tolerance: the margin that gives a logit of 1, in the same unit.
    """

    value: float
    tolerance: float

    def at_least(self, values: Float64) -> Float64:
        """Logits that are positive where `values` exceed the limit."""
        return np.asarray((values - self.value) / self.tolerance)

    def at_most(self, values: Float64) -> Float64:
        """Logits that are positive where `values` are below the limit."""
        return np.asarray((self.value - values) / self.tolerance)


# On: from the bottom of the subject to the surface below. Depth noise and robust bounds are off by
# a few centimetres.
CONTACT_M = Limit(0.04, 0.02)
# On: fraction of the subject's footprint over the object. The centre of mass has to be there.
ON_COVERED = Limit(0.4, 0.2)
# On: log of the object's width over the subject's. The object is wider, or 10 % narrower at most.
ON_LOG_WIDTH = Limit(-0.1, 0.1)
# On: from the bottom of the object to the top of the subject.
ON_RISE_M = Limit(0.02, 0.02)

# In: from the top of the container to the bottom of the subject, which may be hidden by the rim.
IN_CLEARANCE_M = Limit(0.05, 0.03)
# In: fraction of the subject's footprint inside the container's. Only its near side is seen.
IN_COVERED = Limit(0.3, 0.15)
# In: from the bottom of the container to the bottom of the subject.
IN_BOTTOM_M = Limit(-0.02, 0.02)
# In, plants: overlap fraction of the smaller footprint. Leaves spread beyond the pot.
POTTED_OVERLAP = Limit(0.5, 0.15)
# In, plants: from the top of the pot to the top of the plant.
POTTED_RISE_M = Limit(0.0, 0.03)

# Attached to: horizontal and vertical distance. The connection itself is seldom visible.
FIXED_GAP_M = Limit(0.3, 0.1)
# Attached to a wall: horizontal distance.
WALL_GAP_M = Limit(0.08, 0.03)

# Above: overlap fraction of the smaller footprint, hidden depth included.
ABOVE_OVERLAP = Limit(0.5, 0.15)
# Above: from the top of the object to the bottom of the subject; at most an arm's reach.
ABOVE_MIN_CLEARANCE_M = Limit(-0.02, 0.02)
ABOVE_MAX_CLEARANCE_M = Limit(1.2, 0.2)

# Against: horizontal distance, and the height range that both share.
AGAINST_GAP_M = Limit(0.05, 0.02)
AGAINST_SHARED_HEIGHT_M = Limit(0.3, 0.1)
# Against: from the top of the object to the top of the subject. The lower one leans on the higher.
AGAINST_RISE_M = Limit(0.0, 0.05)

# Near: furniture within half a metre, small objects within a hand's breadth and at one height.
NEAR_FURNITURE_M = Limit(0.5, 0.1)
NEAR_SMALL_M = Limit(0.10, 0.03)
NEAR_LEVEL_M = Limit(0.06, 0.03)
# With: a table and its chair, which is within reach of a person who sits on it.
WITH_GAP_M = Limit(0.35, 0.1)

# Objects that are larger do not fit in one hand and count as furniture.
FURNITURE_M = 0.45

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


def predicate_logits(layout: Layout, class_names: list[str]) -> dict[str, Float64]:
    """Logits of the predicates that the layout of n objects can judge.

    Args:
        layout: of the n objects.
        class_names: most likely class of each; a hint where no surface shows the relation.

    Returns:
        By predicate name of both predicate sets, (n, n) float64: row = subject, column = object.
    """
    pairs = _Pairs(layout, class_names)
    inside, fixed = _inside(pairs), _fixed(pairs)
    # A more specific predicate of the pair lowers the logits of the general ones.
    on = _unless(_resting(pairs), inside, inside.T, fixed)
    above = _unless(_above(pairs), on, on.T)
    against = _unless(_against(pairs), on, on.T, fixed, fixed.T)
    specific = (on, inside, fixed, above, against)
    beside = _unless(_beside(pairs), *specific, *(logits.T for logits in specific))
    table_and_seat = pairs.are(TABLES)[:, None] & pairs.are(SEATS)[None, :]
    with_ = _all(beside, WITH_GAP_M.at_most(layout.gap_m), _flag(table_and_seat))
    on_floor = _flag(pairs.furniture[:, None]) + _flag(pairs.are(FLOORS)[None, :])
    on_wall = _all(WALL_GAP_M.at_most(layout.gap_m), _flag(pairs.are(WALLS)[None, :]))
    return {
        "on": on,
        "in": inside,
        "attached to": np.maximum(fixed, on_wall - WALL_PENALTY_LOGIT),
        "above": above,
        "under": above.T,
        "against": against,
        "near": _unless(beside, with_),
        "with": with_,
        "standing on": np.maximum(on - GENERAL_PENALTY_LOGIT, _all(on, on_floor)),
        "supported by": on,
        "hanging on": np.maximum(fixed - GENERAL_PENALTY_LOGIT, on_wall - GENERAL_PENALTY_LOGIT),
        "build in": _all(fixed, _flag(pairs.are(BUILT_IN)[:, None])),
        "connected to": against,
    }


class _Pairs:
    """Layout and classes of n objects.

    Attributes:
        layout: of the objects.
        furniture: (n,) bool.
        distance_m: (n, n) vertical distance between the bounds; negative = they overlap.
    """

    def __init__(self, layout: Layout, class_names: list[str]) -> None:
        self.layout = layout
        self._class_names = class_names
        largest_m = (layout.high - layout.low).max(axis=1)
        self.furniture: Bool = (largest_m > FURNITURE_M) | self.are(FURNITURE)
        self.distance_m = np.maximum(layout.clearance_m, layout.clearance_m.T)

    def are(self, classes: frozenset[str]) -> Bool:
        """(n,) bool: the objects of these classes."""
        return np.array([name in classes for name in self._class_names], dtype=bool)

    def are_fixed(self) -> Bool:
        """(n, n) bool: the class of the subject is fixed to the class of the object."""
        names = self._class_names
        fixed = [[name in FIXED_TO.get(subject, ()) for name in names] for subject in names]
        return np.array(fixed, dtype=bool)

    def both_furniture(self) -> Bool:
        """(n, n) bool."""
        return self.furniture[:, None] & self.furniture[None, :]


def _resting(pairs: _Pairs) -> Float64:
    """On, if it is not in it nor attached to it."""
    layout = pairs.layout
    # The lower limit keeps the ratio of two widths finite.
    width_m = np.maximum((layout.high - layout.low)[:, :2].max(axis=1), 1e-3)
    return _all(
        CONTACT_M.at_most(layout.contact_m),
        ON_COVERED.at_least(layout.covered),
        ON_LOG_WIDTH.at_least(np.log(width_m[None, :] / width_m[:, None])),
        ON_RISE_M.at_least(_height(layout.high, layout.low)),
    )


def _inside(pairs: _Pairs) -> Float64:
    """In a small container, or a plant in its pot."""
    layout = pairs.layout
    containers = pairs.are(CONTAINERS)[None, :]
    sunk = IN_CLEARANCE_M.at_most(layout.clearance_m)
    held = _all(
        IN_COVERED.at_least(layout.covered),
        sunk,
        IN_BOTTOM_M.at_least(_height(layout.low, layout.low)),
        _flag(containers & ~pairs.furniture[None, :]),
    )
    potted = _all(
        POTTED_OVERLAP.at_least(layout.shared),
        sunk,
        POTTED_RISE_M.at_least(_height(layout.high, layout.high)),
        _flag(pairs.are(PLANTS)[:, None] & containers),
    )
    return np.maximum(held, potted)


def _fixed(pairs: _Pairs) -> Float64:
    """Attached to an object of a class in `FIXED_TO`."""
    return _all(
        _flag(pairs.are_fixed()),
        FIXED_GAP_M.at_most(pairs.layout.gap_m),
        FIXED_GAP_M.at_most(pairs.distance_m),
    )


def _above(pairs: _Pairs) -> Float64:
    """Furniture over furniture."""
    layout = pairs.layout
    return _all(
        ABOVE_OVERLAP.at_least(layout.shared_deep),
        ABOVE_MIN_CLEARANCE_M.at_least(layout.clearance_m),
        ABOVE_MAX_CLEARANCE_M.at_most(layout.clearance_m),
        _flag(pairs.both_furniture()),
    )


def _against(pairs: _Pairs) -> Float64:
    """Furniture that touches higher furniture; people move seats, which therefore do not count."""
    layout = pairs.layout
    top_m, bottom_m = layout.high[:, 2], layout.low[:, 2]
    shared_m = np.minimum(top_m[:, None], top_m[None, :]) - np.maximum(
        bottom_m[:, None], bottom_m[None, :]
    )
    seats = pairs.are(SEATS)
    return _all(
        AGAINST_GAP_M.at_most(layout.gap_m),
        AGAINST_SHARED_HEIGHT_M.at_least(shared_m),
        AGAINST_RISE_M.at_most(_height(layout.high, layout.high)),
        _flag(pairs.both_furniture() & ~seats[:, None] & ~seats[None, :]),
    )


def _beside(pairs: _Pairs) -> Float64:
    """Near, for two pieces of furniture or two small objects."""
    layout = pairs.layout
    furniture = _all(
        NEAR_FURNITURE_M.at_most(layout.gap_m),
        NEAR_FURNITURE_M.at_most(pairs.distance_m),
        _flag(pairs.both_furniture()),
    )
    small = _all(
        NEAR_SMALL_M.at_most(layout.gap_m),
        NEAR_LEVEL_M.at_most(np.abs(_height(layout.low, layout.low))),
        _flag(~pairs.furniture[:, None] & ~pairs.furniture[None, :]),
    )
    return np.maximum(furniture, small)


def _height(subject: Float64, reference: Float64) -> Float64:
    """(n, n) metres: height of the points (n, 3) of the subject over those of the object."""
    return subject[:, None, 2] - reference[None, :, 2]


def _flag(condition: Bool) -> Float64:
    """A condition that holds or does not, as a logit."""
    return np.where(condition, CEILING_LOGIT, FLOOR_LOGIT)


def _all(*conditions: Float64) -> Float64:
    """The weakest condition of each pair, between floor and ceiling."""
    result = conditions[0]
    for condition in conditions[1:]:
        result = np.minimum(result, condition)
    return np.clip(result, FLOOR_LOGIT, CEILING_LOGIT)


def _unless(logits: Float64, *specific: Float64) -> Float64:
    """Logits, at most the negative of each specific predicate's logits."""
    strongest = specific[0]
    for other in specific[1:]:
        strongest = np.maximum(strongest, other)
    return np.asarray(np.minimum(logits, np.maximum(-strongest, FLOOR_LOGIT)))
