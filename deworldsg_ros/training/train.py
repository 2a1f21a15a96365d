"""From labelled clips to a saved probe: features, split, fit, scores, and a record of them."""

from __future__ import annotations

import copy
import hashlib
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deworldsg_ros.base.files import together, write_atomically
from deworldsg_ros.checkpoints.cards import (
    BOX_INPUTS,
    ClipOrigin,
    FitOptions,
    ProbeCard,
    TrainingOptions,
)
from deworldsg_ros.checkpoints.probe_network import (
    PROBE_FILES,
    Probe,
    build_network,
    probe_inputs,
    write_probe,
)
from deworldsg_ros.relations.clip_models import FrozenBackbone
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.training.clips import LabelledClip, of_length

# --- Fit of a probe on features: cross-entropy, early stopping, one random seed.


@dataclass(frozen=True)
class Fit:
    """A trained probe, the losses of each epoch, and the epoch of the kept weights.

    Without validation clips there are no validation losses, and the last epoch is kept.
    """

    probe: Probe
    train_losses: list[float]
    validation_losses: list[float]
    best_epoch: int


def class_weights(targets: Float32) -> Float32:
    """Weight of each predicate in the loss, (R,) float32, inverse to its frequency.

    The mean weight of a clip is one. Predicates without a clip have weight zero.

    Args:
        targets: (n, R) float32, distributions of the clips.
    """
    occurrences = targets.sum(axis=0)
    present = occurrences > 0
    weights = np.zeros_like(occurrences)
    weights[present] = len(targets) / (present.sum() * occurrences[present])
    return weights


def fit_probe(
    card: ProbeCard,
    inputs: Float32,
    targets: Float32,
    train: Int64,
    validation: Int64,
    options: FitOptions,
    advance: Callable[[float, float | None], None] = lambda *_: None,
) -> Fit:
    """Train a probe.

    Args:
        card: architecture of the probe.
        inputs: (n, input_dim) float32.
        targets: (n, R) float32, distributions over the card's predicates.
        train: rows to train on.
        validation: rows whose loss stops the fit; without any it has `options.epochs` epochs.
        options: of the fit.
        advance: called with the training and the validation loss (None = no rows) after each epoch.
    """
    torch.manual_seed(options.seed)
    # Features of different dimensions differ by orders of magnitude. The network is trained on
    # standardised inputs; the standardisation is then folded into its first layer.
    mean, std = inputs[train].mean(axis=0), inputs[train].std(axis=0) + 1e-6
    weighted = options.class_weights == "inverse_frequency"
    weights = torch.from_numpy(class_weights(targets[train])) if weighted else None
    values = torch.from_numpy((inputs - mean) / std)
    network = build_network(card)
    optimisation = _Optimisation(network, values, torch.from_numpy(targets), weights, options)
    # A predicate without training clips cannot be learnt: its validation clips do not count.
    unknown = targets[train].sum(axis=0) == 0
    known = ~targets[validation][:, unknown].any(axis=1)
    rows, judged = torch.from_numpy(train), torch.from_numpy(validation[known])
    train_losses: list[float] = []
    validation_losses: list[float] = []
    best = copy.deepcopy(network.state_dict())
    best_epoch, lowest = 0, float("inf")
    for epoch in range(options.epochs):
        # Batch normalisation has no deviation over a batch of one.
        least_batch = 2 if card.layout == "batch_norm" else 1
        train_losses.append(optimisation.train_epoch(rows, least_batch))
        if not len(judged):
            advance(train_losses[-1], None)
            continue
        loss = optimisation.loss(judged)
        validation_losses.append(loss)
        advance(train_losses[-1], loss)
        if loss < lowest:
            lowest, best_epoch = loss, epoch
            best = copy.deepcopy(network.state_dict())
        elif epoch - best_epoch >= options.patience:
            break
    if len(judged):
        network.load_state_dict(best)
    else:
        best_epoch = options.epochs - 1
    _fold_standardisation(network, card, mean, std)
    probe = Probe(card, network.eval().requires_grad_(False))
    return Fit(probe, train_losses, validation_losses, best_epoch)


class _Optimisation:
    """A network with its data, its cross-entropy and AdamW."""

    def __init__(
        self,
        network: torch.nn.Sequential,
        values: torch.Tensor,
        targets: torch.Tensor,
        weights: torch.Tensor | None,
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
        micro_accuracy: fraction of correct clips: the most probable predicate is one of theirs.
        macro_accuracy: mean over the predicates that occur of their fraction of correct clips.
        chance_macro: macro accuracy of guessing among the predicates of the training clips.
        majority_micro: micro accuracy of always predicting the most frequent training predicate.
        log_loss_nats: mean cross-entropy of their distributions; it judges the probabilities.
        confusion: (R, R) int64, counts by true and predicted predicate. Of the predicates of a
            clip, the true one is the predicted one if it is among them, else the first.
    """

    clips: int
    micro_accuracy: float
    macro_accuracy: float
    chance_macro: float
    majority_micro: float
    log_loss_nats: float
    confusion: Int64


def score(distributions: Float64, targets: Float32, train_targets: Float32) -> Scores:
    """Compare predicted distributions (n, R) with those of the clips, (n, R) each, n > 0."""
    count = distributions.shape[1]
    predicted = distributions.argmax(axis=1)
    right = targets[np.arange(len(targets)), predicted] > 0
    confusion = np.zeros((count, count), np.int64)
    np.add.at(confusion, (np.where(right, predicted, targets.argmax(axis=1)), predicted), 1)
    totals = confusion.sum(axis=1)
    present = totals > 0
    logs = np.log(np.maximum(distributions, np.finfo(np.float64).tiny))
    occurrences = train_targets.sum(axis=0)
    return Scores(
        clips=len(targets),
        micro_accuracy=float(right.mean()),
        macro_accuracy=float((confusion.diagonal()[present] / totals[present]).mean()),
        chance_macro=1 / int(np.count_nonzero(occurrences)),
        majority_micro=float((targets[:, occurrences.argmax()] > 0).mean()),
        log_loss_nats=float(-(targets * logs).sum(axis=1).mean()),
        confusion=confusion,
    )


# --- Features of clips, with a cache on disk: an interrupted training continues from it.

# Features per file. An interruption loses at most this many clips.
SHARD_SIZE = 32


class FeatureCache:
    """Features of clips, for one backbone and preprocessing; each has its own folder.

    Args:
        root: folder of all caches.
        description: everything besides the clip that changes a feature.
    """

    def __init__(self, root: Path, description: str) -> None:
        self.folder = root / _digest(description)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self.folder / "description.txt", description + "\n")
        self._features: dict[str, Float32] = {}
        self._unsaved: list[str] = []
        for path in sorted(self.folder.glob("*.npz")):
            self._load(path)

    def __len__(self) -> int:
        return len(self._features)

    def get(self, key: str) -> Float32 | None:
        """The feature of a clip, (d,) float32; None if it was not extracted yet."""
        return self._features.get(_digest(key))

    def add(self, key: str, feature: Float32) -> None:
        """Keep a feature; the next full file or `save` writes it."""
        digest = _digest(key)
        self._features[digest] = feature
        self._unsaved.append(digest)
        if len(self._unsaved) >= SHARD_SIZE:
            self.save()

    def save(self) -> None:
        """Write all unsaved features to one new file, completely or not at all."""
        if not self._unsaved:
            return
        digests = self._unsaved
        path = self.folder / f"{_digest(' '.join(digests))}.npz"
        features = np.stack([self._features[digest] for digest in digests])
        write_atomically(
            path, lambda file: np.savez(file, digests=np.array(digests), features=features)
        )
        self._unsaved = []

    def _load(self, path: Path) -> None:
        try:
            with np.load(path, allow_pickle=False) as content:
                rows = zip(content["digests"].tolist(), content["features"])
                self._features.update((digest, np.asarray(row, np.float32)) for digest, row in rows)
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            # A damaged file: its features are extracted again.
            path.unlink()


def extract_features(
    backbone: FrozenBackbone,
    clips: Sequence[LabelledClip],
    cache: FeatureCache,
    *,
    batch_size: int,
    advance: Callable[[int], None] = lambda _: None,
) -> Float32:
    """Features of clips, (n, d) float32; only clips that are not in the cache are encoded.

    Args:
        backbone: encodes the clips.
        clips: labelled clips.
        cache: of this backbone.
        batch_size: clips encoded at once.
        advance: called with the number of further clips that are done.
    """
    # Both directions of a pair have the same clip.
    missing = list({clip.key: clip for clip in clips if cache.get(clip.key) is None}.values())
    advance(len(clips) - len(missing))
    try:
        for start in range(0, len(missing), batch_size):
            batch = missing[start : start + batch_size]
            length = backbone.identity.clip_length
            features = backbone.encode([of_length(clip.read(), length) for clip in batch])
            for clip, feature in zip(batch, features):
                cache.add(clip.key, feature)
            advance(len(batch))
    finally:
        cache.save()
    rows = [feature for clip in clips if (feature := cache.get(clip.key)) is not None]
    return np.stack(rows) if rows else np.zeros((0, backbone.identity.feature_dim), np.float32)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:20]


# --- Training, validation and held-out clips. The clips of one room stay together.


@dataclass(frozen=True)
class Split:
    """Rows of the clips in each part.

    Attributes:
        train, validation, held_out: (n,) int64 rows.
        held_out_groups: names of the held-out rooms.
        validation_by: ``group``, or ``pair`` if only one room is left to train on; ``none`` if
            nothing is held out.
    """

    train: Int64
    validation: Int64
    held_out: Int64
    held_out_groups: tuple[str, ...]
    validation_by: str

    def parts(self) -> dict[str, Int64]:
        """The rows of each part that has some, by its name."""
        parts = {"train": self.train, "validation": self.validation, "held_out": self.held_out}
        return {name: rows for name, rows in parts.items() if len(rows)}


def split_by_group(
    groups: Sequence[str],
    pairs: Sequence[str],
    *,
    held_out_fraction: float,
    held_out_groups: Sequence[str] = (),
    seed: int = 0,
) -> Split:
    """Split clips so that early stopping uses no held-out room.

    Args:
        groups: group of each clip, e.g. its room.
        pairs: pair of objects of each clip.
        held_out_fraction: fraction of the groups to hold out, at least one group; 0 trains on all.
        held_out_groups: hold out exactly these groups instead.
        seed: of the random choice.

    Raises:
        ConfigurationError: fewer than two groups, or an unknown held-out group.
    """
    names = sorted(set(groups))
    unknown = sorted(set(held_out_groups) - set(names))
    if unknown:
        raise ConfigurationError(
            f"held-out groups {', '.join(unknown)} have no clips: "
            f"expected some of {', '.join(names)}"
        )
    if not held_out_groups and not held_out_fraction:
        none = np.zeros(0, np.int64)
        return Split(np.arange(len(groups), dtype=np.int64), none, none, (), "none")
    if len(names) < 2 or len(set(held_out_groups)) == len(names):
        raise ConfigurationError(
            f"the clips have {len(names)} group(s), {len(set(held_out_groups))} of them held out: "
            "expected at least one to train on and one to hold out, or a held-out fraction of 0"
        )
    generator = np.random.default_rng(seed)
    chosen = set(held_out_groups) or _choose(generator, names, held_out_fraction)
    held_out = np.array([group in chosen for group in groups])
    rest = [name for name in names if name not in chosen]
    by_group = len(rest) > 1
    units = np.array(groups if by_group else pairs)
    candidates = sorted(set(units[~held_out].tolist()))
    if len(candidates) < 2:
        raise ConfigurationError(
            "the training clips have one pair of objects: expected at least two pairs"
        )
    # 15 % of the rest decide when the training stops.
    validating = np.isin(units, sorted(_choose(generator, candidates, 0.15)))
    validating &= ~held_out
    return Split(
        np.flatnonzero(~held_out & ~validating).astype(np.int64),
        np.flatnonzero(validating).astype(np.int64),
        np.flatnonzero(held_out).astype(np.int64),
        tuple(sorted(chosen)),
        "group" if by_group else "pair",
    )


def _choose(generator: np.random.Generator, names: Sequence[str], fraction: float) -> set[str]:
    """A fraction of the names, at least one and never all."""
    count = min(max(1, round(fraction * len(names))), len(names) - 1)
    return {names[index] for index in generator.permutation(len(names))[:count].tolist()}


# --- A confusion matrix as a picture.

# Size of the picture per predicate, and of the margin for the names.
INCHES_PER_PREDICATE = 0.45
MARGIN_INCHES = 2.0


@rc_context({"text.parse_math": False})  # a name may contain $
def write_confusion(path: Path, confusion: Int64, names: Sequence[str]) -> None:
    """Write the confusion matrix as PNG; only predicates that occur are shown.

    Args:
        path: the file to write.
        confusion: (R, R) counts, rows = true predicate, columns = predicted predicate.
        names: R names.
    """
    shown = np.flatnonzero(confusion.sum(axis=0) + confusion.sum(axis=1))
    counts = confusion[np.ix_(shown, shown)]
    labels = [names[index] for index in shown.tolist()]
    fractions = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = MARGIN_INCHES + INCHES_PER_PREDICATE * len(labels)
    figure = Figure(figsize=(side, side), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if labels:
        axes.imshow(fractions, cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(labels)), labels, rotation=90)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_xlabel("predicted")
    axes.set_ylabel("true")
    for row, column in np.argwhere(counts).tolist():
        colour = "white" if fractions[row, column] > 0.5 else "black"
        axes.text(column, row, str(counts[row, column]), ha="center", va="center", color=colour)
    write_atomically(path, lambda file: figure.savefig(file, format="png"))


# --- From labelled clips to a saved probe, with a record of the training.

METRICS_FILE = "metrics.json"
CONFUSION_FILE = "confusion.png"
CACHE_FOLDER = "features"


@dataclass(frozen=True)
class Progress:
    """Callbacks for progress; the default does nothing.

    Attributes:
        encoded: called with the number of further clips that have features.
        epoch: called with the training and the validation loss of an epoch; None = no validation.
    """

    encoded: Callable[[int], None] = lambda _: None
    epoch: Callable[[float, float | None], None] = lambda *_: None


def train_probe(
    backbone: FrozenBackbone,
    clips: Sequence[LabelledClip],
    predicates: tuple[str, ...],
    out: Path,
    options: TrainingOptions,
    *,
    cache: Path | None = None,
    origin: ClipOrigin | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Train a probe and save it.

    Args:
        backbone: encodes the clips.
        clips: labelled clips; of at least two groups if one is held out.
        predicates: names of the probe's outputs.
        out: folder of the probe.
        options: of the training.
        cache: folder of the features; default: a folder in `out`.
        origin: of the clips, for the record.
        progress: callbacks for progress.

    Returns:
        the content of metrics.json.

    Raises:
        ConfigurationError: the clips do not fit the predicates, or cannot be split.
    """
    progress = progress or Progress()
    card = _card(backbone, predicates, options)
    targets = _targets(clips, predicates)
    boxes = _boxes(clips, options)
    split = _split(clips, options)
    features = extract_features(
        backbone,
        clips,
        FeatureCache(cache or out / CACHE_FOLDER, backbone.description),
        batch_size=options.batch_size,
        advance=progress.encoded,
    )
    inputs = probe_inputs(card, features, boxes)
    fit = fit_probe(
        card, inputs, targets, split.train, split.validation, options.fit, progress.epoch
    )
    scores = {
        name: score(fit.probe.distributions(inputs[rows]), targets[rows], targets[split.train])
        for name, rows in split.parts().items()
    }
    record = asdict(origin or ClipOrigin()) | _record(clips, split, backbone, options)
    return _save(out, fit, scores, record)


def _card(
    backbone: FrozenBackbone, predicates: tuple[str, ...], options: TrainingOptions
) -> ProbeCard:
    return ProbeCard(
        backbone.identity,
        predicates,
        options.layout,
        options.inputs,
        window=options.window,
        crop=options.crop,
    )


def _record(
    clips: Sequence[LabelledClip], split: Split, backbone: FrozenBackbone, options: TrainingOptions
) -> dict[str, Any]:
    """How a probe was trained, for its card."""
    parts = split.parts()
    groups = {name: sorted({clips[row].group for row in rows}) for name, rows in parts.items()}
    scans = {name: sorted({clips[row].scan for row in rows} - {""}) for name, rows in parts.items()}
    return {
        "options": msgspec.to_builtins(asdict(options)),
        "preprocessing": backbone.description,
        "torch": str(torch.__version__),
        "clips": {name: len(rows) for name, rows in parts.items()},
        "groups_by_part": groups,
        "scans_by_part": scans,
        "held_out_groups": list(split.held_out_groups),
        "validation_by": split.validation_by,
    }


def _split(clips: Sequence[LabelledClip], options: TrainingOptions) -> Split:
    return split_by_group(
        [clip.group for clip in clips],
        [clip.pair for clip in clips],
        held_out_fraction=options.held_out_fraction,
        held_out_groups=options.held_out_groups,
        seed=options.fit.seed,
    )


def _save(
    out: Path, fit: Fit, scores: dict[str, Scores], training: dict[str, Any]
) -> dict[str, Any]:
    """Write metrics, confusion picture and the probe, together; returns the metrics."""
    card = msgspec.structs.replace(fit.probe.card, training=training)
    metrics = {
        **{name: _metrics(found, card.predicates) for name, found in scores.items()},
        "best_epoch": fit.best_epoch,
        "train_losses": fit.train_losses,
        "validation_losses": fit.validation_losses,
    }
    with together(out, (METRICS_FILE, CONFUSION_FILE, *PROBE_FILES)) as staged:
        content = msgspec.json.format(msgspec.json.encode(metrics), indent=1)
        write_atomically(staged / METRICS_FILE, content)
        judged = scores.get("held_out", scores["train"])
        write_confusion(staged / CONFUSION_FILE, judged.confusion, card.predicates)
        write_probe(staged, Probe(card, fit.probe.network))
    return metrics


def _boxes(clips: Sequence[LabelledClip], options: TrainingOptions) -> Float32:
    """(n, 8) boxes of the clips; zeros for a clip without boxes if the probe does not use them."""
    if options.inputs == "clip_and_boxes" and any(clip.boxes is None for clip in clips):
        raise ConfigurationError(
            "inputs 'clip_and_boxes': some clips have no boxes; give subject_box and object_box "
            "of each in index.jsonl, or train with inputs 'clip'"
        )
    none = np.zeros(BOX_INPUTS, np.float32)
    return np.stack([none if clip.boxes is None else clip.boxes for clip in clips])


def _targets(clips: Sequence[LabelledClip], predicates: tuple[str, ...]) -> Float32:
    """(n, R) distribution of each clip: its predicates have equal parts."""
    indices = {name: index for index, name in enumerate(predicates)}
    unknown = Counter(name for clip in clips for name in clip.predicates if name not in indices)
    if unknown:
        name, count = unknown.most_common(1)[0]
        raise ConfigurationError(
            f"{count} clips have the predicate '{name}', which is not one of the "
            f"{len(predicates)} of the chosen set: choose another set, or rename it"
        )
    targets = np.zeros((len(clips), len(predicates)), np.float32)
    for row, clip in enumerate(clips):
        targets[row, [indices[name] for name in clip.predicates]] = 1 / len(clip.predicates)
    return targets


def _metrics(scores: Scores, predicates: tuple[str, ...]) -> dict[str, Any]:
    confusion = scores.confusion
    totals = confusion.sum(axis=1)
    return {
        "clips": scores.clips,
        "micro_accuracy": scores.micro_accuracy,
        "macro_accuracy": scores.macro_accuracy,
        "chance_macro": scores.chance_macro,
        "majority_micro": scores.majority_micro,
        "log_loss_nats": scores.log_loss_nats,
        "by_predicate": {
            predicates[index]: {
                "clips": int(totals[index]),
                "right": int(confusion[index, index]),
            }
            for index in np.flatnonzero(totals)
        },
    }
