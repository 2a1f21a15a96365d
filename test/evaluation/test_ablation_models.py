"""Ablation (d) and (e) end to end: probes trained on rooms, then a table of another room.

The backbones are tiny and have random weights: the test shows that the parts fit together.
"""

import json

import pytest
from support.checkpoints import save_dinov2, save_vjepa2
from support.evaluation import PREDICATES, write_dataset
from support.sequences import BLOCKS, RELATIONS, ROWS, write_room, write_sequence
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.graph.graph_files import read_graph

pytestmark = pytest.mark.models


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output


def training_rooms(root):
    """A data set with two training scans."""
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    write_dataset(root, {scan: (objects, RELATIONS) for scan in ("a", "b")}, split_scans=[])
    (root / "ReplicaSSG" / "train_scans.txt").write_text("a\nb\n")
    lines = [f"{i} {x1} {ROWS[0]} {x2 - 1} {ROWS[1] - 1}" for i, _, x1, x2 in BLOCKS]
    for scan in ("a", "b"):
        sequence = write_sequence(root / "data" / scan) / "sequence"
        for number in range(3):
            (sequence / f"frame-{number:06d}.bb.txt").write_text("\n".join(lines))
    return root


def test_the_ablation_runs_with_world_models_of_clips(tmp_path):
    rooms, room = training_rooms(tmp_path / "training"), write_room(tmp_path / "rooms")
    (tmp_path / "names.txt").write_text("\n".join(PREDICATES))
    settings = []
    for row, name, save in (("d", "dinov2", save_dinov2), ("e", "vjepa2", save_vjepa2)):
        checkpoint, probe = save(tmp_path / name), tmp_path / f"probe_{name}"
        run(
            *("train-probe", rooms, "--out", probe, "--world-model", name, "--model", checkpoint),
            *("--predicates", tmp_path / "names.txt", "--epochs", 2, "--device", "cpu"),
        )
        settings += ["--set", f"{row}:relations.world_model_path={checkpoint}"]
        settings += ["--set", f"{row}:relations.probe_path={probe}"]
    run(
        *("evaluate", "table", "ablation", "--layout", "replica", room),
        *("--front-end", "recorded", "--workers", 1, "--checkpoints", 0),
        *("--out", tmp_path / "out", "--json", tmp_path / "table.json", *settings),
    )
    values = json.loads((tmp_path / "table.json").read_text())
    rows = {row["name"]: row for row in values["rows"] if not row["printed"]}
    assert [rows[name]["scan_count"] for name in "abcde"] == [1] * 5
    without = read_graph(tmp_path / "out" / "c" / "room_0").edges
    assert {edge.provenance for edge in without} == {"visual"}
    for name in "de":
        edges = read_graph(tmp_path / "out" / name / "room_0").edges
        directions = {(edge.subject, edge.object) for edge in edges}
        # Eq. 10 completes the direction that no frame has seen.
        assert directions == {pair[::-1] for pair in directions}
        assert "prior" in {edge.provenance for edge in edges}
        assert len(edges) > len(without)
