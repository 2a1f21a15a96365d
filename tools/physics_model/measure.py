#!/usr/bin/env python3
"""Measure weights of the physical world model on mapped rooms, and renew their card.

    python tools/physics_model/measure.py --test MAPS ROOMS [--weights FILE.npz] [--renew]

MAPS is a folder that collect.py wrote, ROOMS the data set that it ran on; the option may be given
several times. Without --weights, the shipped weights are measured. With --renew, the figures and
the fingerprint of today's code replace those of card.json.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import fingerprint
import numpy as np
from dataset import Array, Room, inputs_of, nodes_of, rooms_of, states_of
from numpy.typing import NDArray
from scipy.special import softmax

from deworldsg_ros.relations import physics
from deworldsg_ros.relations.physics import PhysicsModel, believed_logits, vote_logits
from deworldsg_ros.relations.rules import one_support

CARD = Path(__file__).with_name("card.json")

Figures = dict[str, dict[str, float]]


def believed_states(
    model: PhysicsModel, rooms: list[Room], geometry: Array, votes: Array, *, independent: bool
) -> Array:
    """State probabilities as the package computes them."""
    alike = np.full(len(geometry), independent)
    states = softmax(believed_logits(model, geometry, votes, alike), axis=1)
    pairs, rise, height, _ = nodes_of(rooms)
    floor_odds = np.exp(model.floor @ np.stack([np.ones_like(rise), rise, height]))
    return one_support(states, pairs, floor_odds)[0]


def cross_entropy(probabilities: Array, states: NDArray[np.int64]) -> float:
    """Mean log loss, nats a pair."""
    chosen = probabilities[np.arange(len(states)), states]
    return float(-np.log(np.maximum(chosen, 1e-9)).mean())


def votes_of(model: PhysicsModel, rooms: list[Room]) -> Array:
    """Logits (m, STATE_COUNT) of the votes."""
    counts = np.concatenate([room.counts for room in rooms])
    frames = np.concatenate([room.frames for room in rooms])
    return vote_logits(counts, frames, model.votes)[0]


def figures(model: PhysicsModel, name: str, rooms: list[Room], geometry: Array) -> Figures:
    """Print and return log loss, precision, recall and calibration of each source and of both.

    Precision and recall are in percent at a probability of 0.5, the calibration error in percent.
    """
    states, votes, nothing = states_of(rooms), votes_of(model, rooms), np.zeros_like(geometry)
    print(f"{name}: {len(rooms)} rooms, {(states > 0).sum()} of {len(states)} pairs related")
    result = {}
    for source, g, v, independent in (
        ("prior", nothing, nothing, False),
        ("votes", nothing, votes, True),
        ("geometry", geometry, nothing, False),
        ("both", geometry, votes, False),
    ):
        p = believed_states(model, rooms, g, v, independent=independent)
        best = p[:, 1:].argmax(axis=1) + 1
        said, right = p[:, 1:].max(axis=1), best == states
        sure, listed = said >= 0.5, said >= 0.1
        bins = np.minimum((said * 10).astype(int), 9)
        error = sum(
            abs((said - right)[listed & (bins == index)].sum()) for index in range(10)
        ) / max(1, listed.sum())
        result[source] = {
            "log_loss_nats": round(cross_entropy(p, states), 4),
            "precision": round(100.0 * float(right[sure].mean()) if sure.any() else 0.0, 1),
            "recall": round(100.0 * float(right[sure].sum() / max(1, (states > 0).sum())), 1),
            "calibration_error": round(100.0 * float(error), 1),
        }
        print(f"  {source:>8}: {result[source]}", flush=True)
    return result


def tested(model: PhysicsModel, folders: list[list[Path]]) -> dict[str, Figures]:
    """Figures of a model by the name of each folder of maps."""
    result = {}
    for maps, root in folders:
        rooms = rooms_of([[maps, root]])
        result[maps.name] = figures(model, maps.name, rooms, model.state_logits(*inputs_of(rooms)))
    return result


def write_card(path: Path, weights: Path, **parts: Any) -> None:
    """Write the card of weights; what `parts` do not name stays as it is in the file."""
    card = json.loads(path.read_text()) if path.exists() else {}
    card |= parts
    card["weights_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
    card["fingerprint"] = fingerprint.measure()
    path.write_text(json.dumps(card, indent=1) + "\n")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--test", nargs=2, type=Path, action="append", required=True)
    parser.add_argument("--weights", type=Path, default=physics.PATH)
    parser.add_argument("--renew", action="store_true")
    chosen = parser.parse_args()
    tests = tested(physics.load_physics_model(chosen.weights), chosen.test)
    if chosen.renew:
        write_card(CARD, chosen.weights, tests=tests)


if __name__ == "__main__":
    main()
