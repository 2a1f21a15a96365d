"""deworldsg_ros on an Intel RealSense: deworldsg.launch.py with the topics of that camera.

Start the camera with depth aligned to colour and synchronised stamps (align_depth.enable:=true
enable_sync:=true). Poses come from your odometry or SLAM: from TF, or with pose:=/odom. Without
either, add odometry:=true.
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
        description="namespace and name of the camera node; /camera in older drivers",
    )
    nodes = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution(
                [FindPackageShare("deworldsg_ros"), "launch", "deworldsg.launch.py"]
            )
        ),
        # ros2 launch passes all other arguments of the command line to the included file.
        launch_arguments=[
            (name, [LaunchConfiguration("camera"), topic]) for name, topic in CAMERA_TOPICS.items()
        ],
    )
    return LaunchDescription([camera, nodes])
