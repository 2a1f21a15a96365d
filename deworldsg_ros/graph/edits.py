"""Edits of an operator: labels, merges, splits and deletions.

The edits are a log. Everything that holds now is read from it, so that an edit holds for later
frames, is saved with the graph, and can be undone. Nodes that a merge or a split replaced stay in
the graph, hidden, until the edit cannot be undone any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal, Union

import msgspec

from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.limits import MAX_NAME_CHARACTERS
from deworldsg_ros.wire import messages as wire

# Merges and splits that can be undone: each keeps its hidden nodes.
MAX_UNDO = 100
# Edits that hold at the same time.
MAX_EDITS = 10_000

# Control characters forge lines of logs and terminals. A "$" would let a last line feed pass.
LABEL_PATTERN = r"\A[^\x00-\x1f\x7f-\x9f]*\Z"
Label = Annotated[
    str, msgspec.Meta(min_length=1, max_length=MAX_NAME_CHARACTERS, pattern=LABEL_PATTERN)
]
Kind = Literal["set_label", "merge", "split", "delete"]


class SetLabel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A node is of this class, whatever the frames say; it need not be in the vocabulary."""

    node: wire.NodeId
    label: Label


class MergeNodes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two nodes are one object."""

    nodes: Annotated[list[wire.NodeId], msgspec.Meta(min_length=2, max_length=2)]


class SplitNode(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A node is two objects. Each surface point is of the nearer of two points, in metres."""

    node: wire.NodeId
    near_m: Union[Annotated[list[wire.Point], msgspec.Meta(min_length=2, max_length=2)], None] = (
        None  # the two halves along the longest axis
    )


class DeleteNode(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A node is no object, or one that nobody wants: it is published no more."""

    node: wire.NodeId


class Undo(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Undo the newest edit that was not undone yet, of any user."""


class NameRoom(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A room is called so, whatever is in it; an empty name takes that back. `Undo` does not."""

    room: wire.NodeId
    name: Annotated[str, msgspec.Meta(max_length=MAX_NAME_CHARACTERS, pattern=LABEL_PATTERN)]


EditRequest = Union[SetLabel, MergeNodes, SplitNode, DeleteNode, Undo]
GraphEdit = Union[EditRequest, NameRoom]


class Edit(msgspec.Struct, frozen=True):
    """An edit that holds.

    Attributes:
        id: from 1, in the order of the edits; 0 = not in a log yet.
        kind: what was said.
        stamp_ns: of the newest frame at that time.
        nodes: for which it holds; one, or the parts of a split that are left.
        replaced: hidden nodes that undo brings back; empty if it cannot any more.
        label: of the nodes; empty = that of the frames.
    """

    id: Annotated[int, msgspec.Meta(ge=0, le=2**52)]
    kind: Kind
    stamp_ns: int
    nodes: Annotated[list[wire.NodeId], msgspec.Meta(min_length=1, max_length=2)]
    replaced: Annotated[list[wire.NodeId], msgspec.Meta(max_length=2)] = []
    label: Annotated[str, msgspec.Meta(max_length=MAX_NAME_CHARACTERS, pattern=LABEL_PATTERN)] = ""


class EditLog:
    """The edits that hold, oldest first.

    Attributes:
        edits: the log.
        labels: of each node whose label the operator has set.
        deleted: nodes that the operator has deleted.
        replaced: hidden nodes that undo brings back, with the node that stands for each; 0 = none.
        merged: nodes that the operator has merged of two.
        separate: pairs (smaller id first) that the operator has split.
    """

    def __init__(self, edits: Iterable[Edit] = ()) -> None:
        self.edits = list(edits)
        self._read()

    def __len__(self) -> int:
        return len(self.edits)

    def hides(self, node_id: int) -> bool:
        """Whether the operator says that a node is not to be published."""
        return node_id in self.deleted or node_id in self.replaced

    def origins(self, node_id: int) -> list[int]:
        """The hidden nodes of which edits have made a node."""
        found: list[int] = []
        waiting = [node_id]
        while waiting:
            new = [old_id for old_id in self._made_of.get(waiting.pop(), ()) if old_id not in found]
            found += new
            waiting += new
        return found

    def believed_classes(
        self, nodes: NodeTable, vocabulary: Vocabulary, slots: Int64 | Sequence[int]
    ) -> Float64:
        """Class distributions (n, C) of n slots: those of the frames, or the operator's labels."""
        classes: Float64 = nodes.class_probabilities[slots]
        for index, node_id in enumerate(nodes.ids[slots].tolist() if self.labels else ()):
            label = self.labels.get(node_id)
            if label in vocabulary.classes:
                classes[index] = 0.0
                classes[index, vocabulary.classes.index(label)] = 1.0
        return classes

    def add(self, edit: Edit) -> tuple[Edit, dict[int, int]]:
        """Add an edit, with the next number.

        Returns:
            The edit, and what `removed` returns, of the oldest one beyond MAX_UNDO.
        """
        number = self.edits[-1].id + 1 if self.edits else 1
        self.edits.append(msgspec.structs.replace(edit, id=number))
        undoable = [index for index, known in enumerate(self.edits) if known.replaced]
        lost: dict[int, int] = {}
        for index in undoable[:-MAX_UNDO]:
            self._finish(index, lost)
        self._read()
        return self.edits[-1], lost

    def pop(self) -> Edit:
        """Remove the newest edit."""
        edit = self.edits.pop()
        self._read()
        return edit

    def removed(self, node_id: int, successor: int) -> dict[int, int]:
        """Follow the removal of a node; 0 = it has no successor.

        Returns:
            Hidden nodes that no undo can bring back now, each with its successor.
        """
        lost: dict[int, int] = {}
        for index, edit in enumerate(self.edits):
            if node_id in edit.nodes:
                nodes = [successor if known == node_id else known for known in edit.nodes]
                # Of a split, one part may go: what was said of the other one still holds.
                left = [known for known in nodes if known]
                self.edits[index] = msgspec.structs.replace(edit, nodes=left)
                self._finish(index, lost)
        self.edits = [edit for edit in self.edits if edit.nodes]
        self._read()
        return lost

    def _finish(self, index: int, lost: dict[int, int]) -> None:
        """From now on, an edit cannot be undone."""
        edit = self.edits[index]
        lost.update(dict.fromkeys(edit.replaced, edit.nodes[0] if edit.nodes else 0))
        self.edits[index] = msgspec.structs.replace(edit, replaced=[])

    def _read(self) -> None:
        self.labels: dict[int, str] = {}
        self.deleted: set[int] = set()
        self.replaced: dict[int, int] = {}
        for edit in self.edits:
            if edit.label:
                self.labels.update(dict.fromkeys(edit.nodes, edit.label))
            if edit.kind == "delete":
                self.deleted.update(edit.nodes)
            successor = edit.nodes[0] if edit.kind == "merge" else 0
            self.replaced.update(dict.fromkeys(edit.replaced, successor))
        made = [edit for edit in self.edits if edit.replaced]
        self._made_of = {node_id: edit.replaced for edit in made for node_id in edit.nodes}
        merges = [edit.nodes[0] for edit in self.edits if edit.kind == "merge"]
        self.merged = {node_id for node_id in merges if node_id not in self.replaced}
        self.separate = self._split_pairs()

    def _split_pairs(self) -> set[Pair]:
        pairs: set[Pair] = set()
        # What later edits have made of each replaced node.
        present: dict[int, set[int]] = {}
        for edit in reversed(self.edits):
            nodes = [present.get(node_id, {node_id}) for node_id in edit.nodes]
            present.update(dict.fromkeys(edit.replaced, set().union(*nodes)))
            if edit.kind == "split" and len(nodes) == 2:
                pairs.update((min(a, b), max(a, b)) for a in nodes[0] for b in nodes[1] if a != b)
        return pairs
