"""The configuration of a command: defaults, a file, single options; shared options."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Optional

import msgspec
import typer

from deworldsg_ros.base.files import parse_yaml
from deworldsg_ros.base.words import suggestion
from deworldsg_ros.config import Config, from_mapping, load_config, texts_limits, to_mapping
from deworldsg_ros.scene.errors import ConfigurationError

# --- Arguments and options that several commands of `deworldsg` share.
#
# typer evaluates these annotations at run time, so they use `Optional`.

RecordingPath = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        help="rosbag2 folder, .mcap or .db3 file, or folder of 7-Scenes, TUM RGB-D, 3RScan or "
        "ReplicaSSG",
    ),
]
OutFolder = Annotated[
    Path, typer.Option("--out", help="folder for the results; created if missing")
]
ConfigFile = Annotated[
    Optional[Path],
    typer.Option("--config", help="ROS parameter file; default: the built-in values"),
]
Settings = Annotated[
    Optional[list[str]],
    typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="set one option; may be repeated"),
]
MaxFrames = Annotated[
    int,
    typer.Option(
        "--max-frames", min=0, max=10**9, help="stop after this many frames; 0 = all frames"
    ),
]
RgbTopic = Annotated[
    str, typer.Option("--rgb", metavar="TOPIC", help="topic of the RGB images in a bag")
]
DepthTopic = Annotated[
    str, typer.Option("--depth", metavar="TOPIC", help="topic of the depth images in a bag")
]
InfoTopic = Annotated[
    str, typer.Option("--camera-info", metavar="TOPIC", help="topic of the CameraInfo in a bag")
]
PoseTopic = Annotated[
    str,
    typer.Option(
        "--pose", metavar="TOPIC", help="topic of the poses in a bag: PoseStamped, Odometry or /tf"
    ),
]
FrameRate = Annotated[
    float,
    typer.Option(
        "--rate",
        min=0,
        help="frames per second of a folder without stamps; 0 = the data set's rate",
    ),
]
CameraIntrinsics = Annotated[
    str,
    typer.Option(
        "--intrinsics",
        metavar="FX,FY,CX,CY",
        help="intrinsics in pixels, in place of those of the recording",
    ),
]
DepthSource = Annotated[
    str,
    typer.Option(
        "--depth-source",
        help="depth of a 3RScan folder: rendered or sensor; auto = rendered if available",
    ),
]
Poses = Annotated[
    Optional[Path],
    typer.Option(
        "--poses",
        metavar="FILE",
        help="use the poses of this trajectory: TUM or KITTI file, or folder of "
        "frame-NNNNNN.pose.txt or .slam.pose.txt",
    ),
]
PoseFormat = Annotated[
    str,
    typer.Option(
        "--pose-format", help="format of --poses: tum, kitti, 3rscan or slam; auto = detect"
    ),
]
OdometryPoses = Annotated[
    bool, typer.Option("--odometry", help="estimate the poses from the images, by RGB-D odometry")
]
PoseNoiseText = Annotated[
    str,
    typer.Option(
        "--pose-noise",
        metavar="NAME=NUMBER,…",
        help="perturb the poses: jitter_m, jitter_deg, drift_m_per_m, drift_deg_per_m, "
        "jump_probability, jump_m, seed",
    ),
]
SaveTrajectory = Annotated[
    Optional[Path],
    typer.Option(
        "--save-trajectory",
        metavar="FILE",
        help="write the poses of the processed frames, as a TUM file",
    ),
]
MapFile = Annotated[
    Optional[Path],
    typer.Option(
        "--map",
        metavar="FILE",
        help="load this map if the file exists, and save the map there at the end; the poses must "
        "be in the map's world frame, or --relocalise be given",
    ),
]
Relocalise = Annotated[
    bool,
    typer.Option(
        "--relocalise",
        help="find the recording in the map (--map) by its objects and surfaces, wherever its "
        "poses begin; the map stays as it is if that fails",
    ),
]
Temporal = Annotated[
    bool,
    typer.Option("--temporal", help="write the temporal stability of the graph to run.json"),
]

Timings = Annotated[bool, typer.Option("--timings", help="print the time of each stage")]


# --- Exit codes of the `deworldsg` program, besides 0.

# Bad usage, a bad configuration, or a recording that cannot be used.
EXIT_USAGE = 2
# Ctrl-C: 128 + SIGINT, as shells report it.
EXIT_INTERRUPTED = 130
# An evaluation in which every scan failed.
EXIT_NOTHING_DONE = 1
# `deworldsg doctor` found something that has to be mended.
EXIT_FINDINGS = 3


# --- The configuration of a command: the defaults, a file, single options on top.

HEADER = """\
# Configuration of deworldsg_ros: each option with its description, its range in brackets, and its
# value. The sections follow the data: inputs, odometry, the four stages, output.
# This is a ROS 2 parameter file: pass it to the nodes (--params-file) or to deworldsg (--config).
# A file may contain a part of the options; the others keep their defaults.
# Some thresholds and rates can be changed while a node runs (docs/on_a_robot.md). Nodes read all
# others once, at start-up.
"""
NO_BREAK = "\N{NO-BREAK SPACE}"


def effective_config(path: Path | None, settings: Sequence[str] | None = None) -> Config:
    """Configuration of a file (or the defaults) with single options set on top.

    Args:
        path: ROS parameter file; None = the defaults.
        settings: ``section.field=value`` each.

    Raises:
        ConfigurationError: names the file or setting, the value seen and the value expected.
    """
    config = Config() if path is None else load_config(path)
    for setting in settings or []:
        config = _set(config, setting)
    return config


def _set(config: Config, setting: str) -> Config:
    try:
        setting.encode()
    except UnicodeEncodeError as error:  # bytes of the command line that are no text
        raise ConfigurationError(f"--set {setting!a}: expected UTF-8 text") from error
    name, equals, text = setting.partition("=")
    section, _, field = name.strip().partition(".")
    mapping = to_mapping(config)
    if not equals:
        raise ConfigurationError(f"--set {setting}: expected section.field=value")
    if field not in mapping.get(section, {}):
        hint = suggestion(name, (".".join(path) for path, _ in _described_fields()))
        known = ", ".join(mapping.get(section, mapping))
        raise ConfigurationError(
            f"--set {setting}: there is no {name}{hint}; expected one of {known}"
        )
    mapping[section][field] = _value(text, mapping[section][field])
    try:
        return from_mapping(mapping)
    except ConfigurationError as error:
        described = next(line for path, line in _described_fields() if path == (section, field))
        raise ConfigurationError(f"--set {setting}: expected for {name}: {described}") from error


def _value(text: str, current: Any) -> Any:
    """The value as YAML reads it; a string field keeps the text (YAML reads a bare y as true)."""
    if isinstance(current, str):
        return text
    try:
        value = parse_yaml(text.encode())
        is_whole = isinstance(current, float) and isinstance(value, int)
        return float(value) if is_whole and not isinstance(value, bool) else value
    except (ValueError, OverflowError):
        return text


def described_yaml(config: Config) -> str:
    """ROS parameter file of a configuration; description and range precede each field."""
    lines = [*HEADER.splitlines(), "/**:", "  ros__parameters:"]
    mapping = to_mapping(config)
    for (section, field), description in _described_fields():
        if f"    {section}:" not in lines:
            kind = type(getattr(config, section))
            lines += ["", f"    # {(kind.__doc__ or '').strip()}", f"    {section}:"]
        value = mapping[section][field]
        # A list in one line: JSON is YAML. msgspec ends a plain value with a line of three dots.
        listed = isinstance(value, (list, tuple))
        value = (msgspec.json if listed else msgspec.yaml).encode(value).decode()
        lines += [*_comment(description), f"      {field}: {value.splitlines()[0]}"]
    return "\n".join(lines) + "\n"


def _comment(description: str) -> list[str]:
    """Comment lines of a description, at most 100 characters each; the range stays in one."""
    text, bracket, limits = description.partition(" [")
    unbroken = text + bracket + limits.replace(" ", NO_BREAK)
    indent = "      # "
    lines = textwrap.wrap(unbroken, 100, initial_indent=indent, subsequent_indent=indent)
    return [line.replace(NO_BREAK, " ") for line in lines]


def _described_fields() -> Iterator[tuple[tuple[str, str], str]]:
    """Section, field, and description with range, of every option."""
    sections: Any = msgspec.inspect.type_info(Config)
    for section in sections.fields:
        for field in section.type.fields:
            yield (section.name, field.name), _description(field.type)


def _description(metadata: Any) -> str:
    text = str((metadata.extra_json_schema or {}).get("description", ""))
    kind = metadata.type
    if isinstance(kind, msgspec.inspect.LiteralType):
        return f"{text} [{' | '.join(map(str, kind.values))}]"
    if isinstance(kind, msgspec.inspect.VarTupleType):
        return f"{text} [{texts_limits(kind)}]"
    limits = [
        f"{sign} {getattr(kind, name):g}"
        for name, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
        if getattr(kind, name, None) is not None
    ]
    return f"{text} [{', '.join(limits)}]" if limits else text
