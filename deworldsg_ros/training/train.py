"""From labelled clips to a saved probe, with a record of the training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from deworldsg_ros.checkpoints.probe_card import BOX_INPUTS, ProbeCard
from deworldsg_ros.checkpoints.probe_network import PROBE_FILES, Probe, probe_inputs, write_probe
from deworldsg_ros.files import together, write_atomically
from deworldsg_ros.relations.probing.backbone import FrozenBackbone
from deworldsg_ros.scene.arrays import Float32, Int64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.training.confusion import write_confusion
from deworldsg_ros.training.features import FeatureCache, extract_features
from deworldsg_ros.training.fit import Fit, Scores, fit_probe, score
from deworldsg_ros.training.labelled_clips import LabelledClip
from deworldsg_ros.training.options import TrainingOptions
from deworldsg_ros.training.split import Split, split_by_group

METRICS_FILE = "metrics.json"
CONFUSION_FILE = "confusion.png"
CACHE_FOLDER = "features"


@dataclass(frozen=True)
class Progress:
    """Callbacks for progress; the default does nothing.

    Attributes:
        encoded: called with the number of further clips that have features.
        epoch: called with the training and the validation loss of an epoch.
    """

    encoded: Callable[[int], None] = lambda _: None
    epoch: Callable[[float, float], None] = lambda *_: None


def train_probe(
    backbone: FrozenBackbone,
    clips: Sequence[LabelledClip],
    predicates: tuple[str, ...],
    out: Path,
    options: TrainingOptions,
    *,
    cache: Path | None = None,
    source: str = "",
    data_split: str = "",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Train a probe and save it.

    Args:
        backbone: encodes the clips.
        clips: labelled clips of at least two groups.
        predicates: names of the probe's outputs.
        out: folder of the probe.
        options: of the training.
        cache: folder of the features; default: a folder in `out`.
        source: origin of the clips, for the record.
        data_split: split of the data set that they come from, for the record; empty = a folder of
            clips.
        progress: callbacks for progress.

    Returns:
        the content of metrics.json.

    Raises:
        ConfigurationError: the clips do not fit the predicates, or cannot be split.
    """
    progress = progress or Progress()
    card = _card(backbone, predicates, options)
    labels = _labels(clips, predicates)
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
        card, inputs, labels, split.train, split.validation, options.fit, progress.epoch
    )
    scores = {
        name: score(fit.probe.distributions(inputs[rows]), labels[rows], labels[split.train])
        for name, rows in split.parts().items()
    }
    origin = {"source": source, "data_split": data_split}
    return _save(out, fit, scores, {**origin, **_record(clips, split, backbone, options)})


def _card(
    backbone: FrozenBackbone, predicates: tuple[str, ...], options: TrainingOptions
) -> ProbeCard:
    return ProbeCard(
        backbone.identity, predicates, options.layout, options.inputs, window=options.window
    )


def _record(
    clips: Sequence[LabelledClip], split: Split, backbone: FrozenBackbone, options: TrainingOptions
) -> dict[str, Any]:
    """How a probe was trained, for its card."""
    parts = split.parts()
    groups = {name: sorted({clips[row].group for row in rows}) for name, rows in parts.items()}
    return {
        "options": msgspec.to_builtins(asdict(options)),
        "preprocessing": backbone.description,
        "torch": str(torch.__version__),
        "clips": {name: len(rows) for name, rows in parts.items()},
        "groups_by_part": groups,
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
        write_confusion(staged / CONFUSION_FILE, scores["held_out"].confusion, card.predicates)
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


def _labels(clips: Sequence[LabelledClip], predicates: tuple[str, ...]) -> Int64:
    """(n,) index of each clip's predicate."""
    indices = {name: index for index, name in enumerate(predicates)}
    unknown = Counter(clip.predicate for clip in clips if clip.predicate not in indices)
    if unknown:
        name, count = unknown.most_common(1)[0]
        raise ConfigurationError(
            f"{count} clips have the predicate '{name}', which is not one of the "
            f"{len(predicates)} of the chosen set: choose another set, or rename it"
        )
    return np.array([indices[clip.predicate] for clip in clips], np.int64)


def _metrics(scores: Scores, predicates: tuple[str, ...]) -> dict[str, Any]:
    confusion = scores.confusion
    totals = confusion.sum(axis=1)
    return {
        "clips": scores.clips,
        "micro_accuracy": scores.micro_accuracy,
        "macro_accuracy": scores.macro_accuracy,
        "chance_macro": scores.chance_macro,
        "majority_micro": scores.majority_micro,
        "by_predicate": {
            predicates[index]: {
                "clips": int(totals[index]),
                "right": int(confusion[index, index]),
            }
            for index in np.flatnonzero(totals)
        },
    }
