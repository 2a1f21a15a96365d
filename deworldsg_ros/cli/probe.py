"""`deworldsg train-probe` and `deworldsg import-probe`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console

from deworldsg_ros.checkpoints.card import CARD_FILE, read_card
from deworldsg_ros.config import RelationsConfig, from_mapping
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS

OPTION_OF = {
    "world_model_path": "--model",
    "clip_length": "--clip-length",
    "device": "--device",
}

PredicateSet = Annotated[
    str,
    typer.Option(
        "--predicates",
        metavar="SET",
        help="replica_ssg, 3dssg, a file with a name a line, or the folder of an imported FROSS",
    ),
]


def train_probe(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="CLIPS",
            help="folder of clips, or a data set in ReplicaSSG's or 3RScan's layout",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="folder of the probe")],
    world_model: Annotated[str, typer.Option("--world-model", help="vjepa2 or dinov2")] = "vjepa2",
    model: Annotated[
        str, typer.Option("--model", metavar="PATH", help="its checkpoint: folder or hub id")
    ] = "",
    predicates: PredicateSet = "replica_ssg",
    layout: Annotated[
        str, typer.Option("--layout", help="two_layer (the paper's) or batch_norm (the published)")
    ] = "two_layer",
    inputs: Annotated[
        str,
        typer.Option(
            "--inputs", help="clip (the paper's), or clip_and_boxes, which tells the directions"
        ),
    ] = "clip",
    held_out: Annotated[
        Optional[list[str]],
        typer.Option("--held-out", metavar="GROUP", help="keep this room aside; may be repeated"),
    ] = None,
    held_out_share: Annotated[
        float, typer.Option("--held-out-share", min=0, max=0.9, help="share of the rooms instead")
    ] = 0.2,
    clips_per_pair: Annotated[
        int, typer.Option("--clips-per-pair", min=1, help="clips cut of each related pair")
    ] = 4,
    clip_length: Annotated[int, typer.Option("--clip-length", min=1, help="frames")] = 16,
    device: Annotated[str, typer.Option("--device", help="auto, cpu or cuda")] = "auto",
    batch_size: Annotated[
        int, typer.Option("--batch-size", min=1, help="clips encoded at once")
    ] = 1,
    epochs: Annotated[int, typer.Option("--epochs", min=1, help="most passes")] = 200,
    patience: Annotated[
        int, typer.Option("--patience", min=1, help="passes without a better validation loss")
    ] = 20,
    learning_rate: Annotated[float, typer.Option("--learning-rate", min=0)] = 1e-3,
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    cache: Annotated[
        Optional[Path],
        typer.Option("--cache", help="folder of the extracted features; default OUT/features"),
    ] = None,
    download: Annotated[
        bool, typer.Option("--download", help="let a hub id be fetched from the network")
    ] = False,
) -> None:
    """Train the world model's probe; an interrupted run goes on where it stopped."""
    from deworldsg_ros.cli.progress import frame_progress

    choice = {
        "world_model": world_model,
        "world_model_path": model,
        "clip_length": clip_length,
        "device": device,
    }
    config = from_mapping({"relations": choice}, "train-probe").relations
    names = read_predicates(predicates)
    console = Console(highlight=False, soft_wrap=True)
    with _needing_torch():
        from deworldsg_ros.training.dataset_clips import read_clips
        from deworldsg_ros.training.fit import FitOptions
        from deworldsg_ros.training.train import Progress, TrainingOptions
        from deworldsg_ros.training.train import train_probe as train

        clips = read_clips(source, clip_length, clips_per_pair)
        options = TrainingOptions(
            layout=_one_of("layout", layout, ("two_layer", "batch_norm")),
            inputs=_one_of("inputs", inputs, ("clip", "clip_and_boxes")),
            held_out_share=held_out_share,
            held_out_groups=tuple(held_out or ()),
            batch_size=batch_size,
            fit=FitOptions(epochs, patience, learning_rate=learning_rate, seed=seed),
        )
        backbone = _load_backbone(config, download)
        with frame_progress(console) as bar:
            encoding = bar.add_task("features", total=len(clips), note="")
            fitting = bar.add_task("epochs", total=epochs, note="")

            def epoch(train_loss: float, validation_loss: float) -> None:
                note = f"loss {train_loss:.3f}, validation {validation_loss:.3f}"
                bar.update(fitting, advance=1, note=note)

            metrics = train(
                backbone,
                clips,
                names,
                out,
                options,
                cache=cache,
                source=source.name,
                progress=Progress(lambda count: bar.update(encoding, advance=count), epoch),
            )
    held = metrics["held_out"]
    console.print(
        f"{out}: best epoch {metrics['best_epoch'] + 1}; {held['clips']} clips of held-out rooms: "
        f"macro accuracy {held['macro_accuracy']:.3f} (chance {held['chance_macro']:.3f}), micro "
        f"{held['micro_accuracy']:.3f} (most frequent {held['majority_micro']:.3f})",
        markup=False,
    )
    console.print(
        f"use it: --set relations.world_model={world_model} "
        f"--set relations.world_model_path={model} --set relations.probe_path={out}",
        markup=False,
    )


def import_probe(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="CHECKPOINT", help="published vjepa_probe_mlp.pt")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="folder to write")],
    predicates: PredicateSet = "replica_ssg",
) -> None:
    """Turn the published probe of V-JEPA 2 ViT-g 384 into a folder that loads by name."""
    names = read_predicates(predicates)
    with _needing_torch():
        from deworldsg_ros.relations.probing.probe_network import import_published, save_probe

        probe = import_published(checkpoint, names)
        save_probe(out, probe)
    Console(highlight=False, soft_wrap=True).print(
        f"{out}: probe of {probe.card.backbone}, {len(names)} predicates", markup=False
    )


def read_predicates(choice: str) -> tuple[str, ...]:
    """Names of a set, of a file, or of a checkpoint's card; raises ConfigurationError."""
    if choice in PREDICATE_SETS:
        return PREDICATE_SETS[choice]
    card_path = Path(choice) / CARD_FILE
    if card_path.is_file() and (names := read_card(card_path).predicates):
        return names
    try:
        lines = Path(choice).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"--predicates '{choice}': wanted {', '.join(PREDICATE_SETS)}, a file with a name a "
            f"line, or the folder of an imported checkpoint with a relation head ({error})"
        ) from error
    names = tuple(line.strip() for line in lines if line.strip())
    if not names or len(set(names)) != len(names):
        raise ConfigurationError(f"--predicates {choice}: wanted names, each of them once")
    return names


def _load_backbone(config: RelationsConfig, download: bool) -> Any:
    from deworldsg_ros.relations.world_models import dinov2, vjepa2

    loaders = {"vjepa2": vjepa2.load_backbone, "dinov2": dinov2.load_backbone}
    load = loaders[_one_of("world-model", config.world_model, tuple(loaders))]
    try:
        return load(config, download=download)
    except ConfigurationError as error:
        # The user typed options of the command, not configuration fields.
        told = str(error).replace(": run `hf", ": give --download, run `hf")
        for name, option in OPTION_OF.items():
            told = told.replace(f"relations.{name}", option)
        raise ConfigurationError(told) from error


def _one_of(option: str, value: str, choices: tuple[str, ...]) -> Any:
    if value not in choices:
        raise ConfigurationError(f"--{option} '{value}': wanted {' or '.join(choices)}")
    return value


@contextmanager
def _needing_torch() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ConfigurationError(
            f"probes need torch, transformers and safetensors ({error}): pip install "
            "'deworldsg_ros[models]'"
        ) from error
