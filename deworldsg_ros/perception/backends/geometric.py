"""Relation head without a network: predicates from the metric layout of a pair.

Every predicate is a conjunction of soft conditions, and its logit the weakest of them: a margin
(metres, or a share) over a tolerance that says how far off the condition may be before it counts
against the predicate. What geometry cannot judge ("eating", "made of") keeps `FLOOR_LOGIT`.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.perception.geometry.layout import Layout, measure_layout
from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import Relations

# Predicates that layout says nothing about. The softmax of 50 logits at -6 beside one at 3 leaves
# it 99.4 % of the mass; the sums over frames (Eq. 9) stay of the same order as a network's.
FLOOR_LOGIT = -6.0
CEILING_LOGIT = 3.0
# A pair counts when its best predicate is likelier than not to be false by no more than this.
MIN_LOGIT = -1.0

# Bottom of an object to the surface it rests on: depth noise and the percentile bounds.
CONTACT_M, CONTACT_TOLERANCE_M = 0.04, 0.02
# Above and under: what hangs within arm's reach over the other.
ABOVE_MAX_M, ABOVE_TOLERANCE_M = 1.2, 0.2
# Near: furniture within half a metre, small things within a hand's breadth.
NEAR_FURNITURE_M, NEAR_SMALL_M = 0.5, 0.10
AGAINST_M = 0.05
LEVEL_M = 0.06
# Larger than what one hand lifts is furniture.
FURNITURE_M = 0.45

CONTAINERS = frozenset(
    [
        "vase",
        "pot",
        "basket",
        "bowl",
        "cup",
        "sink",
        "bag",
        "box",
        "drawer",
        "backpack",
        "handbag",
        "suitcase",
        "bathtub",
    ]
)
TABLES = frozenset({"table", "dining table", "desk", "counter", "bench"})
SEATS = frozenset({"chair", "couch", "seat", "sofa", "stool"})
# Furniture however little of it is seen.
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
# Subject, objects it is fixed to: no surface of the pair shows it.
FIXED_TO = {
    "sink": frozenset({"counter", "cabinet"}),
    "curtain": frozenset({"window", "wall"}),
    "shower curtain": frozenset({"wall", "bathtub"}),
    "picture": frozenset({"wall"}),
    "window": frozenset({"wall"}),
    "door": frozenset({"wall"}),
    "handle": frozenset({"door", "cabinet", "drawer"}),
}
# Where a vocabulary has "on", these would only share its probability.
OTHER_WORDS_FOR_ON = frozenset({"standing on", "supported by", "hanging on"})
GROUND = frozenset({"floor"})
WALLS = frozenset({"wall"})


class GeometricRelationHead:
    """Relation head for any predicate set; it fills the predicates it knows by name.

    Args:
        predicates: names, in the order of the logits.
    """

    def __init__(self, predicates: tuple[str, ...]) -> None:
        self.predicates = predicates
        self._column = {name: column for column, name in enumerate(predicates)}
        # The kernel is compiled now, and not when the first image waits.
        measure_layout(
            np.ones((4, 4), dtype=np.float32),
            Intrinsics(4.0, 4.0, 2.0, 2.0, 4, 4),
            np.ones((4, 4), dtype=np.uint16),
            1,
            np.array([0.0, -1.0, 0.0]),
        )

    def relate(self, objects: SegmentedObjects, max_relations: int) -> Relations:
        """The best ordered pairs, best first; see `RelationHead`."""
        count = len(objects)
        if count < 2 or max_relations <= 0:
            return Relations.none(len(self.predicates))
        layout = measure_layout(
            objects.depth_m, objects.intrinsics, objects.instances, count, objects.up_camera
        )
        logits = self.logits(layout, objects.class_names)
        scores = objects.scores
        # EGTR's pair score, with the layout's own confidence for its connectivity.
        best = logits.max(axis=2)
        pair_scores = scores[:, None] * scores[None, :] / (1.0 + np.exp(-best))
        candidates = np.flatnonzero((best > MIN_LOGIT).ravel())
        order = np.argsort(-pair_scores.ravel()[candidates], kind="stable")[:max_relations]
        kept = candidates[order]
        pairs = np.stack([kept // count, kept % count], axis=1).astype(np.int64)
        return Relations(
            pairs=pairs,
            logits=logits[pairs[:, 0], pairs[:, 1]],
            scores=pair_scores[pairs[:, 0], pairs[:, 1]],
        )

    def logits(self, layout: Layout, class_names: list[str]) -> Float64:
        """Pre-sigmoid logits (n, n, R) of subject and object; the diagonal is at the floor."""
        count = len(class_names)
        result = np.full((count, count, len(self.predicates)), FLOOR_LOGIT)
        for name, values in judge(layout, class_names).items():
            if name in self._column and not ("on" in self._column and name in OTHER_WORDS_FOR_ON):
                result[..., self._column[name]] = values
        usable = layout.valid[:, None] & layout.valid[None, :] & ~np.eye(count, dtype=bool)
        result[~usable] = FLOOR_LOGIT
        return np.clip(result, FLOOR_LOGIT, CEILING_LOGIT)


def judge(layout: Layout, class_names: list[str]) -> dict[str, Float64]:
    """Logits (n, n) by predicate name, of both predicate sets."""
    size = layout.high - layout.low
    width = np.maximum(size[:, :2].max(axis=1), 1e-3)
    kind = _Kinds(class_names)
    is_furniture = (size.max(axis=1) > FURNITURE_M) | kind.of(FURNITURE)
    both_furniture = is_furniture[:, None] & is_furniture[None, :]
    both_small = ~is_furniture[:, None] & ~is_furniture[None, :]

    touches = (CONTACT_M - layout.contact_m) / CONTACT_TOLERANCE_M
    # What rests on something is smaller than it and has its middle over it.
    rests = _all(
        touches,
        (layout.covered - 0.4) / 0.2,
        (np.log(width[None, :] / width[:, None]) + 0.1) / 0.1,
        ((layout.high[:, None, 2] - layout.low[None, :, 2]) - 0.02) / 0.02,
    )
    held = _all(
        (layout.covered - 0.3) / 0.15,
        (0.05 - layout.clearance_m) / 0.03,
        (layout.low[:, None, 2] - layout.low[None, :, 2] + 0.02) / 0.02,
        _flag(kind.of(CONTAINERS)[None, :] & ~is_furniture[None, :]),
    )
    # A plant's leaves spread beyond its pot.
    potted = _all(
        (layout.above_share - 0.5) / 0.15,
        (0.05 - layout.clearance_m) / 0.03,
        (layout.high[:, None, 2] - layout.high[None, :, 2]) / 0.03,
        _flag(kind.of(PLANTS)[:, None] & kind.of(CONTAINERS)[None, :]),
    )
    inside = np.maximum(held, potted)
    fixed = _all(
        _flag(kind.fixed_to()),
        (0.3 - layout.gap_m) / 0.1,
        (0.3 - np.maximum(layout.clearance_m, layout.clearance_m.T)) / 0.1,
    )
    supported = _unless(rests, inside, inside.T, fixed)

    # Something large and high over something large, not resting on it.
    over = _all(
        (layout.deep_share - 0.5) / 0.15,
        (layout.clearance_m + 0.02) / 0.02,
        (ABOVE_MAX_M - layout.clearance_m) / ABOVE_TOLERANCE_M,
        _flag(both_furniture),
    )
    over = _unless(over, supported, supported.T)
    shared_height = np.minimum(layout.high[:, None, 2], layout.high[None, :, 2]) - np.maximum(
        layout.low[:, None, 2], layout.low[None, :, 2]
    )
    leans = _all(
        (AGAINST_M - layout.gap_m) / 0.02,
        (shared_height - 0.3) / 0.1,
        (layout.high[None, :, 2] - layout.high[:, None, 2]) / 0.05,
        _flag(both_furniture & ~kind.of(SEATS)[:, None] & ~kind.of(SEATS)[None, :]),
    )
    leans = _unless(leans, supported, supported.T, fixed, fixed.T)
    level = np.abs(layout.low[:, None, 2] - layout.low[None, :, 2])
    beside = np.maximum(
        _all(
            (NEAR_FURNITURE_M - layout.gap_m) / 0.1,
            (NEAR_FURNITURE_M - np.maximum(layout.clearance_m, layout.clearance_m.T)) / 0.1,
            _flag(both_furniture),
        ),
        _all(
            (NEAR_SMALL_M - layout.gap_m) / 0.03,
            (LEVEL_M - level) / 0.03,
            _flag(both_small),
        ),
    )
    closer = (supported, supported.T, inside, inside.T, fixed, fixed.T, over, over.T)
    seated = _flag(kind.of(TABLES)[:, None] & kind.of(SEATS)[None, :])
    beside = _unless(beside, *closer, leans, leans.T)
    with_ = _all(beside, (0.35 - layout.gap_m) / 0.1, seated)
    near = _unless(beside, with_)

    on_ground = _flag(kind.of(GROUND)[None, :])
    on_wall = _flag(kind.of(WALLS)[None, :])
    stands = _all(supported, _flag(is_furniture[:, None]) + on_ground)
    flush = _all((0.08 - layout.gap_m) / 0.03, on_wall)
    return {
        "on": supported,
        "in": inside,
        "attached to": np.maximum(fixed, flush - 1.0),
        "above": over,
        "under": over.T,
        "against": leans,
        "near": near,
        "with": with_,
        "standing on": np.maximum(supported - 0.5, stands),
        "supported by": supported,
        "hanging on": np.maximum(fixed - 0.5, flush - 0.5),
        "build in": _all(fixed, _flag(kind.of(frozenset({"sink", "window"}))[:, None])),
        "connected to": leans,
    }


class _Kinds:
    def __init__(self, class_names: list[str]) -> None:
        self._names = class_names

    def of(self, names: frozenset[str]) -> Bool:
        return np.array([name in names for name in self._names], dtype=bool)

    def fixed_to(self) -> Bool:
        return np.array(
            [
                [target in FIXED_TO.get(subject, frozenset()) for target in self._names]
                for subject in self._names
            ],
            dtype=bool,
        )


def _flag(condition: Bool) -> Float64:
    """A condition that holds or does not, as a logit bound."""
    return np.where(condition, CEILING_LOGIT, FLOOR_LOGIT)


def _all(*conditions: Float64) -> Float64:
    """The weakest of the conditions decides."""
    result = conditions[0]
    for condition in conditions[1:]:
        result = np.minimum(result, condition)
    return np.clip(result, FLOOR_LOGIT, CEILING_LOGIT)


def _unless(logits: Float64, *stronger: Float64) -> Float64:
    """Logits lowered where a more specific predicate holds for the pair, either way round."""
    taken = stronger[0]
    for other in stronger[1:]:
        taken = np.maximum(taken, other)
    return np.asarray(np.minimum(logits, np.maximum(-taken, FLOOR_LOGIT)))
