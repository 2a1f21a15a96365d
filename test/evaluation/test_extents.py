"""The boxes of the graph against the true extents of the shipped recording."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.evaluation.recorded_room import SPELLINGS
from deworldsg_ros.wire import messages as wire

RECORDING = Path(__file__).resolve().parents[2] / "bags" / "demo_room"
# Promised for perfect masks. Nothing is fitted to this recording.
MEDIAN_ERROR_M = 0.04


def true_size(item: dict) -> np.ndarray:
    """Sides (3,), the longer horizontal one first."""
    length, width, height = item["obb"]["size"]
    return np.array([max(length, width), min(length, width), height])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_boxes_of_perfect_masks_have_the_true_extents(tmp_path: Path) -> None:
    words = ["evaluate", "run", "--layout", "recording", RECORDING, "--checkpoints", 0]
    words += ["--front-end", "ground-truth", "--out", tmp_path]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    graph = SceneGraph.load(tmp_path / "demo_room")
    assert graph.message.up == [0.0, 0.0, 1.0]
    assert isinstance(graph.message.hidden, list)
    assert graph.message.schema == wire.Schema("scene_graph", 2)
    truth = json.loads(RECORDING.with_name("demo_room.gt.json").read_text(encoding="utf-8"))
    errors = []
    for item in truth["objects"]:
        label = SPELLINGS.get(item["class"], item["class"])
        low, high = np.array(item["aabb"])
        inside = [
            node
            for node in graph
            if node.label == label
            and (node.mean_m >= low - 0.05).all()
            and (node.mean_m <= high + 0.05).all()
        ]
        if not inside or not item["detectable"]:
            continue
        best = min(
            inside,
            key=lambda node: np.linalg.norm(np.subtract(node.mean_m, item["visible_centroid"])),
        )
        length, width, height = best.size_m
        size = np.array([max(length, width), min(length, width), height])
        errors.append(np.abs(size - true_size(item)))
    assert len(errors) >= 50
    assert np.median(errors) <= MEDIAN_ERROR_M
    assert (np.median(errors, axis=0) <= MEDIAN_ERROR_M).all()
