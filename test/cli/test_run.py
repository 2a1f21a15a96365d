"""`deworldsg run` on the recording that ships."""

from __future__ import annotations

import json

import pytest
from support.cli import DEMO_ROOM, deworldsg
from support.recordings import camera_items, write_bag
from typer.testing import CliRunner

from deworldsg_ros import pipeline
from deworldsg_ros.cli.app import app
from deworldsg_ros.config import load_config
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.wire import messages as wire

pytestmark = pytest.mark.slow


@pytest.mark.timeout(400)
def test_a_run_writes_every_file_that_it_names(tmp_path):
    result = deworldsg(
        tmp_path,
        *("run", DEMO_ROOM, "--out", "out", "--max-frames", 12, "--set", "output.top_k=3"),
        "--timings",
        limit_s=360,
    )
    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    graph = wire.decode((out / "scene_graph.json").read_bytes(), wire.SceneGraphMessage)
    assert graph.nodes
    assert all(len(surface_points(node)) for node in graph.nodes)
    assert all(len(node.classes) <= 3 for node in graph.nodes)
    assert (out / "scene_graph.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "scene_graph.html").read_text(encoding="utf-8")
    assert graph.nodes[0].label in page
    assert load_config(out / "config.yaml").output.top_k == 3
    report = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert report["frames"] == {"images": 171, "processed": 12}
    assert report["nodes"] == len(graph.nodes)
    assert set(report["times_ms"]) >= {"perception", "masks", "lifting", "merging", "relations"}
    assert "12/12" in result.stdout
    assert "relation inference" in result.stdout
    assert report["device"]
    for name in ("scene_graph.html", "scene_graph.png", "scene_graph.json", "run.json"):
        assert name in result.stdout


@pytest.mark.timeout(400)
def test_a_recording_without_a_usable_frame_is_an_error_with_reasons(tmp_path):
    items = [item for item in camera_items(3) if "depth" not in item[0]]
    items += [item for item in camera_items(9)[-4:] if "depth" in item[0]]
    write_bag(tmp_path / "bag", items)
    result = deworldsg(tmp_path, "run", "bag", "--out", "out", limit_s=360)
    assert result.returncode == 2
    assert "3 no_depth" in result.stdout
    assert "not one frame" in result.stderr


class Broken(FakeWorldModel):
    """A world model that fails on every clip."""

    def predict(self, request):
        raise RuntimeError("no memory left")


@pytest.mark.timeout(400)
def test_a_failing_world_model_is_in_the_report_and_the_run_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "build_world_model", lambda config, device: Broken(16))
    options = ["--max-frames", "6", "--set", "relations.max_clips_per_s=0"]
    result = CliRunner().invoke(app, ["run", str(DEMO_ROOM), "--out", str(tmp_path), *options])
    assert result.exit_code == 0, result.output
    clips = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))["clips"]
    failed = clips["dropped"]["world_model_error"]
    assert failed > 0 and clips["encoded"] == 0
    assert f"left out by world model: {failed} world_model_error" in result.output
