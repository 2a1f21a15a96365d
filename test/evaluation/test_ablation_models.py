"""Ablation (d) and (e) with tiny world models of clips, and probes with random weights."""

import json

import pytest

pytest.importorskip("torch")
pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from support.checkpoints import config_of, save_dinov2, save_vjepa2, torch  # noqa: E402  after the guards
from support.cli import printed  # noqa: E402
from support.evaluation import PREDICATES  # noqa: E402
from support.sequences import write_room  # noqa: E402

from deworldsg_ros.checkpoints.cards import ProbeCard  # noqa: E402
from deworldsg_ros.checkpoints.probe_network import Probe, build_network, save_probe  # noqa: E402
from deworldsg_ros.graph.graph_files import read_graph  # noqa: E402
from deworldsg_ros.relations import clip_models  # noqa: E402

ROWS = {
    "d": ("dinov2", save_dinov2, clip_models.load_dinov2),
    "e": ("vjepa2", save_vjepa2, clip_models.load_vjepa2),
}


def test_the_ablation_runs_with_world_models_of_clips(tmp_path):
    settings = []
    for row, (name, save, load) in ROWS.items():
        model, probe = save(tmp_path / name), tmp_path / f"probe_{name}"
        torch.manual_seed(0)
        card = ProbeCard(load(config_of(name, model, clip_length=16)).identity, PREDICATES)
        save_probe(probe, Probe(card, build_network(card).eval()))
        settings += ["--set", f"{row}:relations.world_model_path={model}"]
        settings += ["--set", f"{row}:relations.probe_path={probe}"]
    printed(
        *("evaluate", "table", "ablation", "--layout", "replica", write_room(tmp_path / "rooms")),
        *("--front-end", "recorded", "--workers", 1, "--checkpoints", 0),
        *("--out", tmp_path / "out", "--json", tmp_path / "table.json", *settings),
    )
    values = json.loads((tmp_path / "table.json").read_text())
    rows = {row["name"]: row for row in values["rows"] if not row["printed"]}
    assert [rows[name]["scan_count"] for name in "abcde"] == [1] * 5
    without = read_graph(tmp_path / "out" / "c" / "room_0").edges
    assert {edge.provenance for edge in without} == {"visual"}
    for name in ROWS:
        edges = read_graph(tmp_path / "out" / name / "room_0").edges
        directions = {(edge.subject, edge.object) for edge in edges}
        # Eq. 10 completes the direction that no frame has seen.
        assert directions == {pair[::-1] for pair in directions}
        assert {edge.provenance for edge in edges} >= {"prior"}
        assert len(edges) > len(without)
