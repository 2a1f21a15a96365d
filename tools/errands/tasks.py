"""Errands in a home, in words, with what is true: which objects fulfil them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from home import MANY, ONCE, Home, bearers, place_on

ORDINALS = ("nearest", "second", "third")


@dataclass(frozen=True)
class Task:
    """An errand.

    Attributes:
        kind: ``relation``, ``order``, ``moved``, ``absent`` or ``removed``.
        words: as the robot is asked.
        right: numbers of the objects that fulfil it; empty = it is not there.
        was: place (3,) where it was before it moved; None = it did not.
    """

    kind: str
    words: str
    right: tuple[int, ...]
    was: tuple[float, float, float] | None = None


def gap_m(home: Home, a: int, b: int) -> float:
    """Gap of the boxes of two objects."""
    one, other = home.bounds(a), home.bounds(b)
    return float(np.linalg.norm(np.maximum(np.maximum(one[0] - other[1], other[0] - one[1]), 0.0)))


def standing_tasks(home: Home, rng: np.random.Generator, count: int = 4) -> list[Task]:
    """Errands to things that stand where they stood: by a relation, and by an order."""
    pairs = {}
    for thing, bearer in home.on.items():
        if home.name(thing) in {*MANY, *ONCE}:
            pairs.setdefault((home.name(thing), home.name(bearer)), []).append(thing)
    # Where the name alone is enough, a relation is no test of it.
    many = [pair for pair in pairs if pair[0] in MANY]
    chosen = [many[k] for k in rng.permutation(len(many))[:count]]
    tasks = [Task("relation", f"{a} on {b}", tuple(pairs[a, b])) for a, b in chosen]
    return tasks + _orders(home, rng)


def _orders(home: Home, rng: np.random.Generator) -> list[Task]:
    """Two errands such as "the second chair from the window"."""
    found = []
    marks = [n for n in ("window", "tv", "refrigerator", "couch", "bed", "oven")
             if len(home.called(n)) == 1]  # fmt: skip
    for name in ("chair", "dining table", "cup", "book", "bottle"):
        for mark in marks:
            items = home.called(name)
            gaps = sorted((gap_m(home, n, home.called(mark)[0]), n) for n in items)
            for place in range(min(len(gaps), 3)):
                around = [gap for gap, _ in gaps[max(0, place - 1) : place + 2]]
                # Two that are equally far are in no order.
                if len(gaps) > 1 and np.diff(around).min() > 0.4:
                    words = f"{ORDINALS[place]} {name} {'to' if place == 0 else 'from'} {mark}"
                    found.append(Task("order", words, (gaps[place][1],)))
    later = [task for task in found if not task.words.startswith("nearest")] or found
    return [later[k] for k in rng.permutation(len(later))[:2]]


def absent_tasks(home: Home, rng: np.random.Generator, count: int = 2) -> list[Task]:
    """Errands to what is not there: no such thing, or not on that."""
    names = [home.name(n) for n in home.present]
    never = [n for n in ("umbrella", "scissors", "suitcase", "toaster", "skateboard", *ONCE)
             if n not in names]  # fmt: skip
    pairs = {(home.name(a), home.name(b)) for a, b in home.on.items()}
    wrong = [
        (a, b) for a in MANY for b in ("dining table", "desk", "bed", "couch", "counter")
        if a in names and b in names and (a, b) not in pairs
    ]  # fmt: skip
    tasks = [Task("absent", str(rng.choice(never)), ())]
    if wrong:
        a, b = wrong[int(rng.integers(len(wrong)))]
        tasks.append(Task("absent", f"{a} on {b}", ()))
    else:
        tasks.append(Task("absent", str(rng.choice([n for n in never if n != tasks[0].words])), ()))
    return tasks[:count]


def move_things(home: Home, rng: np.random.Generator, count: int = 3) -> list[Task]:
    """Move things elsewhere and take one away; returns the errands to them."""
    tasks: list[Task] = []
    single = [n for n in home.on if home.name(n) in {*MANY, *ONCE}]
    # Named alone, it has to be the only one of its name.
    names = [str(n) for n in rng.permutation(sorted({home.name(n) for n in single}))]
    for name in names:
        if len(tasks) == count + 1:
            break
        thing, *others = [int(n) for n in rng.permutation(home.called(name))]
        if others:
            continue
        before = home.bounds(thing).mean(0)
        if len(tasks) == count:
            home.gone.add(thing)
            del home.on[thing]
            tasks.append(Task("removed", name, (), tuple(before.tolist())))
            continue
        item = home.items[thing - 1]
        old, rotation, position = home.on.pop(thing), item.rotation, item.position
        places = [int(b) for b in rng.permutation(bearers(home)) if int(b) != old]
        # One of two stays in its room.
        places.sort(
            key=lambda b: home.room_of[b] != home.room_of[old], reverse=bool(rng.integers(2))
        )
        for bearer in places:
            if place_on(home, item, bearer, rng):
                if np.linalg.norm(home.bounds(thing).mean(0) - before) < 0.6:
                    continue
                home.on[thing], home.room_of[thing] = bearer, home.room_of[bearer]
                tasks.append(Task("moved", name, (thing,), tuple(before.tolist())))
                break
        else:
            home.on[thing], item.rotation, item.position = old, rotation, position
    return tasks
