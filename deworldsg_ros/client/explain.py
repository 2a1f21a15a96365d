"""Why an object or a relation is in the graph, or is not, in short sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.boxes import (
    Footprint,
    footprint,
    gap_m,
    horizontal_gap_m,
    vertical_gap_m,
)
from deworldsg_ros.client.meanings import is_class
from deworldsg_ros.client.objects import HiddenObject, Point, Relation, SceneObject, odds_of
from deworldsg_ros.graph.messages import ABSENT
from deworldsg_ros.graph.pairs import Between, contradicted
from deworldsg_ros.graph.provenance import SeenFrames, SeenSpace
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.vocabulary import CARRY_ON_TOP, PREDICATES, plain

# Two boxes are in contact below this gap: the error of a measured extent.
CONTACT_M = 0.04
# Objects near a place that an answer lists at most.
MOST_NEAR = 5
# A class with a lower probability is not named as a guess.
LEAST_GUESS = 0.1
# A place was never in view if less than LEAST_SEEN of the space within AROUND_M of it was seen.
AROUND_M, LEAST_SEEN = 0.3, 0.1
ANYTHING = "anything"


@dataclass(frozen=True)
class Explanation:
    """The reasons of an answer.

    Attributes:
        subject: what is explained.
        lines: one sentence each.
        values: the same as plain values for JSON.
    """

    subject: str
    lines: tuple[str, ...]
    values: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; of a relation, `subject` is its subject."""
        return {"subject": self.subject, "lines": list(self.lines), **self.values}

    def __str__(self) -> str:
        return "\n".join([self.subject, *(f"  {line}" for line in self.lines)])


def explain_object(
    item: SceneObject, relations: Sequence[Relation], seen: SeenFrames | None = None
) -> Explanation:
    """Why an object is in the graph and has its name.

    Args:
        item: the object.
        relations: all relations of the object.
        seen: its frames; None = not known.
    """
    frames, seconds = item.observations, (item.last_seen_ns - item.first_seen_ns) / 1e9
    lines = [f"detected in {counted(frames, 'frame')} over {seconds:.1f} s", *_frame_lines(seen)]
    names = ", ".join(f"{belief.label} {belief.probability:.0%}" for belief in item.classes[:3])
    what = f"is a {item.label}" if item.is_named else "is an object without a name"
    sure = "" if item.is_sure else ": not sure"
    lines.append(f"{what} with {item.probability:.0%} ({odds_of(item.probability)}){sure}")
    if item.existence is not None:
        lines.append(f"exists with {item.existence:.0%}")
    if item.is_labelled_by_hand:
        lines.append(f"{item.label}: set by the operator")
    else:
        kind = "if it exists" if item.is_named else "no class is probable enough for a name"
        lines.append(f"{kind}: {names}; all others {item.other_classes:.0%}")
    looks = f"{len(item.surface_m)} surface points" if len(item.surface_m) else "no surface points"
    size = " x ".join(item.size_words)
    lines.append(f"box {size} cm, from the {item.box_source}; {looks} in this message")
    if item.is_partly_seen:
        lines.append("partly seen: no view shows where the sides with ≥ end")
    if item.colour_lab is not None:
        lab = ", ".join(f"{value:.0f}" for value in item.colour_lab)
        lines.append(f"colour: {item.colour} (CIELAB {lab})")
    lines += [f"{relation.text}: {relation.probability:.0%}" for relation in relations[:5]]
    values = {**item.to_dict(), "relations": [relation.to_dict() for relation in relations]}
    values["frames"] = _frame_values(seen)
    return Explanation(item.name, tuple(lines), values)


def explain_relation(relation: Relation, seen: SeenFrames | None = None) -> Explanation:
    """Why a relation is in the graph: frames, sources, and the geometry of the two objects.

    The geometry is the one that the relation was judged by, if the message has it.
    """
    geometry = relation_geometry(relation)
    lines = [
        f"holds with {relation.probability:.0%} ({odds_of(relation.probability)})",
        f"holds, and both are what they are called: {relation.triplet_probability:.0%}"
        + ("" if relation.is_sure else ": not sure"),
        f"evidence: {relation.evidence}",
        *_frame_lines(seen),
        f"no relation at all: {relation.unrelated:.0%}",
        geometry_line(geometry),
    ]
    if is_contradicted(relation):
        lines.append("the measured surfaces contradict it")
    others = [item for item in relation.predicates if item.label != relation.predicate]
    likely = [item for item in others if item.probability >= 0.01]
    if likely:
        names = ", ".join(f"{item.label} {item.probability:.0%}" for item in likely[:3])
        lines.append(f"other predicates: {names}")
    values = {**relation.to_dict(), **geometry, "frames": _frame_values(seen)}
    return Explanation(relation.text, tuple(lines), values)


def _frame_lines(seen: SeenFrames | None) -> list[str]:
    """The frames of an object or a relation, as a sentence; stamps in seconds."""
    if seen is None:
        return []
    clearest = ", ".join(
        f"{frame.stamp_ns / 1e9:.3f} ({frame.name} {frame.strength:.0%})" for frame in seen.clearest
    )
    first, last = seen.first_ns / 1e9, seen.last_ns / 1e9
    return [f"frames: first {first:.3f}, last {last:.3f}, clearest {clearest}"]


def _frame_values(seen: SeenFrames | None) -> dict[str, Any] | None:
    if seen is None:
        return None
    clearest = [
        {"stamp_ns": frame.stamp_ns, "name": frame.name, "strength": frame.strength}
        for frame in seen.clearest
    ]
    return {"first_ns": seen.first_ns, "last_ns": seen.last_ns, "clearest": clearest}


def explain_absence(
    asked: str, hidden: Sequence[HiddenObject] | None, objects: Sequence[SceneObject]
) -> Explanation:
    """Why there is no object of a class.

    Args:
        asked: the class.
        hidden: objects that were detected and are not in the graph; None = not known.
        objects: all objects of the graph.
    """
    lines = []
    possible = sorted(
        (item for item in objects if item.probability_of(asked) >= 0.01),
        key=lambda item: -item.probability_of(asked),
    )
    for item in possible[:5]:
        lines.append(f"{item.name} may be one: {item.probability_of(asked):.0%}")
    found = [item for item in hidden or () if is_class(asked, item.label)]
    for hidden_item in found:
        place = " ".join(f"{value:.2f}" for value in hidden_item.position_m)
        lines.append(
            f"hidden at {place}: {hidden_item.reason}; detected in {hidden_item.observations} "
            f"frames, exists with {hidden_item.existence:.0%}"
        )
    if hidden is None:
        lines.append("hidden objects: not in this message; a saved file lists them")
    elif not found:
        lines.append("no hidden object of this class: it was never detected, or long ago")
    values = {
        "label": asked,
        "candidates": {item.id: round(item.probability_of(asked), 3) for item in possible},
        "hidden": [item.to_dict() for item in found],
    }
    return Explanation(f"no object of class '{asked}'", tuple(lines), values)


@dataclass(frozen=True)
class Place:
    """A class, and where one was expected.

    Attributes:
        label: the class; "anything" for any.
        point_m: the point, world frame; of two numbers the horizontal ones, with any height.
        is_column: whether the height is open.
        within_m: largest distance.
    """

    label: str
    point_m: Point
    is_column: bool
    within_m: float = 1.0

    def gap_m(self, position_m: Point, item: SceneObject | None, up: Point) -> float:
        """Distance of the place from the box of an object, or from a position without a box."""
        here = _footprint_of(self.point_m, up)
        there = _footprint_of(position_m, up) if item is None else item.footprint
        return horizontal_gap_m(here, there) if self.is_column else gap_m(here, there)


_NUMBER = r"[+-]?[0-9]{0,9}\.?[0-9]{1,9}"
_PLACE = re.compile(
    rf"(.+?)\s+near\s*\(\s*({_NUMBER})\s*,\s*({_NUMBER})\s*(?:,\s*({_NUMBER})\s*)?\)"
    r"(?:\s+within\s+([0-9]{0,9}\.?[0-9]{1,9})\s*(cm|m)?)?"
)
# Of a class and a place. The pattern takes the square of the length.
MAX_PLACE_CHARACTERS = 1000
_PLACE_LIKE = re.compile(r"\bnear\s*\(")


def place_of(text: str, up: Point) -> Place | None:
    """The place that a text such as ``chair near (1.6, -0.5)`` names; None if it names none.

    Two numbers are the two horizontal coordinates, in the order of the axes; a third one, of the
    vertical axis, makes them a point. After them, ``within 50 cm`` is the largest distance; else it
    is 1 m.

    Raises:
        ClientError: for other numbers after ``near (``.
    """
    if len(text) > MAX_PLACE_CHARACTERS:
        return None
    match = _PLACE.fullmatch(text.strip())
    if match is None:
        if _PLACE_LIKE.search(text):
            raise ClientError(
                f"'{text[:80]}': expected a place such as 'chair near (1.6, -0.5)', in metres and "
                "without exponents, and perhaps 'within 50 cm' after it"
            )
        return None
    label, *numbers, within, unit = match.groups()
    within_m = float(within or 1.0) * (0.01 if unit == "cm" else 1.0)
    values = [float(number) for number in numbers if number is not None]
    if len(values) == 2:
        values.insert(int(np.argmax(np.abs(up))), 0.0)
    return Place(label, (values[0], values[1], values[2]), numbers[2] is None, within_m)


def _footprint_of(position_m: Point, up: Point) -> Footprint:
    return footprint(position_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), up)


def explain_place(
    place: Place,
    objects: Sequence[SceneObject],
    hidden: Sequence[HiddenObject] | None,
    space: SeenSpace | None,
    up: Point,
) -> Explanation:
    """What is known of an object of a class near a place.

    Args:
        place: the class and the place.
        objects: all objects of the graph.
        hidden: objects that were detected and are not in the graph; None = not known.
        space: what the camera has seen; None = not known.
        up: unit vector against gravity, world frame.
    """
    gaps = [(place.gap_m(item.position_m, item, up), item) for item in objects]
    near = [pair for pair in sorted(gaps, key=itemgetter(0)) if pair[0] <= place.within_m]
    apart = [(place.gap_m(item.position_m, None, up), item) for item in hidden or ()]
    asides = [pair for pair in sorted(apart, key=itemgetter(0)) if pair[0] <= place.within_m]
    lines = [_object_line(place, gap, item) for gap, item in near[:MOST_NEAR]]
    lines += [
        f"{_fate(item)}, {gap:.2f} m away: {item.label}, {item.reason}; detected in "
        f"{counted(item.observations, 'frame')}, exists with {item.existence:.0%}"
        for gap, item in asides[:MOST_NEAR]
    ]
    more = len(near) + len(asides) - len(lines)
    if more:
        lines.append(f"and {more} more")
    if hidden is None:
        lines.append("hidden objects: not in this message; a saved file lists them")
    shares = _space_there(place, objects, space, up)
    lines.append(_space_line(shares))
    values = {
        "label": place.label,
        "near_m": list(place.point_m),
        "any_height": place.is_column,
        "within_m": place.within_m,
        "known": _verdict(place, [item for _, item in near], [item for _, item in asides], shares),
        "objects": [{"gap_m": round(gap, 3), **item.to_dict()} for gap, item in near],
        "hidden": [{"gap_m": round(gap, 3), **item.to_dict()} for gap, item in asides],
        "space": shares,
    }
    axes = np.arange(3) != np.argmax(np.abs(up)) if place.is_column else np.ones(3, bool)
    at = ", ".join(f"{value:.2f}" for value in np.array(place.point_m)[axes])
    subject = f"{place.label} near ({at}), within {place.within_m:g} m: {values['known']}"
    return Explanation(subject, tuple(lines), values)


def _fate(item: HiddenObject) -> str:
    return "removed" if item.reason == ABSENT else "hidden"


def _is_one(place: Place, label: str) -> bool:
    return place.label == ANYTHING or is_class(place.label, label)


def _object_line(place: Place, gap: float, item: SceneObject) -> str:
    guesses = ", ".join(f"{belief.label} {belief.probability:.0%}" for belief in item.classes[:3])
    line = f"{item.name}, {gap:.2f} m away: {guesses}"
    if not item.is_named:
        return f"{line}; no class is probable enough for a name"
    if _is_one(place, item.label):
        return line
    return f"{line}; a {place.label} with {item.probability_of(place.label):.0%}"


def _verdict(
    place: Place,
    near: Sequence[SceneObject],
    hidden: Sequence[HiddenObject],
    shares: dict[str, float] | None,
) -> str:
    """What is known, in a few words: the surest first."""
    any_ = place.label == ANYTHING
    ones = [item for item in near if any_ or (item.is_named and _is_one(place, item.label))]
    if ones:
        return f"{ones[0].name} is there"
    unseen = [item for item in hidden if _is_one(place, item.label)]
    guessed = [item for item in near if item.probability_of(place.label) >= LEAST_GUESS]
    if guessed:
        best = max(guessed, key=lambda item: item.probability_of(place.label))
        return f"{best.name} may be it"
    if unseen:
        return f"{_fate(unseen[0])}: {unseen[0].reason}"
    if near:
        return f"other objects are there, {near[0].name} the nearest"
    if hidden:
        return f"something else there is {_fate(hidden[0])}: {hidden[0].reason}"
    if shares is None:
        return "nothing was detected there"
    if shares["free"] + shares["occupied"] < LEAST_SEEN:
        return "never in view"
    return "nothing was detected there, though it was in view"


def _space_there(
    place: Place, objects: Sequence[SceneObject], space: SeenSpace | None, up: Point
) -> dict[str, float] | None:
    """Parts of the place that were seen as free and as occupied; None = not known."""
    if space is None:
        return None
    steps = np.linspace(-AROUND_M, AROUND_M, 7)
    offsets = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    points = np.array(place.point_m) + offsets
    if place.is_column:
        heights = [item.height_m for item in objects] or [0.0]
        low, high = min(heights) - AROUND_M, max(heights) + AROUND_M
        spread = (offsets @ np.array(up) / AROUND_M + 1) / 2
        wanted = low + spread * (high - low)
        points += (wanted - points @ np.array(up))[:, None] * np.array(up)
    free, occupied = space.look(points)
    return {"free": round(float(free.mean()), 3), "occupied": round(float(occupied.mean()), 3)}


def _space_line(shares: dict[str, float] | None) -> str:
    if shares is None:
        return "free space and views: not known here; the folder of a run has them"
    unseen = 1.0 - shares["free"] - shares["occupied"]
    return (
        f"the space there: {shares['free']:.0%} seen as free, {shares['occupied']:.0%} as a "
        f"surface, {unseen:.0%} never in view"
    )


def explain_no_relation(a: SceneObject, b: SceneObject) -> Explanation:
    """Why there is no relation between two objects."""
    geometry = pair_geometry(a, b)
    lines = (
        "no predicate is probable enough to be published in either direction",
        geometry_line(geometry),
    )
    return Explanation(f"{a.name} and {b.name}", lines, geometry)


def relation_geometry(relation: Relation) -> dict[str, Any]:
    """The measured geometry of a relation; that of the boxes if it is not in the message."""
    if relation.measured_m is None:
        return pair_geometry(relation.subject, relation.object)
    gap, rise, fall = relation.measured_m
    whole = math.hypot(gap, max(rise, fall, 0.0))
    return {
        "gap_m": round(whole, 3),
        "horizontal_gap_m": gap,
        "bottom_above_top_m": rise,
        "contact": whole <= CONTACT_M,
        "from": "surfaces",
    }


def is_contradicted(relation: Relation) -> bool:
    """Whether the measured geometry contradicts a relation; false if it is not in the message."""
    kinds = [i for i, names in enumerate(PREDICATES) if plain(relation.predicate) in names]
    if relation.measured_m is None or not kinds:
        return False
    between = Between(*(np.array([value]) for value in relation.measured_m))
    on_top = np.array([plain(relation.object.label) in CARRY_ON_TOP])
    return bool(contradicted(between, on_top)[0, kinds[0]])


def pair_geometry(a: SceneObject, b: SceneObject) -> dict[str, Any]:
    """Gaps of two boxes in metres, and whether they are in contact."""
    gap = gap_m(a.footprint, b.footprint)
    return {
        "gap_m": round(gap, 3),
        "horizontal_gap_m": round(horizontal_gap_m(a.footprint, b.footprint), 3),
        "bottom_above_top_m": round(vertical_gap_m(a.footprint, b.footprint), 3),
        "contact": gap <= CONTACT_M,
        "from": "boxes",
    }


def geometry_line(geometry: dict[str, Any]) -> str:
    """The geometry of a pair as a sentence."""
    contact = "in contact" if geometry["contact"] else "not in contact"
    rise_cm = round(100 * geometry["bottom_above_top_m"])
    return (
        f"{geometry['from']}: {contact}, gap {100 * geometry['gap_m']:.0f} cm; the bottom of the "
        f"first is {abs(rise_cm)} cm {'above' if rise_cm >= 0 else 'below'} the top of the second"
    )
