"""The diagnostics of nodes as observations for the doctor; imports no ROS."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping

from deworldsg_ros.doctor import Observations
from deworldsg_ros.ros.health import DROPPED, HIDDEN, counts_in, received_in

EXAMPLE, WAITING, TURNED = "example ", "waiting for ", "frames turned by "


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
            elif key.startswith(TURNED):
                turns[int(key[len(TURNED) :].split()[0]) // 90] += int(value)
    nodes = [int(values["nodes"]) for values in statuses.values() if "nodes" in values]
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
