"""The `deworldsg` program: its commands and options, and how errors end it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Optional

import typer
from rich.console import Console
from rich.markup import escape

from deworldsg_ros import __version__
from deworldsg_ros.cli import EXIT_INTERRUPTED, models, probe
from deworldsg_ros.cli.evaluate import evaluate
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions, parse_intrinsics
from deworldsg_ros.scene.errors import DeWorldSGError

# Bad usage, a bad configuration, a recording that cannot be used.
EXIT_USAGE = 2

app = typer.Typer(
    name="deworldsg",
    help="Live 3D semantic scene graphs from an RGB-D camera, with world-model relations.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

# typer reads these while the program runs: no `X | None` before Python 3.10's own rules allow it.
RecordingPath = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        help="rosbag2 folder, .mcap or .db3 file, or folder of 7-Scenes, TUM RGB-D, 3RScan, "
        "ReplicaSSG",
    ),
]
OutFolder = Annotated[Path, typer.Option("--out", help="folder for the results; made if need be")]
ConfigFile = Annotated[
    Optional[Path],
    typer.Option("--config", help="ROS parameter file; the defaults without one"),
]
Settings = Annotated[
    Optional[list[str]],
    typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="one value of it; may be repeated"),
]
MaxFrames = Annotated[
    int, typer.Option("--max-frames", min=0, help="stop after so many frames; 0 = take all")
]
RgbTopic = Annotated[str, typer.Option("--rgb", metavar="TOPIC", help="RGB images in a bag")]
DepthTopic = Annotated[str, typer.Option("--depth", metavar="TOPIC", help="depth images in a bag")]
InfoTopic = Annotated[
    str, typer.Option("--camera-info", metavar="TOPIC", help="calibration in a bag")
]
PoseTopic = Annotated[
    str, typer.Option("--pose", metavar="TOPIC", help="poses in a bag: also an odometry or /tf")
]
FrameRate = Annotated[
    float,
    typer.Option("--rate", min=0, help="frames a second of a folder without stamps; 0 = its own"),
]
CameraIntrinsics = Annotated[
    str,
    typer.Option("--intrinsics", metavar="FX,FY,CX,CY", help="of a folder that does not tell"),
]
DepthSource = Annotated[
    str,
    typer.Option("--depth-source", help="3rscan: rendered or sensor; auto = rendered if there"),
]
Poses = Annotated[
    Optional[Path],
    typer.Option(
        "--poses",
        metavar="FILE",
        help="poses of this trajectory rather than the recording's: TUM or KITTI file, or folder "
        "of frame-NNNNNN.pose.txt or .slam.pose.txt",
    ),
]
PoseFormat = Annotated[
    str, typer.Option("--pose-format", help="tum, kitti, 3rscan or slam; auto = by looking")
]
OdometryPoses = Annotated[
    bool, typer.Option("--odometry", help="poses out of the images, by RGB-D odometry")
]
PoseNoiseText = Annotated[
    str,
    typer.Option(
        "--pose-noise",
        metavar="NAME=NUMBER,…",
        help="make poses worse: jitter_m, jitter_deg, drift_m_per_m, drift_deg_per_m, "
        "jump_probability, jump_m, seed",
    ),
]
SaveTrajectory = Annotated[
    Optional[Path],
    typer.Option("--save-trajectory", metavar="FILE", help="write the poses used, as TUM"),
]
MapFile = Annotated[
    Optional[Path],
    typer.Option(
        "--map",
        metavar="FILE",
        help="go on with the graph of this map where the file is there, and write it at the end; "
        "the poses have to be in the same world frame",
    ),
]
Temporal = Annotated[
    bool,
    typer.Option("--temporal", help="measure how steady the graph was, into run.json"),
]

Timings = Annotated[bool, typer.Option("--timings", help="print how long each stage takes")]


@contextmanager
def _telling_errors() -> Iterator[None]:
    """Errors of the user end the program with a sentence; no traceback for them or Ctrl-C."""
    try:
        yield
    except DeWorldSGError as error:
        console = Console(stderr=True, highlight=False, soft_wrap=True)
        console.print(f"[bold red]error:[/] {escape(str(error))}")
        raise typer.Exit(EXIT_USAGE) from error
    except KeyboardInterrupt as interrupt:
        Console(stderr=True).print("interrupted")
        raise typer.Exit(EXIT_INTERRUPTED) from interrupt


def _version(wanted: bool) -> None:
    if wanted:
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
    temporal: Temporal = False,
    timings: Timings = False,
) -> None:
    """Make a recording's scene graph in one process."""
    with _telling_errors():
        from deworldsg_ros.cli.run import run_recording
        from deworldsg_ros.poses.perturbation import parse_noise
        from deworldsg_ros.recordings.posing import PoseChoice

        run_recording(
            recording,
            out,
            config,
            settings or [],
            max_frames=max_frames,
            topics=TopicChoice(rgb, depth, camera_info, pose),
            options=DatasetOptions(rate, parse_intrinsics(intrinsics), depth_source),
            poses=PoseChoice(poses, pose_format, odometry, parse_noise(pose_noise)),
            temporal=temporal,
            trajectory_out=save_trajectory,
            map_path=map_path,
            timings=timings,
            console=Console(),
        )


@app.command()
def demo(
    recording: Annotated[
        Optional[Path],
        typer.Argument(
            metavar="RECORDING",
            help="as for run; without one the recording that ships with the package",
        ),
    ] = None,
    out: OutFolder = Path("demo_out"),
    config: ConfigFile = None,
    settings: Settings = None,
    rate: Annotated[
        float,
        typer.Option("--rate", min=0, help="pace: 1 = real time, 0 = as fast as the nodes keep up"),
    ] = 1.0,
    rgb: RgbTopic = "",
    depth: DepthTopic = "",
    camera_info: InfoTopic = "",
    pose: PoseTopic = "",
    intrinsics: CameraIntrinsics = "",
    odometry: OdometryPoses = False,
) -> None:
    """Make it with the four ROS 2 nodes, from a replay."""
    with _telling_errors():
        from deworldsg_ros.cli.demo import run_demo

        run_demo(
            recording,
            out,
            config,
            settings or [],
            rate=rate,
            topics=TopicChoice(rgb, depth, camera_info, pose),
            options=DatasetOptions(intrinsics=parse_intrinsics(intrinsics)),
            odometry=odometry,
            console=Console(),
        )


@app.command()
def convert(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT",
            help="name of a data set (7scenes, tum, …), rosbag2, or auto = by looking",
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
    """Turn a folder or bag into one MCAP file."""
    with _telling_errors():
        from deworldsg_ros.cli.convert import convert_recording

        convert_recording(
            kind,
            source,
            output,
            topics=TopicChoice(rgb, depth, camera_info, pose),
            options=DatasetOptions(rate, parse_intrinsics(intrinsics), depth_source),
            console=Console(),
        )


@app.command()
def info(recording: RecordingPath) -> None:
    """Tell what a recording holds and what is used."""
    with _telling_errors():
        from deworldsg_ros.cli.info import show_recording

        show_recording(recording, Console())


@app.command("config")
def show_config(config: ConfigFile = None, settings: Settings = None) -> None:
    """Print the effective configuration, described."""
    with _telling_errors():
        from deworldsg_ros.cli.configuration import described_yaml, effective_config

        typer.echo(described_yaml(effective_config(config, settings)), nl=False)


# A command's own first sentence would be cut to one line of the list.
for function, summary in (
    (evaluate, "Measure scene graphs against annotations."),
    (probe.train_probe, "Train the probe of a world model."),
    (probe.import_probe, "Make the published probe ready for use."),
):
    app.command(short_help=summary)(_telling_errors()(function))
app.add_typer(models.app)
