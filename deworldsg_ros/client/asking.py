"""Answers questions in words from a graph."""

from __future__ import annotations

import math

from deworldsg_ros.client.content import distance_m
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import Relation, SceneObject
from deworldsg_ros.client.patterns import (
    MIN_PROBABILITY,
    Answer,
    Answers,
    Condition,
    Pattern,
    Since,
    absence_notes,
    parse,
)
from deworldsg_ros.words import counted

# Part of an answer: probability, relation or None, words.
_Part = tuple[float, Relation | None, str]


def ask(graph: SceneGraph, question: str) -> Answers:
    """Answer a pattern such as "cup on dining table", or "what changed since 10 s ago".

    A single graph knows of changes only when each object was first and last seen.

    Raises:
        ClientError: if the question cannot be read.
    """
    pattern = parse(question, {edge.predicate for edge in graph.message.edges})
    if isinstance(pattern, Since):
        return _seen_since(graph, question, pattern)
    items = graph.objects(pattern.thing, min_probability=MIN_PROBABILITY)
    answers = [answer for item in items if (answer := _answer(graph, pattern, item)) is not None]
    answers.sort(key=lambda answer: (-answer.probability, answer.item.id))
    things = [pattern.thing, *(condition.thing for condition in pattern.conditions)]
    notes = [
        note
        for thing in dict.fromkeys(thing for thing in things if thing is not None)
        for note in absence_notes(thing, graph.hidden, graph.labels)
    ]
    if not answers:
        notes.insert(0, f"nothing fulfils this with {MIN_PROBABILITY:.0%} or more")
    return Answers(question, tuple(answers), tuple(notes))


def since_ns(graph: SceneGraph, since: Since) -> int:
    """The stamp that is meant; 0 = the start.

    Raises:
        ClientError: for a time that is not finite.
    """
    if since.time_s is None:
        return 0
    if not math.isfinite(since.time_s):
        raise ClientError(f"time {since.time_s}: expected a finite number of seconds")
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


def _answer(graph: SceneGraph, pattern: Pattern, item: SceneObject) -> Answer | None:
    chance = item.probability if pattern.thing is None else item.probability_of(pattern.thing)
    if chance < MIN_PROBABILITY:
        return None
    what = item.label if pattern.thing is None else pattern.thing
    words = [f"{what} {chance:.0%} in {counted(item.observations, 'frame')}"]
    relations = []
    for condition in pattern.conditions:
        part = _best_part(graph, item, condition)
        if part is None:
            return None
        chance *= part[0]
        relations += [part[1]] if part[1] is not None else []
        words.append(part[2])
    if chance < MIN_PROBABILITY:
        return None
    return Answer(item, chance, tuple(relations), "; ".join(words))


def _best_part(graph: SceneGraph, item: SceneObject, condition: Condition) -> _Part | None:
    """The most probable way to fulfil a condition."""
    if condition.point is not None:
        is_close = distance_m(item, condition.point) <= (condition.within_m or 0.0)
        return (1.0, None, f"within {condition.within_m:g} m") if is_close else None
    if condition.predicate is None:
        around = graph.objects(near=item, within=condition.within_m or 0.0)
    else:
        around = [found.object for found in graph.relations(item, condition.predicate)]
    others: list[tuple[SceneObject, float]] = []
    for other in sorted(dict.fromkeys(around), key=lambda other: other.id):
        chance = 1.0 if condition.thing is None else other.probability_of(condition.thing)
        if other.id != item.id and chance >= MIN_PROBABILITY:
            others.append((other, chance))
    parts = [part for other in others if (part := _part(graph, item, condition, *other))]
    return max(parts, key=lambda part: part[0], default=None)


def _part(
    graph: SceneGraph, item: SceneObject, condition: Condition, other: SceneObject, chance: float
) -> _Part | None:
    of = f"{other.name} ({chance:.0%})" if condition.thing is not None else other.name
    if condition.predicate is None:
        return chance, None, f"{distance_m(item, other):.2f} m from {of}"
    found = graph.relations(item, condition.predicate, other)
    if not found:
        return None
    relation = found[0]
    text = f"{relation.predicate} {of}: {relation.probability:.0%}, {relation.evidence}"
    return chance * relation.probability, relation, text
