"""Arguments of the launch files. Test doubles replace `launch`, which is not among the wheels."""

import runpy
import sys
from collections import defaultdict
from types import ModuleType

import pytest

from deworldsg_ros.ros.node import RESPAWN_VARIABLE


class Doubles(ModuleType):
    """Any class of a module of launch, as a test double that keeps its arguments."""

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)

        def keep(self, *args, **kwargs):
            self.args, self.kwargs = args, kwargs

        return type(name, (), {"__init__": keep})


MODULES = (
    *("launch", "launch.actions", "launch.conditions", "launch.launch_description_sources"),
    *("launch.substitutions", "launch_ros", "launch_ros.actions"),
    *("launch_ros.parameter_descriptions", "launch_ros.substitutions"),
)


@pytest.fixture(autouse=True)
def launch_doubles(monkeypatch):
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, Doubles(name))


def described(path):
    (entities,) = runpy.run_path(str(path))["generate_launch_description"]().args
    found = defaultdict(list)
    for entity in entities:
        found[type(entity).__name__].append(entity)
    return found


def test_nodes_have_the_parameter_file_remappings_conditions_and_respawn(root_dir):
    found = described(root_dir / "launch" / "deworldsg.launch.py")
    nodes = found["Node"]
    assert {
        node.kwargs["executable"]: (type(condition).__name__, *condition.args[0].args)
        for node in nodes
        for condition in [node.kwargs["condition"]]
    } == {
        **dict.fromkeys(
            ("segmentation_node", "lifting_node", "relation_node", "graph_node"),
            ("UnlessCondition", "one_process"),
        ),
        "deworldsg_node": ("IfCondition", "one_process"),
        "odometry_node": ("IfCondition", "odometry"),
    }
    for node in nodes:
        assert node.kwargs["package"] == "deworldsg_ros"
        assert (root_dir / "scripts" / "ros" / node.kwargs["executable"]).is_file()
        # The node itself reads the file, so that a missing one ends its start.
        *options, file = node.kwargs["arguments"][:3]
        assert (options, file.args) == (["--ros-args", "--params-file"], ("params_file",))
        # Later arguments replace what the file says.
        more = node.kwargs["arguments"][3:]
        has_graph = node.kwargs["executable"] in ("graph_node", "deworldsg_node")
        assert bool(more) == has_graph
        if has_graph:
            (_, path, _, relocalise) = more
            assert path.args[0].args[0].args == ("map",)
            assert path.args[1][0] == "map_path:="
            assert (relocalise.args[0].args, relocalise.args[1]) == (
                ("relocalise",),
                "relocalise:=true",
            )
        (extra,) = node.kwargs["parameters"]
        assert list(extra) == ["use_sim_time"]
        assert {topic: value.args[0] for topic, value in node.kwargs["remappings"]} == {
            "rgb/image_raw": "rgb",
            "rgb/camera_info": "camera_info",
            "depth/image_raw": "depth",
            "camera/pose": "pose",
            "deworldsg/detections": "detections",
        }
        assert node.kwargs["respawn"].args == ("respawn",)
    variables = dict(entity.args for entity in found["SetEnvironmentVariable"])
    assert variables[RESPAWN_VARIABLE].args == ("respawn",)
    assert {entity.args[0] for entity in found["DeclareLaunchArgument"]} == {
        *("params_file", "use_sim_time", "namespace", "odometry", "one_process", "respawn"),
        *("map", "relocalise"),
        *("rgb", "camera_info", "depth", "pose", "detections"),
    }


def test_realsense_passes_the_topics_of_the_camera(root_dir):
    found = described(root_dir / "launch" / "realsense.launch.py")
    (camera,), (include,) = found["DeclareLaunchArgument"], found["IncludeLaunchDescription"]
    passed = dict(include.kwargs["launch_arguments"])
    assert all(prefix.args == ("camera",) for prefix, _ in passed.values())
    default = camera.kwargs["default_value"]
    assert {name: default + topic for name, (_, topic) in passed.items()} == {
        "rgb": "/camera/camera/color/image_raw",
        "camera_info": "/camera/camera/color/camera_info",
        "depth": "/camera/camera/aligned_depth_to_color/image_raw",
    }
