"""Bags with detections: a run takes them in place of its own detector."""

import itertools
from contextlib import closing

import msgspec
import pytest
from support.cli import DEMO_ROOM, invoke
from support.detections import json_item, named, vision_item, wire_message, with_detections

from deworldsg_ros.config import Config, PerceptionConfig
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.recording import Recording, open_recording, open_source
from deworldsg_ros.recordings.replaying import write_mcap
from deworldsg_ros.scene.errors import RecordingError, RefusedInput

FRAMES = 40
TOPIC = Config(perception=PerceptionConfig(detector="topic"))


@pytest.fixture(scope="module")
def detected():
    """The frames' stamps, with what the embedded detector finds, and its classes."""
    detector = build_perception(PerceptionConfig())._detector
    with closing(open_source(DEMO_ROOM)) as source:
        frames = itertools.islice(Recording(source).frames(), FRAMES)
        found = {frame.stamp_ns: detector.detect(frame.rgb, 0.2) for frame in frames}
    return found, detector.classes


def bag_of(folder, items):
    last_ns = max(items)
    messages = itertools.takewhile(
        lambda raw: raw.log_time_ns <= last_ns + 10**9, with_detections(DEMO_ROOM, items)
    )
    write_mcap(messages, folder / "sent.mcap")
    return folder / "sent.mcap"


def graph_of(recording, config, frames=FRAMES):
    pipeline = Pipeline(config)
    for frame in itertools.islice(recording.frames(), frames):
        pipeline.process(frame)
    graph = pipeline.graph()
    return msgspec.structs.replace(graph, session="") if graph.session else graph


def test_the_detector_gives_the_same_graph_from_a_topic(detected, tmp_path):
    found, classes = detected
    items = {}
    for stamp_ns, one in found.items():
        # A source says how certain its names are by their distribution.
        message = wire_message(named(one.doubted(), classes, full=True), stamp_ns)
        for item, score in zip(message.detections, one.scores.tolist()):
            item.score = score
        items[stamp_ns] = json_item(message)
    with closing(open_source(bag_of(tmp_path, items))) as source:
        recording = Recording(source, with_detections=True)
        sent = graph_of(recording, TOPIC)
        assert not recording.drops
    own = graph_of(open_recording(DEMO_ROOM), Config())
    assert len(own.nodes) > 5 and sent.nodes == own.nodes and sent.edges == own.edges


def test_names_and_scores_of_vision_msgs_make_a_graph(detected, tmp_path):
    found, classes = detected
    items = {
        stamp_ns: vision_item(named(one, classes, full=False), stamp_ns)
        for stamp_ns, one in found.items()
    }
    left_out = list(items)[3]
    del items[left_out]
    bag = bag_of(tmp_path, items)
    with closing(
        open_source(bag, topics=TopicChoice(detections="/deworldsg/detections"))
    ) as source:
        recording = Recording(source, with_detections=True)
        graph = graph_of(recording, TOPIC, FRAMES - 1)
        assert recording.drops == {"no_detections": 1}
    assert {node.label for node in graph.nodes} & set(classes)
    with pytest.raises(RefusedInput, match="came without detections"):
        graph_of(open_recording(bag), TOPIC)


def test_a_bag_without_detections_is_refused_by_name(tmp_path):
    with pytest.raises(RecordingError, match="it has no detections: expected a Detection2DArray"):
        Recording(open_source(DEMO_ROOM), with_detections=True)
    words = "run", DEMO_ROOM, "--out", tmp_path, "--set", "perception.detector=topic"
    assert "it has no detections" in " ".join(invoke(*words).output.split())
