"""Backends and recording formats of other packages, as in tools/example_plugin."""

import sys
from importlib import metadata
from types import SimpleNamespace

import numpy as np
import pytest
from support.cli import DEMO_ROOM, deworldsg

from deworldsg_ros.base import plugins
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.errors import ConfigurationError

tomllib = pytest.importorskip("tomllib")  # of Python 3.11


@pytest.fixture
def installed(root_dir, tmp_path, monkeypatch):
    """The example, as pip puts it into an environment."""
    source = root_dir / "tools" / "example_plugin"
    project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
    site = tmp_path / "site"
    folder = site / "deworldsg_example_plugin-0.1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    ]
    (folder / "entry_points.txt").write_text("\n".join(lines))
    (site / "example_plugin.py").write_bytes((source / "example_plugin.py").read_bytes())
    monkeypatch.syspath_prepend(site)
    yield site
    sys.modules.pop("example_plugin", None)


def detector(text):
    return build_perception(PerceptionConfig(detector=text))


@pytest.mark.usefixtures("installed")
def test_a_detector_is_found_by_name_and_its_options_are_checked():
    perception = detector("red_things {least_px: 20, names: [ball, thing]}")
    assert perception.vocabulary.classes == ("ball", "thing")
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[10:20, 30:45] = 200, 10, 10
    (box,) = perception._detector.detect(rgb, 0.5).boxes_xyxy
    assert box.tolist() == [30, 10, 44, 19]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("blue_things", "expected one of nanodet, pair, transformers, .*, red_things"),
        ("red_things {least_px: 0}", "deworldsg-example-plugin 0.1.0.*`int` >= 1.*least_px"),
        ("red_things {least: 3}", "`least`"),
        ("red_things 20", "expected options as in"),
        ("red_things {", "options of perception.detector 'red_things'"),
        ("red_things " + 10_001 * "x", "10001 characters"),
    ],
)
def test_what_is_refused_is_named(text, words):
    with pytest.raises(ConfigurationError, match=words):
        detector(text)


@pytest.mark.parametrize(
    ("load", "words"),
    [
        (lambda: 1 / 0, "cannot be imported: division by zero"),
        (lambda: "no function", "is a str: expected a function"),
    ],
)
def test_a_broken_plug_in_is_named(monkeypatch, load, words):
    point = SimpleNamespace(name="mine", dist=None, load=load)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point])
    with pytest.raises(plugins.PluginError, match=f"'mine' of an unknown package {words}"):
        plugins.load_plugin("relations.world_model", "mine", [])


@pytest.mark.slow
def test_a_run_and_the_nodes_use_a_detector_and_a_format(installed, tmp_path, monkeypatch):
    folder = tmp_path / "frames"
    folder.mkdir()
    recording = open_recording(DEMO_ROOM)
    for number, frame in zip(range(40), recording.frames()):
        camera = frame.intrinsics
        np.savez(
            folder / f"frame_{number:03d}.npz",
            rgb=frame.rgb,
            depth_mm=np.rint(1000 * frame.depth_m).astype(np.uint16),
            T_world_camera=frame.T_world_camera,
            intrinsics=[camera.fx, camera.fy, camera.cx, camera.cy],
            stamp_ns=frame.stamp_ns,
        )
    recording.close()
    monkeypatch.setenv("PYTHONPATH", str(installed))
    words = ["--set", "perception.detector=red_things {least_px: 100}"]
    for command in (["run"], ["demo", "--rate", 0, "--no-view"]):
        done = deworldsg(tmp_path, *command, folder, "--out", "out", *words, limit_s=300)
        assert done.returncode == 0, done.stderr
        assert "red thing" in (tmp_path / "out" / "scene_graph.json").read_text()
    listed = deworldsg(tmp_path, "models", "list", limit_s=60)
    assert "plug-in    red_things: perception.detector, of deworldsg-example-plugin 0.1.0" in (
        listed.stdout
    )
    measured = deworldsg(tmp_path, "models", "measure", "red_things", DEMO_ROOM, limit_s=300)
    assert measured.returncode == 0, measured.stderr
    rows = {cells[0]: cells[1:] for line in measured.stdout.splitlines() if (cells := line.split())}
    found, of, objects, precision = rows["embedded"][-4:]
    assert (of, objects) == ("of", "61") and int(found) > 20 and float(precision) > 0.5
    assert rows["red_things"][-4:-1] == ["0", "of", "61"]
