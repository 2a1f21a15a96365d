"""The class of a node: a hidden Markov model, because wrong names come in spells.

A detector that calls a chair a bag calls it so for as long as it sees it from there. So the model
of a node has two labels: the class of the object, and the name that it has at present. The name is
drawn again with a time constant of SPELL_S seconds: it is the class, or another label with
probability WRONG. A frame shows the name, or any label with probability OUTLIERS. Only the LABELS
most probable labels are considered. The constants gave the most relations with faults of all kinds
in one room, and no fewer with the detector (tools/merging_lab).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float64, Int64

LABELS = 8
SPELL_S = 3.0
WRONG = 0.4
OUTLIERS = 0.4
# Probability of all other labels together.
OTHERS = 0.05

# The part of a node's record that belongs to its name: the labels (-1 = none), and the probability
# of each class (row) with each name (column).
FIELDS: list[Any] = [
    ("labels", np.int64, LABELS),
    ("joint", np.float64, (LABELS, LABELS)),
    ("named_ns", np.int64),
]


@kernel
def start(record: Any, probabilities: Float64, stamp_ns: int) -> None:
    """Begin with class probabilities (C,)."""
    order = np.argsort(-probabilities)
    count = min(LABELS, len(order))
    for i in range(LABELS):
        record.labels[i] = order[i] if i < count else -1
        for j in range(LABELS):
            share = 1.0 - WRONG if i == j else WRONG / max(count - 1, 1)
            both = i < count and j < count
            record.joint[i, j] = share * probabilities[order[j]] if both else 0.0
    record.named_ns = stamp_ns


@kernel
def observe(
    records: NDArray[Any], owners: Int64, seen: Float64, stamp_ns: int, classes: Float64
) -> None:
    """Add class distributions (n, C) of a frame to n known nodes.

    Args:
        records: with `FIELDS`; those of the owners are updated.
        owners: (n,) index of each node's record.
        seen: (n, C) distributions of the detections.
        stamp_ns: of the frame.
        classes: (n, C), filled with the distributions of the nodes' classes.
    """
    for index in range(len(owners)):
        record = records[owners[index]]
        _consider(record, int(np.argmax(seen[index])))
        known = 0
        for label in record.labels:
            known += int(label >= 0)
        leave = 1.0 - np.exp(-max(stamp_ns - record.named_ns, 0) * 1e-9 / SPELL_S)
        record.named_ns = stamp_ns
        total = 0.0
        for i in range(known):
            belief = record.joint[i].sum()
            for j in range(known):
                drawn = 1.0 - WRONG if i == j else WRONG / max(known - 1, 1)
                shown = (1.0 - OUTLIERS) * seen[index, record.labels[j]]
                shown += OUTLIERS / seen.shape[1]
                moved = (1.0 - leave) * record.joint[i, j] + leave * drawn * belief
                record.joint[i, j] = moved * shown
                total += record.joint[i, j]
        classes[index] = OTHERS / seen.shape[1]
        for i in range(known):
            record.joint[i] /= total
            classes[index, record.labels[i]] += (1.0 - OTHERS) * record.joint[i].sum()


@kernel
def _consider(record: Any, label: int) -> None:
    """Make sure that a label is considered; it takes the place of the least probable one."""
    place = 0
    for i in range(LABELS):
        if record.labels[i] == label:
            return
        if record.labels[i] < 0 or record.joint[i].sum() < record.joint[place].sum():
            place = i
            if record.labels[i] < 0:
                break
    record.labels[place] = label
    for i in range(LABELS):
        record.joint[i, place] = 0.0
    # If the object is this, all names so far were wrong.
    for j in range(LABELS):
        others = 0.0
        for i in range(LABELS):
            others += record.joint[i, j] if i != place else 0.0
        record.joint[place, j] = WRONG / LABELS * others
