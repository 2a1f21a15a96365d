"""A backend that fails during a run loses only its own results."""

from __future__ import annotations

import builtins
import logging

import numpy as np
import pytest
from support.failing_backend import SHAPE, Backend

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import Detections, Perception, build_perception
from deworldsg_ros.ros.health import REASONS
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput


def perceive(backend, times=1):
    perception = Perception(backend, backend, backend, PerceptionConfig(), world_up="z")
    intrinsics = Intrinsics(40.0, 40.0, 24.5, 19.5, SHAPE[1], SHAPE[0])
    rgb, depth_m = np.zeros((*SHAPE, 3), np.uint8), np.ones(SHAPE, np.float32)
    for stamp_ns in range(times):
        found = perception.perceive(RgbdFrame(stamp_ns, rgb, depth_m, intrinsics, np.eye(4)))
    return found


def test_without_failure_all_objects_and_relations_are_returned():
    backend = Backend()
    found = perceive(backend)
    assert len(found.frame_graph) == 3 and len(found.frame_graph.relations.pairs) == 1
    assert found.drops == {} and found.failures == {}
    # The features are sorted by score together with their objects.
    assert backend.features.tolist() == [[2, 3], [4, 5], [0, 1]]


def test_if_the_relation_head_fails_the_objects_are_kept():
    found = perceive(Backend("relation head"))
    assert len(found.frame_graph) == 3 and found.instances.any()
    assert len(found.frame_graph.relations.pairs) == 0
    assert found.frame_graph.relations.logits.shape == (0, 2)
    assert found.drops == {"relation_head_error": 3}
    message = "the relation head failed: CUDA out of memory in the relation head"
    assert found.failures == {"relation_head_error": message}
    assert found.failures.keys() <= REASONS.keys()


def test_if_the_segmenter_fails_the_frame_has_no_objects():
    found = perceive(Backend("segmenter"))
    assert len(found.frame_graph) == 0 and not found.instances.any()
    assert found.instances.shape == SHAPE and found.instances.dtype == np.uint16
    assert found.drops == {"segmenter_error": 3}
    assert list(found.failures) == ["segmenter_error"] and "segmenter_error" in REASONS


def test_if_the_detector_fails_the_frame_is_refused_with_a_documented_reason():
    with pytest.raises(RefusedInput, match="the detector failed: CUDA out of memory") as refusal:
        perceive(Backend("detector"))
    assert refusal.value.reason == "detector_error" and "detector_error" in REASONS


@pytest.mark.parametrize("part", ["segmenter", "relation head"])
def test_a_failure_is_logged_once_with_its_traceback(part, caplog):
    with caplog.at_level(logging.ERROR):
        perceive(Backend(part), times=3)
    assert len(caplog.records) == 1
    assert f"the {part} failed" in caplog.text and "Traceback" in caplog.text


@pytest.mark.parametrize(
    ("field", "name"), [("detector", "rtdetr"), ("segmenter", "sam2"), ("segmenter", "sam")]
)
def test_without_torch_the_error_names_the_package_to_install(field, name, monkeypatch):
    really = builtins.__import__

    def without_torch(module, *arguments, **options):
        if module.split(".")[0] in ("torch", "transformers") or module.endswith((name, "egtr")):
            raise ImportError("No module named 'torch'")
        return really(module, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without_torch)
    with pytest.raises(
        ConfigurationError, match=f"'{name}', which needs torch.*: pip install torch"
    ):
        build_perception(PerceptionConfig(**{field: name}))


def test_features_have_one_row_per_object():
    with pytest.raises(ValueError, match="2 scores, 1 features"):
        Detections(np.zeros((2, 4)), np.ones((2, 1)), np.zeros(2), np.zeros((1, 3), np.float32))


def test_the_geometric_head_has_no_predicates_of_its_own():
    with pytest.raises(ConfigurationError, match="'checkpoint', but the relation head 'geometric'"):
        build_perception(PerceptionConfig(predicate_set="checkpoint", threads=1))
