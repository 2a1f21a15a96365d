"""Ablation (d) and (e) end to end: probes trained on rooms, then a table of another room.

The backbones are tiny and have random weights: the test shows that the parts fit together.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from support.checkpoints import save_dinov2, save_vjepa2  # noqa: E402  after the guards
from support.evaluation import PREDICATES, write_dataset  # noqa: E402
from support.sequences import BLOCKS, RELATIONS, ROWS, write_room, write_sequence  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

from deworldsg_ros.cli.app import app  # noqa: E402
from deworldsg_ros.graph.graph_files import read_graph  # noqa: E402

SAVERS = {"vjepa2": save_vjepa2, "dinov2": save_dinov2}
ROWS_OF_MODELS = {"d": "dinov2", "e": "vjepa2"}


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def training_rooms(root: Path) -> Path:
    """A data set with two training scans."""
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    write_dataset(root, {scan: (objects, RELATIONS) for scan in ("a", "b")}, split_scans=[])
    (root / "ReplicaSSG" / "train_scans.txt").write_text("a\nb\n")
    for scan in ("a", "b"):
        sequence = write_sequence(root / "data" / scan) / "sequence"
        for number in range(3):
            lines = [f"{i} {x1} {ROWS[0]} {x2 - 1} {ROWS[1] - 1}" for i, _, x1, x2 in BLOCKS]
            (sequence / f"frame-{number:06d}.bb.txt").write_text("\n".join(lines))
    return root


@pytest.fixture(scope="module")
def probed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path]]:
    """Checkpoint and trained probe of each world model."""
    root = tmp_path_factory.mktemp("probed")
    rooms = training_rooms(root / "rooms")
    (root / "names.txt").write_text("\n".join(PREDICATES))
    found = {}
    for name, save in SAVERS.items():
        checkpoint, probe = save(root / name), root / f"probe_{name}"
        run(
            *("train-probe", rooms, "--out", probe, "--world-model", name, "--model", checkpoint),
            *("--predicates", root / "names.txt", "--epochs", 2, "--device", "cpu"),
        )
        found[name] = (checkpoint, probe)
    return found


def test_the_ablation_runs_with_world_models_of_clips(
    probed: dict[str, tuple[Path, Path]], tmp_path: Path
) -> None:
    room = write_room(tmp_path / "rooms")
    settings = []
    for row, name in ROWS_OF_MODELS.items():
        checkpoint, probe = probed[name]
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
    for name in ROWS_OF_MODELS:
        edges = read_graph(tmp_path / "out" / name / "room_0").edges
        directions = {(edge.subject, edge.object) for edge in edges}
        # Eq. 10 completes the direction that no frame has seen.
        assert directions == {pair[::-1] for pair in directions}
        assert {edge.provenance for edge in edges} >= {"prior"}
        assert len(edges) > len(without)
