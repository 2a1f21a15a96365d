"""The embedded world model: what physics says of two objects, and what the votes of frames add."""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.relations.geometry import FEATURES
from deworldsg_ros.relations.states import (
    DIRECTED,
    NEAR,
    NONE,
    RELATIONS,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    states_of_relations,
)
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import KINDS, fixed_table, kind_table

# --- The evidence of frame votes: how much the votes of many frames speak for each relation.
#
# Of the n frames that showed both objects, a fraction x voted for a relation. Its evidence, in nats
# against "not related", is
#
#     n / (n + n_half) · slope · log((x + floor) / (even + floor)).
#
# It grows with the fraction, and saturates with the number of frames, because the frames of one
# pair are not independent. A relation with fewer votes than the fraction `even` is less likely than
# without votes. The four numbers are fitted to simulated rooms (tools/physics_model).

# Relations of each state in both directions, and how many of them have a name.
_STATES = RELATIONS_OF_STATE
_NAMED = (_STATES != NONE).sum(axis=1).astype(np.float64)
# A vote on "near" counts this much for pairs on the floor. A frame ranks neighbours among the
# furniture in its view, and its gaps have errors: a quarter of the frames say "near" of pairs that
# look near and are not (chosen on ten simulated rooms). No votes say as much as elsewhere.
NEAR_FLOOR_WORTH = 1.0 / 3.0


class VoteScales(NamedTuple):
    """The numbers of the formula above.

    Attributes:
        slope: nats for each factor e of the fraction.
        n_half: frames that give half of the evidence of infinitely many.
        floor: fraction below which fewer votes hardly matter.
        even: fraction without evidence.
    """

    slope: float
    n_half: float
    floor: float
    even: float


@kernel
def relation_counts(votes: Float32, relation_of: Int64) -> tuple[Float64, Float64]:
    """Votes by relation.

    Args:
        votes: (m, ends, R) sums of the votes, in some directions.
        relation_of: (R,) relation of each predicate, -1 = it names none.

    Returns:
        (m, ends, NONE) votes by relation; and (m,) most votes on a predicate that names no physical
        relation.
    """
    counts = np.zeros((len(votes), votes.shape[1], NONE), np.float64)
    others = np.zeros(len(votes), np.float64)
    for row in range(len(votes)):
        for end in range(votes.shape[1]):
            for name in range(len(relation_of)):
                if relation_of[name] >= 0:
                    counts[row, end, relation_of[name]] += votes[row, end, name]
                else:
                    others[row] = max(others[row], votes[row, end, name])
    return counts, others


def vote_logits(counts: Float64, frames: Int64, scales: VoteScales) -> tuple[Float64, Float64]:
    """Logits (m, STATE_COUNT) of the states of pairs, and (m, 2) of near against "not related".

    The logits of near are those of pairs on a support, and on the floor. A relation that has a
    converse has the votes of both.

    Args:
        counts: (m, 2, NONE) of `relation_counts` in both directions.
        frames: (m,) number of frames that showed both objects.
        scales: of the evidence.
    """
    return _vote_logits(counts, frames, *scales)


@kernel
def _vote_logits(
    counts: Float64, frames: Int64, slope: float, n_half: float, floor: float, even: float
) -> tuple[Float64, Float64]:
    logits = np.zeros((len(counts), STATE_COUNT), np.float64)
    near = np.empty((len(counts), 2), np.float64)
    for row in range(len(counts)):
        worth = frames[row] / (frames[row] + n_half) * slope
        for state in range(1, STATE_COUNT + 1):
            votes = (counts[row, 0, NEAR] + counts[row, 1, NEAR]) / 2.0
            if state < STATE_COUNT:
                votes = 0.0
                for end in range(2):
                    relation = _STATES[state, end]
                    if relation != NONE:
                        votes += counts[row, end, relation] / _NAMED[state]
            fraction = votes / max(frames[row], 1e-9)
            evidence = worth * math.log((fraction + floor) / (even + floor))
            if state < STATE_COUNT:
                logits[row, state] = evidence
            else:
                near[row, 0] = evidence
                weighed = NEAR_FLOOR_WORTH * fraction
                near[row, 1] = worth * math.log((weighed + floor) / (even + floor))
    return logits, near


# --- How much of what holds a source says at all.

# The formula was fitted to votes of the embedded head. Of pairs that are related, this fraction of
# their frames says so.
FITTED_RATE = 0.6
# The rate of a source is learned from pairs that are related with more than `SURE`, by their
# geometry alone. At least `MIN_FRAMES` have shown them, with more than `MIN_FRACTION` votes a
# frame. Pairs without votes do not count: their geometry may be wrong.
SURE, MIN_FRAMES, MIN_FRACTION = 0.9, 5, 0.05
# The rate starts as the fitted one, with the weight of this many pairs.
PRIOR_PAIRS = 5
# Steps of the worth of a vote. A change concerns all pairs: they are taken in anew, in one call.
WORTH_STEP = 0.25
# Sums of whole numbers of this are exact: taking one back leaves no trace, and the order does not
# matter.
UNIT = 2.0**-40


class VoteRate:
    """How often a source says a relation that holds, learned from pairs of sure geometry.

    A source that lists ten relations a frame, as EGTR does, leaves most of them out. That is no
    denial. Its votes are worth more, so that they mean what those of the embedded head do.

    Attributes:
        worth: of a vote, at least 1.
    """

    def __init__(self) -> None:
        self.worth = 1.0
        self._told: dict[int, int] = {}
        self._sum = 0

    def follow(
        self, rows: Int64, logits: Float64, judged: Bool, counts: Float64, frames: Int64
    ) -> bool:
        """Take in pairs as they are now, in place of what they said before.

        Args:
            rows: (m,) of the pairs.
            logits: (m, STATE_COUNT) of their geometry.
            judged: (m,) whether they have one.
            counts: (m, 2, NONE) of `relation_counts`.
            frames: (m,) number of frames that showed both objects.

        Returns:
            Whether the worth of a vote changed.
        """
        said = counts[:, :, :NEAR].sum(axis=(1, 2)) / np.maximum(frames, 1)
        related = 1.0 - np.exp(logits[:, 0] - np.logaddexp.reduce(logits, axis=1))
        tells = judged & (related > SURE) & (frames >= MIN_FRAMES) & (said > MIN_FRACTION)
        for row in rows.tolist():
            self._sum -= self._told.pop(row, 0)
        for row, fraction in zip(rows[tells].tolist(), said[tells].tolist()):
            self._told[row] = round(fraction / UNIT)
            self._sum += self._told[row]
        pairs = PRIOR_PAIRS + len(self._told)
        rate = (PRIOR_PAIRS * FITTED_RATE + self._sum * UNIT) / pairs
        before = self.worth
        self.worth = max(1.0, round(FITTED_RATE / rate / WORTH_STEP) * WORTH_STEP)
        return self.worth != before

    def worthy(self, counts: Float64, frames: Int64) -> Float64:
        """Votes (m, 2, NONE) times their worth. This lifts no vote above the fitted rate."""
        if self.worth == 1.0:
            return counts
        most = np.maximum(counts, FITTED_RATE * frames[:, None, None])
        return np.asarray(np.minimum(self.worth * counts, most))


assert len(RELATIONS) == NONE + 1


# --- The embedded world model: what physics says of two objects, learnt from simulated rooms.
#
# A few small networks map the fused geometry and the classes of an ordered pair to logits. They are
# trained on rooms in which a physics engine knows every contact, and what falls when an object is
# taken away (tools/physics_rooms, tools/physics_model). docs/dev/relations.md has the model card.

PATH = Path(__file__).with_name("weights") / "physics.npz"

# Inputs of the network: the geometry, the kinds of both classes, whether one class is usually fixed
# to the other, whether the classes are equal, and the entropies and observations of both.
INPUT_COUNT = len(FEATURES) + 2 * len(KINDS) + 7
# Standardised inputs are limited to this many standard deviations.
MAX_INPUT = 6.0
# Odds are finite.
MAX_FLOOR_LOGIT = 20.0


@dataclass(frozen=True)
class PhysicsModel:
    """The trained network, and what each source of evidence is worth.

    Attributes:
        input_means, input_scales: (INPUT_COUNT,) standardise the inputs.
        weights_1, biases_1, weights_2, biases_2: hidden layers with ReLU, of several networks.
        weights_3, biases_3: logits of the relations of `DIRECTED`, relative to "not related". The
            mean of the networks counts.
        prior: (len(DIRECTED),) logits of a pair without geometry.
        vote_scales: (4,) of `VoteScales`.
        source_weights: (3,) exponents of geometry, and of independent votes; and the fraction of
            pairs whose geometry is broken; see `believed_logits`.
        floor: (3,) offset and slopes of the logit that an object stands on the floor, for the
            height of its bottom over the floor in metres, and the log of its height.
    """

    input_means: Float64
    input_scales: Float64
    weights_1: Float32
    biases_1: Float32
    weights_2: Float32
    biases_2: Float32
    weights_3: Float32
    biases_3: Float32
    prior: Float64
    vote_scales: Float64
    source_weights: Float64
    floor: Float64

    @cached_property
    def votes(self) -> VoteScales:
        """The weights of votes."""
        return VoteScales(*self.vote_scales.tolist())

    @cached_property
    def _hidden(self) -> list[tuple[Float32, Float32]]:
        """Weights and biases of the hidden layers."""
        return [
            (self.weights_1, self.biases_1[:, None]),
            (self.weights_2, self.biases_2[:, None]),
        ]

    @cached_property
    def state_prior(self) -> Float64:
        """Logits (STATE_COUNT,) of a pair without geometry."""
        return np.concatenate([[0.0], np.repeat(self.prior, 2)])

    def relation_logits(self, inputs: Float64) -> Float64:
        """Logits (m, len(DIRECTED)) of ordered pairs with inputs (m, INPUT_COUNT)."""
        scaled = inputs - self.input_means
        scaled /= self.input_scales
        # `np.clip` takes longer than both, and `mean` longer than sum and division.
        np.minimum(np.maximum(scaled, -MAX_INPUT, out=scaled), MAX_INPUT, out=scaled)
        x = scaled.astype(np.float32)
        for weights, biases in self._hidden:
            x = x @ weights
            x += biases
            np.maximum(x, 0.0, out=x)
        logits = x @ self.weights_3
        logits += self.biases_3[:, None]
        mean: Float32 = np.add.reduce(logits, axis=0)
        mean /= len(logits)
        return mean.astype(np.float64)

    def state_logits(self, there: Float64, back: Float64) -> Float64:
        """Logits (m, STATE_COUNT) of pairs, from the inputs of both directions."""
        return self.states_of(np.concatenate([there, back]))

    def states_of(self, inputs: Float64) -> Float64:
        """As `state_logits`, from inputs (2 m, INPUT_COUNT): one direction after the other."""
        both = self.relation_logits(inputs)
        return states_of_relations(both.reshape(2, len(inputs) // 2, -1))


@kernel
def floor_odds(shapes: NDArray[Any], slots: Int64, floor_m: float, floor: Float64) -> None:
    """Write the odds that objects stand on the floor; 0 for those without points.

    Args:
        shapes: (n,) of `SHAPE`.
        slots: (k,) of the objects.
        floor_m: height of the floor.
        floor: of `PhysicsModel`.
    """
    offset, by_bottom, by_height = floor
    for slot in slots:
        shape = shapes[slot]
        shape.floor_odds = 0.0
        if shape.count:
            rise, height = abs(shape.low[2] - floor_m), shape.high[2] - shape.low[2]
            logit = offset + by_bottom * rise + by_height * math.log(height + 0.01)
            shape.floor_odds = math.exp(min(max(logit, -MAX_FLOOR_LOGIT), MAX_FLOOR_LOGIT))


def believed_logits(
    model: PhysicsModel, geometry: Float64, votes: Float64, independent: Bool
) -> Float64:
    """Logits of the states of pairs from both sources.

    A fraction of surfaces is broken: masks bleed, and nodes merge. Judged geometry therefore never
    excludes a state; `PairTable.contradicted` does. The embedded relation head errs where the
    geometry is misleading: beside geometry, its votes are worth less than independent ones.

    Args:
        model: its prior and its source weights are used.
        geometry: (m, STATE_COUNT) of `state_logits`; zeros = not judged.
        votes: (m, STATE_COUNT) of `vote_logits`.
        independent: (m,) bool; the votes do not come from the embedded head, or the geometry was
            not judged.
    """
    return _believed(geometry, votes, independent, model.state_prior, model.source_weights)


@kernel
def _believed(
    geometry: Float64, votes: Float64, independent: Bool, prior: Float64, source_weights: Float64
) -> Float64:
    by_geometry, by_independent, broken = source_weights
    result = np.empty(geometry.shape)
    sound = np.empty(len(prior))
    of_prior = _log_sum(prior)
    for row in range(len(geometry)):
        judged = np.any(geometry[row] != 0.0)
        for state in range(len(prior)):
            sound[state] = by_geometry * geometry[row, state] if judged else prior[state]
        of_sound = _log_sum(sound)
        worth = by_independent if independent[row] else 1.0
        for state in range(len(prior)):
            a = math.log1p(-broken) + sound[state] - of_sound
            b = math.log(broken) + prior[state] - of_prior
            mixed = max(a, b) + math.log1p(math.exp(-abs(a - b)))
            result[row, state] = mixed + worth * votes[row, state]
    return result


@kernel
def _log_sum(logits: Float64) -> float:
    """Logarithm of the sum of exponentials."""
    best, total = logits.max(), 0.0
    for value in logits:
        total += math.exp(value - best)
    return float(best + math.log(total))


class PairInputs:
    """Makes the inputs of the network for a vocabulary.

    Args:
        classes: names of the C classes.
    """

    def __init__(self, classes: tuple[str, ...]) -> None:
        self._kinds = kind_table(classes)
        self._fixed = np.argwhere(fixed_table(classes))

    def make(
        self,
        features: Float64,
        class_probabilities: Float64,
        observations: Int64,
        subjects: Int64,
        objects: Int64,
    ) -> Float64:
        """Inputs (m, INPUT_COUNT) of ordered pairs.

        Args:
            features: (m, len(FEATURES)) of `pair_features`.
            class_probabilities: (n, C), rows sum to one.
            observations: (n,) number of frames that showed each node.
            subjects: (m,) rows of `class_probabilities`, and
            objects: (m,) rows.
        """
        known = (class_probabilities, observations, subjects, objects)
        return _inputs(features, *known, self._kinds, self._fixed)


# Where the model was trained, few names were surer than this. It does not know what surer ones are,
# as of a source that does not contradict itself (`merging.beliefs.doubt`).
LEAST_ENTROPY_NATS = 0.8


@kernel
def _inputs(
    features: Float64,
    classes: Float64,
    observations: Int64,
    subjects: Int64,
    objects: Int64,
    kinds: Float64,
    fixed: Int64,
) -> Float64:
    """See `PairInputs.make`; kinds are those of `kind_table`, fixed (k, 2) are pairs of classes."""
    count, width = kinds.shape
    of_nodes = np.zeros((len(classes), width), np.float64)
    entropies = np.zeros(len(classes), np.float64)
    for node in range(len(classes)):
        for name in range(count):
            probability = classes[node, name]
            if probability > 0.0:
                entropies[node] -= probability * math.log(probability)
                for kind in range(width):
                    of_nodes[node, kind] += probability * kinds[name, kind]
    start = features.shape[1]
    result = np.empty((len(features), start + 2 * width + 7), np.float64)
    for row in range(len(features)):
        a, b = subjects[row], objects[row]
        there, back, same = 0.0, 0.0, 0.0
        for index in range(len(fixed)):
            name, other = fixed[index]
            there += classes[a, name] * classes[b, other]
            back += classes[b, name] * classes[a, other]
        for name in range(count):
            same += classes[a, name] * classes[b, name]
        for place in range(start):
            result[row, place] = features[row, place]
        for kind in range(width):
            result[row, start + kind] = of_nodes[a, kind]
            result[row, start + width + kind] = of_nodes[b, kind]
        last = result[row, start + 2 * width :]
        last[0], last[1], last[2] = there, back, same
        last[3] = max(entropies[a], LEAST_ENTROPY_NATS)
        last[4] = max(entropies[b], LEAST_ENTROPY_NATS)
        last[5], last[6] = math.log(observations[a]), math.log(observations[b])
    return result


@cache
def load_physics_model(path: Path = PATH) -> PhysicsModel:
    """Read the model.

    Raises:
        ConfigurationError: the file is missing or is no such model.
    """
    try:
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("it is no .npz archive")
        with np.load(path, allow_pickle=False) as archive:
            model = PhysicsModel(*(archive[field.name] for field in fields(PhysicsModel)))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigurationError(
            f"world model 'physics': {path} cannot be read ({error}); reinstall the package"
        ) from error
    for name, shape in _shapes(model).items():
        values = getattr(model, name)
        if values.shape != shape or values.dtype.kind != "f":
            raise ConfigurationError(
                f"world model 'physics': {path} has {name} of {values.dtype} {values.shape}: "
                f"expected floats {shape}; reinstall the package"
            )
    return model


def _shapes(model: PhysicsModel) -> dict[str, tuple[int, ...]]:
    """The shape of each array, for the number of networks and the widths of a model."""
    members, first = (*model.biases_1.shape, 0, 0)[:2]
    second = (0, *model.biases_2.shape)[-1]
    return {
        "input_means": (INPUT_COUNT,),
        "input_scales": (INPUT_COUNT,),
        "weights_1": (members, INPUT_COUNT, first),
        "biases_1": (members, first),
        "weights_2": (members, first, second),
        "biases_2": (members, second),
        "weights_3": (members, second, len(DIRECTED)),
        "biases_3": (members, len(DIRECTED)),
        "prior": (len(DIRECTED),),
        "vote_scales": (4,),
        "source_weights": (3,),
        "floor": (3,),
    }
