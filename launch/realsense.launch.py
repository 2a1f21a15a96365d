"""deworldsg_ros on an Intel RealSense: its topic names, everything else as in deworldsg.launch.py.

Start the camera with depth aligned to colour (align_depth.enable:=true). The pose comes from your
odometry or SLAM: from TF, or pose:=/my/odometry. Without either, odometry:=true makes it.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

CAMERA_TOPICS = {
    "rgb": "/camera/camera/color/image_raw",
    "camera_info": "/camera/camera/color/camera_info",
    "depth": "/camera/camera/aligned_depth_to_color/image_raw",
}


def generate_launch_description() -> LaunchDescription:
    launch_file = PathJoinSubstitution(
        [FindPackageShare("deworldsg_ros"), "launch", "deworldsg.launch.py"]
    )
    arguments = [
        DeclareLaunchArgument(
            "pose", default_value="camera/pose", description="topic of the poses; or use TF"
        ),
        DeclareLaunchArgument(
            "odometry",
            default_value="false",
            choices=["true", "false"],
            description="start odometry_node, which makes the poses out of the images",
        ),
        *(
            DeclareLaunchArgument(name, default_value=topic, description=f"the camera's {topic}")
            for name, topic in CAMERA_TOPICS.items()
        ),
    ]
    nodes = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(launch_file),
        launch_arguments=[
            (name, LaunchConfiguration(name)) for name in ("pose", "odometry", *CAMERA_TOPICS)
        ],
    )
    return LaunchDescription([*arguments, nodes])
