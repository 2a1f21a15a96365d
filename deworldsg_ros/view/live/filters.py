"""Which objects and relations are shown."""

from __future__ import annotations

from dataclasses import dataclass

from deworldsg_ros.view.colours import QUIET


@dataclass(frozen=True)
class Filter:
    """The user's choice; the default hides the relations that hide everything else.

    Attributes:
        hidden_classes, hidden_predicates: names that are not shown.
        min_probability: of an object, that it exists and is of its class.
        min_relation: of a relation.
    """

    hidden_classes: frozenset[str] = frozenset()
    hidden_predicates: frozenset[str] = QUIET
    min_probability: float = 0.0
    min_relation: float = 0.0
