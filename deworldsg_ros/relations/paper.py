"""The relations of the paper: neighbour pairs (Eq. 8), the prior, and edges (Eq. 9-10)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Protocol

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import DECIMALS, Listed, listed
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.scene.arrays import (
    Bool,
    Float64,
    Int8,
    Int64,
    SoftmaxWeights,
    softmax,
    softmax_weights,
)
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, Relations, derived
from deworldsg_ros.scene.limits import MAX_PREDICTION_SUM_ERROR
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.messages import Provenance

# --- The world model's prior of a class pair: the running mean of its predictions.

Index = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]


class PriorState(msgspec.Struct, frozen=True):
    """A prior as plain values.

    Attributes:
        class_count, predicate_count: of the prior.
        class_pairs: subject and object class of each pair that has a prior.
        counts: number of its predictions.
        sums: sum of its predictions.
    """

    class_count: Index
    predicate_count: Index
    class_pairs: list[tuple[Index, Index]]
    counts: list[Annotated[int, msgspec.Meta(ge=1, le=2**52)]]
    sums: list[list[float]]


class Prior(Protocol):
    """A prior of class pairs.

    Attributes:
        changed: class pairs whose prior changed, since the reader emptied it.
    """

    changed: set[tuple[int, int]]

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """Priors (m, R) of class pairs (m, 2), and (m,) bool, whether there is one."""
        ...


class ClassPairPrior:
    """P_WM(r | c_s, c_o): mean of the probe's distributions by (subject class, object class).

    It is computed from predictions only, never from ground truth. Up to rounding, the order of the
    predictions does not matter. A pair of classes without a prediction has no prior.

    Attributes:
        changed: class pairs whose prior changed, since the reader emptied it.
    """

    def __init__(self, class_count: int, predicate_count: int) -> None:
        self.class_count = class_count
        self.predicate_count = predicate_count
        # Row of a class pair in the arrays below; -1 = none yet.
        self._rows = np.full((class_count, class_count), -1, np.int64)
        self._sums: Float64 = np.zeros((0, predicate_count))
        self._counts: Int64 = np.zeros(0, np.int64)
        self.changed: set[tuple[int, int]] = set()

    def __len__(self) -> int:
        """Number of class pairs that have a prior."""
        return len(self._counts)

    def grow(self, class_count: int) -> None:
        """Know this many classes, or more; new ones have no prior yet."""
        more = class_count - self.class_count
        if more > 0:
            self._rows = np.pad(self._rows, (0, more), constant_values=-1)
            self.class_count = class_count

    def update(self, pair_classes: Int64, predictions: Float64) -> None:
        """Add predictions; rows of NaN (no clip was encoded) are skipped.

        Args:
            pair_classes: (m, 2) int64, subject and object class of each row.
            predictions: (m, R) float64 distributions.

        Raises:
            RefusedInput: ``invalid_prediction`` for an unknown class, or a row that is not a
                distribution; then no row is added.
        """
        predicted = ~np.isnan(predictions).any(axis=1)
        classes, values = pair_classes[predicted], predictions[predicted]
        try:
            self._check(classes, values)
        except ValueError as error:
            raise RefusedInput("invalid_prediction", str(error)) from error
        if not len(classes):
            return
        pairs = np.unique(classes, axis=0)
        self._add_rows(pairs[self._rows[pairs[:, 0], pairs[:, 1]] < 0])
        rows = self._rows[classes[:, 0], classes[:, 1]]
        np.add.at(self._sums, rows, values / values.sum(axis=1, keepdims=True))
        np.add.at(self._counts, rows, 1)
        self.changed.update(map(tuple, pairs.tolist()))

    def lookup(self, pair_classes: Int64) -> tuple[Float64, Bool]:
        """The priors of many class pairs.

        Args:
            pair_classes: (E, 2) int64.

        Returns:
            priors (E, R) float64, zeros for pairs without one, and has_prior (E,) bool.
        """
        rows = self._rows[pair_classes[:, 0], pair_classes[:, 1]]
        has_prior = rows >= 0
        priors = np.zeros((len(rows), self.predicate_count))
        known = rows[has_prior]
        priors[has_prior] = self._sums[known] / self._counts[known, None]
        return priors, has_prior

    def to_state(self) -> PriorState:
        """Plain values from which `from_state` makes an equal prior."""
        pairs = np.argwhere(self._rows >= 0)
        rows = self._rows[pairs[:, 0], pairs[:, 1]]
        return PriorState(
            self.class_count,
            self.predicate_count,
            [(first, second) for first, second in pairs.tolist()],
            self._counts[rows].tolist(),
            self._sums[rows].tolist(),
        )

    @classmethod
    def from_state(cls, state: PriorState) -> ClassPairPrior:
        """The prior of saved plain values.

        Raises:
            ValueError: if they do not fit together.
        """
        prior = cls(state.class_count, state.predicate_count)
        pairs = np.array(state.class_pairs, np.int64).reshape(-1, 2)
        counts = np.array(state.counts, np.int64)
        # Rows of another length than R are no array.
        sums = np.array(state.sums, np.float64).reshape(-1, prior.predicate_count)
        if not len(pairs) == len(counts) == len(sums) == len(np.unique(pairs, axis=0)):
            raise ValueError(
                f"saved prior: {len(pairs)} class pairs, {len(counts)} counts and {len(sums)} "
                "sums: expected one count and sum for each class pair, no pair twice"
            )
        if (counts < 1).any():
            raise ValueError(f"saved prior: a count is {counts.min()}: expected >= 1")
        prior._check(pairs, sums / counts[:, None])
        prior._add_rows(pairs)
        prior._counts, prior._sums = counts, sums
        return prior

    def _check(self, classes: Int64, values: Float64) -> None:
        if values.shape != (len(classes), self.predicate_count):
            raise ValueError(
                f"predictions have shape {values.shape}: "
                f"expected {(len(classes), self.predicate_count)}"
            )
        if not len(classes):
            return
        if classes.min() < 0 or classes.max() >= self.class_count:
            raise ValueError(
                f"class pairs name classes {classes.min()} to {classes.max()}: "
                f"expected 0 to {self.class_count - 1}"
            )
        sums = values.sum(axis=1)
        if not (
            values.min() >= 0 and np.allclose(sums, 1.0, rtol=0, atol=MAX_PREDICTION_SUM_ERROR)
        ):
            raise ValueError(
                f"predictions have a minimum of {values.min():.3g} and sums from "
                f"{sums.min():.6g} to {sums.max():.6g}: expected distributions"
            )

    def _add_rows(self, pairs: Int64) -> None:
        self._rows[pairs[:, 0], pairs[:, 1]] = len(self) + np.arange(len(pairs))
        self._sums = np.vstack([self._sums, np.zeros((len(pairs), self.predicate_count))])
        self._counts = np.concatenate([self._counts, np.zeros(len(pairs), np.int64)])


# --- Visual evidence and the world model's prior, and how an edge combines them (Eq. 9-10).

PROVENANCES: tuple[Provenance, ...] = ("visual", "prior", "fused")
_VISUAL, _PRIOR, _FUSED = range(3)

# Fraction of frames whose relation logits are outliers (`edge_belief: robust`). Relation heads are
# wrong in 10 to 20 % of the frames (docs/dev/notebook.md). From 0.2 on, one confident frame
# would leave more than 1 nat of entropy among 50 predicates, and the prior would enter every pair
# that was seen once.
OUTLIER_RATE = 0.1


def bounded_logits(
    logits: Float64, outlier_rate: float, weights: SoftmaxWeights | None = None
) -> Float64:
    """A frame's relation logits if a fraction of all frames are outliers (beyond the paper).

    log((1 - ε) softmax(ℓ)_r + ε / R). They are summed like the logits in Eq. 9, but the evidence of
    one frame against a predicate is at most log(1 + R (1 - ε) / ε) nats.

    Args:
        logits: (m, R) float64, pre-sigmoid logits of one frame.
        outlier_rate: ε, between 0 and 1.
        weights: those of the logits, if they are known.

    Returns:
        (m, R) float64.
    """
    if not logits.size:
        return logits
    _, exponentials, totals = weights or softmax_weights(logits)
    inliers = (1.0 - outlier_rate) * exponentials / totals
    bounded: Float64 = np.log(inliers + outlier_rate / logits.shape[1])
    return bounded


def visual_distribution(summed_logits: Float64) -> Float64:
    """P_vis = Softmax(Σ_t ℓ_t), the visually aggregated relation distribution (Eq. 9).

    Args:
        summed_logits: (..., R) float64, logits summed over the frames in which the directed pair
            was seen; zeros for a pair that was never seen, which gives the uniform distribution.

    Returns:
        (..., R) float64, rows sum to one.
    """
    distribution: Float64 = softmax(summed_logits)
    return distribution


def entropy_nats(distributions: Float64) -> Float64:
    """Shannon entropy of distributions (..., R), in nats; shape (...)."""
    # The smallest positive float replaces 0 in the logarithm: 0 log 0 is 0.
    logs = np.log(np.maximum(distributions, np.finfo(np.float64).tiny))
    entropies: Float64 = np.maximum(-(distributions * logs).sum(axis=-1), 0.0)
    return entropies


def fuse_distributions(visual: Float64, prior: Float64, alpha: Float64) -> Float64:
    """P_new ∝ P_vis + α_ij · P_WM, the uncertainty-aware additive fusion (Eq. 10).

    Args:
        visual: (..., R) float64 distributions.
        prior: the same; ignored if alpha is 0.
        alpha: (...) float64, α_ij >= 0; 0 if the prior is not active.

    Returns:
        (..., R) float64, rows sum to one; exactly `visual` if alpha is 0.
    """
    weight = np.asarray(alpha, dtype=np.float64)[..., None]
    mixed = visual + weight * prior
    fused: Float64 = np.where(weight > 0, mixed / mixed.sum(axis=-1, keepdims=True), visual)
    return fused


def fuse_prior(
    probabilities: Float64, priors: Float64, has_prior: Bool, alpha: float, threshold_nats: float
) -> tuple[Float64, Bool]:
    """Eq. 10 for pairs that are related with some probability (beyond the paper).

    The prior says by what a pair is related, not whether. It enters where the distribution over
    predicates, given that one holds, has an entropy above the threshold.

    Args:
        probabilities: (m, R), row sums at most 1.
        priors: (m, R) distributions, and
        has_prior: (m,) bool.
        alpha: weight of Eq. 10.
        threshold_nats: entropy.

    Returns:
        (m, R) with the same row sums, and (m,) bool: the prior entered.
    """
    related = probabilities.sum(axis=1)
    given = probabilities / np.maximum(related, 1e-300)[:, None]
    active = has_prior & (entropy_nats(given) > threshold_nats) & (related > 0) & (alpha > 0)
    fused = fuse_distributions(given, priors, np.where(active, alpha, 0.0))
    return np.where(active[:, None], related[:, None] * fused, probabilities), active


@dataclass(frozen=True)
class FusedEdges:
    """Beliefs of E directed edges.

    Attributes:
        probabilities: (E, R) float64, rows sum to one.
        provenance_codes: (E,) int8, indices into `PROVENANCES`; meaningless if not known.
        entropies_nats: (E,) float64, of the visual distributions (uniform without evidence).
        known: (E,) bool; false = neither visual evidence nor an active prior, so no edge.
    """

    probabilities: Float64
    provenance_codes: Int8
    entropies_nats: Float64
    known: Bool


def fuse_edges(
    summed_logits: Float64,
    has_visual: Bool,
    priors: Float64,
    has_prior: Bool,
    alpha: float,
    entropy_threshold_nats: float,
) -> FusedEdges:
    """Beliefs of many directed edges (Eq. 9, the entropy gate, Eq. 10).

    The prior enters if the entropy of P_vis is above the threshold (strictly). The result of a row
    does not depend on the other rows, to the last bit.

    Args:
        summed_logits: (E, R) float64; rows without visual evidence are ignored.
        has_visual: (E,) bool.
        priors: (E, R) float64 distributions; rows without a prior are ignored.
        has_prior: (E,) bool.
        alpha: α of Eq. 10; 0 = the visual distribution only.
        entropy_threshold_nats: the paper's 1.0.
    """
    has_visual = np.asarray(has_visual, dtype=np.bool_)
    has_prior = np.asarray(has_prior, dtype=np.bool_)
    visual = visual_distribution(np.where(has_visual[:, None], summed_logits, 0.0))
    entropies = entropy_nats(visual)
    active = has_prior & (entropies > entropy_threshold_nats) & (alpha > 0)
    probabilities = fuse_distributions(
        visual, np.where(active[:, None], priors, 0.0), np.where(active, alpha, 0.0)
    )
    codes = np.where(active, np.where(has_visual, _FUSED, _PRIOR), _VISUAL).astype(np.int8)
    return FusedEdges(probabilities, codes, entropies, has_visual | active)


# --- Geometric neighbours among the objects of a frame (Eq. 8).


def geometric_costs(boxes_xyxy: Float64, depths_m: Float64, width: int, height: int) -> Float64:
    """Geometric cost of every pair of a frame's objects (Eq. 8).

    cost = |c_i - c_j| / (2 D) + |z_i - z_j|, with box centres c in pixels, the image diagonal D in
    pixels, and mean depths z in metres. Like the paper, it adds a ratio to a length in metres.

    Args:
        boxes_xyxy: (n, 4) float64 pixels.
        depths_m: (n,) float64, mean depth of each object's inliers in the camera frame.
        width: image width in pixels.
        height: image height in pixels.

    Returns:
        (n, n) float64, symmetric, zero diagonal.
    """
    centres = (boxes_xyxy[:, :2] + boxes_xyxy[:, 2:]) / 2
    offsets = centres[:, None, :] - centres[None, :, :]
    distances_px = np.hypot(offsets[..., 0], offsets[..., 1])
    depth_gaps_m = np.abs(depths_m[:, None] - depths_m[None, :])
    costs: Float64 = 0.5 * distances_px / math.hypot(width, height) + depth_gaps_m
    return costs


def neighbour_pairs(
    boxes_xyxy: Float64, depths_m: Float64, width: int, height: int, threshold: float
) -> tuple[Int64, Float64]:
    """Ordered pairs whose geometric cost is strictly below a threshold (Eq. 8).

    Args:
        boxes_xyxy: (n, 4) float64 pixels.
        depths_m: (n,) float64, as in `geometric_costs`.
        width: image width in pixels.
        height: image height in pixels.
        threshold: of the cost; 0.45 in the paper.

    Returns:
        pairs (m, 2) int64 of rows, both directions of each neighbour pair, in lexicographic
        order; and their costs (m,) float64.
    """
    costs = geometric_costs(boxes_xyxy, depths_m, width, height)
    near = costs < threshold
    np.fill_diagonal(near, False)
    pairs = np.argwhere(near).astype(np.int64, copy=False).reshape(-1, 2)
    return pairs, costs[pairs[:, 0], pairs[:, 1]]


def candidates(local: LocalGraph, config: RelationsConfig) -> LocalGraph:
    """A frame's local graph with the relations that are evidence of an edge.

    With `edge_belief: paper`, these are the relations of neighbour pairs (Eq. 8); else all.
    """
    if config.edge_belief != "paper":
        return local
    relations = local.relations
    costs = geometric_costs(local.boxes_xyxy, local.depths_m, local.width, local.height)
    near = costs[relations.pairs[:, 0], relations.pairs[:, 1]] < config.geo_cost_threshold
    kept = relations.pairs[near], relations.logits[near], relations.scores[near]
    return derived(local, relations=Relations(*kept))


# --- The beliefs of edges as in the paper (Eq. 9-10), rebuilt only where something changed.


class PaperBeliefs:
    """Computes the messages of the edges of a graph, each direction for itself.

    Args:
        config: `fusion_alpha` and `entropy_threshold_nats` are used.
        graph: whose edges these are.
        top_k: number of predicates in the message of an edge.

    Attributes:
        states: the messages by subject and object; those that did not change are the same objects.
    """

    def __init__(self, config: RelationsConfig, graph: GlobalGraph, top_k: int) -> None:
        self._config = config
        self._graph = graph
        self._top_k = top_k
        self.states: dict[Pair, wire.EdgeState] = {}
        self._changes = graph.pairs.watch()
        self._touched = graph.watch_nodes()
        # By slot, the class of a published node; -1 = none.
        self._classes = np.full(0, -1, np.int64)
        # Rows of the pairs with an edge between two classes; some have none any more.
        self._by_classes: dict[tuple[int, int], set[int]] = {}

    def refresh(self, prior: Prior) -> list[Pair]:
        """Bring `states` up to date; returns the pairs with another message, or none.

        Args:
            prior: of class pairs.
        """
        changed = []
        for _, ids in self._changes.gone:
            changed += [pair for pair in (ids, ids[::-1]) if self.states.pop(pair, None)]
        touched = self._changes.edges | self._follow_nodes()
        for classes in prior.changed:
            touched |= self._by_classes.pop(classes, set())
        prior.changed.clear()
        rows = np.array(sorted(touched), np.int64)
        self._changes.clear()
        made = self._make(rows, prior)
        for first, second in self._graph.pairs.rows["ids"][rows].tolist():
            for pair in ((first, second), (second, first)):
                state, known = made.get(pair), self.states.get(pair)
                if state == known:
                    continue
                changed.append(pair)
                if state is None:
                    del self.states[pair]
                else:
                    self.states[pair] = state
        return changed

    def _follow_nodes(self) -> set[int]:
        """Rows of the pairs of nodes that came, went or have another class now."""
        nodes, edits, names = self._graph.nodes, self._graph.edits, self._graph.vocabulary
        if len(self._classes) < len(nodes.ids):
            more = len(nodes.ids) - len(self._classes)
            self._classes = np.pad(self._classes, (0, more), constant_values=-1)
        slots = np.array(sorted(set(self._touched.values())), np.int64)
        self._touched.clear()
        classes = edits.believed_classes(nodes, names, slots).argmax(axis=1)
        classes = np.where(nodes.confirmed[slots], classes, -1)
        differ = classes != self._classes[slots]
        self._classes[slots] = classes
        return set(self._graph.pairs.of(slots[differ]).tolist())

    def _make(self, rows: Int64, prior: Prior) -> dict[Pair, wire.EdgeState]:
        """Messages of the edges of some pairs (Eq. 9-10); without those that have no belief."""
        pairs = self._graph.pairs
        known = pairs.rows.take(rows)
        published = (self._classes[known["slots"]] >= 0).all(axis=1)
        is_edge = (known["frames"] > 0) | (known["neighbour_frames"] > 0)
        at, ends = np.nonzero(is_edge & published[:, None])
        if not len(at):
            return {}
        of_ends = self._classes[known["slots"][at]]
        order = np.arange(len(at))
        classes = np.column_stack([of_ends[order, ends], of_ends[order, 1 - ends]])
        for row, (subject, object_) in zip(rows[at].tolist(), classes.tolist()):
            self._by_classes.setdefault((subject, object_), set()).add(row)
        frames = known["frames"][at, ends]
        fused = fuse_edges(
            pairs.logits[known["logits"][at, ends]],
            frames > 0,
            *prior.lookup(classes),
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        believed = np.flatnonzero(fused.known)
        names = self._graph.vocabulary.predicates
        told = listed(fused.probabilities[believed], names, self._top_k)
        made = {}
        for index, one in zip(believed.tolist(), told):
            first, second = known["ids"][at[index]].tolist()
            pair = (second, first) if ends[index] else (first, second)
            made[pair] = edge_state(
                pair,
                one,
                provenance=PROVENANCES[fused.provenance_codes[index]],
                entropy_nats=float(fused.entropies_nats[index]),
                observations=int(frames[index]),
            )
        return made


def edge_state(
    pair: Pair,
    told: Listed,
    *,
    provenance: wire.Provenance,
    entropy_nats: float,
    observations: int,
    shown: int | None = None,
    mutual: bool = False,
    measured_m: list[float] | UnsetType = UNSET,
) -> wire.EdgeState:
    """The message of an edge with the probabilities of its predicates."""
    return wire.EdgeState(
        subject=pair[0],
        object=pair[1],
        predicate=told.beliefs[0].label,
        probability=told.beliefs[0].probability,
        predicates=told.beliefs,
        provenance=provenance,
        entropy_nats=round(entropy_nats, DECIMALS),
        observations=observations,
        remainder=told.remainder,
        shown=UNSET if shown is None else shown,
        mutual=mutual or UNSET,
        measured_m=measured_m,
    )
