"""Fit of a probe on features: weighted cross-entropy, early stopping, one random seed."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from deworldsg_ros.checkpoints.probe_card import ProbeCard
from deworldsg_ros.checkpoints.probe_network import Probe, build_network
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.training.options import FitOptions


@dataclass(frozen=True)
class Fit:
    """A trained probe, the losses of each epoch, and the epoch of the kept weights."""

    probe: Probe
    train_losses: list[float]
    validation_losses: list[float]
    best_epoch: int


def class_weights(labels: Int64, count: int) -> Float32:
    """Weight of each predicate in the loss, (count,) float32, inverse to its frequency.

    The mean weight of a clip is one. Predicates without a clip have weight zero.
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
        card: architecture of the probe.
        inputs: (n, input_dim) float32.
        labels: (n,) int64, indices of the card's predicates.
        train: rows to train on.
        validation: rows whose loss stops the fit.
        options: of the fit.
        advance: called with the training and the validation loss after each epoch.
    """
    torch.manual_seed(options.seed)
    # Features of different dimensions differ by orders of magnitude. The network is trained on
    # standardised inputs; the standardisation is then folded into its first layer.
    mean, std = inputs[train].mean(axis=0), inputs[train].std(axis=0) + 1e-6
    weights = torch.from_numpy(class_weights(labels[train], len(card.predicates)))
    values, targets = torch.from_numpy((inputs - mean) / std), torch.from_numpy(labels)
    network = build_network(card)
    optimisation = _Optimisation(network, values, targets, weights, options)
    rows, judged = torch.from_numpy(train), torch.from_numpy(validation)
    # A predicate without training clips cannot be learnt: its validation clips do not count.
    judged = judged[weights[targets[judged]] > 0]
    train_losses: list[float] = []
    validation_losses: list[float] = []
    best = copy.deepcopy(network.state_dict())
    best_epoch, lowest = 0, float("inf")
    for epoch in range(options.epochs):
        # Batch normalisation has no deviation over a batch of one.
        least_batch = 2 if card.layout == "batch_norm" else 1
        train_losses.append(optimisation.train_epoch(rows, least_batch))
        loss = optimisation.loss(judged) if len(judged) else train_losses[-1]
        validation_losses.append(loss)
        advance(train_losses[-1], loss)
        if loss < lowest:
            lowest, best_epoch = loss, epoch
            best = copy.deepcopy(network.state_dict())
        elif epoch - best_epoch >= options.patience:
            break
    network.load_state_dict(best)
    _fold_standardisation(network, card, mean, std)
    probe = Probe(card, network.eval().requires_grad_(False))
    return Fit(probe, train_losses, validation_losses, best_epoch)


class _Optimisation:
    """A network with its data, its weighted cross-entropy and AdamW."""

    def __init__(
        self,
        network: torch.nn.Sequential,
        values: torch.Tensor,
        targets: torch.Tensor,
        weights: torch.Tensor,
        options: FitOptions,
    ) -> None:
        self._network = network
        self._values = values
        self._targets = targets
        self._batch_size = options.batch_size
        self._generator = torch.Generator().manual_seed(options.seed)
        self._loss_of = torch.nn.CrossEntropyLoss(weight=weights)
        self._optimiser = torch.optim.AdamW(
            network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
        )

    def train_epoch(self, rows: torch.Tensor, least_batch: int) -> float:
        """One pass over the rows in random order; returns the mean loss."""
        self._network.train()
        total = 0.0
        order = rows[torch.randperm(len(rows), generator=self._generator)]
        for start in range(0, len(order), self._batch_size):
            batch = order[start : start + self._batch_size]
            if len(batch) < least_batch:
                continue
            self._optimiser.zero_grad()
            loss = self._loss_of(self._network(self._values[batch]), self._targets[batch])
            loss.backward()
            self._optimiser.step()
            total += float(loss.detach()) * len(batch)
        return total / max(len(rows), 1)

    def loss(self, rows: torch.Tensor) -> float:
        """The loss on some rows, without training."""
        self._network.eval()
        with torch.inference_mode():
            return float(self._loss_of(self._network(self._values[rows]), self._targets[rows]))


def _fold_standardisation(
    network: torch.nn.Sequential, card: ProbeCard, mean: Float32, std: Float32
) -> None:
    """Change the first layer of a network for standardised inputs, so that it takes raw inputs."""
    layers: torch.nn.Module = network.get_submodule("net")
    first = layers.get_submodule("0")
    state = first.state_dict()
    shift, scale = torch.from_numpy(mean).double(), torch.from_numpy(std).double()
    if card.layout == "batch_norm":
        # (x - m) / s normalised by (mu, v) equals x normalised by (m + s mu, s² v). The layer adds
        # its ridge of 1e-5 to the variance in both.
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
    """Accuracy of a probe on some clips.

    Attributes:
        clips: number of clips.
        micro_accuracy: fraction of correct clips.
        macro_accuracy: mean over the predicates that occur of their fraction of correct clips.
        chance_macro: macro accuracy of guessing among the predicates of the training clips.
        majority_micro: micro accuracy of always predicting the most frequent training predicate.
        confusion: (R, R) int64, counts by true and predicted predicate.
    """

    clips: int
    micro_accuracy: float
    macro_accuracy: float
    chance_macro: float
    majority_micro: float
    confusion: Int64


def score(distributions: Float64, labels: Int64, train_labels: Int64) -> Scores:
    """Compare predicted distributions (n, R) with labels (n,)."""
    count = distributions.shape[1]
    confusion = np.zeros((count, count), np.int64)
    np.add.at(confusion, (labels, distributions.argmax(axis=1)), 1)
    totals = confusion.sum(axis=1)
    present = totals > 0
    fractions = confusion.diagonal()[present] / totals[present]
    majority = int(np.bincount(train_labels, minlength=count).argmax()) if len(train_labels) else 0
    return Scores(
        clips=len(labels),
        micro_accuracy=float(confusion.trace() / max(len(labels), 1)),
        macro_accuracy=float(fractions.mean()) if present.any() else 0.0,
        chance_macro=1 / max(len(np.unique(train_labels)), 1),
        majority_micro=float(totals[majority] / max(len(labels), 1)),
        confusion=confusion,
    )
