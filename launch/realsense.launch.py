"""deworldsg_ros on an Intel RealSense: its topic names, everything else as in deworldsg.launch.py.

Start the camera with depth aligned to colour and of its stamps (align_depth.enable:=true
enable_sync:=true). The pose comes from your odometry or SLAM: from TF, or pose:=/odom. Without
either, odometry:=true makes it.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

CAMERA_TOPICS = {
    "rgb": "/color/image_raw",
    "camera_info": "/color/camera_info",
    "depth": "/aligned_depth_to_color/image_raw",
}


def generate_launch_description() -> LaunchDescription:
    camera = DeclareLaunchArgument(
        "camera",
        default_value="/camera/camera",
        description="namespace and name of the camera node; of older drivers /camera",
    )
    nodes = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution(
                [FindPackageShare("deworldsg_ros"), "launch", "deworldsg.launch.py"]
            )
        ),
        # What else is given on the command line reaches the included file by itself.
        launch_arguments=[
            (name, [LaunchConfiguration("camera"), topic]) for name, topic in CAMERA_TOPICS.items()
        ],
    )
    return LaunchDescription([camera, nodes])
