"""Arguments and options that several commands of `deworldsg` share.

typer evaluates these annotations at run time, so they use `Optional`.
"""

from pathlib import Path
from typing import Annotated, Optional

import typer

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
    int, typer.Option("--max-frames", min=0, help="stop after this many frames; 0 = all frames")
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
        "be in the map's world frame",
    ),
]
Temporal = Annotated[
    bool,
    typer.Option("--temporal", help="write the temporal stability of the graph to run.json"),
]

Timings = Annotated[bool, typer.Option("--timings", help="print the time of each stage")]
