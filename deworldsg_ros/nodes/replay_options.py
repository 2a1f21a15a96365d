"""What replay_node can be told."""

from typing import Annotated

import msgspec

from deworldsg_ros.config import option


class ReplayOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is replayed, how fast, and who has to be there."""

    recording: Annotated[
        str, option("rosbag2 folder, .mcap or .db3 file, or a data set folder")
    ] = ""
    rate: Annotated[
        float, option("pace: 1 = as recorded, 0 = as fast as the pipeline keeps up", ge=0)
    ] = 1.0
    window: Annotated[
        int, option("most frames that wait for their local graph; 0 = never wait", ge=0)
    ] = 4
    wait_s: Annotated[
        float, option("how long to wait for the four nodes, seconds; 0 = not at all", ge=0)
    ] = 10.0
    listener_s: Annotated[
        float,
        option("without the four nodes: how long to wait for any listener, seconds", ge=0),
    ] = 4.0
    required: Annotated[bool, option("end with code 3 where they do not come")] = False
    stall_s: Annotated[
        float,
        option("after so long without an answer, frames in flight are given up, seconds", gt=0),
    ] = 20.0
    clock: Annotated[bool, option("publish the recorded time on /clock, for use_sim_time")] = False
    odometry: Annotated[
        bool, option("poses are odometry_node's to make, which is waited for: none is published")
    ] = False
    save: Annotated[
        bool, option("at the end, when all is worked off, have graph_node save its graph")
    ] = False
    events: Annotated[bool, option("tell what happens as JSON lines on the standard output")] = (
        False
    )
    config: Annotated[
        str, option("parameter file of the pipeline: world frame and slop of poses from TF")
    ] = ""
    rgb_topic: Annotated[str, option("RGB images in the bag; empty = found by name")] = ""
    depth_topic: Annotated[str, option("depth images in the bag; empty = found by name")] = ""
    camera_info_topic: Annotated[str, option("calibration in the bag; empty = found by name")] = ""
    pose_topic: Annotated[
        str, option("poses in the bag, also an odometry or /tf; empty = found by name")
    ] = ""
    intrinsics: Annotated[str, option("FX,FY,CX,CY of a folder that does not tell")] = ""
    frame_rate: Annotated[
        float, option("frames a second of a folder without stamps; 0 = its own", ge=0)
    ] = 0.0


class ReplayParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parameters of replay_node; `node` as in `bridge.options.Parameters`: without a prefix."""

    node: ReplayOptions = ReplayOptions()
