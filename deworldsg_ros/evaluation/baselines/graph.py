"""The graph of the baselines: nodes absorb one another, relations are counted.

New nodes are added to the graph and pushed on a stack. The popped node is compared with all other
nodes. The best node that the baseline accepts absorbs it and is pushed on the stack.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.beliefs import listed
from deworldsg_ros.scene.frame_graph import Relations, Vocabulary
from deworldsg_ros.scene.gaussian import fuse

# Number of classes and predicates of each node and edge in the message.
TOP_K = 5


@dataclass(frozen=True)
class BaselineNode:
    """One object of a baseline.

    Attributes:
        mean_world: (3,) float64, metres.
        covariance_world: (3, 3) float64, square metres.
        class_scores: (C,) float64, not negative.
        weight: weight in a fusion.
        points_world: (n, 3) float64, metres, points for the protocol.
        first_ns, last_ns: stamps of the first and last observation.
        observations: number of observations.
        colours: colour histogram of any length; empty if the baseline has none.
    """

    mean_world: Float64
    covariance_world: Float64
    class_scores: Float64
    weight: float
    points_world: Float64
    first_ns: int
    last_ns: int
    observations: int = 1
    colours: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def label(self) -> int:
        """The class with the highest score."""
        return int(self.class_scores.argmax())


Choose = Callable[[BaselineNode, Sequence[BaselineNode]], "int | None"]


def fuse_nodes(keeper: BaselineNode, other: BaselineNode, class_scores: Float64) -> BaselineNode:
    """Both nodes in one, moments fused by Eq. 7. Two weights of 0 count as 1 and 1."""
    weights = (keeper.weight, other.weight)
    weights = weights if sum(weights) > 0 else (1.0, 1.0)
    mean, covariance = fuse(
        weights[0],
        keeper.mean_world,
        keeper.covariance_world,
        weights[1],
        other.mean_world,
        other.covariance_world,
    )
    return replace(
        keeper,
        mean_world=mean,
        covariance_world=covariance,
        class_scores=class_scores,
        weight=keeper.weight + other.weight,
        points_world=np.concatenate([keeper.points_world, other.points_world]),
        first_ns=min(keeper.first_ns, other.first_ns),
        last_ns=max(keeper.last_ns, other.last_ns),
        observations=keeper.observations + other.observations,
        colours=keeper.colours + other.colours,
    )


class BaselineGraph:
    """A graph whose nodes absorb one another.

    Args:
        vocabulary: classes and predicates.
        frame_id: world frame.
        choose: returns the index of the other node that absorbs a node, or None.
        fuse: returns the keeper and the absorbed node in one.

    Attributes:
        nodes: nodes by id, in order of creation.
        counts: (R,) int64 by ordered pair, number of predictions of each predicate.
    """

    def __init__(
        self,
        vocabulary: Vocabulary,
        frame_id: str,
        choose: Choose,
        fuse: Callable[[BaselineNode, BaselineNode], BaselineNode],
    ) -> None:
        self.vocabulary = vocabulary
        self.frame_id = frame_id
        self.nodes: dict[int, BaselineNode] = {}
        self.counts: dict[tuple[int, int], Int64] = {}
        self._choose = choose
        self._fuse = fuse
        self._next_id = 1
        self._newest_ns = 0

    def integrate(
        self, nodes: Sequence[BaselineNode], relations: Relations, stamp_ns: int
    ) -> list[int]:
        """Integrate the nodes of a frame and the relations between them.

        Args:
            nodes: nodes of the frame.
            relations: pairs of indices into `nodes`; the best predicate of each pair counts once.
            stamp_ns: stamp of the frame.

        Returns:
            Id of the node of the graph for each node of the frame.
        """
        self._newest_ns = stamp_ns
        created = list(range(self._next_id, self._next_id + len(nodes)))
        self._next_id += len(nodes)
        self.nodes.update(zip(created, nodes))
        merged_into: dict[int, int] = {}
        stack = list(created)
        while stack:
            node_id = stack.pop()
            if node_id not in self.nodes:
                continue
            keeper_id = self._absorb(node_id)
            if keeper_id is not None:
                merged_into[node_id] = keeper_id
                stack.append(keeper_id)
        node_ids = [_resolve(node_id, merged_into) for node_id in created]
        for (subject, object_), logits in zip(relations.pairs.tolist(), relations.logits):
            pair = (node_ids[subject], node_ids[object_])
            if pair[0] != pair[1]:
                counts = self.counts.setdefault(pair, np.zeros(len(logits), np.int64))
                counts[int(logits.argmax())] += 1
        return node_ids

    def _absorb(self, node_id: int) -> int | None:
        """Merge a node into the best other node; returns the id of that node, or None."""
        node = self.nodes[node_id]
        other_ids = [other for other in self.nodes if other != node_id]
        chosen = self._choose(node, [self.nodes[other] for other in other_ids])
        if chosen is None:
            return None
        keeper_id = other_ids[chosen]
        self.nodes[keeper_id] = self._fuse(self.nodes[keeper_id], node)
        del self.nodes[node_id]
        for pair in [pair for pair in self.counts if node_id in pair]:
            counts = self.counts.pop(pair)
            moved = (
                keeper_id if pair[0] == node_id else pair[0],
                keeper_id if pair[1] == node_id else pair[1],
            )
            if moved[0] != moved[1]:
                self.counts[moved] = self.counts.get(moved, np.zeros_like(counts)) + counts
        return keeper_id

    def message(self) -> wire.SceneGraphMessage:
        """The graph as a message, with the points of the nodes as surface points."""
        return wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=wire.stamp_from_ns(self._newest_ns),
            frame_id=self.frame_id,
            sequence=0,
            nodes=[self._node_state(node_id, node) for node_id, node in self.nodes.items()],
            edges=[self._edge_state(pair) for pair in sorted(self.counts)],
        )

    def _node_state(self, node_id: int, node: BaselineNode) -> wire.NodeState:
        beliefs = _beliefs(_fractions(node.class_scores), self.vocabulary.classes)
        return wire.NodeState(
            id=node_id,
            label=beliefs[0].label,
            classes=beliefs,
            mean_m=node.mean_world.tolist(),
            covariance_m2=node.covariance_world.ravel().tolist(),
            observations=node.observations,
            first_seen=wire.stamp_from_ns(node.first_ns),
            last_seen=wire.stamp_from_ns(node.last_ns),
            surface_points_m=node.points_world.tolist(),
        )

    def _edge_state(self, pair: tuple[int, int]) -> wire.EdgeState:
        fractions = _fractions(self.counts[pair])
        beliefs = _beliefs(fractions, self.vocabulary.predicates)
        positive = fractions[fractions > 0]
        return wire.EdgeState(
            subject=pair[0],
            object=pair[1],
            predicate=beliefs[0].label,
            probability=beliefs[0].probability,
            predicates=beliefs,
            provenance="visual",
            entropy_nats=max(0.0, float(-(positive * np.log(positive)).sum())),
            observations=int(self.counts[pair].sum()),
        )


def _resolve(node_id: int, merged_into: dict[int, int]) -> int:
    while node_id in merged_into:
        node_id = merged_into[node_id]
    return node_id


def _fractions(scores: Float64 | Int64) -> Float64:
    return np.asarray(scores / scores.sum(), np.float64)


def _beliefs(fractions: Float64, names: Sequence[str]) -> list[wire.Belief]:
    (best,) = listed(fractions[None], names, TOP_K)
    return [item for item in best.beliefs if item.probability > 0]
