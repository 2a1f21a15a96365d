"""What replay_node can be told."""

from typing import Annotated, Any

import msgspec


def _option(description: str, **limits: Any) -> Any:
    return msgspec.Meta(description=description, **limits)


class ReplayOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is replayed, how fast, and who has to be there."""

    recording: Annotated[
        str, _option("rosbag2 folder, .mcap or .db3 file, or a data set folder")
    ] = ""
    rate: Annotated[
        float, _option("pace: 1 = as recorded, 0 = as fast as the pipeline keeps up", ge=0)
    ] = 1.0
    window: Annotated[
        int, _option("most frames that wait for their local graph; 0 = never wait", ge=0)
    ] = 4
    wait_s: Annotated[
        float, _option("how long to wait for the four nodes, seconds; 0 = not at all", ge=0)
    ] = 10.0
    listener_s: Annotated[
        float,
        _option("without the four nodes: how long to wait for any listener, seconds", ge=0),
    ] = 4.0
    required: Annotated[bool, _option("end with code 3 where they do not come")] = False
    stall_s: Annotated[
        float,
        _option("after so long without an answer, frames in flight are given up, seconds", gt=0),
    ] = 20.0
    clock: Annotated[bool, _option("publish the recorded time on /clock, for use_sim_time")] = False
    odometry: Annotated[
        bool, _option("poses are odometry_node's to make, which is waited for: none is published")
    ] = False
    save: Annotated[
        bool, _option("at the end, when all is worked off, have graph_node save its graph")
    ] = False
    events: Annotated[bool, _option("tell what happens as JSON lines on the standard output")] = (
        False
    )
    config: Annotated[
        str, _option("parameter file of the pipeline: world frame and slop of poses from TF")
    ] = ""
    rgb_topic: Annotated[str, _option("RGB images in the bag; empty = found by name")] = ""
    depth_topic: Annotated[str, _option("depth images in the bag; empty = found by name")] = ""
    camera_info_topic: Annotated[str, _option("calibration in the bag; empty = found by name")] = ""
    pose_topic: Annotated[
        str, _option("poses in the bag, also an odometry or /tf; empty = found by name")
    ] = ""
    intrinsics: Annotated[str, _option("FX,FY,CX,CY of a folder that does not tell")] = ""
    frame_rate: Annotated[
        float, _option("frames a second of a folder without stamps; 0 = its own", ge=0)
    ] = 0.0


class ReplayParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parameters of replay_node; `node` as in `bridge.options.Parameters`: without a prefix."""

    node: ReplayOptions = ReplayOptions()
