"""The `deworldsg` program: its commands, their options, and the exit codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Optional

import typer
from rich.console import Console
from rich.text import Text

from deworldsg_ros import __version__
from deworldsg_ros.base.words import visible_lines
from deworldsg_ros.cli import ask, probe, store
from deworldsg_ros.cli import models as models_command
from deworldsg_ros.cli.configuration import (
    EXIT_FINDINGS,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    CameraIntrinsics,
    ConfigFile,
    DepthSource,
    DepthTopic,
    FrameRate,
    InfoTopic,
    MapFile,
    MaxFrames,
    OdometryPoses,
    OutFolder,
    PoseFormat,
    PoseNoiseText,
    Poses,
    PoseTopic,
    RecordingPath,
    Relocalise,
    RgbTopic,
    SaveTrajectory,
    Settings,
    Temporal,
    Timings,
)
from deworldsg_ros.cli.evaluate_options import (
    DataOptions,
    DetectionOptions,
    JsonFile,
    LossOptions,
    RunOptions,
    ScoringOptions,
    TableOptions,
    with_option_groups,
)
from deworldsg_ros.cli.evaluate_options import OutFolder as EvaluationFolder
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions, parse_intrinsics
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError

app = typer.Typer(
    name="deworldsg",
    help="Live 3D semantic scene graphs from an RGB-D camera, with world-model relations.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@contextmanager
def _reporting_errors() -> Iterator[None]:
    """Print an error of the user as one sentence and exit. Errors and Ctrl-C give no traceback."""
    try:
        yield
    except DeWorldSGError as error:
        _print_error(str(error))
        raise typer.Exit(EXIT_USAGE) from error
    except OSError as error:
        # Of a file that could not be written: a full disk, a read-only place.
        where = f"{error.filename}: " if error.filename else ""
        _print_error(f"{where}{error.strerror or error}")
        raise typer.Exit(EXIT_USAGE) from error
    except KeyboardInterrupt as interrupt:
        Console(stderr=True).print("interrupted")
        raise typer.Exit(EXIT_INTERRUPTED) from interrupt


def _print_error(message: str) -> None:
    """Print the lines of an error, which may contain names of a file or message."""
    text = Text.assemble(("error:", "bold red"), f" {visible_lines(message)}")
    Console(stderr=True, highlight=False, soft_wrap=True).print(text)


def _version(requested: bool) -> None:
    if requested:
        typer.echo(f"deworldsg {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    """Options of the program itself."""


@app.command()
def run(
    recording: RecordingPath,
    out: OutFolder,
    config: ConfigFile = None,
    settings: Settings = None,
    max_frames: MaxFrames = 0,
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
    rate: FrameRate = 0.0,
    intrinsics: CameraIntrinsics = "",
    depth_source: DepthSource = "auto",
    poses: Poses = None,
    pose_format: PoseFormat = "auto",
    odometry: OdometryPoses = False,
    pose_noise: PoseNoiseText = "",
    save_trajectory: SaveTrajectory = None,
    map_path: MapFile = None,
    relocalise: Relocalise = False,
    temporal: Temporal = False,
    timings: Timings = False,
) -> None:
    """Build the scene graph of a recording in one process."""
    with _reporting_errors():
        from deworldsg_ros.cli.run import RunOptions, run_recording
        from deworldsg_ros.poses.trajectory import parse_noise
        from deworldsg_ros.recordings.posing import PoseChoice

        run_recording(
            RunOptions(
                recording=recording,
                out=out,
                config_path=config,
                settings=tuple(settings or ()),
                max_frames=max_frames,
                topics=TopicChoice(rgb, depth, camera_info, pose),
                dataset=DatasetOptions(rate, parse_intrinsics(intrinsics), depth_source),
                poses=PoseChoice(poses, pose_format, odometry, parse_noise(pose_noise)),
                trajectory_out=save_trajectory,
                map_path=map_path,
                relocalise=relocalise,
                temporal=temporal,
                timings=timings,
            ),
            Console(markup=False),
        )


@app.command()
def demo(
    recording: Annotated[
        Optional[Path],
        typer.Argument(
            metavar="RECORDING",
            help="as for run; default: the recording that ships with the package",
        ),
    ] = None,
    out: OutFolder = Path("demo_out"),
    config: ConfigFile = None,
    settings: Settings = None,
    rate: Annotated[
        float,
        typer.Option(
            "--rate", min=0, help="replay speed: 1 = real time, 0 = as fast as the nodes keep up"
        ),
    ] = 1.0,
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
    intrinsics: CameraIntrinsics = "",
    odometry: OdometryPoses = False,
    models: Annotated[
        str,
        typer.Option(
            "--models",
            help="paper: config/paper.yaml with the folder models/ (two networks come from "
            "`deworldsg models get paper`, the others are imported: docs/dev/models.md); "
            "embedded: the default",
        ),
    ] = "embedded",
    no_view: Annotated[
        bool, typer.Option("--no-view", help="without the page that shows the graph growing")
    ] = False,
) -> None:
    """Build it with the four ROS 2 nodes, from a replay."""
    with _reporting_errors():
        from deworldsg_ros.cli.demo import DemoOptions, configuration_of, run_demo

        run_demo(
            recording,
            out,
            configuration_of(models, config),
            settings or [],
            DemoOptions(
                rate=rate,
                topics=TopicChoice(rgb, depth, camera_info, pose),
                intrinsics=parse_intrinsics(intrinsics),
                odometry=odometry,
                view=not no_view,
            ),
            console=Console(markup=False),
        )


@app.command()
def view(
    graph: Annotated[
        Optional[Path],
        typer.Argument(
            metavar="[FILE|RECORDING]",
            help="graph (file, or folder of a run), or a recording that is processed while it is "
            "shown",
        ),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="follow the running graph_node instead of a file")
    ] = False,
    namespace: ask.Namespace = "",
    host: Annotated[
        str,
        typer.Option(
            "--host",
            help="address of the page; with 0.0.0.0, who has the link sees the images anywhere",
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="or the next free one; 0 = 8080, Foxglove 8765")
    ] = 0,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="serve Foxglove instead of a page")
    ] = False,
    config: ConfigFile = None,
    settings: Settings = None,
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
    intrinsics: CameraIntrinsics = "",
    odometry: OdometryPoses = False,
) -> None:
    """Show a graph in the browser, in 3D, while it grows.

    With --foxglove, it needs pip install 'deworldsg_ros[foxglove]'.
    """
    with _reporting_errors():
        from deworldsg_ros.cli.view import ViewOptions, view_graph

        if live == (graph is not None):
            raise ConfigurationError("view: expected a graph, a recording or --live")
        view_graph(
            ViewOptions(
                path=graph,
                host=host,
                port=port,
                foxglove=foxglove,
                namespace=namespace,
                config_path=config,
                settings=tuple(settings or ()),
                topics=TopicChoice(rgb, depth, camera_info, pose),
                dataset=DatasetOptions(intrinsics=parse_intrinsics(intrinsics)),
                odometry=odometry,
            ),
            Console(markup=False),
        )


@app.command()
def convert(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT",
            help="name of a data set (7scenes, tum, …) or rosbag2; auto = detect",
        ),
    ],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="folder or bag")],
    output: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="file to write")],
    rate: FrameRate = 0.0,
    intrinsics: CameraIntrinsics = "",
    depth_source: DepthSource = "auto",
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
) -> None:
    """Convert a folder or bag to one MCAP file."""
    with _reporting_errors():
        from deworldsg_ros.cli.run import convert_recording

        convert_recording(
            kind,
            source,
            output,
            topics=TopicChoice(rgb, depth, camera_info, pose),
            options=DatasetOptions(rate, parse_intrinsics(intrinsics), depth_source),
            console=Console(markup=False),
        )


@app.command()
def info(
    recording: RecordingPath,
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
    intrinsics: CameraIntrinsics = "",
) -> None:
    """Show the topics of a recording and their use."""
    with _reporting_errors():
        from deworldsg_ros.cli.run import show_recording

        show_recording(
            recording,
            TopicChoice(rgb, depth, camera_info, pose),
            DatasetOptions(intrinsics=parse_intrinsics(intrinsics)),
            Console(markup=False),
        )


@app.command()
def doctor(
    recording: Annotated[
        Optional[Path], typer.Argument(metavar="RECORDING", help="as for run")
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="examine the nodes that run now, in place of a recording")
    ] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", min=2, max=600, help="with --live: time to listen")
    ] = 5.0,
    config: ConfigFile = None,
    settings: Settings = None,
    max_frames: MaxFrames = 200,
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
    intrinsics: CameraIntrinsics = "",
    poses: Poses = None,
    odometry: OdometryPoses = False,
) -> None:
    """Say what is off with a recording or nodes."""
    with _reporting_errors():
        from deworldsg_ros.cli.run import RunOptions, examine_nodes, examine_recording
        from deworldsg_ros.recordings.posing import PoseChoice

        if (recording is None) is not live:
            raise ConfigurationError("doctor: expected either a RECORDING or --live")
        console = Console(markup=False)
        if recording is None:
            is_well = examine_nodes(seconds, console)
        else:
            options = RunOptions(
                recording,
                config_path=config,
                settings=tuple(settings or ()),
                max_frames=max_frames,
                topics=TopicChoice(rgb, depth, camera_info, pose),
                dataset=DatasetOptions(intrinsics=parse_intrinsics(intrinsics)),
                poses=PoseChoice(poses, odometry=odometry),
            )
            is_well = examine_recording(options, console)
    raise typer.Exit(0 if is_well else EXIT_FINDINGS)


@app.command("compile")
def compile_kernels() -> None:
    """Compile the kernels ahead of the first run."""
    with _reporting_errors():
        from deworldsg_ros.cli import run

        run.compile_kernels(Console())


@app.command("config")
def show_config(config: ConfigFile = None, settings: Settings = None) -> None:
    """Print all options: description, range, value."""
    with _reporting_errors():
        from deworldsg_ros.cli.configuration import described_yaml, effective_config

        typer.echo(described_yaml(effective_config(config, settings)), nl=False)


@with_option_groups
def evaluate_score(
    data: DataOptions,
    scoring: ScoringOptions,
    predictions: Annotated[
        Optional[Path],
        typer.Option("--predictions", help="predictions of any method, .json or official .pkl"),
    ] = None,
    graphs: Annotated[
        Optional[Path],
        typer.Option("--graphs", help="folder with SCAN/scene_graph.json of an earlier run"),
    ] = None,
    out: Annotated[
        Optional[Path], typer.Option("--out", help="folder for tables and plots")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Score predictions or scene graphs against annotations with the official protocol."""
    from deworldsg_ros.cli.evaluate import score_files

    score_files(data, scoring, predictions, graphs, out, json_file)


@with_option_groups
def evaluate_run(
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    scoring: ScoringOptions,
    out: EvaluationFolder,
    json_file: JsonFile = None,
) -> None:
    """Run the pipeline on every scan of a data set and score its graphs."""
    from deworldsg_ros.cli.evaluate import run_scans

    run_scans(data, detections, running, scoring, out, json_file)


@with_option_groups
def evaluate_table(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="TABLE", help="main, predictions, hard, pose, ablation, switches or runtime"
        ),
    ],
    data: DataOptions,
    detections: DetectionOptions,
    running: RunOptions,
    comparing: TableOptions,
    scoring: ScoringOptions,
    out: EvaluationFolder,
    json_file: JsonFile = None,
) -> None:
    """Compare methods or configurations in a table, with the numbers of the paper."""
    from deworldsg_ros.cli.evaluate import make_table

    make_table(kind, data, detections, running, comparing, scoring, out, json_file)


@with_option_groups
def evaluate_losses(
    data: LossOptions,
    detections: DetectionOptions,
    running: RunOptions,
    out: EvaluationFolder,
    json_file: JsonFile = None,
) -> None:
    """Run the pipeline, and say of each annotated object which stage lost it, with a picture."""
    from deworldsg_ros.cli.evaluate import list_losses

    list_losses(data, detections, running, out, json_file)


evaluation = typer.Typer(
    name="evaluate", help="Measure scene graphs against annotations.", no_args_is_help=True
)
# Short help: the list of commands cuts a longer first sentence.
for parent, function, summary in (
    (evaluation, evaluate_score, "Score predictions or scene graphs of earlier runs."),
    (evaluation, evaluate_run, "Run the pipeline on every scan and score its graphs."),
    (evaluation, evaluate_table, "Compare methods or configurations in a table."),
    (evaluation, evaluate_losses, "Find the stage that lost each annotated object."),
    (app, ask.query, "Ask a scene graph in words."),
    (app, ask.goal, "Print a pose from which an object is in view."),
    (app, ask.explain, "Explain an object, a relation or a class."),
    (app, ask.edit, "Correct a map by hand, or undo it."),
    (app, ask.mcp, "Serve a scene graph to an LLM agent (MCP)."),
    (app, ask.export, "Write a scene graph in another format."),
    (app, ask.diff, "List what differs between two scene graphs."),
    (app, ask.merge, "Merge two scene graphs into one."),
    (store.app, store.add, "Add graphs, or follow the running graph_node."),
    (store.app, store.ask, "Ask in Cypher."),
    (store.app, store.at, "Print where objects were at a time."),
    (store.app, store.rebuild, "Make the database anew from the messages."),
    (app, probe.train_probe, "Train the probe of a world model."),
    (app, probe.import_probe, "Make the published probe ready for use."),
):
    name = function.__name__.removeprefix("evaluate_").replace("_", "-")
    parent.command(name, short_help=summary)(_reporting_errors()(function))
app.add_typer(evaluation)
app.add_typer(store.app)
app.add_typer(models_command.app)
