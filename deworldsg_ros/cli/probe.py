"""`deworldsg train-probe` and `deworldsg import-probe`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console

from deworldsg_ros.checkpoints.cards import (
    DETECTOR_CARD,
    ClipOrigin,
    FitOptions,
    TrainingOptions,
    read_detector_card,
)
from deworldsg_ros.cli.terminal import frame_progress
from deworldsg_ros.config import RelationsConfig, from_mapping
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import PREDICATE_SETS

# Options of the command by the configuration fields that they set, for error messages.
OPTION_OF = {
    "relations.world_model_path": "--model",
    "relations.clip_length": "--clip-length",
    "perception.device": "--device",
}

# Options of the commands. typer evaluates these annotations at run time.
ClipSource = Annotated[
    Path,
    typer.Argument(
        metavar="CLIPS", help="folder of clips, or data set in the layout of ReplicaSSG or 3RScan"
    ),
]
ProbeFolder = Annotated[Path, typer.Option("--out", help="folder to write the probe to")]
WorldModelName = Annotated[str, typer.Option("--world-model", help="vjepa2 or dinov2")]
ModelPath = Annotated[
    str, typer.Option("--model", metavar="PATH", help="checkpoint of the world model")
]
PredicateSet = Annotated[
    str,
    typer.Option(
        "--predicates",
        metavar="SET",
        help="replica_ssg, 3dssg, a file with one name per line, or a folder of an imported FROSS",
    ),
]
Layout = Annotated[
    str,
    typer.Option("--layout", help="two_layer (the paper), or batch_norm (the published probe)"),
]
Inputs = Annotated[
    str,
    typer.Option(
        "--inputs", help="clip (the paper), or clip_and_boxes, which distinguishes directions"
    ),
]
Window = Annotated[
    str,
    typer.Option(
        "--window",
        help="frames of a clip of a data set: last_frames, or valid_interval (those since both "
        "objects were seen without a break)",
    ),
]
Crop = Annotated[
    str,
    typer.Option(
        "--crop",
        help="region of a clip of a data set: last_frame (the paper: the union box of the last "
        "frame, in all frames), clip_union (of the boxes of all frames), or each_frame",
    ),
]
GeoCost = Annotated[
    float,
    typer.Option(
        "--geo-cost-threshold",
        help="clips of a data set end with a frame in which the pair has a lower cost (Eq. 8)",
    ),
]
ClassWeights = Annotated[
    str,
    typer.Option(
        "--class-weights",
        help="none (the paper: the probe learns how frequent predicates are), or "
        "inverse_frequency, which makes rare ones more probable than they are",
    ),
]
DataSplit = Annotated[
    str,
    typer.Option(
        "--split",
        help="split of a data set to train on: train; validation or test only on purpose, because "
        "a probe cannot be measured on scans that it has seen",
    ),
]
HeldOut = Annotated[
    Optional[list[str]],
    typer.Option("--held-out", metavar="GROUP", help="hold out this room; may be repeated"),
]
HeldOutFraction = Annotated[
    float,
    typer.Option(
        "--held-out-fraction",
        min=0,
        max=0.9,
        help="fraction of the rooms to hold out instead; 0 trains on all, for --epochs passes",
    ),
]
ClipsPerPair = Annotated[
    int, typer.Option("--clips-per-pair", min=1, help="clips per related pair of a data set")
]
ClipLength = Annotated[int, typer.Option("--clip-length", min=1, help="frames per clip")]
Device = Annotated[str, typer.Option("--device", help="auto, cpu or cuda")]
BatchSize = Annotated[int, typer.Option("--batch-size", min=1, help="clips encoded at once")]
Epochs = Annotated[
    Optional[int], typer.Option("--epochs", min=1, help="maximum number of passes; default 200")
]
Patience = Annotated[
    int,
    typer.Option(
        "--patience", min=1, help="passes without a lower validation loss before the training stops"
    ),
]
LearningRate = Annotated[float, typer.Option("--learning-rate", min=0, help="of AdamW")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="of the weights and the split")]
Cache = Annotated[
    Optional[Path],
    typer.Option("--cache", help="folder for the features of clips; default OUT/features"),
]
Download = Annotated[bool, typer.Option("--download", help="download a checkpoint by its hub id")]


@dataclass(frozen=True)
class ProbeTraining:
    """Options of `deworldsg train-probe`.

    Attributes:
        source: folder of clips, or data set.
        out: folder of the probe.
        relations: world model, checkpoint and clip length.
        device: auto, cpu or cuda.
        download: whether the checkpoint may be downloaded.
        predicates: names of the probe's outputs.
        clips_per_pair: clips per related pair of a data set.
        data_split: split of a data set.
        training: architecture, split and fit.
        cache: folder for the features; None = `out`/features.
    """

    source: Path
    out: Path
    relations: RelationsConfig
    device: str
    download: bool
    predicates: tuple[str, ...]
    clips_per_pair: int
    data_split: str
    training: TrainingOptions
    cache: Path | None


def train_probe(
    source: ClipSource,
    out: ProbeFolder,
    world_model: WorldModelName = "vjepa2",
    model: ModelPath = "",
    predicates: PredicateSet = "replica_ssg",
    layout: Layout = "two_layer",
    inputs: Inputs = "clip",
    window: Window = "last_frames",
    crop: Crop = "last_frame",
    geo_cost_threshold: GeoCost = RelationsConfig().geo_cost_threshold,
    class_weights: ClassWeights = "none",
    split: DataSplit = "train",
    held_out: HeldOut = None,
    held_out_fraction: HeldOutFraction = 0.2,
    clips_per_pair: ClipsPerPair = 4,
    clip_length: ClipLength = 16,
    device: Device = "auto",
    batch_size: BatchSize = 1,
    epochs: Epochs = None,
    patience: Patience = 20,
    learning_rate: LearningRate = 1e-3,
    seed: Seed = 0,
    cache: Cache = None,
    download: Download = False,
) -> None:
    """Train a probe for a world model; an interrupted training continues where it stopped."""
    choice = {
        "world_model": world_model,
        "world_model_path": model,
        "clip_length": clip_length,
        "geo_cost_threshold": geo_cost_threshold,
    }
    if not held_out and not held_out_fraction and epochs is None:
        raise ConfigurationError(
            "--held-out-fraction 0 trains on all rooms, and none is left to stop the training: "
            "give --epochs, e.g. the best epoch of a training that holds some out"
        )
    training = TrainingOptions(
        layout=_one_of("layout", layout, ("two_layer", "batch_norm")),
        inputs=_one_of("inputs", inputs, ("clip", "clip_and_boxes")),
        window=_one_of("window", window, ("last_frames", "valid_interval")),
        crop=_one_of("crop", crop, ("last_frame", "clip_union", "each_frame")),
        held_out_fraction=held_out_fraction,
        held_out_groups=tuple(held_out or ()),
        batch_size=batch_size,
        fit=FitOptions(
            epochs or FitOptions.epochs,
            patience,
            learning_rate=learning_rate,
            seed=seed,
            class_weights=_one_of("class-weights", class_weights, ("none", "inverse_frequency")),
        ),
    )
    options = ProbeTraining(
        source=source,
        out=out,
        relations=from_mapping({"relations": choice}, "train-probe").relations,
        device=_one_of("device", device, ("auto", "cpu", "cuda")),
        download=download,
        predicates=read_predicates(predicates),
        clips_per_pair=clips_per_pair,
        data_split=_one_of("split", split, ("train", "validation", "test")),
        training=training,
        cache=cache,
    )
    with _needing_torch():
        run_training(options, Console(highlight=False, soft_wrap=True, markup=False))


def run_training(options: ProbeTraining, console: Console) -> None:
    """Train and save a probe, and print its accuracy; raises DeWorldSGError."""
    from deworldsg_ros.training.clips import ClipChoice, is_data_set, read_clips
    from deworldsg_ros.training.train import Progress
    from deworldsg_ros.training.train import train_probe as train

    choice = ClipChoice(
        options.relations.clip_length,
        options.clips_per_pair,
        options.data_split,
        options.training.window,
        options.training.crop,
        options.relations.geo_cost_threshold,
    )
    clips = read_clips(options.source, choice)
    backbone = _load_backbone(options)
    with frame_progress(console) as bar:
        encoding = bar.add_task("features", total=len(clips), note="")
        fitting = bar.add_task("epochs", total=options.training.fit.epochs, note="")

        def epoch(train_loss: float, validation_loss: float | None) -> None:
            note = f"loss {train_loss:.3f}"
            if validation_loss is not None:
                note += f", validation {validation_loss:.3f}"
            bar.update(fitting, advance=1, note=note)

        metrics = train(
            backbone,
            clips,
            options.predicates,
            options.out,
            options.training,
            cache=options.cache,
            origin=ClipOrigin(
                options.source.name, options.data_split if is_data_set(options.source) else ""
            ),
            progress=Progress(lambda count: bar.update(encoding, advance=count), epoch),
        )
    held = metrics.get("held_out")
    console.print(
        f"{options.out}: best epoch {metrics['best_epoch'] + 1}; {held['clips']} clips of held-out "
        f"rooms: macro accuracy {held['macro_accuracy']:.3f} (chance {held['chance_macro']:.3f}), "
        f"micro {held['micro_accuracy']:.3f} (most frequent {held['majority_micro']:.3f}), "
        f"log loss {held['log_loss_nats']:.3f} nats"
        if held
        else f"{options.out}: trained on all {metrics['train']['clips']} clips for "
        f"{metrics['best_epoch'] + 1} epochs; no room was held out to measure it",
        markup=False,
    )
    relations = options.relations
    console.print(
        f"use it: --set relations.world_model={relations.world_model} "
        f"--set relations.world_model_path={relations.world_model_path} "
        f"--set relations.probe_path={options.out}",
        markup=False,
    )


def import_probe(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="CHECKPOINT", help="the published vjepa_probe_mlp.pt")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="folder to write")],
    predicates: PredicateSet = "3dssg",
) -> None:
    """Convert the published probe of V-JEPA 2 ViT-g 384 to a folder for relations.probe_path."""
    names = read_predicates(predicates)
    with _needing_torch():
        from deworldsg_ros.checkpoints.probe_network import import_published, save_probe

        probe = import_published(checkpoint, names)
        save_probe(out, probe)
    Console(highlight=False, soft_wrap=True, markup=False).print(
        f"{out}: probe of {probe.card.backbone}, {len(names)} predicates", markup=False
    )
    Console(stderr=True, highlight=False, soft_wrap=True, markup=False).print(
        "warning: the file does not know the weights of its backbone, and the released code may "
        "not have loaded any (docs/dev/models.md, The published probe): measure it before you "
        "trust it"
    )


def read_predicates(choice: str) -> tuple[str, ...]:
    """Predicates of a named set, a file or a checkpoint's card; raises ConfigurationError."""
    if choice in PREDICATE_SETS:
        return PREDICATE_SETS[choice]
    card_path = Path(choice) / DETECTOR_CARD
    if card_path.is_file() and (names := read_detector_card(card_path).predicates):
        return names
    try:
        lines = Path(choice).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"--predicates '{choice}': expected {', '.join(PREDICATE_SETS)}, a file with one name "
            f"per line, or the folder of an imported checkpoint with a relation head ({error})"
        ) from error
    names = tuple(line.strip() for line in lines if line.strip())
    if not names or len(set(names)) != len(names):
        raise ConfigurationError(f"--predicates {choice}: expected names, each once")
    return names


def _load_backbone(options: ProbeTraining) -> Any:
    from deworldsg_ros.relations import clip_models

    loaders = {"vjepa2": clip_models.load_vjepa2, "dinov2": clip_models.load_dinov2}
    load = loaders[_one_of("world-model", options.relations.world_model, tuple(loaders))]
    try:
        return load(options.relations, device=options.device, download=options.download)
    except ConfigurationError as error:
        # The user typed options of the command, not configuration fields.
        message = str(error).replace(": run `hf", ": give --download, run `hf")
        for name, option in OPTION_OF.items():
            message = message.replace(name, option)
        raise ConfigurationError(message) from error


def _one_of(option: str, value: str, choices: tuple[str, ...]) -> Any:
    if value not in choices:
        raise ConfigurationError(f"--{option} '{value}': expected {' or '.join(choices)}")
    return value


@contextmanager
def _needing_torch() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ConfigurationError(
            f"probes need torch, transformers and safetensors ({error}): "
            "pip install torch transformers safetensors"
        ) from error
