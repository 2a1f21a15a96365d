#!/usr/bin/env python3
"""Write config/sros2/policies.xml: what each node may publish, subscribe to, serve and call.

python tools/make_policies.py [FILE]

The nodes are started in this process, with the options that change their topics. The ROS graph then
tells what each of them uses. Run this again after a change of topics or services; a test compares.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import rclpy  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from deworldsg_ros.lifting.stage import Lifting  # noqa: E402
from deworldsg_ros.nodes import viewer_node  # noqa: E402
from deworldsg_ros.ros import graph_keeper, graph_output, inputs, transforms  # noqa: E402

# fleet_link_node asks for fleet_node at its start.
NODES = sorted(
    (path.name for path in (ROOT / "scripts" / "ros").iterdir()),
    key=lambda name: (name == "fleet_link_node", name),
)
STAGES = {"use_sim_time": True, "relations.world_model": "fake", "odometry.publish_tf": True}
# These tell where their graph is in its map.
GRAPH_NODES = ("graph_node", "deworldsg_node")
# Options that change topics, in two runs.
VARIANTS: tuple[dict[str, Any], ...] = (
    STAGES,
    {**STAGES, "inputs.transport": "compressed", "inputs.pose_source": "tf"},
)
RECORDING = {"recording": str(ROOT / "bags" / "demo_room"), "clock": True}
REPLAYS: tuple[dict[str, Any], ...] = (RECORDING, {**RECORDING, "odometry": True})
# replay_node publishes what its recording contains; demo_room has raw images and poses.
MORE_RECORDINGS = {"rgb/image_raw/compressed", "depth/image_raw/compressedDepth"}
# Topics that all robots share, whatever their namespace.
SHARED = {"/clock", "/diagnostics", "/parameter_events", "/rosout", "/tf", "/tf_static"}
# Time until the graph knows all topics of the nodes.
DISCOVERY_S = 2.0
# A client of the graph has a random number in its name.
RANDOM = re.compile(r"_\d{4,}/")
# Kind of element, its attribute, and the question to the ROS graph.
RULES = (
    ("topic", "publish", "get_publisher_names_and_types_by_node"),
    ("topic", "subscribe", "get_subscriber_names_and_types_by_node"),
    ("service", "reply", "get_service_names_and_types_by_node"),
    ("service", "request", "get_client_names_and_types_by_node"),
)
# Names by node and attribute.
Uses = dict[str, dict[str, set[str]]]


def used() -> Uses:
    """What the nodes use, whatever their options are."""
    # The wheels of ROS 2 lack these two packages. The names of topics do not depend on the types.
    inputs.TFMessage = transforms.TFMessage = TransformStamped
    graph_output.VISION_MSGS = SimpleNamespace(Detection3DArray=MarkerArray)
    viewer_node.make_viewer = MagicMock()  # its page is no part of ROS
    # No frame is processed, so no kernel has to be compiled.
    graph_keeper.warm_up = Lifting.warm_up = MagicMock()
    uses: Uses = {name: {attribute: set() for _, attribute, _ in RULES} for name in NODES}
    rclpy.init()
    try:
        for variant, replay in zip(VARIANTS, REPLAYS):
            _ask(uses, variant, replay)
    finally:
        rclpy.try_shutdown()
    uses["replay_node"]["publish"] |= MORE_RECORDINGS
    return uses


def _ask(uses: Uses, variant: dict[str, Any], replay: dict[str, Any]) -> None:
    """Start all nodes, add to `uses` what they use, end them."""
    asking, maps = Node("asking"), tempfile.mkdtemp()
    with socket.create_server(("127.0.0.1", 0)) as free:
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    options = dict.fromkeys(NODES, variant)
    options["replay_node"] = replay
    for name in GRAPH_NODES:
        options[name] = {**variant, "relocalise": True, "map_path": f"{maps}/{name}.map"}
    options["region_node"] = {"use_sim_time": True}
    options["fleet_node"] = {"use_sim_time": True, "listen": endpoint}
    options["fleet_link_node"] = {"use_sim_time": True, "connect": endpoint, "robot": "ada"}
    known, nodes, owners = set(asking.get_node_names()), [], dict[str, str]()
    for name in NODES:
        nodes.append(_started(name, options[name]))
        # A node may make another one in its process.
        owners |= dict.fromkeys(set(asking.get_node_names()) - known - owners.keys(), name)
    time.sleep(DISCOVERY_S)
    for made, name in owners.items():
        for _, attribute, question in RULES:
            answer = getattr(asking, question)(made, "/")
            uses[name][attribute].update(RANDOM.sub("_*/", topic) for topic, _ in answer)
    for node in reversed(nodes):
        node.close()
        node.destroy_node()
    asking.destroy_node()
    shutil.rmtree(maps)


def _started(name: str, options: dict[str, Any]) -> Any:
    module = importlib.import_module(f"deworldsg_ros.nodes.{name}")
    kind = getattr(module, name.title().replace("_", ""))
    overrides = [Parameter(key, value=value) for key, value in options.items()]
    stop = [threading.Event()] if name == "replay_node" else []
    return kind(*stop, parameter_overrides=overrides)


def policies(uses: Uses) -> str:
    """The policy file of SROS2 for these nodes, with one enclave for each."""
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    for name in sorted(uses):
        enclave = ElementTree.SubElement(enclaves, "enclave", path=f"/{name}")
        profiles = ElementTree.SubElement(enclave, "profiles")
        profile = ElementTree.SubElement(profiles, "profile", ns="/", node=name)
        for element, attribute, _ in RULES:
            if not uses[name][attribute]:
                continue
            rule = ElementTree.SubElement(profile, f"{element}s", {attribute: "ALLOW"})
            for topic in sorted(_relative(name, topic) for topic in uses[name][attribute]):
                ElementTree.SubElement(rule, element).text = topic
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n'


def _relative(name: str, topic: str) -> str:
    """The name as the node asks for it; the namespace of a robot then goes before it."""
    if topic in SHARED:
        return topic
    own = f"/{name}/"
    return "~/" + topic.removeprefix(own) if topic.startswith(own) else topic.lstrip("/")


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "config/sros2/policies.xml"
    target.parent.mkdir(exist_ok=True)
    target.write_text(policies(used()), encoding="utf-8")
    print(target)
