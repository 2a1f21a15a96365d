"""The options of the nodes: one structure for the pipeline's nodes, one for replay_node."""

from typing import Annotated

import msgspec

from deworldsg_ros.config import Config, option

# Parameters that can be changed while a node runs, by stage. The others are read at the start.
LIVE_LIFTING = ("lifting.tau", "lifting.gamma_base_m", "lifting.covariance_ridge_m2")
LIVE_RELATIONS = ("relations.geo_cost_threshold", "relations.max_clips_per_s")
LIVE_GRAPH = (
    "merging.hellinger_threshold",
    "merging.class_distance_threshold",
    "merging.overlap_threshold",
    "relations.geo_cost_threshold",
    "output.min_existence",
    "output.rate_hz",
    "output.robot_height_m",
)


class NodeOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Files of graph_node."""

    save_path: Annotated[str, option("file that graph_node's service ~/save writes")] = (
        "scene_graph.json"
    )
    map_path: Annotated[
        str,
        option(
            "map file: graph_node continues it if it exists; ~/save and a clean shutdown write it; "
            "empty = no map. Poses must be in the map's world frame, or relocalise be true"
        ),
    ] = ""
    relocalise: Annotated[
        bool,
        option(
            "find the new run in the map by its objects and surfaces, wherever the poses begin; "
            "until then the new graph waits apart (needs map_path)"
        ),
    ] = False
    map_period_s: Annotated[
        float,
        option(
            "seconds between two checkpoints of the map while the graph changes: a node that is "
            "killed loses no more; 0 = none",
            ge=0,
            le=1e9,
        ),
    ] = 10.0


class Parameters(Config, frozen=True, forbid_unknown_fields=True):
    """Parameters of the pipeline's nodes: the configuration, and `node` without a prefix."""

    node: NodeOptions = NodeOptions()


class ReplayOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The recording, the speed of its replay, and the nodes to wait for."""

    recording: Annotated[str, option("rosbag2 folder, .mcap or .db3 file, or data set folder")] = ""
    topics: Annotated[
        str,
        option(
            "topics of a bag, as rgb=/a,depth=/b,camera_info=/c,pose=/d; "
            "a role that is left out is found by type and name"
        ),
    ] = ""
    intrinsics: Annotated[
        str, option("FX,FY,CX,CY in pixels, for a data set folder without intrinsics")
    ] = ""
    rate: Annotated[
        float, option("speed: 1 = as recorded, 0 = as fast as the nodes process frames", ge=0)
    ] = 1.0
    wait_s: Annotated[
        float, option("maximum wait for the four nodes, seconds; 0 = do not wait", ge=0)
    ] = 10.0
    save: Annotated[
        bool,
        option(
            "when all frames are processed, call graph_node's service ~/save; requires the four "
            "nodes: without them replay_node ends with exit code 3"
        ),
    ] = False
    odometry: Annotated[
        bool, option("wait for odometry_node, and do not publish the recorded poses")
    ] = False
    clock: Annotated[bool, option("publish the recorded time on /clock, for use_sim_time")] = False
    events: Annotated[bool, option("print progress as JSON lines on the standard output")] = False


class ReplayParameters(Config, frozen=True, forbid_unknown_fields=True):
    """Parameters of replay_node: the configuration, and `node` without a prefix.

    The configuration's `inputs` select the topics of a bag and the world frame of poses from TF.
    """

    node: ReplayOptions = ReplayOptions()


class ViewerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The page of viewer_node."""

    host: Annotated[
        str,
        option("address of the page; with 0.0.0.0, who has the link sees the images anywhere"),
    ] = "127.0.0.1"
    port: Annotated[
        int,
        option(
            "the next free port from this one on is used; 0 = 8080, with foxglove 8765",
            ge=0,
            le=65535,
        ),
    ] = 0
    foxglove: Annotated[bool, option("serve Foxglove instead of a page (needs foxglove-sdk)")] = (
        False
    )


class ViewerParameters(Config, frozen=True, forbid_unknown_fields=True):
    """Parameters of viewer_node; of the configuration, `inputs` chooses the type of the images."""

    node: ViewerOptions = ViewerOptions()


PeriodS = Annotated[float, option("seconds between two requests for changes", gt=0, le=60)]


class FleetOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The network of fleet_node and fleet_link_node."""

    connect: Annotated[
        str,
        option("endpoints of Zenoh routers, separated by commas; empty = none, with listen"),
    ] = ""
    listen: Annotated[
        str,
        option(
            "endpoints on which fleet_node is the router, e.g. tcp/0.0.0.0:7447 for robots on "
            "other machines; not used with connect"
        ),
    ] = "tcp/127.0.0.1:7447"
    period_s: PeriodS = 0.5


class FleetParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of fleet_node."""

    node: FleetOptions = FleetOptions()


class FleetLinkOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One robot's link to the fleet."""

    robot: Annotated[
        str, option("name of this robot in the fleet, unique; letters, digits, _ and -")
    ] = ""
    connect: Annotated[str, option("endpoints of Zenoh routers, separated by commas")] = (
        "tcp/127.0.0.1:7447"
    )
    period_s: PeriodS = 0.5


class FleetLinkParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of fleet_link_node."""

    node: FleetLinkOptions = FleetLinkOptions()


class RegionOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The part of the graph that region_node publishes."""

    center: Annotated[
        str,
        option("centre as X,Y,Z in the world frame, metres; empty = follow region/center"),
    ] = ""
    radius_m: Annotated[
        float, option("largest distance of the centre of an object's box, metres", gt=0, le=1e6)
    ] = 5.0
    classes: Annotated[
        str, option("classes, separated by commas; table means dining table too; empty = all")
    ] = ""


class RegionParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of region_node."""

    node: RegionOptions = RegionOptions()
