"""A model that raises, hangs or is lost: its stage goes on, says so, and recovers by itself."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from std_msgs.msg import String
from support.failing_backend import Backend
from support.nodes_bench import CAMERA, Bench, local_graph, rgb, send_frame, works

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.perception import Perception
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.ros import models
from deworldsg_ros.ros.health import ERROR, WARN
from deworldsg_ros.ros.models import Faults, parse_faults
from deworldsg_ros.ros.node import EXIT_HUNG, RESPAWN_VARIABLE
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire import messages as wire

LIMIT_S = 0.5
HANG_S = 3.0
loaded_on: list[str] = []


@pytest.fixture(autouse=True)
def short_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(config: PerceptionConfig, *, world_up: str) -> Perception:
        loaded_on.append(config.device)
        backend = Backend()
        return Perception(backend, backend, backend, config, world_up=world_up)

    loaded_on.clear()
    monkeypatch.setattr(models, "build_perception", build)
    monkeypatch.setattr(models, "PERCEPTION_LIMIT_S", LIMIT_S)
    monkeypatch.setattr(models, "WORLD_MODEL_LIMIT_S", LIMIT_S)
    monkeypatch.setattr(models, "SLOW_S", LIMIT_S / 2)
    monkeypatch.setattr(models, "RELOAD_PERIOD_S", 0.2)


MakeBench = Callable[[str], Bench]


@pytest.fixture
def segmentation() -> Iterator[MakeBench]:
    made: list[Bench] = []

    def make(faults: str) -> Bench:
        overrides = [Parameter("debug.faults", value=faults)]
        made.append(Bench(SegmentationNode, CAMERA, parameter_overrides=overrides))
        return made[-1]

    yield make
    for at in made:
        at.close()


def objects_after(at: Bench, texts: list[str]) -> int:
    """Send a frame; the number of objects in its frame graph."""
    texts.clear()
    works(at, lambda: send_frame(at))
    at.expect(lambda: bool(texts), "a frame graph")
    return len(wire.decode(texts[-1], wire.FrameGraphMessage).objects)


def drops(at: Bench, reason: str) -> int:
    return int(at.node.health.drops.get(reason, 0))


def warns(at: Bench, words: str) -> bool:
    report = at.node.health.report(0.0, at.node.waiting_for(0))
    return report.level == WARN and words in report.message


def test_a_detector_that_raises_costs_its_frames(segmentation: MakeBench) -> None:
    at = segmentation("detector:raise:2")
    texts = at.peer.collect("deworldsg/frame_graph")
    for _ in range(2):
        at.refuses("detector_error", lambda: send_frame(at))
        assert warns(at, "the detector fails: injected fault")
    assert objects_after(at, texts) > 0
    assert not warns(at, "the detector")
    assert drops(at, "detector_error") == 2
    assert loaded_on == ["auto"]


def test_a_segmenter_that_hangs_gives_frames_without_objects(segmentation: MakeBench) -> None:
    at = segmentation(f"segmenter:hang:{HANG_S}")
    texts = at.peer.collect("deworldsg/frame_graph")
    assert objects_after(at, texts) == 0
    assert objects_after(at, texts) == 0
    assert drops(at, "segmenter_error") == 2
    assert warns(at, "the segmenter has given no result for")
    at.peer.spin_for(HANG_S)
    assert objects_after(at, texts) > 0
    assert not warns(at, "the segmenter")


def test_a_detector_that_never_returns_is_an_error(segmentation: MakeBench) -> None:
    at = segmentation("detector:hang:1e9")
    at.refuses("detector_error", lambda: send_frame(at))
    at.expect(lambda: bool(at.node.hung()), "a hung detector")
    assert re.search(r"the detector \(Backend\) has given no result for \d+ s", at.node.hung())
    statuses: list[DiagnosticArray] = []
    at.peer.node.create_subscription(DiagnosticArray, "/diagnostics", statuses.append, 10)
    at.expect(lambda: bool(statuses), "diagnostics")
    assert ord(statuses[-1].status[0].level) == ERROR
    assert "the detector (Backend)" in statuses[-1].status[0].message


STUCK = """
import sys, threading
from deworldsg_ros.ros.node import StageNode, run

class Stuck(StageNode):
    def __init__(self):
        super().__init__("stuck_node", "frames")
        threading.Thread(target=threading.Event().wait).start()  # not even a daemon

    def hung(self):
        return "the detector never returns"

sys.exit(run(Stuck))
"""


@pytest.mark.parametrize("respawn", ["true", "false"])
def test_a_node_with_a_hung_model_ends_if_it_is_started_again(respawn: str) -> None:
    environment = {**os.environ, RESPAWN_VARIABLE: respawn}
    with subprocess.Popen(
        [sys.executable, "-c", STUCK], env=environment, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            lines = iter(process.stderr.readline, "")
            assert any("the detector never returns" in line for line in lines)
            if respawn == "true":
                assert "error: the detector never returns\n" in lines
                assert process.wait(20) == EXIT_HUNG
            else:
                with pytest.raises(subprocess.TimeoutExpired):
                    process.wait(3)
        finally:
            process.kill()


HOLDS_THE_LOCK = """
import ctypes, sys
from deworldsg_ros.ros import node

class Holds(node.StageNode):
    def __init__(self):
        super().__init__("holding_node", "frames")
        # PyDLL keeps the interpreter's lock, unlike CDLL.
        self.every(2.0, lambda: ctypes.PyDLL(None).sleep(1000))

node.STUCK_S = 3.0
sys.exit(node.run(Holds))
"""


def test_a_node_whose_model_holds_the_interpreter_ends_if_it_is_started_again() -> None:
    environment = {**os.environ, RESPAWN_VARIABLE: "true"}
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS_THE_LOCK], env=environment, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            _, errors = process.communicate(timeout=30)
            assert process.returncode == 1
            assert "Timeout" in errors
            assert "in <lambda>" in errors
        finally:
            process.kill()


def test_a_lost_detector_is_loaded_again_on_the_cpu(segmentation: MakeBench) -> None:
    """As with a GPU that is gone: the model raises until it is on the CPU."""
    at = segmentation("detector:missing:1")
    texts = at.peer.collect("deworldsg/frame_graph")
    at.refuses("detector_error", lambda: send_frame(at))
    assert warns(at, "it is not there")
    at.peer.spin_for(0.3)
    assert objects_after(at, texts) > 0
    assert loaded_on == ["auto", "cpu", "cpu"]
    assert not warns(at, "the detector")


def test_a_model_that_keeps_failing_is_loaded_again(segmentation: MakeBench) -> None:
    at = segmentation("relation_head:raise:4")
    for _ in range(6):
        works(at, lambda: send_frame(at))
        at.peer.spin_for(0.25)
    assert drops(at, "relation_head_error") == 4
    assert loaded_on[:2] == ["auto", "cpu"]


@pytest.mark.parametrize("fault", ["raise:3", f"hang:{HANG_S}", "missing:1"])
def test_relations_go_on_without_the_world_model(
    monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    monkeypatch.setattr(models, "build_world_model", lambda config, device: FakeWorldModel(2))
    options = {
        "relations.clip_length": 2,
        "relations.max_clips_per_s": 0.0,
        "debug.faults": f"world_model:{fault}",
    }
    at = Bench(
        RelationNode,
        {"rgb/image_raw": CAMERA["rgb/image_raw"], "deworldsg/local_graph": String},
        parameter_overrides=[Parameter(name, value=value) for name, value in options.items()],
    )
    predicted: list[Any] = []
    monkeypatch.setattr(
        at.node._relating._world_model, "_deliver", lambda evidence: predicted.append(evidence)
    )

    def send() -> None:
        stamp_ns = at.next_stamp()
        graph = local_graph(stamp_ns)
        other = {"instance": 2, "mean_m": [0.1, 0.0, 1.0]}
        graph.objects.append(type(graph.objects[0])(**{**_fields(graph.objects[0]), **other}))
        at.send(rgb__image_raw=rgb(stamp_ns), deworldsg__local_graph=graph)

    try:
        works(at, send)
        works(at, send)
        at.expect(lambda: warns(at, "the world model"), "a warning")
        for _ in range(40):
            works(at, send)
            at.peer.spin_for(0.25)
            if predicted:
                break
        assert predicted
        at.expect(lambda: not warns(at, "the world model"), "no warning")
        assert int(at.node.more_values()["clips dropped world_model_error"]) > 0
    finally:
        at.close()


def _fields(item: Any) -> dict[str, Any]:
    return {name: getattr(item, name) for name in item.__struct_fields__}


def test_faults_are_parsed_or_refused() -> None:
    assert parse_faults("")["detector"] == Faults()
    faults = parse_faults("detector:raise:5, segmenter:hang:2.5,world_model:missing:0")
    assert faults["detector"].raises == 5
    assert faults["segmenter"].hang_s == 2.5
    assert faults["world_model"].missing == 0
    for text in ("detector", "lamp:raise:5", "detector:burn:1", "detector:raise:many"):
        with pytest.raises(ConfigurationError, match=f"debug.faults has '{text}', expected"):
            parse_faults(text)
