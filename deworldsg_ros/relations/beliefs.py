"""The beliefs of the edges of the global graph: evidence in, messages out.

Three sources are combined for each pair of nodes: the fused geometry of both, judged by the
physical world model; the votes of all frames that showed both; and the prior of their classes.
Relations of different pairs exclude each other (`rules`). Beliefs are computed anew only around
the pairs that changed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.config import Config
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import DECIMALS, listed, some_of
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.graph.publication import MEASURED_A_CALL, NEW_A_CALL
from deworldsg_ros.relations.pairs import AT_ONCE, PairTable, joined
from deworldsg_ros.relations.paper import (
    OUTLIER_RATE,
    PROVENANCES,
    ClassPairPrior,
    PaperBeliefs,
    Prior,
    bounded_logits,
    edge_state,
    entropy_nats,
    fuse_prior,
    visual_distribution,
)
from deworldsg_ros.relations.physics import (
    UNIT,
    VoteRate,
    believed_logits,
    floor_odds,
    load_physics_model,
    relation_counts,
    vote_logits,
)
from deworldsg_ros.relations.rules import settle, take_in
from deworldsg_ros.relations.states import (
    ABOVE_STATES,
    NEAR,
    NONE,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    PredicateNames,
    canonical_predicates,
    predicate_probabilities,
    related_pairs,
    said_predicates,
    uncertain,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64, SoftmaxWeights
from deworldsg_ros.scene.camera import UpEstimator
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary, derived
from deworldsg_ros.scene.vocabulary import SYMMETRIC, plain
from deworldsg_ros.wire import messages as wire

# Votes of objects whose means are farther apart are not counted.
MAX_DISTANCE_M = 2.5
# Pairs in reach that are judged anew in a call that may leave some for the next one. A frame of
# 12 objects changes about 80 pairs.
JUDGED_A_CALL = 12
# A prediction of a pair enters the prior of its classes if the model says, with this probability,
# that the pair is related in this direction. Otherwise it abstains.
MIN_RELATED = 0.5
# Logit of a state that the measured geometry contradicts.
CONTRADICTED_LOGIT = -60.0

ClassPair = tuple[int, int]

# --- The predictions of the embedded world model as the prior of class pairs (Eq. 9-10).


@kernel
def _predictions(beliefs: NDArray[Any], named: Float64) -> tuple[Int64, Bool]:
    """Predictions (k, 2, NONE) of pairs in both directions, in `UNIT`s; and which there are."""
    values = np.zeros((len(beliefs), 2, NONE), np.int64)
    told = np.zeros((len(beliefs), 2), np.bool_)
    weights = np.empty(STATE_COUNT, np.float64)
    predictions = np.empty(NONE, np.float64)
    for index in range(len(beliefs)):
        logits, best, total = beliefs[index].state_logits, 0.0, 0.0
        for state in range(STATE_COUNT):
            best = max(best, logits[state])  # the first one is 0
        for state in range(STATE_COUNT):
            weights[state] = math.exp(logits[state] - best)
            total += weights[state]
        if not beliefs[index].judged or weights[0] / total >= 1.0 - MIN_RELATED:
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
        # By row of a pair: what it adds, to which class pair.
        self._told: dict[int, list[tuple[ClassPair, Int64]]] = {}

    def __len__(self) -> int:
        """Number of class pairs that have a prior."""
        return len(self._sums)

    def follow(self, table: PairTable, rows: Collection[int]) -> None:
        """Take in the pairs of these rows as they are now, in place of what they said before."""
        for row in rows:
            for pair, values in self._told.pop(row, ()):
                self._add(pair, -values, -1)
        known = np.fromiter(rows, np.int64, len(rows))
        known = known[table.beliefs["known"][known]]
        values, told = _predictions(table.beliefs.take(known), self._named)
        places, ends = np.nonzero(told)
        if not len(places):
            return
        classes = table.classes(known[places])
        for place, end, row, both in zip(
            places.tolist(), ends.tolist(), known[places].tolist(), classes.tolist()
        ):
            pair = (both[end], both[1 - end])
            self._told.setdefault(row, []).append((pair, values[place, end]))
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


# --- The beliefs beyond the paper: is a pair related at all, and by what.


@dataclass(frozen=True)
class ChangedBeliefs:
    """Beliefs of pairs of nodes that were computed anew.

    Attributes:
        unrelated: rows of pairs without a belief.
        rows: (k,) of pairs with one.
        probabilities: (k, 2, R) that the predicate holds, in both directions; sums over R are at
            most 1.
        sources: (k, 2) indices into `PROVENANCES`.
    """

    unrelated: Int64
    rows: Int64
    probabilities: Float64
    sources: Int64


class RobustBeliefs:
    """Beliefs of all edges of a graph.

    Args:
        config: sections ``relations`` and ``perception`` are used.
        graph: whose edges these are.
        table: the geometry of its pairs.
    """

    def __init__(self, config: Config, graph: GlobalGraph, table: PairTable) -> None:
        self._config = config.relations
        self._geometry = config.relations.world_model != "none"
        self._own_head = config.perception.relation_head == "geometric"
        self._graph = graph
        self._table = table
        self._model = load_physics_model()
        self._rate = VoteRate()
        self._names = PredicateNames.of(graph.vocabulary.predicates)
        # Rows of the pairs into which a prior may enter, by class pair; some do not any more.
        self._by_classes: dict[ClassPair, set[int]] = {}
        # Nodes of each circle of supports that was cut.
        self._circles: list[set[int]] = []

    def refresh(self, prior: Prior) -> ChangedBeliefs:
        """Compute the beliefs that may have changed since the last call.

        Args:
            prior: of class pairs, from the predictions of a world model.
        """
        table = self._table
        rows = np.array(sorted(table.changed_rows), np.int64)
        if not self._own_head and self._learn_rate(rows):
            rows = joined(rows, np.flatnonzero(table.beliefs["known"]))
        known = table.beliefs["known"][rows]
        changed = self._settle(rows[known])
        again = set().union(*map(self._open_rows, prior.changed))
        changed = joined(changed, [*rows[known].tolist(), *again])
        table.changed_rows.clear()
        table.changed_slots.clear()
        prior.changed.clear()
        return self._beliefs(changed, rows[~known], prior)

    def _learn_rate(self, rows: Int64) -> bool:
        """Learn how often the source speaks; returns whether the worth of its votes changed."""
        pairs, beliefs = self._graph.pairs, self._table.beliefs.take(rows)
        counts, _ = relation_counts(pairs.counts(rows), self._names.relation_of)
        logits = self._model.source_weights[0] * beliefs["state_logits"].astype(np.float64)
        judged = beliefs["known"] & beliefs["judged"]
        return self._rate.follow(rows, logits, judged, counts, pairs.rows["shown"][rows])

    def _settle(self, rows: Int64) -> Int64:
        """Relations around pairs that were judged; returns the rows whose relations changed."""
        table = self._table
        shapes = table.shapes
        slots = joined(self._graph.pairs.rows["slots"][rows], table.changed_slots)
        slots = slots[shapes["node_id"][slots] > 0]
        if not len(slots):
            return slots
        # In parts, so that a whole map needs no large arrays.
        for start in range(0, len(rows), AT_ONCE):
            self._take_in(rows[start : start + AT_ONCE])
        slots = self._reopen_circles(slots)
        if self._geometry:
            floor_odds(shapes, slots, table.floor_m, self._model.floor)
        cut, changed = settle(table.scene, slots)
        for place in cut.tolist():
            self._note_circle(place)
        return changed

    def _take_in(self, rows: Int64) -> None:
        """Take in the evidence on each of some pairs alone."""
        table, model, pairs = self._table, self._model, self._graph.pairs
        beliefs = table.beliefs
        counts, others = relation_counts(pairs.counts(rows), self._names.relation_of)
        beliefs["other_votes"][rows] = others
        geometry = beliefs["state_logits"][rows].astype(np.float64)
        unknown = ~beliefs["judged"][rows]
        geometry[unknown] = 0.0
        frames = pairs.rows["shown"][rows]
        votes, near = vote_logits(self._rate.worthy(counts, frames), frames, model.votes)
        independent = unknown if self._own_head else np.ones_like(unknown)
        if self._own_head:
            above = votes[:, ABOVE_STATES]
            votes[:, ABOVE_STATES] = np.where(
                table.rated_above(rows), above, np.maximum(above, 0.0)
            )
        logits = believed_logits(model, geometry, votes, independent)
        # Whatever the votes: what is measured to be false is not so.
        wrong = table.contradicted(rows)
        there, back = (_with_none(wrong[:, end])[:, RELATIONS_OF_STATE[:, end]] for end in (0, 1))
        logits = np.where(there | back, CONTRADICTED_LOGIT, logits)
        if not self._own_head:  # how others vote on the floor was never measured
            near[:, 1] = near[:, 0]
        near[wrong[:, :, NEAR].any(axis=1)] = CONTRADICTED_LOGIT
        worth = np.where(independent, model.source_weights[1], 1.0)
        take_in(table.scene, rows, logits, votes, near, worth)

    def _reopen_circles(self, slots: Int64) -> Int64:
        """The objects, and those of the circles that contain one of them."""
        if not self._circles:
            return slots
        shapes, slot_of = self._table.shapes, self._graph.nodes.slot_of
        ids = set(shapes["node_id"][slots].tolist())
        opened = [circle for circle in self._circles if not circle.isdisjoint(ids)]
        self._circles = [circle for circle in self._circles if circle.isdisjoint(ids)]
        more = [slot_of[i] for circle in opened for i in circle if i in slot_of]
        return joined(slots, [slot for slot in more if shapes["node_id"][slot] > 0])

    def _note_circle(self, place: int) -> None:
        """Remember the nodes of the circle of supports that was cut at a place."""
        pairs, kept = self._graph.pairs, self._table.beliefs["kept"]
        ends_of = pairs.rows["slots"]
        row, end = place >> 1, place & 1
        circle = [int(ends_of[row, end])]
        slot = int(ends_of[row, 1 - end])
        while slot not in circle:
            circle.append(slot)
            rows = pairs.of([slot])
            ends = (ends_of[rows, 1] == slot).astype(np.int64)
            likely = np.flatnonzero(kept[rows, ends] > 0.5)
            if not len(likely):
                break
            slot = int(ends_of[rows[likely[0]], 1 - ends[likely[0]]])
        self._circles.append(set(self._table.shapes["node_id"][circle].tolist()))

    def _beliefs(self, rows: Int64, gone: Int64, prior: Prior) -> ChangedBeliefs:
        """Beliefs of pairs in both directions: few of those in reach are related."""
        table, pairs = self._table, self._graph.pairs
        related = related_pairs(table.beliefs, rows)
        gone = np.concatenate([gone, rows[~related]])
        table.beliefs["open"][gone] = False
        rows = rows[related]
        probabilities, voted = predicate_probabilities(
            table.beliefs.take(rows),
            pairs.counts(rows),
            pairs.rows["shown"][rows],
            self._names,
            self._model.vote_scales,
        )
        judged = table.beliefs["judged"][rows].repeat(2).reshape(-1, 2)
        self._add_prior(rows, probabilities, judged, prior)
        # The prior knows only the classes.
        wrong = _with_none(table.contradicted(rows))[:, :, self._names.relation_of]
        probabilities[wrong] = 0.0
        visual, prior_alone, fused = range(3)
        sources = np.where(judged, np.where(voted, fused, prior_alone), visual)
        return ChangedBeliefs(gone, rows, probabilities, sources)

    def _add_prior(self, rows: Int64, probabilities: Float64, judged: Bool, prior: Prior) -> None:
        """Eq. 10 with the prior of class pairs, in place; and whether a world model spoke."""
        open_ = uncertain(probabilities, self._config.entropy_threshold_nats)
        best = self._table.classes(rows)
        self._index(rows, open_, best)
        places, ends = np.nonzero(open_)
        if not len(places):
            return
        classes = np.column_stack([best[places, ends], best[places, 1 - ends]])
        priors, has_prior = prior.lookup(classes)
        if not has_prior.any():
            return
        fused, active = fuse_prior(
            probabilities[places, ends],
            priors,
            has_prior,
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        probabilities[places, ends] = fused
        judged[places, ends] |= active

    def _index(self, rows: Int64, open_: Bool, classes: Int64) -> None:
        """Note the class pairs whose prior may enter pairs."""
        beliefs = self._table.beliefs
        before = beliefs["open"][rows] > 0
        may_enter = open_ | before
        if not may_enter.any():
            return
        differ = (before != open_) | (beliefs["classes"][rows] != classes)
        places = (differ.any(axis=1) & may_enter.any(axis=1)).nonzero()[0]
        beliefs["open"][rows], beliefs["classes"][rows] = open_, classes
        for index in places.tolist():
            both = classes[index].tolist()
            for end in open_[index].nonzero()[0].tolist():
                pair = both[end], both[1 - end]
                self._by_classes.setdefault(pair, set()).add(int(rows[index]))

    def _open_rows(self, classes: ClassPair) -> set[int]:
        """Rows of the pairs into which the prior of a class pair may enter."""
        known = self._by_classes.pop(classes, None)
        if not known:
            return set()
        rows = np.fromiter(known, np.int64, len(known))
        beliefs = self._table.beliefs.take(rows)
        there = (beliefs["classes"] == classes).all(axis=1) & (beliefs["open"][:, 0] > 0)
        back = (beliefs["classes"] == classes[::-1]).all(axis=1) & (beliefs["open"][:, 1] > 0)
        found = set(rows[there | back].tolist())
        if found:
            self._by_classes[classes] = found
        return found


def _with_none(contradicted: Bool) -> Bool:
    """Of which relations the geometry contradicts, (..., NONE + 1): never "none"."""
    return np.concatenate([contradicted, np.zeros_like(contradicted[..., :1])], axis=-1)


# --- The beliefs of the edges of the global graph: evidence in, messages out.


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

    def __init__(self, config: Config, graph: GlobalGraph, prior: ClassPairPrior) -> None:
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
        slot_of = self._graph.nodes.slot_of
        slots = np.array([slot_of.get(node_id, -1) for node_id in node_ids], np.int64)
        close, shown = _counted(slots, local.means_world)
        # In the order of the rows; of two relations of one pair of rows, the last one counts.
        last = {pair: at for at, pair in enumerate(map(tuple, local.relations.pairs.tolist()))}
        told = sorted((sorted(pair), at) for pair, at in last.items() if close[pair])
        rows = [at for _, at in told]
        self._graph.pairs.add_frame(shown, slots[local.relations.pairs[rows]], votes[rows])

    def add(self, evidence: RelationEvidence) -> None:
        """Take in neighbour pairs (Eq. 8) and the world model's predictions.

        Raises:
            RefusedInput: ``vocabulary_mismatch``; ``unknown_frame`` if the local graph with that
                stamp was never merged or is forgotten.
        """
        columns = self._graph.class_columns(evidence.vocabulary)
        node_ids = self._graph.nodes_of_frame(evidence.stamp_ns)
        if node_ids is None or (len(evidence.pairs) and evidence.pairs.max() >= len(node_ids)):
            raise RefusedInput(
                "unknown_frame",
                f"relation evidence for {evidence.stamp_ns} ns: no local graph of that frame "
                "is remembered",
            )
        classes = evidence.pair_classes if columns is None else columns[evidence.pair_classes]
        self.prior.grow(len(self._graph.vocabulary.classes))
        self.prior.update(classes, evidence.predictions)
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
        self.prior.grow(len(self._graph.vocabulary.classes))
        prior = self._follow_table(whole)
        self._begun = self._begun or not self.waiting
        if self._robust is not None and self._table is not None:
            if not self._table.begun:
                return [], False
            return self._follow(self._table, self._robust.refresh(prior)), self._begun
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
            self._predicted.follow(table, table.changed_rows)
        if self._robust is None:
            for known in (table.changed_rows, table.changed_slots, table.gone, table.changes.edges):
                known.clear()
        return prior if self._predicted is None else self._predicted

    def _follow(self, table: PairTable, beliefs: ChangedBeliefs) -> list[Pair]:
        """Write the messages of the edges that are probable enough; returns those that changed."""
        changed: list[Pair] = []
        for gone in table.gone:
            changed += [pair for pair in (gone, gone[::-1]) if self.states.pop(pair, None)]
        table.gone.clear()
        # Messages have the geometry, too.
        between, near = table.between(beliefs.rows)
        cm = np.rint(100.0 * np.stack(between, axis=1)).astype(np.int64)
        keys = np.where(near, (cm << [2, 18, 34]).sum(axis=1), 0)
        keys = beliefs.sources + keys[:, None]
        said, mutual = said_predicates(beliefs.probabilities, keys, self._symmetric)
        nothing = np.zeros((len(beliefs.unrelated), 2), np.int64)
        for rows, numbers in ((beliefs.unrelated, nothing), (beliefs.rows, said)):
            differ = numbers != table.beliefs["said"][rows]
            if not differ.any():
                continue
            table.beliefs["said"][rows] = numbers
            at, ends = np.nonzero(differ)
            ids = self._graph.pairs.rows["ids"][rows[at]].tolist()
            pairs = [(b, a) if end else (a, b) for (a, b), end in zip(ids, ends.tolist())]
            for pair, is_said in zip(pairs, numbers[at, ends].tolist()):
                if not is_said:
                    del self.states[pair]
            told = numbers[at, ends] != 0
            self._tell(beliefs, at[told], ends[told], mutual)
            changed += pairs
        return changed + self._follow_evidence(table, changed)

    def _tell(self, beliefs: ChangedBeliefs, at: Int64, ends: Int64, mutual: Bool) -> None:
        """Write the messages of some directions of pairs."""
        if not len(at):
            return
        rows = beliefs.rows[at]
        for (first, second), end, one, source, both, evidence in zip(
            self._graph.pairs.rows["ids"][rows].tolist(),
            ends.tolist(),
            listed(beliefs.probabilities[at, ends], self._graph.vocabulary.predicates, self._top_k),
            beliefs.sources[at, ends].tolist(),
            mutual[at].tolist(),
            self._evidence(rows, ends),
        ):
            pair = (second, first) if end else (first, second)
            self.states[pair] = edge_state(
                pair, one, provenance=PROVENANCES[source], mutual=both, **evidence
            )

    def _follow_evidence(self, table: PairTable, told: Collection[Pair]) -> list[Pair]:
        """Bring the other messages up to date with the evidence of their edges."""
        rows = np.array(sorted(table.changes.edges), np.int64)
        table.changes.edges.clear()
        at, ends = np.nonzero(table.beliefs["said"][rows])
        rows, known, changed = rows[at], set(told), []
        for (first, second), end, evidence in zip(
            self._graph.pairs.rows["ids"][rows].tolist(),
            ends.tolist(),
            self._evidence(rows, ends),
        ):
            pair = (second, first) if end else (first, second)
            if pair not in known:
                evidence["entropy_nats"] = round(evidence["entropy_nats"], DECIMALS)
                self.states[pair] = msgspec.structs.replace(self.states[pair], **evidence)
                changed.append(pair)
        return changed

    def _evidence(self, rows: Int64, ends: Int64) -> list[dict[str, Any]]:
        """The evidence of directed pairs as their messages have it."""
        pairs = self._graph.pairs
        if not len(rows):
            return []
        logits = pairs.logits[pairs.rows["logits"][rows, ends]]
        entropies = entropy_nats(visual_distribution(logits)).tolist()
        observations = pairs.rows["frames"][rows, ends].tolist()
        shown = pairs.rows["shown"][rows].tolist()
        assert self._table is not None
        (gap_m, rise_m, fall_m), near = self._table.between(rows)
        back = ends > 0
        steps = np.where(back, fall_m, rise_m), np.where(back, rise_m, fall_m)
        measured = np.stack([gap_m, *steps], axis=1).tolist()
        return [
            {
                "entropy_nats": e,
                "observations": frames,
                "shown": both,
                "measured_m": m if n else UNSET,
            }
            for e, frames, both, m, n in zip(
                entropies, observations, shown, measured, near.tolist()
            )
        ]


@kernel
def _counted(slots: Int64, means_world: Float64) -> tuple[Bool, Int64]:
    """Whether (n, n) frames count for each two rows: two nodes (-1 = none) that are close.

    Also the slots (k, 2) of these pairs of rows.
    """
    size = len(slots)
    close, shown = np.zeros((size, size), np.bool_), np.empty((size * size // 2, 2), np.int64)
    count = 0
    for a in range(size):
        for b in range(a + 1, size):
            squared_m2 = 0.0
            for axis in range(3):
                squared_m2 += (means_world[a, axis] - means_world[b, axis]) ** 2
            live = slots[a] >= 0 and slots[b] >= 0 and slots[a] != slots[b]
            if live and squared_m2 < MAX_DISTANCE_M**2:
                close[a, b] = close[b, a] = True
                shown[count, 0], shown[count, 1] = slots[a], slots[b]
                count += 1
    return close, shown[:count].copy()


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
    graph = GlobalGraph(Vocabulary(("table", "cup"), ("on", "near", "with", "other")), "world")
    beliefs = EdgeBeliefs(config, graph, ClassPairPrior(2, 4))
    points = np.indices((3, 3, 3)).reshape(3, -1).T.astype(np.float32) / 10.0
    for index in range(3):
        mean, surface = np.zeros(3), points + np.float32(0.1 * index)
        graph.add_node(mean, np.eye(3), np.array([0.7, 0.3]), 1, surface)
    for pair in ((1, 2), (2, 3), (3, 1)):
        graph.add_votes(*pair, np.array([[30.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]))
        graph.add_visual(*pair, np.zeros(4), 1)
    beliefs.refresh()
    _counted(np.array([1, 2]), np.zeros((2, 3)))
    T_far = np.array([[1.0, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    graph.move_nodes(graph.nodes.slots_of([2]), T_far[None])
    beliefs.refresh()
    graph.remove_node(1)
    beliefs.refresh()
