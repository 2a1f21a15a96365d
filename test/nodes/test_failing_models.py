"""A model fails while segmentation_node runs: /diagnostics counts it, and the node continues."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.failing_backend import Backend
from support.nodes_bench import CAMERA, Bench, bench, send_frame, works

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.nodes.segmentation_node import SegmentationNode
from deworldsg_ros.perception import Perception
from deworldsg_ros.ros import models


@pytest.fixture(scope="module")
def backend() -> Backend:
    return Backend()


@pytest.fixture(scope="module")
def segmentation(backend: Backend) -> Iterator[Bench]:
    def build(config: PerceptionConfig, *, world_up: str) -> Perception:
        return Perception(backend, backend, backend, config, world_up=world_up)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "build_perception", build)
        yield from bench(SegmentationNode, CAMERA)


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        ("detector", "detector_error"),
        ("segmenter", "segmenter_error"),
        ("relation head", "relation_head_error"),
    ],
)
def test_a_failing_model_is_counted_and_the_node_continues(
    segmentation: Bench, backend: Backend, part: str, reason: str
) -> None:
    works(segmentation, lambda: send_frame(segmentation))
    published = segmentation.products()
    backend.failing = part
    segmentation.refuses(reason, lambda: send_frame(segmentation))
    report = segmentation.node.health.report(0.0)
    assert f"the {part} failed: CUDA out of memory" in report.values[f"example {reason}"]
    # Without detections the frame has no product.
    if part != "detector":
        segmentation.expect(lambda: segmentation.products() > published, "a product")
    backend.failing = ""
    works(segmentation, lambda: send_frame(segmentation))
