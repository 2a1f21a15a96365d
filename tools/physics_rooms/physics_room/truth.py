"""Relations of a room, from what the physics measured.

README.md in the folder above states the rules.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deworldsg_ros.relations.rules import NEAR_FLOOR_M, NEAR_SUPPORT_M, NEAREST, SEAT_GAP_M

from .bodies import Bodies
from .holding import MIN_UPWARD, Holding
from .labels import CHAIRS, SEATS, TABLES, visual_genome
from .shapes import Item
from .simulate import FLOOR, Outcome

# A second support is a relation of its own from this share on; below, and above UNCLEAR_SHARE, the
# pair is unclear.
SECOND_SHARE = 0.4
UNCLEAR_SHARE = 0.15
AGAINST_GAP_M, AGAINST_UNCLEAR_M = 0.05, 0.07
AGAINST_SHARE, AGAINST_HEIGHT_M = 0.5, 0.3
SKEW_RAD = np.deg2rad(15)
OVER_SHARE, OVER_LOW_M, OVER_HIGH_M = 0.5, -0.02, 1.2
OVER_UNCLEAR = (0.38, 0.62)
# The rule in the package allows more, because neighbours hide bottoms.
LEVEL_M = 0.04

PREDICATES = {
    "above": 0,
    "against": 2,
    "attached to": 6,
    "in": 21,
    "near": 28,
    "on": 30,
    "under": 42,
    "with": 49,
}


@dataclass
class Truth:
    """Relations and the physics behind them.

    Attributes:
        relations: predicate by (subject, object).
        unclear: pairs that two people might judge differently; leave them out.
        physics: by item number: supports, falls_without, on_floor, leans_on, near_gaps_m.
    """

    relations: dict[tuple[int, int], str] = field(default_factory=dict)
    unclear: set[tuple[int, int]] = field(default_factory=set)
    physics: dict[int, dict[str, Any]] = field(default_factory=dict)

    def say(self, subject: Item, predicate: str, other: Item) -> None:
        """Add a relation, unless the ordered pair has one."""
        self.relations.setdefault((subject.number, other.number), predicate)

    def linked(self, a: Item, b: Item) -> bool:
        """Whether a relation holds in either direction."""
        pair = (a.number, b.number)
        return pair in self.relations or pair[::-1] in self.relations


class Judge:
    """Judges the items of a room at rest.

    Args:
        items: numbered, with their final poses.
        outcome: of the simulation.
        visible: numbers of the items that can be detected; the others do not count as neighbours.
    """

    def __init__(self, items: list[Item], outcome: Outcome, visible: set[int]) -> None:
        self.items = items
        self.by_number = {item.number: item for item in items}
        self.outcome = outcome
        self.visible = visible
        self.truth = Truth()
        self.bodies = Bodies(items)
        self.holding = Holding(items, outcome, self.bodies)
        self.supports, self.container = self.holding.supports, self.holding.container

    def judge(self) -> Truth:
        """All relations; see README.md."""
        for item in self.items:
            self._say_support(item)
        self.parent = {}
        for (subject, other), predicate in self.truth.relations.items():
            self.parent.setdefault(subject, other)
            del predicate
        floor = [i for i in self.items if self._on_floor(i)]
        for a in floor:
            for b in floor:
                if a is not b:
                    self._against(a, b)
        self._over(floor)
        self._with(floor)
        self._near(floor)
        for item in self.items:
            self._record(item)
        return self.truth

    def _say_support(self, item: Item) -> None:
        holder = self.container[item.number]
        if holder is not None:
            self.truth.say(item, "in", holder)
            for support in self.supports[item.number]:
                if support.number > 0 and support.number != holder.number:
                    self._doubt(item, self.by_number[support.number])
            return
        if item.anchor == "item" and item.holder is not None:
            self.truth.say(item, "attached to", item.holder)
            return
        for rank, support in enumerate(s for s in self.supports[item.number] if s.number > 0):
            other = self.by_number[support.number]
            if (rank == 0 and support.share >= 0.34) or support.share >= SECOND_SHARE:
                self.truth.say(item, "on", other)
            elif support.share >= UNCLEAR_SHARE:
                self._doubt(item, other)

    def _doubt(self, a: Item, b: Item) -> None:
        self.truth.unclear.add((a.number, b.number))
        self.truth.unclear.add((b.number, a.number))

    def _on_floor(self, item: Item) -> bool:
        if item.anchor == "world":
            return item.kind == "furn"
        found = self.supports[item.number]
        return bool(found) and found[0].number == FLOOR

    def _against(self, a: Item, b: Item) -> None:
        if a.label in SEATS or b.label in SEATS:
            return
        if self.bodies.top(a) > self.bodies.top(b) or self.truth.linked(a, b):
            return
        tall = min(self.bodies.top(a), self.bodies.top(b))
        distance = self.bodies.gap(a, b)
        if (
            distance > AGAINST_UNCLEAR_M
            or tall < AGAINST_HEIGHT_M
            or self.bodies.overlap(a, b) > 0.1
        ):
            return
        share, skew = self.bodies.side_by_side(a, b)
        if skew > SKEW_RAD or share < 0.4:
            if share > 0.25:
                self._doubt(a, b)
        elif distance > AGAINST_GAP_M or share < AGAINST_SHARE or tall < AGAINST_HEIGHT_M + 0.05:
            self._doubt(a, b)
        elif {a.kind, b.kind} != {"furn"}:
            # A basket or a box is no furniture, but many would say it all the same.
            self._doubt(a, b)
        else:
            self.truth.say(a, "against", b)

    def _over(self, floor: list[Item]) -> None:
        on_floor = {i.number for i in floor}
        large = [
            i for i in self.items if i.kind in ("furn", "wallm", "screen") or i.number in on_floor
        ]
        for a in large:
            for b in large:
                if a is not b and not self._stacked(a, b):
                    self._over_pair(a, b, a.number in on_floor)

    def _over_pair(self, a: Item, b: Item, a_on_floor: bool) -> None:
        space = self.bodies.bottom(a) - self.bodies.top(b)
        tucked = (
            a_on_floor and b.label in (*TABLES, "bench") and self.bodies.top(a) < self.bodies.top(b)
        )
        if not (OVER_LOW_M <= space <= OVER_HIGH_M or tucked):
            return
        share = self.bodies.overlap(a, b)
        if OVER_UNCLEAR[0] < share < OVER_UNCLEAR[1]:
            self._doubt(a, b)
        elif share >= OVER_SHARE:
            over, below = (b, a) if tucked else (a, b)
            self.truth.say(over, "above", below)
            self.truth.say(below, "under", over)

    def _stacked(self, a: Item, b: Item) -> bool:
        """Whether supports or welds lead from one to the other."""
        for first, second in ((a, b), (b, a)):
            number: int | None = first.number
            while number is not None:
                number = self.parent.get(number)
                if number == second.number:
                    return True
        return False

    def _with(self, floor: list[Item]) -> None:
        for table in (i for i in floor if i.label in TABLES):
            for seat in (i for i in floor if i.label in CHAIRS):
                distance = self.bodies.gap(table, seat)
                if distance <= SEAT_GAP_M:
                    self.truth.say(table, "with", seat)
                    self.truth.say(seat, "near", table)
                elif distance <= SEAT_GAP_M + 0.04:
                    self._doubt(table, seat)

    def _near(self, floor: list[Item]) -> None:
        groups: list[tuple[list[Item], float]] = [(floor, NEAR_FLOOR_M)]
        by_parent: dict[int, list[Item]] = {}
        for item in self.items:
            parent = self.parent.get(item.number)
            if parent is not None and item.kind in ("small", "screen") and item.anchor == "free":
                by_parent.setdefault(parent, []).append(item)
        groups += [(group, NEAR_SUPPORT_M) for group in by_parent.values()]
        for group, reach in groups:
            self._near_group([i for i in group if i.number in self.visible], reach)

    def _near_group(self, group: list[Item], reach: float) -> None:
        distances: dict[tuple[int, int], float] = {}
        for a in group:
            for b in group:
                if a is b or self.bodies.apart(a, b) > reach * 1.2:
                    continue
                level = abs(self.bodies.bottom(a) - self.bodies.bottom(b)) <= LEVEL_M
                if level:
                    distances[a.number, b.number] = self.bodies.gap(a, b)
        for (a, b), distance in distances.items():
            first, second = self.by_number[a], self.by_number[b]
            if a > b or distance > reach or self.truth.linked(first, second):
                continue
            ranks = [self._rank(distances, x, y) for x, y in ((a, b), (b, a))]
            if max(ranks) < NEAREST and not self.bodies.between(first, second, group):
                self.truth.say(first, "near", second)
                self.truth.say(second, "near", first)
                self.physics(a)["near_gaps_m"][str(b)] = round(distance, 4)
                self.physics(b)["near_gaps_m"][str(a)] = round(distance, 4)

    def _rank(self, distances: dict[tuple[int, int], float], a: int, b: int) -> int:
        own = distances[a, b]
        return sum(
            d < own - 1e-9 or (abs(d - own) <= 1e-9 and y < b)
            for (x, y), d in distances.items()
            if x == a and y != b
        )

    def physics(self, number: int) -> dict[str, Any]:
        """The record of an item, made when first asked for."""
        return self.truth.physics.setdefault(number, {"near_gaps_m": {}})

    def _record(self, item: Item) -> None:
        record = self.physics(item.number)
        record["supports"] = [
            {
                "id": s.number,
                "share": round(s.share, 3),
                "normal": [round(float(v), 3) for v in s.normal],
            }
            for s in self.supports[item.number]
        ]
        record["falls_without"] = sorted(self.outcome.falls_without.get(item.number, set()))
        record["on_floor"] = self._on_floor(item)
        record["fixed_to"] = (
            None if item.anchor == "free" else (item.holder.number if item.holder else 0)
        )
        leans = {
            lower for (upper, lower), touch in self.outcome.touches.items()
            if upper == item.number and max(abs(n[2]) for n in touch.normals) < MIN_UPWARD
        }  # fmt: skip
        record["leans_on"] = sorted(leans)
        for other in leans:
            if (
                other > 0
                and not self.truth.linked(item, self.by_number[other])
                and item.anchor == "free"
            ):
                record.setdefault("touches_beside", []).append(other)


def relation_rows(truth: Truth, keep: set[int]) -> list[list[Any]]:
    """[subject, object, index, predicate] of the relations between kept items."""
    return [
        [subject, other, PREDICATES[name], name]
        for (subject, other), name in sorted(truth.relations.items())
        if subject in keep and other in keep
    ]


def has_class(item: Item) -> bool:
    """Whether an item can be a node."""
    return visual_genome(item.label) is not None
