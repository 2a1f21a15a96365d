"""Questions in words ("cup on dining table", "chair within 1 m of table"), and their answers."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.grammar import RANKS, Condition, Like, Pattern, Rank, Since, parse
from deworldsg_ros.client.graph import SceneGraph, distance_m
from deworldsg_ros.client.meanings import colour_shares, is_class, room_kind
from deworldsg_ros.client.objects import (
    NO_ROOMS,
    SURE,
    UNNAMED_ROOM,
    HiddenObject,
    Point,
    Relation,
    Room,
    SceneObject,
    odds_of,
    room_words,
)
from deworldsg_ros.client.removal import carriers_of
from deworldsg_ros.scene.errors import ClientError

# Answers that are less probable are left out.
MIN_PROBABILITY = 0.05
# Nothing is the second, third, … of an order if the most probable one is that with less.
MIN_RANKED = 0.2
# The opposite of "on".
UNDER = frozenset({"under", "below"})
# The most that one question may cost: objects that are compared, and seconds. A question that a
# person asks of ten thousand objects compares a tenth of it.
MOST_COMPARED, LIMIT_S = 1_000_000, 2.0
# Seconds of a time that is asked for: stamps reach as far.
MOST_S = 1e10


class _Budget:
    """The work and the time that are left for a question."""

    def __init__(self, question: str) -> None:
        self._question = question
        self._left, self._end_s = MOST_COMPARED, time.monotonic() + LIMIT_S

    def spend(self, compared: int) -> None:
        """Note that so many objects are compared next; raises ClientError if it is too much."""
        self._left -= compared
        if self._left < 0 or time.monotonic() > self._end_s:
            raise ClientError(
                f"question '{self._question}' takes too long: expected fewer conditions, or "
                "a class in place of 'anything'"
            )


@dataclass(frozen=True)
class Answer:
    """An object that fulfils a pattern.

    Attributes:
        item: the object.
        probability: that it exists, is of the class, and fulfils all conditions; the factors count
            as independent.
        relations: the relations that were used.
        evidence: in words.
    """

    item: SceneObject
    probability: float
    relations: tuple[Relation, ...]
    evidence: str

    @property
    def is_sure(self) -> bool:
        """Whether `probability` is at least `SURE`."""
        return self.probability >= SURE

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "object": self.item.to_dict(),
            "probability": round(self.probability, 3),
            "odds": odds_of(self.probability),
            "sure": self.is_sure,
            "evidence": self.evidence,
            "relations": [relation.to_dict() for relation in self.relations],
        }


@dataclass(frozen=True)
class RoomAnswer:
    """A room that fulfils a pattern.

    Attributes:
        room: the room.
        probability: that it is of the kind, and fulfils all conditions.
        evidence: in words.
    """

    room: Room
    probability: float
    evidence: str

    @property
    def is_sure(self) -> bool:
        """Whether `probability` is at least `SURE`."""
        return self.probability >= SURE

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "room": self.room.to_dict(),
            "probability": round(self.probability, 3),
            "odds": odds_of(self.probability),
            "sure": self.is_sure,
            "evidence": self.evidence,
        }


@dataclass(frozen=True)
class Answers:
    """The answers to a pattern.

    Attributes:
        question: as asked.
        found: the most probable first, or by the rank that was asked for.
        rooms: of a question for rooms, in place of `found`.
        notes: what else is worth knowing: how a word was understood, why there is no answer.
        count: of "how many": how many of them are more probable than not; else None.
        probability: of "is there": that at least one object fulfils the question; of "is the": that
            the most probable one does, if it exists; else None.
        colour: of "what colour": the name, and the next one if it is likely, too; else None.
    """

    question: str
    found: tuple[Answer, ...]
    notes: tuple[str, ...] = field(default=())
    rooms: tuple[RoomAnswer, ...] = field(default=())
    count: int | None = None
    probability: float | None = None
    colour: str | None = None

    @property
    def said(self) -> str | None:
        """The answer to "how many", "is there" or "what colour"; None for other questions."""
        if self.colour is not None:
            return self.colour
        if self.count is not None:
            expected = sum(one.probability for one in self.found)
            expected += sum(one.probability for one in self.rooms)
            return f"{self.count} (expected number: {expected:.1f})"
        if self.probability is None:
            return None
        if self.probability < 1e-9:
            return "no: nothing in the graph fulfils it"
        word = "yes" if self.probability >= 0.5 else "no"
        doubt = "" if max(self.probability, 1.0 - self.probability) >= SURE else ", not sure"
        odds = odds_of(self.probability)
        return f"{word}{doubt} ({odds if odds == 'certain' else f'odds {odds}'})"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        values: dict[str, Any] = {
            "question": self.question,
            "answers": [answer.to_dict() for answer in self.found],
            "notes": list(self.notes),
        }
        if self.rooms:
            values["rooms"] = [answer.to_dict() for answer in self.rooms]
        if self.count is not None:
            values["count"] = self.count
        if self.probability is not None:
            values["probability"] = round(self.probability, 3)
        if self.colour is not None:
            values["colour"] = self.colour
        if self.said is not None:
            values["said"] = self.said
        return values


def absence_notes(
    thing: str, hidden: Sequence[HiddenObject] | None, labels: Sequence[str]
) -> list[str]:
    """Why there is no object of a class: hidden ones, or the classes that there are."""
    found = [item for item in hidden or () if is_class(thing, item.label)]
    notes = [
        f"a {item.label} was detected in {counted(item.observations, 'frame')} and is hidden: "
        f"{item.reason}"
        for item in found
    ]
    if not any(is_class(thing, label) for label in labels):
        notes.append(f"no object of class '{thing}'; classes of the graph: {', '.join(labels)}")
    return notes


# --- Answers questions in words from a graph.

# Part of an answer: probability, relation or None, words.
_Part = tuple[float, Relation | None, str]


def ask(graph: SceneGraph, question: str) -> Answers:
    """Answer a pattern such as "cup on dining table", or "what changed since 10 s ago".

    A single graph knows of changes only when each object was first and last seen.

    Raises:
        ClientError: if the question cannot be read.
    """
    asked = parse(question, {edge.predicate for edge in graph.message.edges})
    if isinstance(asked, Since):
        return _seen_since(graph, question, asked)
    if isinstance(asked, Like):
        return _look_like(graph, question, asked)
    if _is_room(graph, asked.thing):
        return _ask_rooms(graph, question, asked)
    pattern, notes = _understood(graph, asked)
    items = graph.objects(pattern.thing, min_probability=MIN_PROBABILITY)
    if pattern.kind == "holds":
        items = items[:1]
    if not any(item.colour for item in graph) and _asks_for_colour(pattern):
        notes.append("no object of the graph has a colour: it was made by an older release")
    budget = _Budget(question)
    answers = [
        answer for item in items if (answer := _answer(graph, pattern, item, budget)) is not None
    ]
    answers.sort(key=lambda answer: (-answer.probability, answer.item.id))
    if pattern.rank is not None:
        answers, more = _ranked(graph, pattern.rank, answers)
        notes += more
    if pattern.kind == "colour":
        answers = answers[:1]
    if not answers:
        notes.insert(0, f"nothing fulfils this with {_least(pattern.rank):.0%} or more")
    chances = [answer.probability for answer in answers]
    return Answers(
        question,
        tuple(answers),
        tuple(notes),
        count=sum(chance >= 0.5 for chance in chances) if pattern.kind == "count" else None,
        # The objects count as independent.
        probability=1.0 - math.prod(1.0 - chance for chance in chances)
        if pattern.kind in ("exists", "holds")
        else None,
        colour=_colour_in_words(answers[0].item) if pattern.kind == "colour" and answers else None,
    )


def _asks_for_colour(pattern: Pattern) -> bool:
    asked = [name for one in pattern.conditions for name in (one.colour, one.own_colour)]
    of_rank = None if pattern.rank is None else pattern.rank.colour
    return pattern.kind == "colour" or any([*asked, of_rank])


def _colour_in_words(item: SceneObject) -> str:
    """The colour of an object: "red", "grey or black"."""
    if item.colour_lab is None:
        return "its colour is not known"
    shares = colour_shares(item.colour_lab)
    best = max(shares.values())
    names = [name for name, share in shares.items() if share >= 0.5 * best]
    lightness, a, b = item.colour_lab
    return f"{' or '.join(names[:2])} (CIELAB {lightness:.0f}, {a:.0f}, {b:.0f})"


def _things(
    items: Iterable[SceneObject], thing: str | None, colour: str | None
) -> list[tuple[SceneObject, float, float]]:
    """The objects that may be a thing of a colour, with the probabilities of both; best first."""
    found = []
    for item in items:
        of_class = 1.0 if thing is None else item.probability_of(thing)
        of_colour = 1.0 if colour is None else item.probability_of_colour(colour)
        if of_class * of_colour >= MIN_PROBABILITY:
            found.append((item, of_class, of_colour))
    return sorted(found, key=lambda one: (-one[1] * one[2], one[0].id))


def _understood(graph: SceneGraph, asked: Pattern) -> tuple[Pattern, list[str]]:
    """The pattern with the classes that are meant, and how each was understood."""
    notes: dict[str, None] = {}

    def meant(thing: str | None) -> str | None:
        if thing is None:
            return None
        understood = graph.understand(thing)
        notes.update(dict.fromkeys(filter(None, [understood.note])))
        notes.update(dict.fromkeys(absence_notes(understood.meant, graph.hidden, graph.labels)))
        return understood.meant

    rank = asked.rank
    pattern = replace(
        asked,
        thing=meant(asked.thing),
        conditions=tuple(
            one if _is_in_room(graph, one) else replace(one, thing=meant(one.thing))
            for one in asked.conditions
        ),
        rank=None if rank is None else replace(rank, thing=meant(rank.thing)),
    )
    return pattern, list(notes)


def _ranked(graph: SceneGraph, rank: Rank, answers: list[Answer]) -> tuple[list[Answer], list[str]]:
    """The one that most probably has a rank, and the sure ones after it; each says what counts."""
    kind, most_first = RANKS[rank.word]
    near: Point | SceneObject | None = rank.point
    if rank.thing is not None or rank.colour is not None:
        others = _things(graph, rank.thing, rank.colour)
        if not others:
            return [], []
        near = others[0][0]

    def value(item: SceneObject) -> tuple[float, str]:
        if kind == "distance":
            assert near is not None
            gap_m = distance_m(item, near)
            name = near.name if isinstance(near, SceneObject) else "the point"
            return gap_m, f"{gap_m:.2f} m from {name}"
        if kind == "size":
            volume_m3 = math.prod(item.size_m)
            return volume_m3, "box of " + " x ".join(f"{side:.2f}" for side in item.size_m) + " m"
        if kind == "height":
            return item.size_m[2], f"{item.size_m[2]:.2f} m high"
        return item.height_m, f"{item.height_m:.2f} m above the origin"

    if isinstance(near, SceneObject):
        answers = [answer for answer in answers if answer.item.id != near.id]
    known = answers
    if kind != "distance":
        # What is false has odd sizes and places: a doubtful object does not win by its size.
        known = [answer for answer in answers if answer.probability >= 0.5] or answers
    compared = [(value(answer.item), answer) for answer in known]
    compared.sort(key=lambda pair: pair[0][0], reverse=most_first)
    found = [replace(one, evidence=f"{one.evidence}; {text}") for (_, text), one in compared]
    doubtful = sum(answer.probability < 0.5 for answer in answers)
    how = "not compared" if len(known) < len(answers) else "counted by probability"
    notes = [f"{counted(doubtful, 'doubtful object')} {how}"] if doubtful else []
    at = _place_of(rank, [one.probability for one in found])
    if at is None:
        return [], notes
    return [found[at], *(one for one in found[at + 1 :] if one.probability >= 0.5)], notes


def _least(rank: Rank | None) -> float:
    """An answer is at least so probable."""
    return MIN_RANKED if rank is not None and rank.place > 1 else MIN_PROBABILITY


def _place_of(rank: Rank, probabilities: Sequence[float]) -> int | None:
    """Which of several objects in an order is most probably the one of a rank.

    Each counts by its probability, independent of the others. None = nothing is probable enough.
    """
    # The probability that 0, 1, 2, … objects before this one are really there.
    before = [1.0] + [0.0] * (rank.place - 1)
    found = []
    for probability in probabilities:
        found.append(probability * before[-1])
        for count in range(rank.place - 1, -1, -1):
            one_less = before[count - 1] if count else 0.0
            before[count] += probability * (one_less - before[count])
    best = max(range(len(found)), key=found.__getitem__, default=None)
    return best if best is not None and found[best] >= _least(rank) else None


def since_ns(graph: SceneGraph, since: Since) -> int:
    """The stamp that is meant; 0 = the start.

    Raises:
        ClientError: for a time that is not finite.
    """
    if since.time_s is None:
        return 0
    if not 0.0 <= since.time_s < MOST_S:
        raise ClientError(f"time {since.time_s:g}: expected at most {MOST_S:g} seconds")
    time_ns = round(since.time_s * 1e9)
    return graph.stamp_ns - time_ns if since.ago else time_ns


def _seen_since(graph: SceneGraph, question: str, since: Since) -> Answers:
    """The objects that were first seen since a time."""
    start_ns = since_ns(graph, since)
    new = [item for item in graph if item.first_seen_ns >= start_ns]
    answers = [
        Answer(
            item,
            item.probability,
            (),
            f"first seen {(graph.stamp_ns - item.first_seen_ns) / 1e9:.1f} s before the newest "
            f"frame, in {counted(item.observations, 'frame')} so far",
        )
        for item in sorted(new, key=lambda item: (item.first_seen_ns, item.id))
    ]
    quiet = sum(item.last_seen_ns < start_ns for item in graph)
    notes = [
        "from one graph: new objects only; objects that moved or went need two graphs "
        "(deworldsg diff) or the live client",
        f"{quiet} of {len(graph)} objects were not seen since",
    ]
    return Answers(question, tuple(answers), tuple(notes))


def _look_like(graph: SceneGraph, question: str, asked: Like) -> Answers:
    """The objects that look most like a text, the best first."""
    answers = [
        Answer(item, item.probability, (), f"cosine {cosine:.3f}")
        for item, cosine in graph.like(asked.text)
    ]
    model = "" if graph.looks is None else graph.looks.model
    notes = (
        f"'{asked.text}': compared with the embeddings of {model}, the most similar first; the "
        "probability is that of the object, not of the likeness",
    )
    return Answers(question, tuple(answers), notes)


def _answer(
    graph: SceneGraph, pattern: Pattern, item: SceneObject, budget: _Budget
) -> Answer | None:
    chance = item.probability if pattern.thing is None else item.probability_of(pattern.thing)
    if chance < MIN_PROBABILITY:
        return None
    is_certain = pattern.kind == "holds"
    what = item.label if pattern.thing is None else pattern.thing
    words = [f"{what} {chance:.0%} in {counted(item.observations, 'frame')}"]
    relations = []
    chance = 1.0 if is_certain else chance
    for condition in pattern.conditions:
        if condition.own_colour is not None and item.colour is None:
            return None
        part = _best_part(graph, item, condition, is_certain, budget)
        if condition.is_negated:
            held = 0.0 if part is None else part[0]
            part = 1.0 - held, None, f"not {_words(condition)} ({1.0 - held:.0%})"
        if part is None:
            return None
        chance *= part[0]
        relations += [part[1]] if part[1] is not None else []
        words.append(part[2])
    if chance < MIN_PROBABILITY:
        return None
    return Answer(item, chance, tuple(relations), "; ".join(words))


def _words(condition: Condition) -> str:
    """A condition as it is asked."""
    if condition.own_colour is not None:
        return condition.own_colour
    thing = condition.thing or ("anything" if condition.point is None else "the point")
    thing = thing if condition.colour is None else f"{condition.colour} {thing}"
    if condition.predicate is None:
        return f"within {condition.within_m or 0.0:g} m of {thing}"
    return f"{condition.predicate} {thing}{', all the way up' * condition.all_the_way}"


def _best_part(
    graph: SceneGraph,
    item: SceneObject,
    condition: Condition,
    is_certain: bool,
    budget: _Budget,
) -> _Part | None:
    """The most probable way to fulfil a condition; the other object may count as certain."""
    if condition.own_colour is not None:
        share = item.probability_of_colour(condition.own_colour)
        return (share, None, f"{condition.own_colour} ({share:.0%})") if share > 0 else None
    if condition.point is not None:
        is_close = distance_m(item, condition.point) <= (condition.within_m or 0.0)
        return (1.0, None, f"within {condition.within_m:g} m") if is_close else None
    if _is_in_room(graph, condition):
        inside = [
            (share * called, None, f"in {room.name}: {share:.0%}")
            for room, called in _rooms_called(graph, condition.thing or "")
            if (share := room.objects.get(item.id, 0.0)) > 0.0
        ]
        return max(inside, key=lambda part: part[0], default=None)
    budget.spend(1)
    if condition.all_the_way:
        return _carried(graph, item, condition, is_certain, budget)
    best: dict[int, Relation] = {}
    if condition.predicate is None:
        around = graph.objects(near=item, within=condition.within_m or 0.0)
    else:
        for relation in graph.relations(item, condition.predicate):
            best.setdefault(relation.object.id, relation)
        if condition.predicate in UNDER:  # the table is under the cup that is on it
            for relation in graph.relations(None, "on", item):
                best.setdefault(relation.subject.id, relation)
        around = [graph[node_id] for node_id in best if node_id != item.id]
    budget.spend(len(around))
    parts: list[_Part] = []
    others = _things(around, condition.thing, condition.colour)
    for other, chance, of_colour in sorted(others, key=lambda one: one[0].id):
        counted_chance = of_colour if is_certain else chance * of_colour
        chance = chance * of_colour
        of = f"{other.name} ({chance:.0%})" if condition.thing is not None else other.name
        if condition.predicate is None:
            parts.append((counted_chance, None, f"{distance_m(item, other):.2f} m from {of}"))
            continue
        relation = best[other.id]
        said = relation.predicate if relation.subject.id == item.id else condition.predicate
        text = f"{said} {of}: {relation.probability:.0%}, {relation.evidence}"
        parts.append((counted_chance * relation.probability, relation, text))
    return max(parts, key=lambda part: part[0], default=None)


def _carried(
    graph: SceneGraph, item: SceneObject, condition: Condition, is_certain: bool, budget: _Budget
) -> _Part | None:
    """The most probable thing that carries an object, with others between them or without."""
    carriers = carriers_of(graph, item)
    budget.spend(len(carriers))
    around = [graph[node_id] for node_id in sorted(carriers)]
    parts: list[_Part] = [
        (
            (of_colour if is_certain else chance * of_colour) * carriers[other.id],
            None,
            f"rests on {other.name}, all the way down: {carriers[other.id]:.0%}",
        )
        for other, chance, of_colour in _things(around, condition.thing, condition.colour)
    ]
    return max(parts, key=lambda part: part[0], default=None)


# --- Rooms: "cup in the kitchen", "rooms next to the hall", "bedrooms with a desk".

_IN = frozenset({"in", "inside"})
_NEXT_TO = frozenset({"near", "with", "has"})


def _is_room(graph: SceneGraph, name: str | None) -> bool:
    """Whether a name is a kind of room, "room 2", or the name of a room, and no object's."""
    if name is None or any(is_class(name, label) for label in graph.labels):
        return False
    words = room_words(name)
    known = graph.rooms if isinstance(graph.message.rooms, list) else ()
    return (
        room_kind(name) is not None
        or words[:1] in ([UNNAMED_ROOM], [f"{UNNAMED_ROOM}s"])
        or any(room.is_named_by_hand and room_words(room.label) == words for room in known)
    )


def _is_in_room(graph: SceneGraph, condition: Condition) -> bool:
    return condition.predicate in _IN and _is_room(graph, condition.thing)


def _rooms_called(graph: SceneGraph, name: str) -> list[tuple[Room, float]]:
    """The rooms with a name; ClientError if there are no rooms at all."""
    if not graph.rooms:
        raise ClientError(f"'{name}': rooms of this graph: {NO_ROOMS}")
    return graph.rooms.called(name)


def _ask_rooms(graph: SceneGraph, question: str, asked: Pattern) -> Answers:
    """The rooms that fulfil a pattern: next to a room, by a doorway, or with an object in them."""
    found = []
    for room, chance in _rooms_called(graph, asked.thing or UNNAMED_ROOM):
        words = [f"{asked.thing} {chance:.0%}, {room.area_m2:.0f} m²"]
        for condition in asked.conditions:
            share, text = _part_of_room(graph, room, condition, question)
            share = 1.0 - share if condition.is_negated else share
            chance *= share
            words.append(f"{'not ' * condition.is_negated}{text} ({share:.0%})")
        if chance >= MIN_PROBABILITY:
            found.append(RoomAnswer(room, chance, "; ".join(words)))
    found.sort(key=lambda answer: (-answer.probability, answer.room.id))
    notes = [] if found else [f"no room fulfils this with {MIN_PROBABILITY:.0%} or more"]
    chances = [answer.probability for answer in found]
    return Answers(
        question,
        (),
        tuple(notes),
        tuple(found),
        count=sum(chance >= 0.5 for chance in chances) if asked.kind == "count" else None,
        probability=1.0 - math.prod(1.0 - chance for chance in chances)
        if asked.kind in ("exists", "holds")
        else None,
    )


def _part_of_room(
    graph: SceneGraph, room: Room, condition: Condition, question: str
) -> tuple[float, str]:
    """The probability that a condition holds for a room, and what fulfils it best."""
    if condition.predicate not in _NEXT_TO or condition.thing is None:
        raise ClientError(
            f"question '{question}': '{_words(condition)}' is no condition of a room; expected "
            "'next to' and a room, or 'with' and an object"
        )
    if _is_room(graph, condition.thing):
        near = {door.to for door in room.doorways}
        rooms = [pair for pair in _rooms_called(graph, condition.thing) if pair[0].id in near]
        best = max(rooms, key=lambda pair: pair[1], default=None)
        return (0.0, _words(condition)) if best is None else (best[1], f"next to {best[0].name}")
    thing = graph.understand(condition.thing).meant
    inside = [graph[node_id] for node_id in room.objects if node_id in graph]
    parts = [
        (chance * of_colour * room.objects[item.id], f"with {item.name}")
        for item, chance, of_colour in _things(inside, thing, condition.colour)
    ]
    return max(parts, key=lambda part: part[0], default=(0.0, f"with {thing}"))
