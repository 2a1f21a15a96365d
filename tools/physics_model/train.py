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
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from dataset import Room, load_room
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import softmax

from deworldsg_ros.relations.physics import (
    INPUT_COUNT,
    MAX_INPUT,
    PairInputs,
    PhysicsModel,
    believed_logits,
    vote_logits,
)
from deworldsg_ros.relations.rules import CARRIED_FIRST, CARRIED_SECOND, one_support
from deworldsg_ros.relations.states import DIRECTED, STATE_COUNT

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

Array = NDArray[np.float64]


def rooms_of(folders: list[list[Path]]) -> list[Room]:
    """All rooms of pairs of a folder of maps and the data set of these rooms."""
    return [
        load_room(path, root / "data" / path.stem / "gt.json")
        for maps, root in folders
        for path in sorted(maps.glob("*.npz"))
    ]


def inputs_of(rooms: list[Room], noise: np.random.Generator | None = None) -> tuple[Array, Array]:
    """Inputs of the network for first and second, and for second and first."""
    both: list[list[Array]] = [[], []]
    for room in rooms:
        classes = room.class_probabilities if noise is None else noisy_classes(room, noise)
        make = PairInputs(room.classes).make
        for end, pairs in enumerate((room.pairs, room.pairs[:, ::-1])):
            known = (classes, room.observations)
            both[end].append(make(room.features[end], *known, pairs[:, 0], pairs[:, 1]))
    return np.concatenate(both[0]), np.concatenate(both[1])


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


def states_of(rooms: list[Room]) -> NDArray[np.int64]:
    """True states of all pairs."""
    return np.concatenate([room.states for room in rooms])


def nodes_of(rooms: list[Room]) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Pairs as rows of the nodes of all rooms; rise, log height and floor of these nodes."""
    starts = np.cumsum([0, *(len(room.bottoms_m) for room in rooms)])
    pairs = np.concatenate([room.pairs + start for room, start in zip(rooms, starts)])
    rise = np.abs(np.concatenate([room.bottoms_m for room in rooms]))
    height = np.log(np.concatenate([room.heights_m for room in rooms]) + 0.01)
    return pairs, rise, height, np.concatenate([room.on_floor for room in rooms])


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


def train_model(rooms: list[Room], seed: int) -> PhysicsModel:
    """A model whose networks are trained on these rooms; the rest of it is neutral."""
    torch.set_num_threads(1)
    generator = np.random.default_rng(seed)
    stacked = np.concatenate(inputs_of(rooms))
    means, scales = stacked.mean(axis=0), stacked.std(axis=0) + 1e-3
    variants = [
        [(inputs - means) / scales for inputs in inputs_of(rooms, generator)]
        for _ in range(VARIANTS)
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
                ).float()
                for x in (variants[epoch % VARIANTS][0][rows], variants[epoch % VARIANTS][1][rows])
            )
            pairs, rise, height, on_floor = known[index]
            states, floor = net(there, back, pairs, rise.float(), height.float())
            truth = torch.tensor(rooms[index].states)
            loss = -states[torch.arange(len(truth)), truth].clamp(min=1e-7).log().mean()
            clear = on_floor >= 0
            loss = loss + FLOOR_WEIGHT * torch.nn.functional.binary_cross_entropy(
                floor[clear].clamp(1e-6, 1 - 1e-6), on_floor[clear].float()
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        schedule.step()
    parts = [getattr(net.layers[index], part) for index in (0, 2, 4) for part in ("weight", "bias")]
    return [part.detach().numpy().T.copy() for part in parts], net.floor.detach().numpy()


def held_out_geometry(rooms: list[Room], seed: int) -> tuple[list[Room], Array]:
    """The rooms in another order, with logits of networks that were trained without them."""
    order, geometry = [], []
    for fold in range(FOLDS):
        held = rooms[fold::FOLDS]
        rest = [room for index, room in enumerate(rooms) if index % FOLDS != fold]
        model = train_model(rest, seed)
        geometry.append(model.state_logits(*inputs_of(held)))
        order += held
    return order, np.concatenate(geometry)


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
    best = tried(minimize(loss, start, method="Nelder-Mead", options={"maxfev": 600}).x)
    votes, nothing = votes_of(best, rooms), np.zeros_like(geometry)

    def alone(weight: float) -> PhysicsModel:
        by_geometry, _, broken = best.source_weights
        return replace(best, source_weights=np.array([by_geometry, weight, broken]))

    def loss_alone(weight: float) -> float:
        believed = believed_states(alone(weight), rooms, nothing, votes, independent=True)
        return cross_entropy(believed, states)

    return alone(float(minimize_scalar(loss_alone, bounds=(0.05, 6.0), method="bounded").x))


def report(model: PhysicsModel, name: str, rooms: list[Room], geometry: Array) -> None:
    """Print log loss, precision and recall at 0.5, and calibration, of each source and of both."""
    states, votes, nothing = states_of(rooms), votes_of(model, rooms), np.zeros_like(geometry)
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
        print(
            f"{name} {source:>8}: log loss {cross_entropy(p, states):.4f}, precision "
            f"{100 * right[sure].sum() / max(1, sure.sum()):.1f}, recall "
            f"{100 * right[sure].sum() / max(1, (states > 0).sum()):.1f}, calibration error "
            f"{100 * error:.1f} % ({(states > 0).sum()} of {len(states)} pairs related)",
            flush=True,
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    for option in ("--train", "--test"):
        parser.add_argument(option, nargs=2, type=Path, action="append", default=[])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    rooms = rooms_of(chosen.train)
    print(f"{len(rooms)} rooms, pairs by state:", np.bincount(states_of(rooms), minlength=11))
    ordered, geometry = held_out_geometry(rooms, chosen.seed)
    model = fit_sources(train_model(rooms, chosen.seed), ordered, geometry)
    for name in ("vote_scales", "source_weights", "floor"):
        print(name, getattr(model, name).round(3))
    report(model, "held out", ordered, geometry)
    for folders in chosen.test:
        tested = rooms_of([folders])
        report(model, str(folders[0]), tested, model.state_logits(*inputs_of(tested)))
    np.savez(chosen.out, **asdict(model))


if __name__ == "__main__":
    main()
