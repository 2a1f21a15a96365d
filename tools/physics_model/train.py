#!/usr/bin/env python3
"""Train the physical world model on mapped rooms, calibrate it, and write its weights.

    pip install torch
    python tools/physics_model/train.py --train MAPS ROOMS --test MAPS ROOMS --out FILE.npz

MAPS is a folder that collect.py wrote, ROOMS the data set that it ran on. Every option may be given
several times. The calibration, and the weights of geometry and votes, are fitted to predictions of
networks for training rooms that they were not trained on. The network that is written is trained on
all training rooms.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from importlib.metadata import version
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from dataset import Array, Room, inputs_of, nodes_of, rooms_of, states_of
from measure import (
    Figures,
    believed_states,
    cross_entropy,
    figures,
    tested,
    votes_of,
    write_card,
)
from numpy.typing import NDArray
from scipy.optimize import minimize

from deworldsg_ros.relations.physics import INPUT_COUNT, MAX_INPUT, PhysicsModel
from deworldsg_ros.relations.rules import CARRIED_FIRST, CARRIED_SECOND
from deworldsg_ros.relations.states import DIRECTED, STATE_COUNT

# The same rooms and the same seed give the same weights: sums in another order, of other threads or
# processors, differ in the 16th digit, which 60 epochs do not bring into single precision.
torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)

FITTED = ("vote_scales", "source_weights", "floor")
# Networks, whose mean counts.
MEMBERS = 4
HIDDEN = 64
EPOCHS = 60
# Sets of noisy classes, in turn.
VARIANTS = 6
LEARNING_RATE = 3e-3
WEIGHT_DECAY = 0.1
FOLDS = 4
# Weight of the floor in the loss, beside the pairs.
FLOOR_WEIGHT = 0.05
# Least fraction of pairs whose geometry is taken for broken. The rooms have true boxes; detectors
# make worse surfaces.
MIN_BROKEN = 0.02
# Fraction of the nodes whose classes are wrong or vague in an epoch: detectors err.
CLASS_NOISE = 0.25
# Noise of the inputs in standard deviations: surfaces of other sensors differ.
INPUT_NOISE = 0.05
# The fit of the sources ends at its minimum, not after a number of steps.
PRECISE = {"maxfev": 6000, "xatol": 1e-8, "fatol": 1e-12}


def noisy_classes(room: Room, generator: np.random.Generator) -> Array:
    """Class distributions in which some nodes have a wrong class, or a vague one."""
    classes = room.class_probabilities.copy()
    for row in np.flatnonzero(generator.random(len(classes)) < CLASS_NOISE):
        # Half of the errors are classes of this room, because detectors confuse such.
        other = classes[generator.integers(len(classes))]
        if generator.random() < 0.5:
            other = np.full(len(other), 1.0 / len(other))
        fraction = generator.uniform(0.2, 0.9)
        classes[row] = (1.0 - fraction) * classes[row] + fraction * other
    return classes


class Network(torch.nn.Module):
    """State probabilities of pairs in which each object has one support at most.

    Training goes through `one_support`: the odds of a support count against those of the other
    supports of the same object, so that a bowl beside no plate rests on the table for certain.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(INPUT_COUNT, HIDDEN), torch.nn.ReLU(),
            torch.nn.Linear(HIDDEN, HIDDEN), torch.nn.ReLU(),
            torch.nn.Linear(HIDDEN, len(DIRECTED)),
        )  # fmt: skip
        self.floor = torch.nn.Parameter(torch.tensor([2.0, -15.0, 1.0]))

    def forward(
        self,
        there: torch.Tensor,
        back: torch.Tensor,
        pairs: torch.Tensor,
        rise: torch.Tensor,
        height: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Probabilities (m, STATE_COUNT), and (n,) that an object stands on the floor."""
        both = torch.stack([self.layers(there), self.layers(back)], dim=2).flatten(1)
        states = torch.softmax(torch.cat([torch.zeros(len(there), 1), both], dim=1), dim=1)
        first, second = torch.tensor(CARRIED_FIRST), torch.tensor(CARRIED_SECOND)
        carried = torch.stack([states[:, first].sum(1), states[:, second].sum(1)], dim=1)
        carried = carried.clamp(1e-7, 1 - 1e-5)
        odds = carried / (1 - carried)
        floor_odds = torch.exp(self.floor[0] + self.floor[1] * rise + self.floor[2] * height)
        total = (1 + floor_odds).index_add(0, pairs.flatten(), odds.flatten())
        kept = odds / total[pairs]
        kept = kept / kept.sum(dim=1, keepdim=True).clamp(min=1.0)
        rest = states[:, ~(first | second)].sum(dim=1).clamp(min=1e-9)
        scale = torch.where(
            first, (kept / carried)[:, :1],
            torch.where(second, (kept / carried)[:, 1:], ((1 - kept.sum(1)) / rest)[:, None]),
        )  # fmt: skip
        return states * scale, floor_odds / total


def train(rooms: list[Room], seed: int, jobs: int) -> tuple[PhysicsModel, Figures]:
    """The model of all rooms, and the figures of models that did not see the rooms they judge."""
    held = [rooms[fold::FOLDS] for fold in range(FOLDS)]
    others = [
        [r for index, r in enumerate(rooms) if index % FOLDS != fold] for fold in range(FOLDS)
    ]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        model, *blind = pool.map(train_model, [rooms, *others], repeat(seed))
    geometry = np.concatenate(
        [precise(one).state_logits(*inputs_of(part)) for one, part in zip(blind, held)]
    )
    ordered = [room for part in held for room in part]
    model = fit_sources(model, ordered, geometry)
    return model, figures(model, "held out", ordered, geometry)


def train_model(rooms: list[Room], seed: int) -> PhysicsModel:
    """A model whose networks are trained on these rooms; the rest of it is neutral."""
    generator = np.random.default_rng(seed)
    stacked = np.concatenate(inputs_of(rooms))
    means, scales = stacked.mean(axis=0), stacked.std(axis=0) + 1e-3
    noisy = [[noisy_classes(room, generator) for room in rooms] for _ in range(VARIANTS)]
    variants = [
        [(inputs - means) / scales for inputs in inputs_of(rooms, classes)] for classes in noisy
    ]
    members = [_train_network(rooms, variants, seed + k) for k in range(MEMBERS)]
    layers = [np.stack(layer) for layer in zip(*(layers for layers, _ in members))]
    floor = np.mean([floor for _, floor in members], axis=0)
    counts = np.bincount(states_of(rooms), minlength=STATE_COUNT) + 0.5
    prior = np.log((counts[1::2] + counts[2::2]) / 2.0 / counts[0])
    return PhysicsModel(means, scales, *layers, prior, np.ones(4), np.ones(3), floor)


def _train_network(
    rooms: list[Room], variants: list[list[Array]], seed: int
) -> tuple[list[NDArray[np.float32]], Array]:
    """Weights and biases of the layers of one network, and its parameters of the floor."""
    torch.manual_seed(seed)
    generator = np.random.default_rng(seed)
    net = Network()
    rates = [
        {"params": net.layers.parameters(), "lr": LEARNING_RATE, "weight_decay": WEIGHT_DECAY},
        {"params": [net.floor], "lr": 10 * LEARNING_RATE, "weight_decay": 0.0},
    ]
    optimiser = torch.optim.AdamW(rates)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS)
    ends = np.cumsum([0, *(len(room.states) for room in rooms)])
    known = [tuple(map(torch.tensor, nodes_of([room]))) for room in rooms]
    for epoch in range(EPOCHS):
        for index in generator.permutation(len(rooms)).tolist():
            rows = slice(ends[index], ends[index + 1])
            there, back = (
                torch.tensor(
                    np.clip(x + INPUT_NOISE * generator.normal(size=x.shape), -MAX_INPUT, MAX_INPUT)
                )
                for x in (variants[epoch % VARIANTS][0][rows], variants[epoch % VARIANTS][1][rows])
            )
            pairs, rise, height, on_floor = known[index]
            states, floor = net(there, back, pairs, rise, height)
            truth = torch.tensor(rooms[index].states)
            loss = -states[torch.arange(len(truth)), truth].clamp(min=1e-7).log().mean()
            clear = on_floor >= 0
            loss = loss + FLOOR_WEIGHT * torch.nn.functional.binary_cross_entropy(
                floor[clear].clamp(1e-6, 1 - 1e-6), on_floor[clear].double()
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        schedule.step()
    parts = [getattr(net.layers[index], part) for index in (0, 2, 4) for part in ("weight", "bias")]
    layers = [part.detach().numpy().T.astype(np.float32) for part in parts]
    return layers, net.floor.detach().numpy()


def precise(model: PhysicsModel) -> PhysicsModel:
    """The model with layers of double precision: the fit magnifies the rounding of single ones."""
    layers = [f"{part}_{layer}" for part in ("weights", "biases") for layer in (1, 2, 3)]
    return replace(model, **{name: getattr(model, name).astype(np.float64) for name in layers})


def fit_sources(model: PhysicsModel, rooms: list[Room], geometry: Array) -> PhysicsModel:
    """The model with the `vote_scales` and `source_weights` of least loss."""
    states = states_of(rooms)

    def tried(logs: Array) -> PhysicsModel:
        slope, n_half, floor, even, by_geometry, broken = np.exp(logs)
        return replace(
            model,
            vote_scales=np.array([slope, max(n_half, 0.5), floor, even]),
            source_weights=np.array([by_geometry, 1.0, np.clip(broken, MIN_BROKEN, 0.5)]),
        )

    def loss(logs: Array) -> float:
        model = tried(logs)
        votes = votes_of(model, rooms)
        believed = believed_states(model, rooms, geometry, votes, independent=False)
        return cross_entropy(believed, states)

    start = np.log([1.0, 1.0, 0.05, 0.2, 1.0, 0.02])
    best = tried(minimize(loss, start, method="Nelder-Mead", options=PRECISE).x)
    votes, nothing = votes_of(best, rooms), np.zeros_like(geometry)

    def alone(weight: float) -> PhysicsModel:
        by_geometry, _, broken = best.source_weights
        return replace(best, source_weights=np.array([by_geometry, weight, broken]))

    def loss_alone(weight: float) -> float:
        believed = believed_states(alone(weight), rooms, nothing, votes, independent=True)
        return cross_entropy(believed, states)

    # Its minimum is flat and has kinks: a grid gives the same value whatever the rounding.
    return alone(min(np.arange(0.05, 6.0, 0.05).tolist(), key=loss_alone))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    for option in ("--train", "--test"):
        parser.add_argument(option, nargs=2, type=Path, action="append", default=[])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at the same time")
    chosen = parser.parse_args()
    rooms = rooms_of(chosen.train)
    model, held_out = train(rooms, chosen.seed, chosen.jobs)
    np.savez(chosen.out, **asdict(model))
    print(*(f"{name} {getattr(model, name).round(3)}" for name in FITTED), sep="\n")
    tests = tested(model, chosen.test)
    write_card(
        chosen.out.with_suffix(".json"),
        chosen.out,
        training={
            "seed": chosen.seed,
            "rooms": {
                maps.name: [path.stem for path in sorted(maps.glob("*.npz"))]
                for maps, _ in chosen.train
            },
            "pairs": sum(len(room.states) for room in rooms),
            "related": int((states_of(rooms) > 0).sum()),
            "versions": {name: version(name) for name in ("numpy", "scipy", "torch")},
        },
        held_out=held_out,
        tests=tests,
    )


if __name__ == "__main__":
    main()
