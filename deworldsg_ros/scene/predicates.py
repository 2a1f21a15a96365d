"""Predicates with the same meaning, and what a predicate says in the opposite direction."""

from __future__ import annotations

# Names of each physical relation. The first one in a vocabulary names it if no frame named another.
PREDICATES: tuple[tuple[str, ...], ...] = (
    (
        "on", "standing on", "supported by", "sitting on", "lying on", "laying on", "parked on",
        "on back of",
    ),
    ("in", "inside", "standing in", "lying in", "hanging in"),
    ("attached to", "hanging on", "hanging from", "mounted on", "build in", "built in"),
    ("against", "leaning against", "connected to"),
    ("above", "over"),
    ("under", "below"),
    ("near", "next to", "beside", "close by", "with"),
)  # fmt: skip

# If A is near B, B is near A.
SYMMETRIC = frozenset({"near", "next to", "beside", "close by"})


def plain(name: str) -> str:
    """A name in lower case, with spaces."""
    return name.lower().replace("_", " ")
