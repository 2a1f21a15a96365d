"""What the stages before the world model give it, on the shipped recording.

Weights and figures belong to these inputs. card.json has those of the code that the figures were
measured with; test/relations/test_physics_card.py compares them with today's.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from collect import collect
from dataset import Array, inputs_of, load_room

from deworldsg_ros.evaluation.front_ends import FrontEndChoice
from deworldsg_ros.evaluation.recorded_room import RecordedRoom
from deworldsg_ros.relations.geometry import FEATURES
from deworldsg_ros.relations.states import DIRECTED
from deworldsg_ros.scene.vocabulary import KINDS

RECORDING = Path(__file__).resolve().parents[2] / "bags" / "demo_room"
# Of the recording, for speed.
EVERY = 2
ENDS = ("subject", "object")
INPUTS = (
    *FEATURES,
    *(f"kind {kind} of {end}" for end in ENDS for kind in range(len(KINDS))),
    *("fixed to object", "fixed to subject", "same class"),
    *(f"{name} of {end}" for name in ("entropy", "log observations") for end in ENDS),
)

# Greatest shift of a mean, in standard deviations of the training rooms, and of a count, in parts.
# Another noise of the boxes shifts a mean by up to 0.45, and a count by 0.05.
MAX_SHIFT, MAX_SHARE = 0.5, 0.1

Fingerprint = dict[str, list[float]]


def measure() -> Fingerprint:
    """The fingerprint of this code."""
    with tempfile.TemporaryDirectory() as folder:
        return of_map(map_recording(Path(folder)))


def map_recording(folder: Path) -> Path:
    """Write a map of the shipped recording with true boxes; returns its path."""
    room = RecordedRoom(RECORDING)
    return collect(room, room.scans()[0], folder, FrontEndChoice("boxes"), EVERY)


def of_map(path: Path) -> Fingerprint:
    """Pairs in reach; means of each input over all and over the related pairs; votes of a frame.

    Subject and object of a related pair are those of the true relation.
    """
    truth = RecordedRoom(RECORDING)
    room = load_room(path, truth.ground_truth(truth.scans()[0]))
    related = np.flatnonzero(room.states > 0)
    ends = (room.states[related] - 1) % 2
    inputs = np.stack(inputs_of([room]))
    relation = np.array(DIRECTED)[(room.states[related] - 1) // 2]
    votes = room.counts[related, ends, relation] / np.maximum(room.frames[related], 1)
    means = np.stack([inputs.mean(axis=(0, 1)), inputs[ends, related].mean(axis=0)], axis=1)
    return dict(zip(INPUTS, means.round(4).tolist(), strict=True)) | {
        "pairs in reach": [len(room.pairs)],
        "related pairs": [len(related)],
        "votes for the true relation": [round(float(votes.mean()), 4)],
    }


def differences(known: Fingerprint, seen: Fingerprint, scales: Array) -> list[str]:
    """What is beyond the limits, as text; the scales (INPUT_COUNT,) are those of the model."""
    scale_of = dict(zip(INPUTS, scales, strict=True))
    result = []
    for name, old in known.items():
        limit = MAX_SHIFT * scale_of[name] if name in scale_of else MAX_SHARE * old[0]
        if np.abs(np.subtract(seen[name], old)).max() > limit:
            result.append(f"{name}: {seen[name]}, on the card {old}, differs by over {limit:.3g}")
    return result
