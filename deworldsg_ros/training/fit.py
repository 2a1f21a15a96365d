"""Fit of a probe on features: weighted cross-entropy, early stopping, one seed."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from deworldsg_ros.checkpoints.probe_card import ProbeCard
from deworldsg_ros.relations.probing.probe_network import Probe, build_network
from deworldsg_ros.scene.arrays import Float32, Float64, Int64


@dataclass(frozen=True)
class FitOptions:
    """How a probe is trained.

    Attributes:
        epochs: most passes over the training clips.
        patience: passes without a better validation loss after which it stops.
        batch_size: clips of a step.
        learning_rate, weight_decay: of AdamW.
        seed: of the initial weights and the order of the clips.
    """

    epochs: int = 200
    patience: int = 20
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    seed: int = 0


@dataclass(frozen=True)
class Fit:
    """A trained probe, with the losses of each epoch and the one whose weights were kept."""

    probe: Probe
    train_losses: list[float]
    validation_losses: list[float]
    best_epoch: int


def class_weights(labels: Int64, count: int) -> Float32:
    """Weight of each predicate in the loss, (count,): inverse to how often it occurs.

    The mean weight of a clip is one; predicates without a clip weigh nothing.
    """
    occurrences = np.bincount(labels, minlength=count)
    present = occurrences > 0
    weights = np.zeros(count, np.float32)
    weights[present] = len(labels) / (present.sum() * occurrences[present])
    return weights


def fit_probe(
    card: ProbeCard,
    inputs: Float32,
    labels: Int64,
    train: Int64,
    validation: Int64,
    options: FitOptions,
    advance: Callable[[float, float], None] = lambda *_: None,
) -> Fit:
    """Train a probe.

    Args:
        card: what to build.
        inputs: (n, input_dim) float32.
        labels: (n,) int64, places in the card's predicates.
        train: rows to learn from.
        validation: rows whose loss decides when to stop.
        options: how.
        advance: told the two losses after each epoch.
    """
    torch.manual_seed(options.seed)
    generator = torch.Generator().manual_seed(options.seed)
    # Features of a random direction differ by orders of magnitude; what is learnt on standardised
    # ones is folded into the first layer afterwards, so that the probe reads them as they are.
    mean, std = inputs[train].mean(axis=0), inputs[train].std(axis=0) + 1e-6
    values = torch.from_numpy((inputs - mean) / std)
    targets = torch.from_numpy(labels)
    network = build_network(card)
    weights = torch.from_numpy(class_weights(labels[train], len(card.predicates)))
    loss_of = torch.nn.CrossEntropyLoss(weight=weights)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
    )
    rows, judged = torch.from_numpy(train), torch.from_numpy(validation)
    # Predicates that occur in the validation clips alone cannot be learnt nor judged.
    judged = judged[weights[targets[judged]] > 0]
    train_losses: list[float] = []
    validation_losses: list[float] = []
    best = copy.deepcopy(network.state_dict())
    best_epoch, lowest = 0, float("inf")
    for epoch in range(options.epochs):
        network.train()
        total = 0.0
        order = rows[torch.randperm(len(rows), generator=generator)]
        for start in range(0, len(order), options.batch_size):
            batch = order[start : start + options.batch_size]
            if len(batch) < 2 and card.layout == "batch_norm":
                continue  # a batch of one has no deviation
            optimiser.zero_grad()
            loss = loss_of(network(values[batch]), targets[batch])
            loss.backward()
            optimiser.step()
            total += float(loss.detach()) * len(batch)
        train_losses.append(total / max(len(rows), 1))
        network.eval()
        with torch.inference_mode():
            judged_loss = (
                float(loss_of(network(values[judged]), targets[judged]))
                if len(judged)
                else train_losses[-1]
            )
        validation_losses.append(judged_loss)
        advance(train_losses[-1], judged_loss)
        if judged_loss < lowest:
            lowest, best_epoch = judged_loss, epoch
            best = copy.deepcopy(network.state_dict())
        elif epoch - best_epoch >= options.patience:
            break
    network.load_state_dict(best)
    _fold_standardisation(network, card, mean, std)
    probe = Probe(card, network.eval().requires_grad_(False))
    return Fit(probe, train_losses, validation_losses, best_epoch)


def _fold_standardisation(
    network: torch.nn.Sequential, card: ProbeCard, mean: Float32, std: Float32
) -> None:
    """Make a network of standardised inputs one of the inputs themselves."""
    layers: torch.nn.Module = network.get_submodule("net")
    first = layers.get_submodule("0")
    state = first.state_dict()
    shift, scale = torch.from_numpy(mean).double(), torch.from_numpy(std).double()
    if card.layout == "batch_norm":
        # (x - m) / s normalised by (mu, v) is x normalised by (m + s mu, s² v); the ridge that
        # the layer adds to v is scaled along.
        state["running_mean"] = (shift + scale * state["running_mean"].double()).float()
        ridge = 1e-5
        variance = scale**2 * (state["running_var"].double() + ridge) - ridge
        state["running_var"] = variance.clamp_min(0).float()
    else:
        weight = state["weight"].double() / scale
        state["bias"] = (state["bias"].double() - weight @ shift).float()
        state["weight"] = weight.float()
    first.load_state_dict(state)


@dataclass(frozen=True)
class Scores:
    """How a probe does on some clips.

    Attributes:
        clips: how many.
        micro_accuracy: share that is right.
        macro_accuracy: mean over the predicates that occur of the share that is right.
        chance_macro: what guessing among the predicates that occur in training gives.
        majority_micro: what always saying the most frequent predicate of training gives.
        confusion: (R, R) int64, true predicate by answer.
    """

    clips: int
    micro_accuracy: float
    macro_accuracy: float
    chance_macro: float
    majority_micro: float
    confusion: Int64


def score(answers: Float64, labels: Int64, train_labels: Int64) -> Scores:
    """Compare distributions (n, R) with labels (n,)."""
    count = answers.shape[1]
    confusion = np.zeros((count, count), np.int64)
    np.add.at(confusion, (labels, answers.argmax(axis=1)), 1)
    totals = confusion.sum(axis=1)
    present = totals > 0
    shares = confusion.diagonal()[present] / totals[present]
    majority = int(np.bincount(train_labels, minlength=count).argmax()) if len(train_labels) else 0
    return Scores(
        clips=len(labels),
        micro_accuracy=float(confusion.trace() / max(len(labels), 1)),
        macro_accuracy=float(shares.mean()) if present.any() else 0.0,
        chance_macro=1 / max(len(np.unique(train_labels)), 1),
        majority_micro=float(totals[majority] / max(len(labels), 1)),
        confusion=confusion,
    )
