"""Small indices of the nodes: rows of the surface map, and of all that is kept beside it."""

from __future__ import annotations


class Owners:
    """Which node has which index; the indices of nodes that are gone are used again."""

    def __init__(self) -> None:
        self._of: dict[int, int] = {}
        self._nodes: list[int] = []
        self._free: list[int] = []

    def take(self, node_id: int) -> int:
        """Give a node an index."""
        if self._free:
            owner = self._free.pop()
            self._nodes[owner] = node_id
        else:
            owner = len(self._nodes)
            self._nodes.append(node_id)
        self._of[node_id] = owner
        return owner

    def free(self, node_id: int) -> int:
        """Take a node's index back, and return it."""
        owner = self._of.pop(node_id)
        self._nodes[owner] = 0
        self._free.append(owner)
        return owner

    @property
    def ids(self) -> dict[int, int]:
        """The index of each node that has one, by the node's id."""
        return dict(self._of)

    def rename(self, old_id: int, new_id: int) -> None:
        """Give another node the index that a node has."""
        owner = self._of.pop(old_id)
        self._nodes[owner] = new_id
        self._of[new_id] = owner

    def of(self, node_id: int) -> int | None:
        """Index of a node; None where it has none."""
        return self._of.get(node_id)

    def node(self, owner: int) -> int:
        """The node that has an index; 0 where it is free."""
        return self._nodes[owner]
