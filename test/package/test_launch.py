"""Content of the launch files.

`launch` and `launch_ros` are not among the wheels of ROS 2. Test doubles, which keep their
arguments, replace their classes. These tests show the arguments of the launch files; they do not
show that ROS 2 accepts them.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from deworldsg_ros.ros.node import RESPAWN_VARIABLE


class Kept:
    """Test double of a class of launch: it keeps its arguments."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args = args
        self.kwargs = kwargs


CLASSES = {
    "launch": ("LaunchDescription",),
    "launch.actions": (
        "DeclareLaunchArgument",
        "IncludeLaunchDescription",
        "SetEnvironmentVariable",
    ),
    "launch.conditions": ("IfCondition", "UnlessCondition"),
    "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
    "launch.substitutions": ("EnvironmentVariable", "LaunchConfiguration", "PathJoinSubstitution"),
    "launch_ros": (),
    "launch_ros.actions": ("Node",),
    "launch_ros.parameter_descriptions": ("ParameterValue",),
    "launch_ros.substitutions": ("FindPackageShare",),
}


@pytest.fixture()
def launch_classes(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[Kept]]:
    """Test doubles of the modules launch and launch_ros; returns the classes by name."""
    classes = {name: type(name, (Kept,), {}) for names in CLASSES.values() for name in names}
    for path, names in CLASSES.items():
        module = ModuleType(path)
        for name in names:
            setattr(module, name, classes[name])
        monkeypatch.setitem(sys.modules, path, module)
    return classes


def describe(path: Path, classes: dict[str, type[Kept]], kind: str) -> list[Kept]:
    """Entities of one kind in the description of a launch file."""
    (description,) = runpy.run_path(str(path))["generate_launch_description"]().args
    return [entity for entity in description if isinstance(entity, classes[kind])]


def test_every_node_has_the_parameter_file_and_the_remappings(
    root_dir: Path, launch_classes: dict[str, type[Kept]]
) -> None:
    path = root_dir / "launch" / "deworldsg.launch.py"
    nodes = describe(path, launch_classes, "Node")
    names = [node.kwargs["executable"] for node in nodes]
    always = ["segmentation_node", "lifting_node", "relation_node", "graph_node"]
    assert names == [*always, "deworldsg_node", "odometry_node"]
    conditions = [node.kwargs["condition"] for node in nodes]
    assert [(type(item).__name__, *item.args[0].args) for item in conditions] == [
        *[("UnlessCondition", "one_process")] * 4,
        ("IfCondition", "one_process"),
        ("IfCondition", "odometry"),
    ]
    assert all((root_dir / "scripts" / "ros" / name).is_file() for name in names)
    for node in nodes:
        assert node.kwargs["package"] == "deworldsg_ros"
        # The node itself reads the file, so that a missing one ends its start.
        *options, file = node.kwargs["arguments"]
        assert options == ["--ros-args", "--params-file"]
        assert file.args == ("params_file",)
        (extra,) = node.kwargs["parameters"]
        assert list(extra) == ["use_sim_time"]
        assert {topic: value.args[0] for topic, value in node.kwargs["remappings"]} == {
            "rgb/image_raw": "rgb",
            "rgb/camera_info": "camera_info",
            "depth/image_raw": "depth",
            "camera/pose": "pose",
        }


def test_a_node_knows_whether_it_is_started_again(
    root_dir: Path, launch_classes: dict[str, type[Kept]]
) -> None:
    path = root_dir / "launch" / "deworldsg.launch.py"
    for node in describe(path, launch_classes, "Node"):
        assert node.kwargs["respawn"].args == ("respawn",)
    variables = {
        entity.args[0]: entity.args[1]
        for entity in describe(path, launch_classes, "SetEnvironmentVariable")
    }
    assert variables[RESPAWN_VARIABLE].args == ("respawn",)


def test_every_launch_configuration_is_a_declared_argument(
    root_dir: Path, launch_classes: dict[str, type[Kept]]
) -> None:
    path = root_dir / "launch" / "deworldsg.launch.py"
    declared = {
        entity.args[0] for entity in describe(path, launch_classes, "DeclareLaunchArgument")
    }
    assert declared == {
        *("params_file", "use_sim_time", "namespace", "odometry", "one_process", "respawn"),
        *("rgb", "camera_info", "depth", "pose"),
    }


def test_realsense_passes_the_topics_of_the_camera(
    root_dir: Path, launch_classes: dict[str, type[Kept]]
) -> None:
    path = root_dir / "launch" / "realsense.launch.py"
    (camera,) = describe(path, launch_classes, "DeclareLaunchArgument")
    (include,) = describe(path, launch_classes, "IncludeLaunchDescription")
    passed = {name: parts for name, parts in include.kwargs["launch_arguments"]}
    assert all(prefix.args == ("camera",) for prefix, _ in passed.values())
    assert {
        name: camera.kwargs["default_value"] + topic for name, (_, topic) in passed.items()
    } == {
        "rgb": "/camera/camera/color/image_raw",
        "camera_info": "/camera/camera/color/camera_info",
        "depth": "/camera/camera/aligned_depth_to_color/image_raw",
    }
