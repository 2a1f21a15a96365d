"""`deworldsg models`: published checkpoints are fetched, listed, inspected and converted."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import msgspec
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from deworldsg_ros.base.files import parse_json, read_regular
from deworldsg_ros.base.plugins import PARAMETERS, plugins, source_of
from deworldsg_ros.base.words import visible, visible_lines
from deworldsg_ros.checkpoints.cards import MAX_CARD_BYTES, WEIGHTS_FILE
from deworldsg_ros.checkpoints.catalogue import (
    CATALOGUE,
    DETECTOR,
    GROUPS,
    MODELS_FOLDER,
    NOT_ON_THE_HUB,
    TEXT_DETECTOR,
    Published,
    detector_of,
    is_complete,
    is_hub_id,
    megabytes,
)
from deworldsg_ros.checkpoints.hub import Hub, Lock, ParameterHeader, read_headers
from deworldsg_ros.cli.configuration import EXIT_USAGE
from deworldsg_ros.client.meanings import is_class
from deworldsg_ros.config import Config, PerceptionConfig
from deworldsg_ros.scene.arrays import UInt8
from deworldsg_ros.scene.errors import (
    ConfigurationError,
    DeWorldSGError,
    RecordingError,
    RefusedInput,
)
from deworldsg_ros.wire import messages as wire

if TYPE_CHECKING:
    from deworldsg_ros.checkpoints.fross import Imported

# --- `deworldsg models get`, `list` and `inspect`.


def get_models(names: list[str], into: Path, console: Console) -> None:
    """Download models by name; see `deworldsg models get`.

    Raises:
        ConfigurationError: an unknown name, no access, no network, or a file that is damaged.
    """
    chosen = [model for name in names for model in _models_of(name)]
    if "embedded" in names:
        console.print("embedded: the weights are part of the package; nothing to download")
    for published in chosen:
        _get_model(published, into / published.name, console)
    if "paper" in names:
        for name, title, advice in NOT_ON_THE_HUB:
            if not (into / name).is_dir():
                console.print(f"{title} is not on the hub: {advice.format(folder=into / name)}")


def _get_model(published: Published, folder: Path, console: Console) -> None:
    """Download a model, unless it is there as its lock says."""
    lock = Lock.read(folder)
    if lock is not None and not _agree(lock, published):
        lock = None
    if lock is not None and lock.holds(folder):
        console.print(f"{folder}: complete, and as {Lock.path(folder)} says")
    else:
        _fetch(published, folder, lock, console)
    if published.purpose in (DETECTOR, TEXT_DETECTOR):
        words = " --set 'perception.words=[mug, red mug, drill]'"
        console.print(
            f"use it: --set {published.purpose.replace(': ', '=')} --set "
            f"perception.detector_path={folder}"
            f"{words if published.purpose == TEXT_DETECTOR else ''}"
        )


def _agree(lock: Lock, published: Published) -> bool:
    """Whether a lock is of a model as the catalogue has it, which may be newer."""
    return (
        lock.repository == published.repository
        and published.revision in ("", lock.commit)
        and published.sha256 in ("", lock.sums.get(WEIGHTS_FILE))
    )


def _fetch(published: Published, folder: Path, lock: Lock | None, console: Console) -> None:
    pins = {WEIGHTS_FILE: published.sha256} if published.sha256 else {}
    try:
        hub = Hub()
        model = hub.find(published.repository, lock.commit if lock else published.revision)
    except ConfigurationError as error:
        # The weights of an entry with a SHA-256 need no hub.
        if lock or not is_complete(folder) or (pins and not Lock("", "", pins).holds(folder)):
            raise
        known = "verified by the SHA-256 of its weights" if pins else "not verified"
        console.print(f"{folder}: complete, and {known}: no {Lock.path(folder)}; {error}")
        return
    console.print(
        f"{model.repository}, commit {model.commit[:12]}, licence {model.licence}, "
        f"{megabytes(model.size / 1e6)} → {folder}"
    )
    if published.name in CATALOGUE:
        console.print(f"  {published.described()}")
    _make_folder(folder)
    sums, source = (lock.sums, str(Lock.path(folder))) if lock else (pins, "the catalogue")
    hub.fetch(model, folder, lambda line: console.print(f"  {line}"), sums, source)


def list_models(folder: Path, console: Console) -> None:
    """Print what a folder of models has, what is missing, and how to bring it to a machine."""
    console.print("in the package: NanoDet-g (detector), embedded world model; no download")
    paper = GROUPS["paper"]
    for name, model in CATALOGUE.items():
        state, size = _state(folder / name), _size(folder / name)
        mark = ", of the paper" if name in paper else ""
        console.print(f"{state:10} {name}: {model.purpose}{mark}; {model.described()}{size}")
    for name, title, advice in NOT_ON_THE_HUB:
        state = _state(folder / name)
        how = (
            _size(folder / name) if state == "there" else f"; {advice.format(folder=folder / name)}"
        )
        console.print(f"{state:10} {name}: {title}, of the paper{how}")
    known = {*CATALOGUE, *(name for name, _, _ in NOT_ON_THE_HUB)}
    others = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    for name in others:
        if name not in known and is_complete(folder / name):
            console.print(f"{'there':10} {name}{_size(folder / name)}")
    for parameter in PARAMETERS:
        for name, point in plugins(parameter).items():
            console.print(f"{'plug-in':10} {name}: {parameter}, of {source_of(point)}")
    console.print(
        f"\nget one: deworldsg models get NAME --into {folder}; without a commit here, the first "
        "download is trusted, and NAME.sha256 holds later ones to it\n"
        f"for a machine without network: run that elsewhere, copy the folder {folder}, and run "
        "`sha256sum -c *.sha256` in it there"
    )


def inspect_file(path: Path, console: Console) -> None:
    """Print names, dtypes and shapes of the parameters of a file, or of the files of a folder."""
    paths = sorted(path.glob("*.safetensors")) if path.is_dir() else [path]
    if not paths:
        raise ConfigurationError(f"{path} has no *.safetensors: expected a file or such a folder")
    for file in paths:
        headers = read_headers(file)
        values = sum(_values(header) for header in headers)
        lines = [f"{file.name}: {len(headers)} parameters, {values / 1e6:.2f} million values"]
        for header in headers:
            shape = " x ".join(map(str, header.shape)) or "scalar"
            lines.append(f"  {header.name}  {header.dtype}  {shape}")
        for line in lines:
            console.print(visible(line), markup=False)


# --- `deworldsg models measure`: detectors on a recording of the user.


@dataclass(frozen=True)
class Measured:
    """What a detector made of a recording; `found` and `precision` are None without ground truth.

    Attributes:
        frames_per_s: of the whole pipeline, without reading.
        detections: of a frame.
        nodes: of the graph.
        found: objects of the ground truth with a node of their class, and all of them.
        precision: fraction of the nodes that are in the box of an object of their class.
    """

    frames_per_s: float
    detections: float
    nodes: int
    found: tuple[int, int] | None = None
    precision: float | None = None


def measure_detectors(
    names: list[str], recording: Path, into: Path, words: tuple[str, ...], console: Console
) -> None:
    """Print what the embedded detector and others make of a recording.

    Args:
        names: models of the catalogue, folders of checkpoints, or plug-ins.
        recording: its ground truth is used if it is there (bags/README.md).
        into: folder of the models.
        words: what detectors of free text look for.
        console: terminal.

    Raises:
        DeWorldSGError: a detector or a recording that cannot be used.
    """
    table = Table(box=box.SIMPLE)
    for column in ("detector", "frames/s", "boxes a frame", "nodes", "found", "precision"):
        table.add_column(column, justify="left" if column == "detector" else "right")
    for name in dict.fromkeys(["embedded", *names]):
        with console.status(f"{name} …"):
            done = _measure(name, recording, into, words)
        table.add_row(
            name,
            f"{done.frames_per_s:.1f}",
            f"{done.detections:.1f}",
            str(done.nodes),
            "-" if done.found is None else f"{done.found[0]} of {done.found[1]}",
            "-" if done.precision is None else f"{done.precision:.2f}",
        )
    console.print(table)


def _measure(name: str, recording: Path, into: Path, words: tuple[str, ...]) -> Measured:
    # The pipeline and the evaluation are slow to import; no other command here needs them.
    from deworldsg_ros.evaluation.graph_measures import measure, read_reference
    from deworldsg_ros.evaluation.recorded_room import RecordedRoom, has_ground_truth
    from deworldsg_ros.pipeline import Pipeline
    from deworldsg_ros.recordings.recording import Recording, open_source

    pipeline = Pipeline(Config(perception=_perception_of(name, into, words)))
    frames, detections, seconds = 0, 0, 0.0
    with closing(open_source(recording)) as source:
        for frame in Recording(source).frames():
            start_s = time.perf_counter()
            with suppress(RefusedInput):
                detections += len(pipeline.process(frame).perceived.frame_graph)
            seconds += time.perf_counter() - start_s
            frames += 1
    if pipeline.builder is None:
        raise RecordingError(f"recording {recording}: not one frame could be used")
    graph = pipeline.builder.full()
    done = Measured(frames / seconds, detections / frames, len(graph.nodes))
    if not has_ground_truth(recording):
        return done
    truth = RecordedRoom(recording)
    (scan,) = truth.scans()
    reference = read_reference(truth, scan, truth.points(scan))
    found = measure(_in_words_of(graph, truth.vocabulary.classes), reference)
    precision = found.matched / max(found.nodes, 1)
    return replace(done, found=(found.found, found.objects), precision=precision)


# Most images that are read to find the range of the activations.
CALIBRATION_IMAGES = 64


def export_model(
    name: str, out: Path, recording: Path | None, into: Path, console: Console
) -> None:
    """Export a detector as ONNX; see `deworldsg models export`.

    Args:
        name: of the catalogue, a folder, or a hub id.
        out: folder to write.
        recording: images for 8 bits; None = float32.
        into: folder of the models.
        console: terminal.

    Raises:
        DeWorldSGError: a detector, a package or a recording that cannot be used.
    """
    try:
        from deworldsg_ros.perception.export import export_detector
    except ImportError as error:
        raise ConfigurationError(
            f"the export needs torch and transformers ({error}): pip install "
            "torch onnx onnxscript 'transformers>=5.23'"
        ) from error
    images = [] if recording is None else _images(recording)
    path = into / name if name in CATALOGUE else name
    with console.status(f"{name} …"):
        made = export_detector(str(path), out, images)
    bits = "8 bits in its convolutions" if images else "float32"
    console.print(
        f"{out}: {made.classes} classes, {made.bytes / 1e6:.1f} MB, {bits}; largest difference of "
        f"a score to torch {made.difference:.4f}\n"
        f"use it: --set perception.detector=onnx --set perception.detector_path={out}"
    )


def _images(recording: Path) -> list[UInt8]:
    """Images at equal distances in a recording of any length, at most CALIBRATION_IMAGES."""
    from deworldsg_ros.recordings.recording import Recording, open_source

    images: list[UInt8] = []
    step = 1
    with closing(open_source(recording)) as source:
        for number, frame in enumerate(Recording(source).frames()):
            if number % step == 0:
                images.append(frame.rgb)
            if len(images) > CALIBRATION_IMAGES:
                images, step = images[::2], 2 * step
    if not images:
        raise RecordingError(f"recording {recording}: not one frame could be used")
    return images


def _perception_of(name: str, into: Path, words: tuple[str, ...]) -> PerceptionConfig:
    if name == "embedded":
        return PerceptionConfig()
    if name.partition(" ")[0] in plugins("perception.detector"):
        return PerceptionConfig(detector=name)
    folder = into / name if name in CATALOGUE else Path(name)
    if name not in CATALOGUE and not (folder.is_dir() or is_hub_id(name)):
        known = ", ".join([*plugins("perception.detector"), *_detectors()])
        raise ConfigurationError(f"detector '{name}': expected a folder, or one of {known}")
    backend = detector_of(folder)
    if backend == "open_vocabulary" and not words:
        raise ConfigurationError(f"detector '{name}' looks for words: give --words 'mug, drill'")
    words = words if backend == "open_vocabulary" else ()
    return PerceptionConfig(detector=backend, detector_path=str(folder), words=words)


def _detectors() -> list[str]:
    return [name for name, model in CATALOGUE.items() if "perception.detector" in model.purpose]


def _in_words_of(graph: wire.SceneGraphMessage, classes: tuple[str, ...]) -> wire.SceneGraphMessage:
    """The graph with the names of the ground truth: another detector may say "sofa" or "Couch"."""

    def named(label: str) -> str:
        return next((name for name in classes if is_class(name, label)), label)

    nodes = [
        msgspec.structs.replace(
            node,
            label=named(node.label),
            classes=[wire.Belief(named(one.label), one.probability) for one in node.classes],
        )
        for node in graph.nodes
    ]
    return msgspec.structs.replace(graph, nodes=nodes)


def _models_of(name: str) -> list[Published]:
    if name in GROUPS:
        return [CATALOGUE[member] for member in GROUPS[name]]
    if name in CATALOGUE:
        return [CATALOGUE[name]]
    if is_hub_id(name):
        return [Published(name.partition("/")[2], name, "", "")]
    raise ConfigurationError(
        f"model '{name}' is unknown: expected {', '.join((*GROUPS, *CATALOGUE))}, or OWNER/NAME of "
        "the hub"
    )


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--into {folder.parent}: {error.strerror}") from error


def _state(folder: Path) -> str:
    if not folder.is_dir():
        return "missing"
    return "there" if is_complete(folder) else "incomplete"


def _size(folder: Path) -> str:
    """Bytes of the files of a folder, in words; empty without one."""
    sizes = [path.stat().st_size for path in folder.glob("*") if path.is_file()]
    return f"; {megabytes(sum(sizes) / 1e6)} here" if sizes else ""


def _values(header: ParameterHeader) -> int:
    count = 1
    for size in header.shape:
        count *= size
    return count


# --- `deworldsg models`: published checkpoints are fetched, listed, inspected and converted.

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
            help=f"{', '.join(GROUPS)}, a name of `models list`, or OWNER/NAME of the hub",
        ),
    ],
    into: IntoFolder = MODELS_FOLDER,
) -> None:
    """Download models from the Hugging Face hub, and verify them."""
    with _terminal() as console:
        get_models(names, into, console)


@app.command("list")
def list_command(into: IntoFolder = MODELS_FOLDER) -> None:
    """List models that are there or missing, with sizes and licences."""
    with _terminal() as console:
        list_models(into, console)


@app.command("measure")
def measure_command(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME... RECORDING",
            help="detectors: names of `models list`, folders or plug-ins; then the recording",
        ),
    ],
    into: IntoFolder = MODELS_FOLDER,
    words: Annotated[
        str, typer.Option("--words", help="of detectors of free text: 'mug, red mug, drill'")
    ] = "",
) -> None:
    """Compare detectors with the embedded one on a recording: speed, objects, precision."""
    listed = tuple(word.strip() for word in words.split(",") if word.strip())
    with _terminal() as console:
        measure_detectors(names[:-1], Path(names[-1]), into, listed, console)


@app.command("export")
def export_command(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="a name of `models list`, a folder, or a hub id")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="folder to write")],
    int8: Annotated[
        Optional[Path],
        typer.Option(
            "--int8",
            metavar="RECORDING",
            help="8 bits in the convolutions, for images like those of a recording",
        ),
    ] = None,
    into: IntoFolder = MODELS_FOLDER,
) -> None:
    """Export a detector of fixed classes as ONNX, which runs without torch."""
    with _terminal() as console:
        export_model(name, out, int8, into, console)


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
