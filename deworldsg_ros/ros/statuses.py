"""The statuses in /diagnostics of all nodes as observations for the doctor; imports no ROS."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping

from deworldsg_ros.doctor import Observations
from deworldsg_ros.ros.health import COUNT, DROPPED, HIDDEN, count_in, counts_in, received_in

EXAMPLE, WAITING = "example ", "waiting for "
TURNED = re.compile(r"frames turned by ([0-9]{1,3})\b.*")


def observations_of(
    statuses: Mapping[str, Mapping[str, str]], classes: tuple[str, ...] = ()
) -> Observations:
    """Observations from the values of each node's newest status, by the node's name.

    Args:
        statuses: values by name, of each node.
        classes: classes that the detector knows, if they are known.
    """
    drops: Counter[str] = Counter()
    examples: dict[str, str] = {}
    turns: Counter[int] = Counter()
    missing: list[str] = []
    hidden: Counter[str] = Counter()
    for values in statuses.values():
        drops.update(counts_in(values, DROPPED))
        hidden.update(counts_in(values, HIDDEN))
        for key, value in values.items():
            if key.startswith(EXAMPLE):
                examples[key[len(EXAMPLE) :]] = value
            elif key.startswith(WAITING):
                missing.append(value)
            elif turned := TURNED.fullmatch(key):
                turns[int(turned[1]) // 90] += count_in(values, key)
    nodes = [int(of["nodes"]) for of in statuses.values() if COUNT.fullmatch(of.get("nodes", ""))]
    images = [received_in(values, "rgb") for values in statuses.values()]
    return Observations(
        images=max(images, default=0) or None,
        frames=max(images, default=0) or None,
        nodes=max(nodes, default=None),
        drops=drops,
        hidden=hidden,
        examples=examples,
        classes=classes,
        turns=turns,
        missing=tuple(dict.fromkeys(missing)),
        found_nodes=bool(statuses),
    )


def listened(statuses: Mapping[str, Mapping[str, str]]) -> list[tuple[str, str, bool]]:
    """Topic, type and reliability of each subscription that nodes report."""
    pattern = re.compile(r"(\S+) \[(\S+)\] (reliable|best effort)")
    matches = [
        match
        for values in statuses.values()
        for key, value in values.items()
        if key.startswith("listening to ") and (match := pattern.fullmatch(value))
    ]
    return list(dict.fromkeys((m[1], m[2], m[3] == "reliable") for m in matches))
