"""Relation head without a network: predicates from the metric layout of each pair."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from deworldsg_ros.perception.backends.layout import Layout, measure_layout
from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import Relations
from deworldsg_ros.scene.vocabulary import (
    CONTAINERS,
    FIXED_TO,
    FURNITURE,
    HUNG,
    OVERHEAD,
    PLANTS,
    SEATS,
    TABLES,
)

# --- Classes of objects whose relations the layout alone cannot show.

# Classes that stand on the floor, and on nothing else that is furniture.
FLOOR_STANDING = (TABLES - {"counter"}) | SEATS | frozenset({"bed", "bathtub", "toilet"})
BUILT_IN = frozenset({"sink", "window"})
FLOORS = frozenset({"floor"})
WALLS = frozenset({"wall"})


# --- Logits of predicates for each ordered pair of objects, from their metric layout.
#
# A predicate is a conjunction of soft conditions, and its logit is the weakest of them. A condition
# compares a length or a fraction with a `Limit`: its logit is the margin divided by the tolerance.
# bench/relation_head.py measures the agreement with the annotated relations of rendered rooms.

# Logit of predicates that the layout cannot judge. The softmax of 50 logits at -6 beside one at 3
# gives that one 99.4 % of the mass. Sums over frames (Eq. 9) stay of the order of a network's.
FLOOR_LOGIT = -6.0
CEILING_LOGIT = 3.0
# A pair is related if its best predicate exceeds this logit, a probability of 0.27.
MIN_LOGIT = -1.0
# Predicates that say less than any other predicate of the pair.
GENERAL = frozenset({"near", "with"})
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
# On: fraction of the subject's bottom edge with the object beneath it, in the image. If the layout
# shows a contact, any part of the edge will do.
BENEATH = Limit(0.35, 0.15)
BENEATH_ANY = Limit(0.05, 0.05)
# On, with the object beneath the edge: fraction of the subject's footprint over the object.
# Otherwise it stands in front of the subject.
BENEATH_COVERED = Limit(0.3, 0.15)
# On, with a contact: the same fraction. The centre of mass has to be there.
ON_COVERED = Limit(0.4, 0.2)
# On and in: log of the object's width over the subject's. The object is wider, or 10 % narrower at
# most.
ON_LOG_WIDTH = Limit(-0.1, 0.1)
# On: from the bottom of the object to the bottom of the subject. Two objects side by side have
# their bottoms at one height.
ON_BOTTOM_M = Limit(0.03, 0.015)
# On a flat object, such as a plate: from the bottom of the subject to the top of the object.
ON_FLAT_M = Limit(0.03, 0.015)
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
# Under a table: fraction of the footprint; from the top of the table to that of the subject.
UNDER_COVERED = Limit(0.6, 0.15)
UNDER_RISE_M = Limit(-0.1, 0.05)
# Above: from the bottom of the subject to the nearest surface of the object. Contact is "on".
ABOVE_CONTACT_M = Limit(0.06, 0.02)

# Against: horizontal distance, and the height range that both share.
AGAINST_GAP_M = Limit(0.05, 0.02)
AGAINST_SHARED_HEIGHT_M = Limit(0.3, 0.1)
# Against: from the top of the object to the top of the subject. The lower one leans on the higher.
AGAINST_RISE_M = Limit(0.0, 0.05)

# Near: furniture on the floor within half a metre, objects on one support within a hand's breadth
# and at one height. Bounds in one frame are off by a few centimetres.
NEAR_FURNITURE_M = Limit(0.5, 0.1)
NEAR_SMALL_M = Limit(0.10, 0.03)
NEAR_LEVEL_M = Limit(0.06, 0.03)
# Near: objects with their bottoms at most this far above the lowest furniture stand on the floor.
FLOOR_M = 0.1
# Near: each is among this many nearest neighbours of the other.
NEAREST = 2
# With: a table and its chair, which is within reach of a person who sits on it.
WITH_GAP_M = Limit(0.35, 0.1)

# Objects that are larger do not fit in one hand and count as furniture.
FURNITURE_M = 0.45


def predicate_logits(layout: Layout, class_names: list[str]) -> dict[str, Float64]:
    """Logits of the predicates that the layout of n objects can judge.

    Args:
        layout: of the n objects.
        class_names: most likely class of each; a hint where no surface shows the relation.

    Returns:
        By predicate name of both predicate sets, (n, n) float64: row = subject, column = object.
    """
    pairs = _Pairs(layout, class_names)
    resting, inside, fixed = _resting(pairs), _inside(pairs), _fixed(pairs)
    # What excludes a predicate lowers its logit: first another support of the same subject, then
    # a more specific predicate of the pair.
    rivals = _rivals(_any(resting, inside, fixed))
    inside, fixed = _unless(inside, rivals), _unless(fixed, rivals)
    on = _unless(resting, rivals, inside, inside.T, fixed)
    held = _any(on, inside, fixed)
    over_table = _under_table(pairs, held).T
    above = _unless(_any(_above(pairs), over_table), held, held.T)
    against = _unless(_against(pairs), held, held.T)
    specific = _any(held, above, against)
    reach = _unless(_within_reach(pairs, held), specific, specific.T)
    table_and_seat = pairs.both(TABLES, SEATS)
    with_ = _all(reach, WITH_GAP_M.at_most(layout.gap_m), _flag(table_and_seat))
    near = _any(_all(reach, _neighbours(layout, reach)), with_.T)
    on_floor = _flag(pairs.furniture[:, None]) + _flag(pairs.are(FLOORS)[None, :])
    on_wall = _all(WALL_GAP_M.at_most(layout.gap_m), _flag(pairs.are(WALLS)[None, :]))
    return {
        "on": on,
        "in": inside,
        "attached to": np.maximum(fixed, on_wall - WALL_PENALTY_LOGIT),
        "above": above,
        "under": above.T,
        "against": against,
        "near": _unless(near, with_),
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
        different: (n, n) bool, false on the diagonal.
        log_width: (n, n) log of the width of the column over that of the row.
        distance_m: (n, n) vertical distance between the bounds; negative = they overlap.
    """

    def __init__(self, layout: Layout, class_names: list[str]) -> None:
        self.layout = layout
        self._class_names = class_names
        size_m = layout.high - layout.low
        self.furniture: Bool = (size_m.max(axis=1) > FURNITURE_M) | self.are(FURNITURE)
        self.different: Bool = ~np.eye(len(class_names), dtype=bool)
        # The lower limit keeps the ratio of two widths finite.
        width_m = np.maximum(size_m[:, :2].max(axis=1), 1e-3)
        self.log_width = np.log(width_m[None, :] / width_m[:, None])
        self.distance_m = np.maximum(layout.clearance_m, layout.clearance_m.T)

    def are(self, classes: Collection[str]) -> Bool:
        """(n,) bool: the objects of these classes."""
        return np.array([name in classes for name in self._class_names], dtype=bool)

    def both(self, subjects: Collection[str], objects: Collection[str]) -> Bool:
        """(n, n) bool: the subject is of a class in `subjects`, the object of one in `objects`."""
        return self.are(subjects)[:, None] & self.are(objects)[None, :]

    def are_fixed(self) -> Bool:
        """(n, n) bool: the class of the subject is fixed to the class of the object."""
        names = self._class_names
        fixed = [[name in FIXED_TO.get(subject, ()) for name in names] for subject in names]
        return np.array(fixed, dtype=bool)


def _resting(pairs: _Pairs) -> Float64:
    """On, if it is not in it nor attached to it."""
    layout = pairs.layout
    # Of furniture, often only the front is visible.
    covered = np.where(pairs.furniture[None, :], layout.covered_deep, layout.covered)
    in_front = covered < BENEATH_COVERED.value
    hidden = np.where(in_front, layout.beneath, 0.0).sum(axis=1, keepdims=True)
    unknown = np.isnan(layout.beneath)
    touching = _all(
        CONTACT_M.at_most(layout.contact_m),
        ON_COVERED.at_least(layout.covered),
        ON_LOG_WIDTH.at_least(pairs.log_width),
        np.where(unknown, CEILING_LOGIT, BENEATH_ANY.at_least(layout.beneath + hidden)),
    )
    beneath = _all(
        BENEATH_COVERED.at_least(covered),
        np.where(unknown, FLOOR_LOGIT, BENEATH.at_least(layout.beneath)),
    )
    raised = _any(
        ON_BOTTOM_M.at_least(_height(layout.low, layout.low)),
        ON_FLAT_M.at_most(-layout.clearance_m),
    )
    return _all(
        _any(touching, beneath),
        raised,
        ON_RISE_M.at_least(_height(layout.high, layout.low)),
        _flag(pairs.different & ~pairs.both(FLOOR_STANDING, FLOOR_STANDING)),
    )


def _rivals(held: Float64) -> Float64:
    """Logits (n, n) of what excludes that the object holds the subject.

    Two objects do not hold each other. A cup on a plate on a table is not on the table. An object
    has one support or container.

    Args:
        held: (n, n) logits that the row is on, in or attached to the column.
    """
    opposite = np.where(held < held.T, held.T, FLOOR_LOGIT)
    held = _unless(held, opposite)
    by_way_of_another = np.minimum(held[:, :, None], held[None]).max(axis=1)
    held = _unless(held, by_way_of_another)
    best = held.max(axis=1, keepdims=True)
    better = np.where(held < best, best, FLOOR_LOGIT)
    return _any(opposite, by_way_of_another, better)


def _inside(pairs: _Pairs) -> Float64:
    """In a small container, or a plant in its pot."""
    layout = pairs.layout
    containers = pairs.are(CONTAINERS)[None, :] & pairs.different
    sunk = IN_CLEARANCE_M.at_most(layout.clearance_m)
    held = _all(
        IN_COVERED.at_least(layout.covered),
        ON_LOG_WIDTH.at_least(pairs.log_width),
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
    return _any(held, potted)


def _fixed(pairs: _Pairs) -> Float64:
    """Attached to an object of a class in `FIXED_TO`."""
    return _all(
        _flag(pairs.are_fixed()),
        FIXED_GAP_M.at_most(pairs.layout.gap_m),
        FIXED_GAP_M.at_most(pairs.distance_m),
    )


def _above(pairs: _Pairs) -> Float64:
    """Furniture, or an object on a wall, over furniture; people move seats, which do not count."""
    layout = pairs.layout
    return _all(
        ABOVE_OVERLAP.at_least(layout.shared_deep),
        ABOVE_MIN_CLEARANCE_M.at_least(layout.clearance_m),
        ABOVE_MAX_CLEARANCE_M.at_most(layout.clearance_m),
        ABOVE_CONTACT_M.at_least(layout.contact_m),
        _flag(pairs.both(OVERHEAD, FURNITURE - SEATS)),
    )


def _under_table(pairs: _Pairs, held: Float64) -> Float64:
    """Under: an object on the floor, inside the outline of a table and lower than its top.

    Args:
        pairs: of the objects.
        held: (n, n) logits that the row is on, in or attached to the column.
    """
    layout = pairs.layout
    return _all(
        UNDER_COVERED.at_least(layout.covered),
        UNDER_RISE_M.at_most(_height(layout.high, layout.high)),
        -held.max(axis=1, keepdims=True),
        _flag(pairs.different & ~pairs.are(SEATS)[:, None] & pairs.are(TABLES)[None, :]),
    )


def _against(pairs: _Pairs) -> Float64:
    """Furniture that touches higher furniture; people move seats, which therefore do not count."""
    layout = pairs.layout
    leaning = FURNITURE - SEATS - FIXED_TO.keys()
    top_m, bottom_m = layout.high[:, 2], layout.low[:, 2]
    shared_m = np.minimum(top_m[:, None], top_m[None, :]) - np.maximum(
        bottom_m[:, None], bottom_m[None, :]
    )
    return _all(
        AGAINST_GAP_M.at_most(layout.gap_m),
        AGAINST_SHARED_HEIGHT_M.at_least(shared_m),
        AGAINST_RISE_M.at_most(_height(layout.high, layout.high)),
        _flag(pairs.both(leaning, leaning)),
    )


def _within_reach(pairs: _Pairs, held: Float64) -> Float64:
    """Near or with: two pieces of furniture on the floor, or two objects on one support.

    Args:
        pairs: of the objects.
        held: (n, n) logits that the row is on, in or attached to the column.
    """
    layout = pairs.layout
    # The image need not show the floor: furniture stands on it, and what is as low.
    bottom_m = layout.low[:, 2]
    floor_m = bottom_m[layout.valid & pairs.furniture].min(initial=np.inf)
    standing = (pairs.furniture | (bottom_m < floor_m + FLOOR_M)) & ~pairs.are(
        HUNG | FIXED_TO.keys()
    )
    small = ~pairs.furniture
    one_support = np.minimum(held[:, None], held[None]).max(axis=2)
    no_support = -_any(held.max(axis=1)[:, None], held.max(axis=1)[None, :])
    on_floor = _all(
        NEAR_FURNITURE_M.at_most(layout.gap_m),
        NEAR_FURNITURE_M.at_most(pairs.distance_m),
        no_support,
        _flag(standing[:, None] & standing[None, :]),
    )
    # The support of small objects need not be a detected object.
    together = _any(one_support, _all(no_support, _flag(small[:, None] & small[None, :])))
    on_support = _all(
        NEAR_SMALL_M.at_most(layout.gap_m),
        NEAR_LEVEL_M.at_most(np.abs(_height(layout.low, layout.low))),
        together,
    )
    return _all(_any(on_floor, on_support), _flag(pairs.different))


def _neighbours(layout: Layout, reach: Float64) -> Float64:
    """Each is among the two nearest of the other, and no third object is nearer to both.

    Args:
        layout: of the objects.
        reach: (n, n) logits that they are within reach.
    """
    gap_m = np.where(reach > 0.0, layout.gap_m, np.inf)
    centres = 0.5 * (layout.low + layout.high)[:, :2]
    # Bounds that overlap have no gap: the distance of their centres decides.
    order = gap_m + 0.01 * np.linalg.norm(centres[:, None] - centres[None], axis=2)
    rank = (order[:, None, :] < order[:, :, None]).sum(axis=2)
    between = np.maximum(gap_m[:, :, None], gap_m[None]).min(axis=1) < layout.gap_m
    return _flag((rank < NEAREST) & (rank.T < NEAREST) & ~between)


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


def _any(*conditions: Float64) -> Float64:
    """The strongest condition of each pair."""
    result = conditions[0]
    for condition in conditions[1:]:
        result = np.maximum(result, condition)
    return result


def _unless(logits: Float64, *specific: Float64) -> Float64:
    """Logits of what holds only if nothing in `specific` does.

    Beside a probable specific predicate, with a logit above 0, they are below `MIN_LOGIT`.
    """
    limit = np.clip(MIN_LOGIT - _any(*specific), FLOOR_LOGIT, None)
    return np.asarray(np.minimum(logits, limit))


# --- Relation head without a network: predicates from the metric layout of each pair.

# In a predicate set with "on", these synonyms would take a part of its probability.
SYNONYMS_OF_ON = frozenset({"standing on", "supported by", "hanging on"})


class GeometricRelationHead:
    """Relation head for any predicate set.

    It judges the predicates whose names it knows. All others ("eating", "made of") keep
    `FLOOR_LOGIT`.

    Args:
        predicates: names, in the order of the logits.
    """

    def __init__(self, predicates: tuple[str, ...]) -> None:
        self.predicates = predicates
        self._is_general = np.array([name in GENERAL for name in predicates], dtype=bool)
        self._column = {name: column for column, name in enumerate(predicates)}
        # Compile the kernel now, so that the first image does not wait.
        measure_layout(
            np.ones((4, 4), dtype=np.float32),
            Intrinsics(4.0, 4.0, 2.0, 2.0, 4, 4),
            np.ones((4, 4), dtype=np.uint16),
            1,
            np.array([0.0, -1.0, 0.0]),
        )

    def relate(self, objects: SegmentedObjects, max_relations: int) -> Relations:
        """The best ordered pairs, specific predicates first; see `RelationHead`."""
        count = len(objects)
        if count < 2 or max_relations <= 0:
            return Relations.none(len(self.predicates))
        layout = measure_layout(
            objects.depth_m, objects.intrinsics, objects.instances, count, objects.up_camera
        )
        logits = self.logits(layout, objects.class_names)
        scores = objects.scores
        # EGTR's pair score; the sigmoid of the best logit replaces its connectivity.
        best = logits.max(axis=2)
        pair_scores = scores[:, None] * scores[None, :] / (1.0 + np.exp(-best))
        candidates = np.flatnonzero((best > MIN_LOGIT).ravel())
        general = self._is_general[logits.argmax(axis=2).ravel()[candidates]]
        order = np.lexsort((-pair_scores.ravel()[candidates], general))[:max_relations]
        kept = candidates[order]
        pairs = np.stack([kept // count, kept % count], axis=1).astype(np.int64)
        return Relations(
            pairs=pairs,
            logits=logits[pairs[:, 0], pairs[:, 1]],
            scores=pair_scores[pairs[:, 0], pairs[:, 1]],
        )

    def logits(self, layout: Layout, class_names: list[str]) -> Float64:
        """Logits (n, n, R), before the sigmoid, of subject and object; the diagonal is the floor.

        Args:
            layout: of the n objects.
            class_names: most likely class of each.
        """
        count = len(class_names)
        result = np.full((count, count, len(self.predicates)), FLOOR_LOGIT)
        skipped = SYNONYMS_OF_ON if "on" in self._column else frozenset()
        for name, values in predicate_logits(layout, class_names).items():
            if name in self._column and name not in skipped:
                result[..., self._column[name]] = values
        usable = layout.valid[:, None] & layout.valid[None, :] & ~np.eye(count, dtype=bool)
        result[~usable] = FLOOR_LOGIT
        return np.clip(result, FLOOR_LOGIT, CEILING_LOGIT)
