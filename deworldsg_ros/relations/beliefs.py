"""The beliefs of the edges of the global graph: evidence in, messages out."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Optional

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.config import Config
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.messages import listed, some_of
from deworldsg_ros.graph.pairs import EdgeEvidence, Pair, ends_of, key
from deworldsg_ros.graph.publication import MEASURED_A_CALL, NEW_A_CALL
from deworldsg_ros.relations.pairs import PairTable
from deworldsg_ros.relations.paper import (
    OUTLIER_RATE,
    ClassPairPrior,
    PaperBeliefs,
    Prior,
    bounded_logits,
    edge_state,
    entropy_nats,
    visual_distribution,
)
from deworldsg_ros.relations.physics import load_physics_model
from deworldsg_ros.relations.settled import ChangedBeliefs, RobustBeliefs
from deworldsg_ros.relations.states import (
    NONE,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    canonical_predicates,
    said_predicates,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64, SoftmaxWeights
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary, derived
from deworldsg_ros.scene.up import UpEstimator
from deworldsg_ros.scene.vocabulary import SYMMETRIC, plain
from deworldsg_ros.wire import messages as wire

# --- The predictions of the embedded world model as the prior of class pairs (Eq. 9-10).

# A prediction of a pair enters the prior of its classes if the model says, with this probability,
# that the pair is related in this direction. Otherwise it abstains.
MIN_RELATED = 0.5
# Predictions are summed as whole numbers of this. Such sums are exact: taking a prediction back
# leaves no trace, and the order does not matter.
UNIT = 2.0**-40

ClassPair = tuple[int, int]


@kernel
def _predictions(
    rows: Int64, judged: Bool, state_logits: Float64, named: Float64
) -> tuple[Int64, Bool]:
    """Predictions (k, 2, NONE) of pairs in both directions, in `UNIT`s; and which there are."""
    values = np.zeros((len(rows), 2, NONE), np.int64)
    told = np.zeros((len(rows), 2), np.bool_)
    weights = np.empty(STATE_COUNT, np.float64)
    predictions = np.empty(NONE, np.float64)
    for index in range(len(rows)):
        logits, best, total = state_logits[rows[index]], 0.0, 0.0
        for state in range(STATE_COUNT):
            best = max(best, logits[state])  # the first one is 0
        for state in range(STATE_COUNT):
            weights[state] = math.exp(logits[state] - best)
            total += weights[state]
        if not judged[rows[index]] or weights[0] / total >= 1.0 - MIN_RELATED:
            continue
        for end in range(2):
            related = 0.0
            for relation in range(NONE):
                predictions[relation] = 0.0
                for state in range(STATE_COUNT):
                    predictions[relation] += weights[state] / total * named[end, state, relation]
                related += predictions[relation]
            told[index, end] = related > MIN_RELATED
            for relation in range(NONE if told[index, end] else 0):
                values[index, end, relation] = np.rint(predictions[relation] / (related * UNIT))
    return values, told


class PredictedPrior:
    """The mean prediction of the physical model, by classes of subject and object.

    The model abstains for pairs that are probably not related.

    Args:
        vocabulary: of the graph.

    Attributes:
        changed: class pairs whose prior changed, since the reader emptied it.
    """

    def __init__(self, vocabulary: Vocabulary) -> None:
        self.changed: set[ClassPair] = set()
        self._canonical = canonical_predicates(vocabulary.predicates)
        self._predicate_count = len(vocabulary.predicates)
        # Which states are a relation that has a name: (2, STATE_COUNT, NONE), by direction.
        named = RELATIONS_OF_STATE.T[:, :, None] == np.arange(NONE)
        self._named = (named & (self._canonical >= 0)).astype(np.float64)
        # By class pair: sum of the predictions of each relation, and their number.
        self._sums: dict[ClassPair, tuple[Int64, int]] = {}
        # By key of a pair: what it adds, to which class pair.
        self._told: dict[int, list[tuple[ClassPair, Int64]]] = {}

    def __len__(self) -> int:
        """Number of class pairs that have a prior."""
        return len(self._sums)

    def follow(self, table: PairTable, keys: Collection[int]) -> None:
        """Take in the pairs with these keys as they are now, in place of what they said before."""
        for pair_key in keys:
            for pair, values in self._told.pop(pair_key, ()):
                self._add(pair, -values, -1)
        known = table.places
        rows = np.array([known[pair_key] for pair_key in keys if pair_key in known], np.int64)
        values, told = _predictions(rows, table.judged, table.state_logits, self._named)
        places, ends = np.nonzero(told)
        if not len(places):
            return
        of_rows = rows[places]
        classes = table.shapes.best_classes[table.ends[of_rows]].tolist()
        for place, end, pair_key, both in zip(
            places.tolist(), ends.tolist(), table.ids[of_rows].tolist(), classes
        ):
            pair = (both[end], both[1 - end])
            self._told.setdefault(pair_key, []).append((pair, values[place, end]))
            self._add(pair, values[place, end], 1)

    def _add(self, classes: ClassPair, values: Int64, count: int) -> None:
        sums, known = self._sums.get(classes, (np.zeros(NONE, np.int64), 0))
        self.changed.add(classes)
        if known + count:
            self._sums[classes] = (sums + values, known + count)
        else:
            del self._sums[classes]

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """The priors of many class pairs; see `ClassPairPrior.lookup`."""
        priors = np.zeros((len(pair_classes), self._predicate_count))
        has_prior = np.zeros(len(pair_classes), np.bool_)
        if not self._sums:
            return priors, has_prior
        named = np.flatnonzero(self._canonical >= 0)
        names = self._canonical[named]
        for row, classes in enumerate(map(tuple, pair_classes.tolist())):
            if classes in self._sums:
                sums, count = self._sums[classes]
                priors[row, names] = sums[named] * UNIT / count
                has_prior[row] = True
        return priors, has_prior


# --- The beliefs of the edges of the global graph: evidence in, messages out.

# Votes of objects whose means are farther apart are not counted.
MAX_DISTANCE_M = 2.5
# Pairs in reach that are judged anew in a call that may leave some for the next one. A frame of
# 12 objects changes about 80 pairs.
JUDGED_A_CALL = 12
NO_EVIDENCE = EdgeEvidence(np.zeros(0), 0, 0, 0, 0)

# What a message is made from, beside the evidence of its edge: probabilities, as bytes; where they
# come from; and whether it speaks for both directions. None = no message.
_Basis = Optional[tuple[bytes, wire.Provenance, bool]]
_UNSAID: tuple[_Basis, _Basis] = (None, None)


class EdgeBeliefs:
    """Takes relation evidence into a graph and computes the messages of its edges.

    Args:
        config: every section but ``lifting`` and ``merging`` is used.
        graph: whose edges these are.
        prior: of class pairs, from clips.

    Attributes:
        prior: of class pairs, from clips.
        up: estimates the direction against gravity from the poses of the frames.
        states: the messages of the edges by subject and object; those that did not change are the
            same objects.
    """

    def __init__(self, config: Config, graph: SceneGraph, prior: ClassPairPrior) -> None:
        self.prior = prior
        self.up = UpEstimator(config.inputs.world_up)
        self._graph = graph
        self._top_k = config.output.top_k
        relations = config.relations
        has_predictions = relations.world_model == "physics"
        self._table: PairTable | None = None
        self._robust: RobustBeliefs | None = None
        self._paper: PaperBeliefs | None = None
        if relations.edge_belief == "robust" or has_predictions:
            geometry = relations.world_model != "none"
            self._table = PairTable(graph, load_physics_model(), geometry=geometry)
        if relations.edge_belief == "robust" and self._table is not None:
            self._robust = RobustBeliefs(config, graph, self._table)
        else:
            self._paper = PaperBeliefs(relations, graph, self._top_k)
        self._predicted = PredictedPrior(graph.vocabulary) if has_predictions else None
        self.states: dict[Pair, wire.EdgeState] = self._paper.states if self._paper else {}
        names = graph.vocabulary.predicates
        self._symmetric = np.array([plain(name) in SYMMETRIC for name in names], np.bool_)
        self._begun = False
        # Of both directions of the pairs with a message, by key.
        self._basis: dict[int, tuple[_Basis, _Basis]] = {}

    def weigh(self, local: LocalGraph, weights: SoftmaxWeights | None = None) -> LocalGraph:
        """A frame's local graph with the relation logits as they enter the sum of Eq. 9.

        The weights are those of its logits, if they are known.
        """
        if self._robust is None:
            return local
        logits = bounded_logits(local.relations.logits, OUTLIER_RATE, weights)
        return derived(local, relations=derived(local.relations, logits=logits))

    def observe(self, local: LocalGraph, node_ids: Sequence[int], votes: Float64) -> None:
        """Count the votes of a merged frame, also for pairs without a relation.

        Args:
            local: the frame, with the logits of the relation head.
            node_ids: the node of each of its rows.
            votes: of the frame, see `frame_votes`.
        """
        self.up.observe(local.T_world_camera)
        if self._robust is None or len(node_ids) < 2:
            return
        ids = np.array(node_ids, np.int64)
        close, nodes = _counted(ids, local.means_world)
        # In the order of the rows; of two relations of one pair of rows, the last one counts.
        last = {pair: at for at, pair in enumerate(map(tuple, local.relations.pairs.tolist()))}
        told = sorted((sorted(pair), at) for pair, at in last.items() if close[pair])
        rows = [at for _, at in told]
        self._graph.add_frame_votes(nodes, ids[local.relations.pairs[rows]], votes[rows])

    def add(self, evidence: RelationEvidence) -> None:
        """Take in neighbour pairs (Eq. 8) and the world model's predictions.

        Raises:
            RefusedInput: ``vocabulary_mismatch``; ``unknown_frame`` if the local graph with that
                stamp was never merged or is forgotten.
        """
        self._check_vocabulary(evidence)
        node_ids = self._graph.nodes_of_frame(evidence.stamp_ns)
        if node_ids is None or (len(evidence.pairs) and evidence.pairs.max() >= len(node_ids)):
            raise RefusedInput(
                "unknown_frame",
                f"relation evidence for {evidence.stamp_ns} ns: no local graph of that frame "
                "is remembered",
            )
        self.prior.update(evidence.pair_classes, evidence.predictions)
        # A pair with a prediction was already named as a neighbour in an earlier message.
        rows = evidence.pairs[~evidence.predicted].tolist()
        self._graph.add_neighbours([(node_ids[a], node_ids[b]) for a, b in rows], evidence.stamp_ns)

    @property
    def waiting(self) -> int:
        """Number of nodes that wait to be measured, and of pairs that wait to be judged."""
        return 0 if self._table is None else self._table.nodes_waiting + self._table.pairs_waiting

    def refresh(self, whole: bool = True) -> tuple[list[Pair], bool]:
        """Bring `states` up to date.

        Args:
            whole: judge all pairs that wait. False: some of them; `NEW_A_CALL` until all first ones
                are judged, then about `JUDGED_A_CALL`.

        Returns:
            The pairs with another message, or none; and whether all first pairs are judged.
        """
        prior = self._follow_table(whole)
        self._begun = self._begun or not self.waiting
        if self._robust is not None:
            if self._table is not None and not self._table.begun:
                return [], False
            return self._follow(self._robust.refresh(prior)), self._begun
        assert self._paper is not None
        return self._paper.refresh(prior), self._begun

    def _follow_table(self, whole: bool) -> Prior:
        """Judge pairs that wait, all of them or some; returns the prior that is used."""
        table, prior = self._table, self.prior
        if table is None:
            return prior
        limits = (None, None) if whole else _limits(table, self._begun and table.begun)
        table.refresh(self.up.up_world(exact=whole or not self._begun), *limits)
        if self._predicted is not None:
            self._predicted.follow(table, table.changed_pairs)
        if self._robust is None:
            table.changed_pairs.clear()
            table.changed_nodes.clear()
        return prior if self._predicted is None else self._predicted

    def _follow(self, beliefs: ChangedBeliefs) -> list[Pair]:
        """Messages of the edges that are probable enough."""
        evidence_changed = self._graph.take_changed_edges()
        said, mutual = said_predicates(beliefs.probabilities, self._symmetric)
        changed = []
        for pair_key in self._basis.keys() & beliefs.unrelated:
            changed += self._say(pair_key, _UNSAID)
        for index, (pair_key, ends) in enumerate(zip(beliefs.pairs, said.tolist())):
            if any(ends) or pair_key in self._basis:
                there, back = (
                    _basis(beliefs, index, end, mutual[index]) if ends[end] else None
                    for end in (0, 1)
                )
                changed += self._say(pair_key, (there, back))
        changed += (evidence_changed & self.states.keys()).difference(changed)
        self._tell(changed)
        return changed

    def _say(self, pair_key: int, now: tuple[_Basis, _Basis]) -> list[Pair]:
        """Note what the messages of a pair are made from; returns the directions that changed."""
        before = self._basis.pop(pair_key, _UNSAID)
        if now != _UNSAID:
            self._basis[pair_key] = now
        first, second = ends_of(pair_key)
        pairs = ((first, second), (second, first))
        return [pair for pair, old, new in zip(pairs, before, now) if old != new]

    def _basis_of(self, pair: Pair) -> _Basis:
        return self._basis.get(key(min(pair), max(pair)), _UNSAID)[pair[0] > pair[1]]

    def _tell(self, pairs: list[Pair]) -> None:
        """Write the messages of edges, or remove those that are not said any more."""
        bases = {pair: basis for pair in pairs if (basis := self._basis_of(pair))}
        for pair in pairs:
            if pair not in bases:
                del self.states[pair]
        if not bases:
            return
        graph = self._graph
        probabilities = np.array([np.frombuffer(basis[0]) for basis in bases.values()])
        evidence = [graph.edges.get(pair, NO_EVIDENCE) for pair in bases]
        logits = np.zeros(probabilities.shape)
        for row, item in enumerate(evidence):
            if item.frames:
                logits[row] = item.visual_logits
        entropies = entropy_nats(visual_distribution(logits)).tolist()
        told = listed(probabilities, graph.vocabulary.predicates, self._top_k)
        shown, _ = graph.votes.of(np.sort(np.array(list(bases)), axis=1))
        for (pair, basis), one, item, entropy, frames in zip(
            bases.items(), told, evidence, entropies, shown.tolist()
        ):
            _, provenance, mutual = basis
            self.states[pair] = edge_state(
                pair,
                one,
                provenance=provenance,
                entropy_nats=entropy,
                observations=item.frames,
                shown=frames,
                mutual=mutual,
            )

    def _check_vocabulary(self, evidence: RelationEvidence) -> None:
        seen, known = evidence.vocabulary, self._graph.vocabulary
        if seen != known:
            raise RefusedInput(
                "vocabulary_mismatch",
                f"relation evidence has {len(seen.classes)} classes and {len(seen.predicates)} "
                f"predicates; expected the graph's {len(known.classes)} and "
                f"{len(known.predicates)}, with the same names in the same order (do all nodes "
                "run with one configuration?)",
            )


@kernel
def _counted(node_ids: Int64, means_world: Float64) -> tuple[Bool, Int64]:
    """Whether (n, n) frames count for each two rows: two live nodes that are close.

    Also the nodes (k, 2) of these pairs of rows, the smaller id first.
    """
    size = len(node_ids)
    close, nodes = np.zeros((size, size), np.bool_), np.empty((size * size // 2, 2), np.int64)
    count = 0
    for a in range(size):
        for b in range(a + 1, size):
            squared_m2 = 0.0
            for axis in range(3):
                squared_m2 += (means_world[a, axis] - means_world[b, axis]) ** 2
            live = node_ids[a] > 0 and node_ids[b] > 0 and node_ids[a] != node_ids[b]
            if live and squared_m2 < MAX_DISTANCE_M**2:
                close[a, b] = close[b, a] = True
                nodes[count, 0] = min(node_ids[a], node_ids[b])
                nodes[count, 1] = max(node_ids[a], node_ids[b])
                count += 1
    return close, nodes[:count]


def _basis(beliefs: ChangedBeliefs, index: int, end: int, mutual: np.bool_) -> _Basis:
    """What the message of one direction of a pair is made from."""
    return beliefs.probabilities[index, end].tobytes(), beliefs.source(index, end), bool(mutual)


def _limits(table: PairTable, begun: bool) -> tuple[int, int]:
    """Numbers of pairs and of nodes that one call of `refresh` works on."""
    if not begun:
        return NEW_A_CALL, NEW_A_CALL
    return (
        some_of(table.pairs_waiting, JUDGED_A_CALL),
        some_of(table.nodes_waiting, MEASURED_A_CALL),
    )


def warm_up(config: Config) -> None:
    """Compile the kernels, or load them from the cache: things come, move, rest in a circle, go."""
    graph = SceneGraph(Vocabulary(("table", "cup"), ("on", "near", "with", "other")), "world")
    beliefs = EdgeBeliefs(config, graph, ClassPairPrior(2, 4))
    points = np.indices((3, 3, 3)).reshape(3, -1).T.astype(np.float32) / 10.0
    for index in range(3):
        mean, surface = np.zeros(3), points + np.float32(0.1 * index)
        graph.add_node(mean, np.eye(3), np.array([0.7, 0.3]), 1, surface)
    for pair in ((1, 2), (2, 3), (3, 1)):
        graph.add_votes(*pair, np.array([[30.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]))
    beliefs.refresh()
    _counted(np.array([1, 2]), np.zeros((2, 3)))
    graph.move_node(2, np.array([[1.0, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    beliefs.refresh()
    graph.remove_node(1)
    beliefs.refresh()
