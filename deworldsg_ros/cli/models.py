"""`deworldsg models`: published checkpoints are fetched, listed, inspected and converted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer
from rich.console import Console

from deworldsg_ros.checkpoints.card import MAX_CARD_BYTES
from deworldsg_ros.checkpoints.catalogue import MODELS_FOLDER
from deworldsg_ros.cli.exit_codes import EXIT_USAGE
from deworldsg_ros.cli.model_folder import get_models, inspect_file, list_models
from deworldsg_ros.files import read_regular
from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError
from deworldsg_ros.words import visible_lines

if TYPE_CHECKING:
    from deworldsg_ros.checkpoints.fross import Imported

app = typer.Typer(name="models", help="Get, list, inspect and convert published models.")


@app.callback()
def _models() -> None:
    """Get, list, inspect and convert published models."""


IntoFolder = Annotated[
    Path, typer.Option("--into", metavar="DIR", help="folder of the models; created if missing")
]


@contextmanager
def _terminal() -> Iterator[Console]:
    """The terminal. An error of the user is printed as one sentence."""
    try:
        yield Console(highlight=False, soft_wrap=True, markup=False)
    except DeWorldSGError as error:
        errors = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
        errors.print(f"error: {visible_lines(str(error))}")
        raise typer.Exit(EXIT_USAGE) from error


@app.command()
def get(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME…",
            help="paper, embedded, a name of `models list`, or OWNER/NAME of the hub",
        ),
    ],
    into: IntoFolder = MODELS_FOLDER,
) -> None:
    """Download models from the Hugging Face hub, and verify them."""
    with _terminal() as console:
        get_models(names, into, console)


@app.command("list")
def list_command(into: IntoFolder = MODELS_FOLDER) -> None:
    """List models that are there or missing, with their licences."""
    with _terminal() as console:
        list_models(into, console)


@app.command()
def inspect(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="safetensors, .pt or .ckpt file, or a folder")
    ],
) -> None:
    """Print names, dtypes and shapes of a checkpoint, and no weights."""
    with _terminal() as console:
        inspect_file(file, console)


@app.command("import-fross")
def import_fross(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            metavar="CHECKPOINT", help="FROSS's .ckpt file, or the folder above checkpoints/"
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="folder to write")],
    names: Annotated[
        Optional[Path],
        typer.Option(
            "--names",
            metavar="FILE",
            help='JSON file with "classes" and "predicates"; needed unless they are '
            "those of Visual Genome or 3DSSG",
        ),
    ] = None,
    frequency_bias: Annotated[
        Optional[bool],
        typer.Option(
            "--frequency-bias/--no-frequency-bias",
            help="add the class-pair statistics; default: the value in FROSS's config.json",
        ),
    ] = None,
) -> None:
    """Convert a checkpoint of FROSS (RT-DETR with EGTR) to a folder for perception."""
    console = Console(highlight=False, soft_wrap=True, markup=False)
    errors = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
    try:
        made = _import(checkpoint, out, names, frequency_bias)
    except DeWorldSGError as error:
        errors.print(f"error: {visible_lines(str(error))}")
        raise typer.Exit(EXIT_USAGE) from error
    console.print(_summary(made, out), markup=False)
    if made.unknown_bias:
        errors.print(
            "warning: the checkpoint has class-pair statistics (triplet_dist), and no config.json "
            "says whether they were used: they are off. Put FROSS's config.json into the folder of "
            "the checkpoint and import again, or give --frequency-bias or --no-frequency-bias"
        )
    console.print(
        f"use it: --set perception.detector=rtdetr --set perception.detector_path={out} "
        "--set perception.relation_head=egtr",
        markup=False,
    )


def _import(
    checkpoint: Path, out: Path, names_file: Path | None, frequency_bias: bool | None
) -> Imported:
    try:
        from deworldsg_ros.checkpoints.fross import Names, import_checkpoint
    except ImportError as error:
        raise ConfigurationError(
            f"importing a checkpoint needs torch, transformers and safetensors ({error}): "
            "pip install torch transformers safetensors"
        ) from error
    names = None
    if names_file is not None:
        try:
            names = parse_json(read_regular(names_file, MAX_CARD_BYTES), Names)
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"names {names_file}: {error}") from error
    return import_checkpoint(checkpoint, out, names=names, frequency_bias=frequency_bias)


def _summary(made: Imported, out: Path) -> str:
    card = made.card
    return (
        f"{out}: {made.architecture}, {made.parameters / 1e6:.1f} million values, "
        f"{len(card.classes)} classes, {len(card.predicates)} predicates, "
        f"{card.decoder_layers or made.layers} of {made.layers} decoder layers used, class-pair "
        f"statistics {'on' if card.frequency_bias else 'off'}"
    )
