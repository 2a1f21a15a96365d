"""The physical relations of all pairs, settled around what changed."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.relations.pair_links import joined
from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.physics_model import believed_logits, floor_odds, load_physics_model
from deworldsg_ros.relations.settling import settle, take_in
from deworldsg_ros.relations.vote_model import near_logits, vote_logits
from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.graph import SceneGraph


class SettledRelations:
    """Writes the belief columns of a table: what its pairs say, and what they exclude.

    The columns of `PairRows` are: ``states`` (STATE_COUNT,), ``carried`` (2,) and ``near_votes`` by
    the pair alone; ``kept`` (2,), ``near``, ``eligible`` and ``close`` (2,) after what others
    exclude (see `settling`); ``relations`` (2, NONE + 1) of both directions; ``by_votes``, the
    exponent of the votes; ``with_`` (2,), a table and a seat; ``live``, false for pairs that are
    apart and have no votes that matter.

    Args:
        config: `world_model` and `relation_head` are used.
        graph: of the table.
        table: of pairs.
    """

    def __init__(self, config: Config, graph: SceneGraph, table: PairTable) -> None:
        self._geometry = config.relations.world_model != "none"
        self._own_head = config.perception.relation_head == "geometric"
        self._table = table
        self._model = load_physics_model()
        # Nodes of each circle of supports that was cut.
        self._circles: list[set[int]] = []

    def settle(self, rows: Int64) -> Int64:
        """Relations around the changed rows; returns the rows whose relations changed."""
        t, shapes = self._table, self._table.shapes
        nodes = [shapes.places[node_id] for node_id in t.changed_nodes]
        objects = joined(t.ends[rows], nodes)
        if not len(objects):
            return objects
        self._judge(rows)
        objects = self._reopen_circles(objects)
        if self._geometry:
            shapes.floor_odds[objects] = floor_odds(
                objects, shapes.low, shapes.high, shapes.counts, t.floor_m, self._model.floor
            )
        cut, changed = settle(
            objects,
            t.states,
            t.carried,
            t.kept,
            shapes.floor_odds,
            shapes.on_floor,
            shapes.totals,
            t.gaps_m,
            t.bottom_steps_m,
            t.centre_steps_m,
            t.with_,
            t.near,
            t.eligible,
            shapes.shares,
            shapes.marks,
            t.close,
            t.near_votes,
            t.live,
            t.relations,
            t.ends,
            t.links,
            shapes.first_links,
        )
        if len(cut):
            self._note_circles(cut.tolist())
        return changed

    def _judge(self, rows: Int64) -> None:
        """What the evidence on each changed pair alone says."""
        if not len(rows):
            return
        t, model = self._table, self._model
        counts, frames = t.counts[rows], t.frames[rows]
        geometry, unknown = t.state_logits[rows], ~t.judged[rows]
        geometry[unknown] = 0.0
        votes = vote_logits(counts, frames, model.votes)
        independent = unknown if self._own_head else np.ones_like(unknown)
        take_in(
            rows,
            believed_logits(model, geometry, votes, independent),
            votes,
            near_logits(counts, frames, model.votes),
            np.where(independent, model.source_weights[1], 1.0),
            t.ends,
            t.shapes.seating,
            t.judged,
            t.gaps_m,
            t.other_votes,
            t.states,
            t.carried,
            t.near,
            t.near_votes,
            t.by_votes,
            t.relations,
            t.eligible,
            t.with_,
            t.live,
        )

    def _reopen_circles(self, objects: Int64) -> Int64:
        """The objects, and those of the circles that contain one of them."""
        if not self._circles:
            return objects
        shapes = self._table.shapes
        ids = set(shapes.ids[objects].tolist())
        opened = [circle for circle in self._circles if not circle.isdisjoint(ids)]
        self._circles = [circle for circle in self._circles if circle.isdisjoint(ids)]
        more = [shapes.row(i) for circle in opened for i in circle if i in shapes]
        return joined(objects, more)

    def _note_circles(self, cut: list[int]) -> None:
        """Remember the nodes of the circles that were cut at these places."""
        table = self._table
        for place in cut:
            row, end = place >> 1, place & 1
            circle = {int(table.nodes[row, end])}
            node = int(table.nodes[row, 1 - end])
            while node not in circle:
                circle.add(node)
                rows = table.rows_of([node])
                ends = (table.nodes[rows, 1] == node).astype(np.int64)
                likely = np.flatnonzero(table.kept[rows, ends] > 0.5)
                if not len(likely):
                    break
                node = int(table.nodes[rows[likely[0]], 1 - ends[likely[0]]])
            self._circles.append(circle)
