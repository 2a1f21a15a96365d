"""Small indices of nodes ("owners"), for arrays with one entry for each node."""

from __future__ import annotations


class Owners:
    """Gives each node an index. Indices of removed nodes are used again."""

    def __init__(self) -> None:
        self._of: dict[int, int] = {}
        self._nodes: list[int] = []
        self._free: list[int] = []

    @property
    def ids(self) -> dict[int, int]:
        """Index of each node, by node id."""
        return dict(self._of)

    def add(self, node_id: int) -> int:
        """Give a node an index."""
        if self._free:
            owner = self._free.pop()
            self._nodes[owner] = node_id
        else:
            owner = len(self._nodes)
            self._nodes.append(node_id)
        self._of[node_id] = owner
        return owner

    def remove(self, node_id: int) -> int:
        """Free the index of a node, and return it."""
        owner = self._of.pop(node_id)
        self._nodes[owner] = 0
        self._free.append(owner)
        return owner

    def rename(self, old_id: int, new_id: int) -> None:
        """Give the index of one node to another node."""
        owner = self._of.pop(old_id)
        self._nodes[owner] = new_id
        self._of[new_id] = owner

    def find(self, node_id: int) -> int | None:
        """Index of a node; None if it has none."""
        return self._of.get(node_id)

    def of(self, node_id: int) -> int:
        """Index of a node that has one."""
        return self._of[node_id]

    def node(self, owner: int) -> int:
        """The node with an index; 0 if the index is free."""
        return self._nodes[owner]
