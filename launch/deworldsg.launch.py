"""The four nodes of deworldsg_ros: RGB, depth, camera info and pose in, /scene_graph out.

ros2 launch deworldsg_ros deworldsg.launch.py rgb:=/my/rgb depth:=/my/depth_registered ...

With one_process:=true, one process runs all four stages (deworldsg_node).

With map:=room.map relocalise:=true, the map of an earlier day goes on, wherever the poses begin.

For a robot without SLAM or odometry, add odometry:=true: odometry_node then computes the poses.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import (
    EnvironmentVariable,
    IfElseSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "deworldsg_ros"
# A node with an error in its configuration ends at once, and is not started again more often.
RESPAWN_DELAY_S = 2.0
GRAPH_NODES = ("graph_node", "deworldsg_node")
NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")

# Launch argument, topic in the nodes, content.
INPUTS = (
    ("rgb", "rgb/image_raw", "colour images"),
    ("camera_info", "rgb/camera_info", "intrinsics of the colour camera"),
    ("depth", "depth/image_raw", "depth images, registered to the colour images"),
    ("pose", "camera/pose", "poses of the colour camera's optical frame (PoseStamped, Odometry)"),
    (
        "detections",
        "deworldsg/detections",
        "detections of another process, if perception.detector is topic",
    ),
)


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare(PACKAGE)
    arguments = [
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution([share, "config", "default.yaml"]),
            description="ROS parameter file of all nodes; the default file changes no value",
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=["true", "false"],
            description="use the time of /clock, e.g. of ros2 bag play --clock",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="of a robot among several: all topics are below it, /robot1/scene_graph",
        ),
        DeclareLaunchArgument(
            "odometry",
            default_value="false",
            choices=["true", "false"],
            description="start odometry_node, which computes poses from the images",
        ),
        DeclareLaunchArgument(
            "one_process",
            default_value="false",
            choices=["true", "false"],
            description="start deworldsg_node, which runs all four stages, in place of four nodes",
        ),
        DeclareLaunchArgument(
            "respawn",
            default_value="false",
            choices=["true", "false"],
            description="start a node again when its process ended; a node whose model never "
            "returns then ends by itself",
        ),
        DeclareLaunchArgument(
            "map",
            default_value="",
            description="map file that is continued and written; empty = map_path of params_file",
        ),
        DeclareLaunchArgument(
            "relocalise",
            default_value="false",
            choices=["true", "false"],
            description="find this run in the map, wherever its poses begin; false = relocalise "
            "of params_file",
        ),
        *(
            DeclareLaunchArgument(name, default_value=topic, description=f"topic of the {content}")
            for name, topic, content in INPUTS
        ),
    ]
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)

    # What is not given leaves the parameter file as it is: it says again what is said already.
    nothing = ["use_sim_time:=", LaunchConfiguration("use_sim_time")]
    path, relocalise = LaunchConfiguration("map"), LaunchConfiguration("relocalise")
    of_graph = [
        "-p",
        IfElseSubstitution(NotEqualsSubstitution(path, ""), ["map_path:=", path], nothing),
        "-p",
        IfElseSubstitution(relocalise, "relocalise:=true", nothing),
    ]

    def node(name: str, condition: IfCondition | UnlessCondition) -> Node:
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            output="screen",
            respawn=LaunchConfiguration("respawn"),
            respawn_delay=RESPAWN_DELAY_S,
            parameters=[{"use_sim_time": use_sim_time}],
            # Given to the node itself, which refuses a missing file; launch would ignore it.
            arguments=[
                *("--ros-args", "--params-file", LaunchConfiguration("params_file")),
                *(of_graph if name in GRAPH_NODES else ()),
            ],
            remappings=[(topic, LaunchConfiguration(argument)) for argument, topic, _ in INPUTS],
            condition=condition,
        )

    one_process = LaunchConfiguration("one_process")
    nodes = [
        *(node(name, UnlessCondition(one_process)) for name in NODES),
        node("deworldsg_node", IfCondition(one_process)),
        node("odometry_node", IfCondition(LaunchConfiguration("odometry"))),
    ]
    # Images between processes need its larger shared-memory segment. A profile of the user is kept.
    profile = SetEnvironmentVariable(
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        EnvironmentVariable(
            "FASTRTPS_DEFAULT_PROFILES_FILE",
            default_value=PathJoinSubstitution([share, "config", "fastdds.xml"]),
        ),
    )
    respawned = SetEnvironmentVariable("DEWORLDSG_RESPAWN", LaunchConfiguration("respawn"))
    return LaunchDescription([*arguments, profile, respawned, *nodes])
