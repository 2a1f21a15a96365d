"""The predictions of the embedded world model as the prior of class pairs (Eq. 9-10)."""

from __future__ import annotations

import numpy as np
from scipy.special import softmax

from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.physical_states import NONE, RELATIONS_OF_STATE, canonical_predicates
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.scene.graph import SceneGraph

# A prediction of a pair enters the prior of its classes if the model says, with this probability,
# that the pair is related in this direction. Otherwise it abstains.
MIN_RELATED = 0.5


def predicted_prior(table: PairTable, graph: SceneGraph) -> ClassPairPrior:
    """The predictions of the physical model as the prior of their class pairs.

    The model abstains for pairs that are probably not related.
    """
    vocabulary = graph.vocabulary
    prior = ClassPairPrior(len(vocabulary.classes), len(vocabulary.predicates))
    rows = np.flatnonzero(table.judged)
    states = softmax(table.state_logits[rows], axis=1)
    related = states[:, 0] < 1.0 - MIN_RELATED
    rows, states = rows[related], states[related]
    if not len(rows):
        return prior
    nodes = graph.nodes
    best = [
        [int(nodes.class_probabilities[nodes.row(end)].argmax()) for end in ends]
        for ends in table.nodes[rows].tolist()
    ]
    classes = np.array(best, np.int64)
    canonical = canonical_predicates(vocabulary.predicates)
    for end in (0, 1):
        predictions = np.zeros((len(rows), prior.predicate_count))
        for state, relation in enumerate(RELATIONS_OF_STATE[:, end].tolist()):
            if relation != NONE and canonical[relation] >= 0:
                predictions[:, canonical[relation]] += states[:, state]
        total = predictions.sum(axis=1)
        spoken = total > MIN_RELATED
        prior.update(classes[spoken][:, :: 1 - 2 * end], predictions[spoken] / total[spoken, None])
    return prior
