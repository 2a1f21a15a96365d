"""The files for RViz and Foxglove name the topics that exist, with the QoS of their publishers."""

import json

import yaml
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.view.markers import markers


def test_rviz_shows_every_namespace_and_receives_the_latched_message(root_dir):
    content = yaml.safe_load((root_dir / "config" / "deworldsg.rviz").read_text(encoding="utf-8"))
    shown = content["Visualization Manager"]["Displays"]
    (display,) = (item for item in shown if item["Class"].endswith("/MarkerArray"))
    assert display["Topic"]["Value"] == "/scene_graph/markers"
    graph = make_graph([make_node(1, "cup"), make_node(2, "table")], [make_edge(1, 2)])
    assert set(display["Namespaces"]) == {marker.namespace for marker in markers(graph)}
    published = reliable(1, latched=True)
    rooms = {
        item["Topic"]["Value"]: item for item in shown if item["Name"] in ("Room", "Floor plan")
    }
    assert set(rooms) == {"/scene_graph/points", "/scene_graph/map"}
    for item in (display, *rooms.values()):
        for policy in ("durability", "reliability"):
            name = getattr(published, policy).name.replace("_", " ").title()
            assert item["Topic"][f"{policy.title()} Policy"] == name


def test_foxglove_shows_the_topics_of_the_server_and_of_the_bridge(root_dir):
    layout = json.loads((root_dir / "config" / "foxglove_layout.json").read_text("utf-8"))
    source = (root_dir / "deworldsg_ros" / "view" / "live" / "foxglove.py").read_text("utf-8")
    topics = layout["configById"]["3D!graph"]["topics"]
    for topic in set(topics) - {"/scene_graph/markers"}:
        assert f'"{topic}"' in source
    assert not topics["/scene_graph/near"]["visible"]
    image = layout["configById"]["Image!camera"]["imageMode"]["imageTopic"]
    assert f'"{image}"' in source
    panels = json.dumps(layout["layout"])
    assert all(f'"{panel}"' in panels for panel in layout["configById"])
