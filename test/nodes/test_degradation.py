"""A model that raises, hangs or is lost: its stage goes on, says so, and recovers by itself."""

import os
import re
import subprocess
import sys
from typing import Any

import pytest
from support.failing_backend import Backend, Faults
from support.nodes_bench import CAMERA, PAIRING, Bench, send_frame, send_pair, works

from deworldsg_ros.nodes.relation_node import RelationNode
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.perception import Perception
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.ros import models
from deworldsg_ros.ros.health import ERROR, WARN
from deworldsg_ros.ros.node import EXIT_HUNG, RESPAWN_VARIABLE
from deworldsg_ros.wire import messages as wire

LIMIT_S = 0.5
HANG_S = 3.0


@pytest.fixture(autouse=True)
def loaded_on(monkeypatch, request):
    """Devices on which models are loaded; all limits are short."""
    devices: list[str] = []
    faults = {**(getattr(request, "param", None) or {})}
    unreachable = faults.pop("unreachable", 0)

    def build(config, *, world_up):
        devices.append(config.device)
        if 0 < len(devices) - 1 <= unreachable:
            raise RuntimeError("it is not there")
        backend = Backend(**{part: Faults(**of) for part, of in faults.items()})
        faults.clear()
        return Perception(backend, backend, backend, config, world_up=world_up)

    monkeypatch.setattr(models, "build_perception", build)
    monkeypatch.setattr(models, "PERCEPTION_LIMIT_S", LIMIT_S)
    monkeypatch.setattr(models, "WORLD_MODEL_LIMIT_S", LIMIT_S)
    monkeypatch.setattr(models, "SLOW_S", LIMIT_S / 2)
    monkeypatch.setattr(models, "RELOAD_PERIOD_S", 0.2)
    return devices


@pytest.fixture
def at(loaded_on):
    """segmentation_node, whose models have the faults of the test."""
    with Bench(SegmentationNode, CAMERA) as made:
        made.texts = made.peer.collect("deworldsg/frame_graph")
        yield made


def with_faults(*faults: dict[str, Any]):
    """Faults by part; "unreachable" is how often the models cannot be loaded again."""
    return pytest.mark.parametrize("loaded_on", faults, indirect=True)


def objects_after_a_frame(at: Bench) -> int:
    at.texts.clear()
    works(at, lambda: send_frame(at))
    at.expect(lambda: bool(at.texts), "a frame graph")
    return len(wire.decode(at.texts[-1], wire.FrameGraphMessage).objects)


def warns(at: Bench, words: str) -> bool:
    report = at.node.health.report(0.0, at.node.waiting_for(0))
    return report.level == WARN and words in report.message


@with_faults(*({part: {"raises": 2}} for part in ("detector", "segmenter", "relation_head")))
def test_a_model_that_raises_is_counted_and_the_node_continues(at, loaded_on, request):
    (part,) = request.node.callspec.params["loaded_on"]
    for count in (1, 2):
        products = at.products()
        at.refuses(f"{part}_error", lambda: send_frame(at))
        assert warns(at, f"the {part.replace('_', ' ')} fails: injected fault")
        # Without detections the frame has no product.
        at.expect(lambda n=products: (at.products() > n) is (part != "detector"), "a product")
        assert at.node.health.drops[f"{part}_error"] == count
    assert objects_after_a_frame(at) > 0
    assert not warns(at, f"the {part.replace('_', ' ')}")
    assert loaded_on == ["auto"]


@with_faults({"segmenter": {"hang_s": HANG_S}})
def test_a_segmenter_that_hangs_gives_frames_without_objects(at):
    assert objects_after_a_frame(at) == 0
    assert objects_after_a_frame(at) == 0
    assert at.node.health.drops["segmenter_error"] == 2
    assert warns(at, "the segmenter has given no result for")
    at.peer.spin_for(HANG_S)
    assert objects_after_a_frame(at) > 0
    assert not warns(at, "the segmenter")


@with_faults({"detector": {"hang_s": 1e9}})
def test_a_detector_that_never_returns_is_an_error(at):
    at.refuses("detector_error", lambda: send_frame(at))
    at.expect(lambda: bool(at.node.hung()), "a hung detector")
    assert re.search(r"the detector \(Backend\) has given no result for \d+ s", at.node.hung())
    statuses = at.peer.statuses()
    at.expect(lambda: bool(statuses), "diagnostics")
    assert ord(statuses[-1].level) == ERROR
    assert "the detector (Backend)" in statuses[-1].message


@with_faults({"detector": {"raises": 9}, "unreachable": 1})
def test_a_model_that_keeps_failing_is_loaded_again_on_the_cpu(at, loaded_on):
    """As with a GPU that is gone: the model raises until it is on the CPU."""
    for _ in range(4):
        at.refuses("detector_error", lambda: send_frame(at))
        at.peer.spin_for(0.25)
    assert warns(at, "it is not there")
    assert objects_after_a_frame(at) > 0
    assert loaded_on == ["auto", "cpu", "cpu"]
    assert not warns(at, "the detector")


@pytest.mark.parametrize("fault", [{"raises": 3}, {"hang_s": HANG_S}])
def test_relations_go_on_without_the_world_model(monkeypatch, fault):
    faults = Faults(**fault)

    class Faulty(FakeWorldModel):
        def predict(self, *arguments):
            faults.work()
            return super().predict(*arguments)

    monkeypatch.setattr(models, "build_world_model", lambda config, device: Faulty(2))
    parameters = {"relations.clip_length": 2, "relations.max_clips_per_s": 0.0}
    with Bench(RelationNode, PAIRING, parameters=parameters) as at:
        predicted = []
        monkeypatch.setattr(at.node._relating._world_model, "_deliver", predicted.append)
        for _ in range(2):
            works(at, lambda: send_pair(at))
        at.expect(lambda: warns(at, "the world model"), "a warning")
        for _ in range(40):
            works(at, lambda: send_pair(at))
            at.peer.spin_for(0.25)
            if predicted:
                break
        assert predicted
        at.expect(lambda: not warns(at, "the world model"), "no warning")
        assert int(at.node.more_values()["clips dropped world_model_error"]) > 0


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


@pytest.fixture
def started():
    """Starts a program that is started again when it ends, or not."""
    processes = []

    def start(program: str, respawn: str) -> subprocess.Popen:
        environment = {**os.environ, RESPAWN_VARIABLE: respawn}
        command = [sys.executable, "-c", program]
        processes.append(
            subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        )
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("respawn", ["true", "false"])
def test_a_node_with_a_hung_model_ends_if_it_is_started_again(started, respawn):
    process = started(STUCK, respawn)
    lines = iter(process.stderr.readline, "")
    assert any("the detector never returns" in line for line in lines)
    if respawn == "true":
        assert "error: the detector never returns\n" in lines
        assert process.wait(20) == EXIT_HUNG
    else:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(3)


def test_a_node_whose_model_holds_the_interpreter_ends_if_it_is_started_again(started):
    process = started(HOLDS_THE_LOCK, "true")
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "Timeout" in errors
    assert "in <lambda>" in errors
