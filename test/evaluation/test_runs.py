"""A scan through the pipeline and the protocol, from the command line too."""

import json
import pickle
import subprocess
import sys

import msgspec
import pytest
from support.cli import invoke, printed, refusal
from support.evaluation import write_dataset, write_json, write_predictions
from support.sequences import BLOCKS, RELATIONS, write_room, write_sequence, write_surface

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard, write_probe_card
from deworldsg_ros.config import Config, RelationsConfig, load_config
from deworldsg_ros.evaluation.front_ends import FrontEndChoice
from deworldsg_ros.evaluation.predictions import read_predictions
from deworldsg_ros.evaluation.reports import latex_text
from deworldsg_ros.evaluation.runner import (
    ScanTask,
    evaluate_graph,
    evaluate_scan,
    to_prediction,
    translate,
    translation,
    warn_of_training,
)
from deworldsg_ros.evaluation.scoring import ProtocolOptions, evaluate_predictions
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.errors import EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.wire.messages import Belief

# The objects of the small rooms are flat and apart: only frames say how they are related.
CONFIG = Config(relations=RelationsConfig(world_model="none"))


@pytest.fixture
def root(tmp_path):
    return write_room(tmp_path / "data_set")


def task(root, out, layout="replica", scan="room_0", config=CONFIG, front_end="recorded", **more):
    choice = FrontEndChoice(front_end)
    return ScanTask(root, layout, scan, out, config, choice, ProtocolOptions(), **more)


def test_every_way_to_a_result_gives_the_same_numbers(root, tmp_path):
    sent = pickle.loads(pickle.dumps(task(root, tmp_path / "out", checkpoints=2)))
    outcome = pickle.loads(pickle.dumps(evaluate_scan(sent)))
    assert outcome.frames == 3
    assert outcome.result.object_ranks == [0, 0, 0]
    assert outcome.result.relationship_ranks == [0, 0]
    assert (outcome.measures.found, outcome.measures.duplicates) == (3, 0)
    assert [item.frames for item in outcome.over_time] == [2, 3]
    assert outcome.over_time[-1].object_recall == 1.0
    # The graph that was left gives the same numbers, and so do its predictions as a file.
    annotations = Annotations(root, "replica")
    graph = read_graph(tmp_path / "out" / "room_0")
    found = evaluate_graph(annotations, "room_0", graph, ProtocolOptions())
    assert found == (outcome.result, outcome.measures)
    prediction = to_prediction(translate(graph, annotations), annotations.vocabulary)
    write_predictions(tmp_path / "p.pkl", {"room_0": prediction})
    (again,) = evaluate_predictions(annotations, read_predictions(tmp_path / "p.pkl")).scans
    assert again.matching == outcome.result.matching
    assert again.relationship_ranks == outcome.result.relationship_ranks
    assert load_config(tmp_path / "out" / "room_0" / "config.yaml") == CONFIG
    # A second run writes the same graph.
    evaluate_scan(task(root, tmp_path / "again"))
    texts = [(tmp_path / n / "room_0/scene_graph.json").read_bytes() for n in ("out", "again")]
    assert texts[0] == texts[1]


def test_labels_of_a_detector_become_classes(root, tmp_path):
    mapping = root / "ReplicaSSG" / "replica_to_visual_genome.json"
    content = json.loads(mapping.read_text())
    content["Replica2VisualGenome"] |= {"stool": "chair", "sofa": "chair", "mat": "unknown"}
    mapping.write_text(json.dumps(content))
    annotations = Annotations(root, "replica")
    names = translation(annotations)
    assert names == {"stool": "chair", "sofa": "chair", "couch": "chair", "dining table": "table"}
    evaluate_scan(task(root, tmp_path / "out"))
    graph = read_graph(tmp_path / "out" / "room_0")
    assert translate(graph, annotations).nodes is graph.nodes
    # A node without a name counts with its best guess.
    guess = graph.nodes[0].label
    unnamed = msgspec.structs.replace(graph.nodes[0], label="object", named=False)
    unnamed_graph = msgspec.structs.replace(graph, nodes=[unnamed], edges=[])
    assert translate(unnamed_graph, annotations).nodes[0].label == guess
    beliefs = [Belief("couch", 0.3), Belief("mat", 0.3), Belief("stool", 0.2), Belief("book", 0.1)]
    node = msgspec.structs.replace(graph.nodes[0], classes=beliefs, label="couch")
    foreign = msgspec.structs.replace(graph, nodes=[node], edges=[])
    translated = translate(foreign, annotations)
    assert translated.nodes[0].label == "chair"
    scores = to_prediction(translated, annotations.vocabulary).class_scores
    # book, chair, table; the rest is spread over what is not stated.
    assert scores[0].tolist() == pytest.approx([0.1, 0.5, 0.1])
    with pytest.raises(EvaluationError, match="'book'"):
        to_prediction(graph, Vocabulary(("bed",), ("near",)))


def test_rotated_images_of_3rscan_are_evaluated(tmp_path):
    objects = [(name, number) for number, name, _, _ in BLOCKS]
    root = write_dataset(tmp_path / "set", {"a": (objects, RELATIONS)}, layout="3rscan")
    write_surface(write_sequence(root / "data" / "a"))
    result = evaluate_scan(
        task(root, tmp_path / "out", "3rscan", "a", CONFIG, "ground-truth")
    ).result
    assert (result.object_ranks, result.relationship_ranks) == ([0, 0, 0], [0, 0])


def values_of(tmp_path, command, *arguments):
    json_file = tmp_path / "new" / "numbers.json"
    words = ("evaluate", command, "--layout", "replica", *arguments, "--json", json_file)
    text = printed(*words)
    return json.loads(json_file.read_text()), text


def test_command_on_a_data_set(root, tmp_path):
    out = tmp_path / "out"
    options = ("--front-end", "recorded", "--flip", 0, "--set", "relations.world_model=none")
    values, text = values_of(tmp_path, "run", root, *options, "--out", out)
    for name in ("object_recall", "predicate_recall", "relationship_recall"):
        assert values[name] == 1.0
    assert values["object_mean_recall"] == values["predicate_mean_recall"] == 1.0
    assert values["measures"]["node_precision"] == 1.0
    assert values["scans"][0]["frames"] == len(values["scans"][0]["over_time"]) == 3
    for name in ("classes.csv", "edge_scores.csv"):
        assert (out / name).stat().st_size > 0
    for name in ("confusion", "predicates", "reliability", "recall_over_time"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    # Both annotated relations are recorded in every frame.
    near, on = (values["measures"]["edges_by_predicate"][name] for name in ("near", "on"))
    # Near is stated in both directions. The small annotation has one of them.
    assert (near["relations"], near["relations_found"], near["edge_precision"]) == (1, 1, 0.5)
    assert (on["relations"], on["relations_found"], on["edge_precision"]) == (1, 1, 1.0)
    assert "edges by predicate" in text
    rows = (out / "room_0" / "edges.csv").read_text().splitlines()
    assert sorted(row.split(",")[0] for row in rows) == ["right", "right", "verdict", "wrong"]
    assert (out / "results.tex").read_text().endswith("& 100.0 & 100.0 \\\\\n")
    assert latex_text("100 % & a_b") == r"100 \% \& a\_b"
    header, first, _ = (out / "results.csv").read_text().splitlines()
    assert header.startswith("scan,object_recall") and first.startswith("room_0,1.0")


def test_command_on_graphs_and_predictions(root, tmp_path):
    out = tmp_path / "out"
    outcome = evaluate_scan(task(root, out))
    values, _ = values_of(tmp_path, "score", root, "--graphs", out)
    assert values["object_recall"] == 1.0
    assert values["measures"]["nodes"] == outcome.nodes
    (out / "room_0" / "scene_graph.json").unlink()
    words = ("evaluate", "score", "--layout", "replica", root, "--graphs", out)
    assert "cannot be read" in refusal(*words)
    path, scans = tmp_path / "p.json", {"room_0": {"nodes": [], "edges": []}}
    write_json(path, {"num_classes": 3, "num_predicates": 3, "scans": scans})
    options = ("--predictions", path, "--skip-no-rel-objects", "--out", out)
    values, _ = values_of(tmp_path, "score", root, *options)
    assert values["object_recall"] == 0.0
    assert values["counts"]["object"] == {"hits": 0, "total": 3}
    assert values["measures"]["node_precision"] is None
    assert not values["notes"]
    assert (out / "confusion.png").exists()


@pytest.mark.parametrize(
    ("command", "arguments", "expected"),
    [
        ("score", (), "none of --predictions FILE and --graphs DIR"),
        ("score", ("--predictions", "p.json", "--graphs", "out"), "both of --predictions FILE"),
        ("score", ("--predictions", "none.json"), "cannot be read"),
        ("run", ("--layout", "scannet", "--front-end", "recorded"), "replica, 3rscan"),
        ("run", ("--layout", "3rscan", "--front-end", "recorded"), "is missing"),
        ("run", ("--front-end", "video"), "backend, boxes, recorded"),
        ("run", ("--split", "train"), "has no scan"),
        ("run", ("--poses", "odometry", "--poses", "perturbed"), "has 2 --poses"),
    ],
)
def test_command_errors_state_the_expected_value(root, tmp_path, command, arguments, expected):
    out = ("--out", tmp_path / "out") if command == "run" else ()
    text = refusal("evaluate", command, root, "--layout", "replica", *out, *arguments)
    assert expected in " ".join(text.split())


def test_a_failed_scan_is_reported_and_does_not_stop_the_rest(root, tmp_path):
    split = root / "ReplicaSSG" / "test_scans.txt"
    split.write_text("absent\nroom_0\n")
    options = ("--checkpoints", 0, "--out", tmp_path / "out")
    values, text = values_of(tmp_path, "run", root, "--front-end", "ground-truth", *options)
    assert "failed: absent" in text
    assert list(values["failed"]) == ["absent"]
    assert [scan["scan"] for scan in values["scans"]] == ["room_0"]
    split.write_text("absent\n")
    words = ("evaluate", "run", "--layout", "replica", root, "--front-end", "recorded", *options)
    assert invoke(*words).exit_code == 1


def test_a_scan_of_the_training_of_the_probe_is_told(tmp_path, caplog):
    parts = {"train": ["a"], "validation": ["b"], "held_out": ["c"]}
    backbone = BackboneIdentity("vjepa2", 48, 32, 4)
    write_probe_card(tmp_path, ProbeCard(backbone, ("on",), training={"groups_by_part": parts}))
    probed = RelationsConfig(world_model="vjepa2", probe_path=str(tmp_path))
    for scan in "abcd":
        warn_of_training(probed, scan)
        warn_of_training(RelationsConfig(), scan)
    assert [message.split()[:2] for message in caplog.messages] == [["scan", "a"], ["scan", "b"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scan", "nodes", "found", "duplicates"), [("rooms_0", 134, 55, 79), ("rooms_1", 116, 45, 70)]
)
def test_the_paper_on_the_rendered_rooms(
    shared_dir, root_dir, tmp_path, scan, nodes, found, duplicates
):
    unpack = shared_dir / "data" / "rooms" / "unpack.py"
    subprocess.run([sys.executable, str(unpack), str(tmp_path / "rooms"), scan], check=True)
    config = load_config(root_dir / "config" / "paper_rules.yaml")
    outcome = evaluate_scan(
        task(tmp_path / "rooms/noisy", tmp_path / "out", scan=scan, config=config)
    )
    measured = outcome.measures
    assert (measured.nodes, measured.found, measured.duplicates) == (nodes, found, duplicates)
    assert all(ranked == 0 for ranked in outcome.result.object_ranks)
    assert measured.numbers()["centroid_error_best_median_m"] == pytest.approx(0.025, abs=0.004)
