"""Tables of methods: jobs that are kept and resumed, processes, a cluster, the command."""

import json
import os
import sys
from collections import Counter
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from support.cli import invoke
from support.evaluation import one_hot, segment, write_dataset, write_predictions
from support.sequences import write_room

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard, write_probe_card
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.config import Config, MergingConfig, RelationsConfig, load_config
from deworldsg_ros.evaluation import tables
from deworldsg_ros.evaluation.front_ends import POSE_KINDS, FrontEndChoice, PoseSource, repose
from deworldsg_ros.evaluation.predictions import ScanPrediction
from deworldsg_ros.evaluation.rows import (
    ABLATION_3DSSG,
    MAIN_3DSSG,
    POSE_REPLICA,
    REPLICA_TEST_SCANS,
    RUNTIME_MS,
    SWITCHES,
    Configurations,
    paper_file,
    table_rows,
)
from deworldsg_ros.evaluation.runner import ScanTask, to_prediction
from deworldsg_ros.evaluation.scoring import ProtocolOptions
from deworldsg_ros.evaluation.tables import Job, run_job, run_jobs, total_ms
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.errors import EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary

# The kernels are compiled by the first test that runs.
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rooms") / "data_set")


def job(root, out, scan="room_0", **changes):
    choice, options = FrontEndChoice("recorded"), ProtocolOptions()
    task = ScanTask(root, "replica", scan, out, Config(), choice, options)
    return Job("row", replace(task, **changes))


def evaluate(root, kind, out, *arguments):
    words = ("evaluate", "table", kind, "--layout", "replica", root, "--front-end", "recorded")
    return invoke(*words, "--out", out, *arguments)


def table(root, kind, out, *arguments):
    """The rows that ran, by name, and the words of the command."""
    json_file = out.with_suffix(".json")
    options = ("--checkpoints", 0, "--json", json_file, *arguments)
    options += () if kind == "runtime" else ("--workers", 1)
    result = evaluate(root, kind, out, *options)
    assert result.exit_code == 0, result.output
    rows = json.loads(json_file.read_text())["rows"]
    return {row["name"]: row for row in rows if not row["printed"]}, result.output


def test_a_finished_job_is_reused_unless_its_inputs_differ(root, tmp_path):
    def reused(**changes):
        return run_job(job(root, tmp_path, **changes)).reused

    first, again = (run_job(job(root, tmp_path)) for _ in range(2))
    assert (first.reused, again.reused) == (False, True)
    assert again.outcome == first.outcome is not None
    assert not run_job(replace(job(root, tmp_path), fresh=True)).reused
    other = msgspec.structs.replace(Config(), merging=MergingConfig(overlap_threshold=0.4))
    assert [reused(config=other), reused(config=other), reused()] == [False, True, False]
    # A result that was not written to its end, and one whose graph is gone.
    kept = tmp_path / "room_0" / "outcome.json"
    kept.write_bytes(kept.read_bytes()[:100])
    assert not reused()
    (tmp_path / "room_0" / "scene_graph.json").unlink()
    assert not reused()


@pytest.mark.parametrize(
    "changes",
    [
        *({"method": "kim"}, {"max_frames": 2}, {"poses": PoseSource("perturbed")}),
        *({"front_end": FrontEndChoice("recorded", flip=0.1)}, {"layout": "3rscan"}),
        {"options": ProtocolOptions(skip_no_rel_objects=True)},
    ],
)
def test_the_fingerprint_depends_on_the_inputs_and_not_on_the_folder(root, tmp_path, changes):
    known = tables.fingerprint(job(root, tmp_path).task)
    assert tables.fingerprint(job(root, tmp_path / "elsewhere").task) == known
    assert tables.fingerprint(job(root, tmp_path, **changes).task) != known


def test_weights_that_were_replaced_at_their_path_are_another_input(root, tmp_path, monkeypatch):
    folder = tmp_path / "probe"
    config = msgspec.structs.replace(Config(), relations=RelationsConfig(probe_path=str(folder)))
    one = job(root, tmp_path / "out", config=config)

    def reused(write):
        write()
        return run_job(one).reused

    def weights(content, name="model.safetensors"):
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
        os.utime(folder / name, ns=(0, 0))  # as a copy that keeps the time

    assert [reused(lambda: None), reused(lambda: weights(b"one"))] == [False, False]
    assert [reused(lambda: weights(b"one")), reused(lambda: weights(b"two"))] == [True, False]
    assert not reused(lambda: weights(b"{}", "config.json"))
    assert reused(lambda: (folder / ".cache").mkdir())
    # Weights that are replaced during a run did not make its result.
    outcome = run_job(one).outcome
    monkeypatch.setattr(tables, "evaluate_scan", lambda task: weights(b"new") or outcome)
    assert [reused(lambda: weights(b"old")), reused(lambda: None)] == [False, False]


class Deadly:
    """Ends the process that unpickles it."""

    def __reduce__(self):
        return os._exit, (7,)


def test_processes_give_the_same_results_and_survive_a_crash(root, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    deadly = job(root, tmp_path / "deadly", scan="deadly", config=Deadly())
    jobs = [job(root, tmp_path / "fross", method="fross"), deadly, job(root, tmp_path / "there")]
    results = {result.scan: result for result in run_jobs(jobs, workers=2)}
    assert results["deadly"].failure == tables.DIED
    here, there = run_job(job(root, tmp_path / "here")).outcome, results["room_0"].outcome
    assert there.result.object_ranks == here.result.object_ranks
    graphs = [tmp_path / name / "room_0" / "scene_graph.json" for name in ("there", "here")]
    assert graphs[0].read_bytes() == graphs[1].read_bytes()
    assert os.environ.get("OMP_NUM_THREADS") != "1"


def test_a_failed_scan_does_not_stop_the_rest(root, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    jobs = [job(root, tmp_path / "a", scan="room_9"), job(root, tmp_path / "a")]
    one_by_one = list(run_jobs(jobs, workers=1))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        jobs = [replace(item, fresh=True) for item in jobs]
        on_a_cluster = list(run_jobs(jobs, scheduler=cluster.scheduler_address))
    for found in (one_by_one, on_a_cluster):
        results = {result.scan: result for result in found}
        assert results["room_9"].outcome is None and "room_9" in results["room_9"].failure
        assert results["room_0"].outcome.result.object_ranks == [0, 0, 0]
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(EvaluationError, match="pip install distributed"):
        list(run_jobs(jobs, scheduler="tcp://nowhere:1"))
    # The traceback of an unexpected error is saved.
    assert "AttributeError" in run_job(job(root, tmp_path / "b", options=None)).failure
    assert "Traceback" in (tmp_path / "b" / "room_0" / "error.txt").read_text()


def test_the_main_table(root, tmp_path):
    out = tmp_path / "out"
    # One of the methods' graphs, as if it were another method's predictions.
    run_job(job(root, tmp_path / "before"))
    graph = read_graph(tmp_path / "before" / "room_0")
    vocabulary = Vocabulary(("book", "chair", "table"), ("near", "on", "under"))
    write_predictions(tmp_path / "p.pkl", {"room_0": to_prediction(graph, vocabulary)})
    other = ("--predictions", f"SGFN={tmp_path / 'p.pkl'}")
    rows, text = table(root, "main", out, *other)
    assert list(rows) == ["fross", "kim", "paper_rules", "default", "SGFN"]
    assert rows["default"]["title"] == "default: recorded detections, embedded world model"
    for name in ("fross", "kim", "paper_rules", "default"):
        assert rows[name]["scan_count"] == 1 and not rows[name]["failed"]
        assert read_graph(out / name / "room_0").nodes
    assert rows["default"]["object_recall"] == rows["SGFN"]["object_recall"] == 1.0
    assert rows["default"]["nodes_per_object"] == 1.0
    stages = {"perception", "lifting", "merging", "relations"}
    assert rows["paper_rules"]["times_ms"].keys() == stages
    # None of these rows is a method of the paper on one of its data sets.
    assert "Numbers of the paper appear only beside" in text
    assert len((out / "table.csv").read_text().splitlines()) == 1 + len(rows)
    assert len((out / "table.tex").read_text().splitlines()) == len(rows)
    # What was finished is not done again.
    assert "4 from before, 0 failed" in table(root, "main", out, *other)[1]


def test_the_ablation_table_reports_failed_rows(root, tmp_path):
    out = tmp_path / "out"
    rows, text = table(root, "ablation", out, "--set", "a:lifting.covariance_ridge_m2=0.5")
    assert [rows[name]["scan_count"] for name in "abcde"] == [1, 1, 1, 0, 0]
    assert rows["e"]["failed"]["room_0"]
    assert "failed:" in text
    for row, pixels, ridge_m2 in (("a", "box", 0.5), ("c", "refined", 1e-6)):
        lifting = load_config(out / row / "room_0" / "config.yaml").lifting
        assert (lifting.pixels, lifting.covariance_ridge_m2) == (pixels, ridge_m2)


def test_the_tables_of_poses_and_of_the_runtime(root, tmp_path):
    noise = ("--pose-noise", "jitter_m=0.0001")
    poses = ("--poses", "slam", "--poses", "perturbed")
    rows, _ = table(root, "pose", tmp_path / "out", *poses, *noise)
    assert rows["default-perturbed"]["object_recall"] == 1.0
    assert "slam.pose.txt" in rows["default-slam"]["failed"]["room_0"]
    rows, text = table(root, "runtime", tmp_path / "out")
    assert all(row["device"] and total_ms(row["times_ms"]) > 0 for row in rows.values())
    assert "milliseconds" in text


@pytest.mark.parametrize(
    ("kind", "name", "count"),
    [("hard", "default-jitter", 24), ("switches", "hidden-label", 5 * len(SWITCHES))],
)
def test_the_tables_of_hard_input_and_of_switches(root, tmp_path, kind, name, count):
    rows, text = table(root, kind, tmp_path / "out", "--max-frames", 2)
    assert name in rows and len(rows) == count
    assert not any(row["failed"] for row in rows.values())
    assert ("merging ms" in text) == (kind == "switches")


# Every row has the default configuration.
UNCHANGED = Configurations(lambda file, settings, row: Config(), "paper", Config())
TRUE_POSES = [PoseSource()]


def rows_of(kind, poses=TRUE_POSES, files=UNCHANGED, front_end="backend"):
    return {row.name: row for row in table_rows(kind, poses, FrontEndChoice(front_end), files)}


def configurations(root_dir, tmp_path, settings=(), layout="3rscan"):
    """The shipped files; the checkpoints of the paper are empty folders, which pass for them."""
    paths = ("perception.detector", "perception.segmenter", "relations.world_model")
    given = [f"{name}_path={tmp_path}" for name in (*paths, "relations.probe")]

    def configure(file, own, row):
        changes = [*given, "perception.threads=1", *own, *settings]
        return effective_config(root_dir / "config" / f"{file}.yaml", changes)

    paper = paper_file(layout)
    return Configurations(configure, paper, load_config(root_dir / "config" / f"{paper}.yaml"))


def test_rows_with_the_papers_networks_are_named_and_compared_with_the_paper(root_dir, tmp_path):
    files = configurations(root_dir, tmp_path)
    rows = rows_of("main", files=files)
    printed = {"fross": "FROSS", "kim": "Kim et al.", "paper": "DeWorldSG", "default": ""}
    assert {name: row.printed for name, row in rows.items()} == printed
    assert rows["paper"].title == "DeWorldSG: RT-DETR, SAM 2, EGTR, V-JEPA 2"
    posed = rows_of("pose", [PoseSource(kind) for kind in POSE_KINDS], files=files)
    assert posed["paper-ground-truth"].printed == "DeWorldSG"
    assert posed["paper-odometry"].printed == posed["paper-perturbed"].printed == ""
    # ReplicaSSG has a file of its own.
    rows = rows_of("pose", files=configurations(root_dir, tmp_path, layout="replica"))
    assert rows["paper_replica-ground-truth"].printed == "DeWorldSG"
    # Without the paper's checkpoints its rules run on the embedded perception.
    rows = rows_of("main", files=configurations(root_dir, tmp_path / "missing"))
    assert list(rows) == ["fross", "kim", "paper_rules", "default"]
    assert not any(row.printed for row in rows.values())


@pytest.mark.parametrize(
    "setting",
    [
        *("lifting.tau=0.08", "merging.hellinger_threshold=0.6", "relations.fusion_alpha=1"),
        *("relations.world_model=fake", "perception.segmenter=sam"),
        "perception.score_threshold=0.5",
    ],
)
def test_a_row_with_a_changed_method_has_no_printed_row(root_dir, tmp_path, setting):
    rows = rows_of("main", files=configurations(root_dir, tmp_path, [setting]))
    assert rows["paper"].printed == ""
    assert rows["fross"].printed == ("" if "score_threshold" in setting else "FROSS")
    # Nor has one whose probe knows the subject.
    backbone = BackboneIdentity("vjepa2", 48, 32, 16)
    write_probe_card(tmp_path, ProbeCard(backbone, ("on",), inputs="clip_and_boxes"))
    assert not rows_of("ablation", files=configurations(root_dir, tmp_path))["e"].printed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("first",), "expected main, predictions, hard, pose, ablation, switches, runtime"),
        (("main", "--predictions", "p.json"), "expected NAME=FILE"),
        (("main", "--predictions", "IMP=none.json"), "none.json is not a file"),
        (("predictions",), "--predictions NAME=FILE"),
        (("main", "--poses", "guessed"), "--poses guessed"),
        (("main", "--poses", "slam", "--poses", "perturbed"), "takes one --poses"),
        (("main", "--set", "best:lifting.tau=0.1"), "no row best"),
        (("main", "--set", "paper_rules:lifting.tao=0.1"), "there is no lifting.tao"),
        # A table without a finished scan.
        (("main", "--scan", "room_9", "--workers", 1), "failed:"),
    ],
)
def test_invalid_options_of_a_table_are_refused(root, tmp_path, arguments, words):
    kind, *options = arguments
    result = evaluate(root, kind, tmp_path, *options)
    assert result.exit_code == (1 if "room_9" in options else 2)
    assert words in " ".join(result.output.split())


def test_the_printed_numbers_are_in_the_paper(shared_dir):
    text = (shared_dir / "paper" / "deworldsg.tex").read_text(encoding="utf-8")
    for wrapper in ("\\textbf{", "}", " ", "\n"):
        text = text.replace(wrapper, "")
    every = [*MAIN_3DSSG, *POSE_REPLICA, *ABLATION_3DSSG]
    assert len(every) == 17
    for row in every:
        assert "&".join(f"{value:.1f}" for value in row.percents) in text, row
    for value in RUNTIME_MS.values():
        assert f"{value:.2f}ms" in text.replace("~", "").replace("\\", "")


def released(is_right):
    """A prediction with the right classes or one wrong class."""
    classes = np.array([one_hot(1 if is_right else 0), one_hot(2)], np.float32)
    points = (segment(1), segment(2))
    return ScanPrediction(points, classes, np.array([[0, 1]]), np.array([one_hot(0)]))


@pytest.mark.parametrize(
    ("layout", "scans", "name", "printed"),
    [
        ("3rscan", ("a", "b"), "DeWorldSG", {"relationship_recall": 0.502, "object_recall": 0.75}),
        ("replica", tuple(REPLICA_TEST_SCANS), "DeWorldSG", {"relationship_recall": 0.382}),
        # A method that the paper does not print has no printed row.
        ("3rscan", ("a", "b"), "Mine", None),
    ],
)
def test_released_predictions_stand_below_the_row_of_the_paper(
    tmp_path, layout, scans, name, printed
):
    scan = ((("chair", 1), ("table", 2)), ((1, 2, "near"),))
    data = write_dataset(tmp_path / "data", dict.fromkeys(sorted(scans), scan), layout=layout)
    file, out = tmp_path / "deworldsg_predictions.pkl", tmp_path / "out"
    write_predictions(file, {scan: released(scan != max(scans)) for scan in sorted(scans)})
    options = ("--layout", layout, "--predictions", f"{name}={file}", "--json", out / "t.json")
    result = evaluate(data, "predictions", out, *options)
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row for row in json.loads((out / "t.json").read_text())["rows"]}
    if printed is None:
        assert list(rows) == [name]
        assert "only beside a row of the same method" in result.output
    else:
        assert list(rows) == [f"printed {name}", name]
        assert rows[f"printed {name}"].items() >= printed.items()
    assert rows[name]["relationship_recall"] == pytest.approx((len(scans) - 1) / len(scans))
    assert rows[name]["predicate_recall"] == 1.0


def test_slam_poses_start_at_the_first_true_pose(tmp_path):
    root = write_room(tmp_path / "data_set", frames=4)
    source = open_source(root / "data" / "room_0")
    true = [frame.T_world_camera for frame in Recording(source, Config().inputs).frames()]
    # A tracker that lost the second frame, whose world is its first camera.
    for number, T in enumerate(true):
        moved = np.linalg.inv(true[0]) @ T
        moved[0, 3] += 0.01 * number
        if number == 1:
            moved[:] = -np.inf
        path = root / "data" / "room_0" / "sequence" / f"frame-{number:06d}.slam.pose.txt"
        np.savetxt(path, moved)
    drops = Counter()
    frames = Recording(source, Config().inputs).frames()
    posed = list(repose(frames, PoseSource("slam"), source, drops))
    assert drops == {"no_slam_pose": 1}
    np.testing.assert_allclose(posed[0].T_world_camera, true[0], atol=1e-9)
    offset = np.linalg.inv(true[0]) @ posed[2].T_world_camera
    assert offset[0, 3] == pytest.approx((np.linalg.inv(true[0]) @ true[3])[0, 3] + 0.03)
