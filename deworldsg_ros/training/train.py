"""From labelled clips to a saved probe, with all that is needed to do it again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import torch

from deworldsg_ros.checkpoints.probe_card import BOX_INPUTS, ProbeCard
from deworldsg_ros.relations.probing.backbone import FrozenBackbone
from deworldsg_ros.relations.probing.probe_network import probe_inputs, save_probe
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.training.confusion import write_confusion
from deworldsg_ros.training.features import FeatureCache, extract_features
from deworldsg_ros.training.fit import FitOptions, Scores, fit_probe, score
from deworldsg_ros.training.labelled_clips import LabelledClip
from deworldsg_ros.training.split import split_by_group

METRICS_FILE = "metrics.json"
CONFUSION_FILE = "confusion.png"
CACHE_FOLDER = "features"


@dataclass(frozen=True)
class TrainingOptions:
    """What to train, and on which part.

    Attributes:
        layout, inputs: of the probe, see `ProbeCard`.
        held_out_share: share of the groups that is only used to tell how good it is.
        held_out_groups: these groups instead.
        batch_size: clips encoded at once.
        fit: how it is trained.
    """

    layout: Literal["two_layer", "batch_norm"] = "two_layer"
    inputs: Literal["clip", "clip_and_boxes"] = "clip"
    held_out_share: float = 0.2
    held_out_groups: tuple[str, ...] = ()
    batch_size: int = 1
    fit: FitOptions = field(default_factory=FitOptions)


@dataclass(frozen=True)
class Progress:
    """Told what goes on; by default to nobody."""

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
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Train a probe and save it.

    Args:
        backbone: frozen.
        clips: labelled clips of at least two groups.
        predicates: what the probe shall answer over.
        out: folder of the probe.
        options: how.
        cache: folder of the features; default: one in `out`.
        source: where the clips came from, for the record.
        progress: told what goes on.

    Returns:
        what is saved as metrics.json.

    Raises:
        ConfigurationError: where the clips do not fit the predicates or cannot be split.
    """
    progress = progress or Progress()
    card = ProbeCard(backbone.identity, predicates, options.layout, options.inputs)
    labels = _labels(clips, predicates)
    if options.inputs == "clip_and_boxes" and any(clip.boxes is None for clip in clips):
        raise ConfigurationError(
            "inputs 'clip_and_boxes': some clips have no boxes; name subject_box and "
            "object_box of each in index.jsonl, or train with inputs 'clip'"
        )
    split = split_by_group(
        [clip.group for clip in clips],
        [clip.pair for clip in clips],
        held_out_share=options.held_out_share,
        held_out_groups=options.held_out_groups,
        seed=options.fit.seed,
    )
    features = extract_features(
        backbone,
        clips,
        FeatureCache(cache or out / CACHE_FOLDER, backbone.description),
        batch_size=options.batch_size,
        advance=progress.encoded,
    )
    none = np.zeros(BOX_INPUTS, np.float32)
    boxes = np.stack([none if clip.boxes is None else clip.boxes for clip in clips])
    inputs = probe_inputs(card, features, boxes)
    fit = fit_probe(
        card, inputs, labels, split.train, split.validation, options.fit, progress.epoch
    )
    parts = {"train": split.train, "validation": split.validation, "held_out": split.held_out}
    scores = {
        name: score(_answers(fit.probe.network, inputs[rows]), labels[rows], labels[split.train])
        for name, rows in parts.items()
    }
    training = {
        "source": source,
        "options": msgspec.to_builtins(asdict(options)),
        "preprocessing": backbone.description,
        "clips": {name: len(rows) for name, rows in parts.items()},
        "groups": sorted({clip.group for clip in clips}),
        "held_out_groups": list(split.held_out_groups),
        "validation_by": split.validation_by,
        "torch": str(torch.__version__),
    }
    trained = msgspec.structs.replace(card, training=training)
    metrics = {
        **{name: _told(found, predicates) for name, found in scores.items()},
        "best_epoch": fit.best_epoch,
        "train_losses": fit.train_losses,
        "validation_losses": fit.validation_losses,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / METRICS_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(metrics), indent=1))
    write_confusion(out / CONFUSION_FILE, scores["held_out"].confusion, predicates)
    save_probe(out, type(fit.probe)(trained, fit.probe.network))
    return metrics


def _labels(clips: Sequence[LabelledClip], predicates: tuple[str, ...]) -> Int64:
    places = {name: place for place, name in enumerate(predicates)}
    unknown = Counter(clip.predicate for clip in clips if clip.predicate not in places)
    if unknown:
        name, count = unknown.most_common(1)[0]
        raise ConfigurationError(
            f"{count} clips have the predicate '{name}', which is none of the {len(predicates)} "
            "of the chosen set: choose another set, or rename it"
        )
    return np.array([places[clip.predicate] for clip in clips], np.int64)


def _answers(network: torch.nn.Module, inputs: Float32) -> Float64:
    with torch.inference_mode():
        logits = network(torch.from_numpy(inputs)).double()
        answers: Float64 = torch.softmax(logits, dim=1).numpy()
    return answers


def _told(scores: Scores, predicates: tuple[str, ...]) -> dict[str, Any]:
    confusion = scores.confusion
    totals = confusion.sum(axis=1)
    return {
        "clips": scores.clips,
        "micro_accuracy": scores.micro_accuracy,
        "macro_accuracy": scores.macro_accuracy,
        "chance_macro": scores.chance_macro,
        "majority_micro": scores.majority_micro,
        "by_predicate": {
            predicates[place]: {
                "clips": int(totals[place]),
                "right": int(confusion[place, place]),
            }
            for place in np.flatnonzero(totals)
        },
    }
