"""Tables of methods: jobs that are kept and resumed, processes, a cluster, the command."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest
from support.evaluation import write_predictions
from support.sequences import write_room
from typer.testing import CliRunner, Result

from deworldsg_ros.checkpoints.cards import BackboneIdentity, ProbeCard, write_probe_card
from deworldsg_ros.cli.app import app
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.config import Config, MergingConfig, load_config
from deworldsg_ros.evaluation import tables
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice
from deworldsg_ros.evaluation.pose_sources import KINDS, PoseSource, repose
from deworldsg_ros.evaluation.rows import (
    ABLATION_3DSSG,
    MAIN_3DSSG,
    POSE_REPLICA,
    REPLICA_TEST_SCANS,
    RUNTIME_MS,
    SWITCHES,
    TABLES,
    Configurations,
    table_rows,
)
from deworldsg_ros.evaluation.runner import ScanTask, to_prediction
from deworldsg_ros.evaluation.scoring import ProtocolOptions
from deworldsg_ros.evaluation.tables import (
    Job,
    fingerprint,
    paper_rows,
    run_job,
    run_jobs,
    total_ms,
)
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.errors import EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("rooms") / "data_set")


# Every row has the default configuration.
UNCHANGED = Configurations(lambda file, settings, row: Config(), Config())


def job(root: Path, out: Path, scan: str = "room_0", **changes: object) -> Job:
    task = ScanTask(
        root,
        "replica",
        scan,
        out,
        Config(),
        FrontEndChoice("recorded"),
        ProtocolOptions(),
    )
    return Job("row", replace(task, **changes))


def evaluate(root: Path, kind: str, *arguments: object) -> Result:
    inputs = ["--layout", "replica", root, "--front-end", "recorded"]
    words = ["evaluate", "table", kind, *inputs, *arguments]
    return CliRunner().invoke(app, [str(word) for word in words])


def test_the_result_of_a_finished_job_is_reused(root: Path, tmp_path: Path) -> None:
    first = run_job(job(root, tmp_path, method="fross"))
    assert first.outcome is not None
    assert not first.reused
    again = run_job(job(root, tmp_path, method="fross"))
    assert again.reused
    assert again.outcome == first.outcome
    assert not run_job(replace(job(root, tmp_path, method="fross"), fresh=True)).reused


def test_a_job_runs_again_if_its_inputs_differ(root: Path, tmp_path: Path) -> None:
    run_job(job(root, tmp_path))
    other = msgspec.structs.replace(Config(), merging=MergingConfig(overlap_threshold=0.4))
    assert not run_job(job(root, tmp_path, config=other)).reused
    assert run_job(job(root, tmp_path, config=other)).reused
    assert not run_job(job(root, tmp_path)).reused
    # A result that was not written to its end, and one whose graph is gone.
    kept = tmp_path / "room_0" / "outcome.json"
    kept.write_bytes(kept.read_bytes()[:100])
    assert not run_job(job(root, tmp_path)).reused
    (tmp_path / "room_0" / "scene_graph.json").unlink()
    assert not run_job(job(root, tmp_path)).reused


def test_the_fingerprint_is_independent_of_the_folder(root: Path, tmp_path: Path) -> None:
    known = fingerprint(job(root, tmp_path).task)
    assert fingerprint(job(root, tmp_path / "elsewhere").task) == known
    for changes in (
        {"method": "kim"},
        {"max_frames": 2},
        {"poses": PoseSource("perturbed")},
        {"front_end": FrontEndChoice("recorded", flip=0.1)},
        {"options": ProtocolOptions(skip_no_rel_objects=True)},
        {"layout": "3rscan"},
    ):
        assert fingerprint(job(root, tmp_path, **changes).task) != known, changes


def test_a_failed_scan_does_not_stop_the_rest(root: Path, tmp_path: Path) -> None:
    jobs = [job(root, tmp_path, scan="room_9"), job(root, tmp_path)]
    results = list(run_jobs(jobs, workers=1))
    assert [result.outcome is None for result in results] == [True, False]
    assert "room_9" in results[0].failure


def test_the_traceback_of_an_unexpected_error_is_saved(root: Path, tmp_path: Path) -> None:
    result = run_job(job(root, tmp_path, options=None))
    assert "AttributeError" in result.failure
    assert "Traceback" in (tmp_path / "room_0" / "error.txt").read_text()


class Deadly:
    """Ends the process that unpickles it."""

    def __reduce__(self) -> object:
        return os._exit, (7,)


@pytest.mark.timeout(300)
def test_processes_give_the_same_results_and_survive_a_crash(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    deadly = job(root, tmp_path / "deadly", scan="deadly", config=Deadly())
    jobs = [job(root, tmp_path / "fross", method="fross"), deadly, job(root, tmp_path / "kim")]
    results = {result.scan: result for result in run_jobs(jobs, workers=2)}
    assert results["deadly"].failure == tables.DIED
    expected = run_job(job(root, tmp_path / "here"))
    assert results["room_0"].outcome is not None
    assert expected.outcome is not None
    assert results["room_0"].outcome.result.object_ranks == expected.outcome.result.object_ranks
    graphs = [tmp_path / name / "room_0" / "scene_graph.json" for name in ("kim", "here")]
    assert graphs[0].read_bytes() == graphs[1].read_bytes()
    assert "OMP_NUM_THREADS" not in os.environ or os.environ["OMP_NUM_THREADS"] != "1"


@pytest.mark.timeout(300)
def test_a_cluster_gives_the_same_results(root: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        jobs = [job(root, tmp_path), job(root, tmp_path, scan="room_9")]
        address = cluster.scheduler_address
        results = {result.scan: result for result in run_jobs(jobs, scheduler=address)}
    assert results["room_0"].outcome is not None
    assert results["room_0"].outcome.result.object_ranks == [0, 0, 0]
    assert results["room_9"].outcome is None


def test_a_scheduler_without_dask_is_refused_with_the_package_to_install(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(EvaluationError, match="pip install distributed"):
        list(run_jobs([job(root, tmp_path)], scheduler="tcp://nowhere:1"))


def test_the_main_table(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    # One of the methods' graphs, as if it were another method's predictions.
    run_job(job(root, tmp_path / "before"))
    graph = read_graph(tmp_path / "before" / "room_0")
    vocabulary = Vocabulary(("book", "chair", "table"), ("near", "on", "under"))
    write_predictions(tmp_path / "p.json", {"room_0": to_prediction(graph, vocabulary)}, 3, 3)
    arguments = (
        *("main", "--workers", 1, "--checkpoints", 0),
        *("--out", out, "--json", tmp_path / "t.json"),
        *("--predictions", f"SGFN={tmp_path / 'p.json'}"),
    )
    result = evaluate(root, *arguments)
    assert result.exit_code == 0, result.output
    values = json.loads((tmp_path / "t.json").read_text())
    rows = {row["name"]: row for row in values["rows"]}
    assert list(rows) == ["fross", "kim", "paper_rules", "default", "SGFN"]
    assert rows["paper_rules"]["title"] == "the paper's rules: recorded detections"
    assert rows["default"]["title"] == "default: recorded detections, embedded world model"
    for name in ("fross", "kim", "paper_rules", "default"):
        assert rows[name]["scan_count"] == 1
        assert not rows[name]["failed"]
        assert read_graph(out / name / "room_0").nodes
    assert rows["default"]["object_recall"] == 1.0
    assert rows["default"]["nodes_per_object"] == 1.0
    assert rows["SGFN"]["object_recall"] == 1.0
    assert rows["paper_rules"]["times_ms"].keys() == {
        "perception",
        "lifting",
        "merging",
        "relations",
    }
    # None of these rows is a method of the paper on one of its data sets.
    assert "Numbers of the paper appear only beside" in result.output
    lines = (out / "table.csv").read_text().splitlines()
    assert len(lines) == 1 + len(rows)
    assert len((out / "table.tex").read_text().splitlines()) == len(rows)
    # What was finished is not done again.
    result = evaluate(root, *arguments)
    assert "4 from before, 0 failed" in result.output


def test_the_ablation_table_reports_failed_rows(root: Path, tmp_path: Path) -> None:
    result = evaluate(
        *(root, "ablation", "--workers", 1, "--checkpoints", 0),
        *(
            "--out",
            tmp_path,
            "--json",
            tmp_path / "t.json",
            "--set",
            "a:lifting.covariance_ridge_m2=0.5",
        ),
    )
    assert result.exit_code == 0, result.output
    values = json.loads((tmp_path / "t.json").read_text())
    rows = {row["name"]: row for row in values["rows"] if not row["printed"]}
    assert [rows[name]["scan_count"] for name in "abcde"] == [1, 1, 1, 0, 0]
    assert rows["e"]["failed"]["room_0"]
    assert "failed:" in result.output
    effective = (tmp_path / "a" / "room_0" / "config.yaml").read_text()
    assert "pixels: box" in effective
    assert "covariance_ridge_m2: 0.5" in effective
    effective = (tmp_path / "c" / "room_0" / "config.yaml").read_text()
    assert "pixels: refined" in effective
    assert "covariance_ridge_m2: 1.0e-06" in effective


def test_the_pose_table(root: Path, tmp_path: Path) -> None:
    result = evaluate(
        *(root, "pose", "--workers", 1, "--checkpoints", 0, "--poses", "slam"),
        *("--poses", "perturbed", "--pose-noise", "jitter_m=0.0001"),
        *("--out", tmp_path, "--json", tmp_path / "t.json"),
    )
    assert result.exit_code == 0, result.output
    values = json.loads((tmp_path / "t.json").read_text())
    rows = {row["name"]: row for row in values["rows"] if not row["printed"]}
    assert rows["default-perturbed"]["object_recall"] == 1.0
    assert "slam.pose.txt" in rows["default-slam"]["failed"]["room_0"]


def test_the_tables_of_hard_input_and_of_switches(root: Path, tmp_path: Path) -> None:
    for table, name in (("hard", "default-jitter"), ("switches", "hidden-label")):
        result = evaluate(
            *(root, table, "--workers", 1, "--checkpoints", 0, "--max-frames", 2),
            *("--out", tmp_path / table, "--json", tmp_path / "t.json"),
        )
        assert result.exit_code == 0, result.output
        rows = {row["name"]: row for row in json.loads((tmp_path / "t.json").read_text())["rows"]}
        assert name in rows
        assert len(rows) == {"hard": 24, "switches": 5 * len(SWITCHES)}[table]
        assert not any(row["failed"] for row in rows.values())
        assert ("merging ms" in result.output) == (table == "switches")


def test_each_condition_applies_to_its_rows() -> None:
    front_end = FrontEndChoice("recorded", flip=0.1, miss=0.2)
    poses = [PoseSource("odometry")]
    hard = {row.name: row for row in table_rows("hard", poses, front_end, UNCHANGED)}
    assert hard["fross-plain"].front_end == front_end
    assert hard["fross-plain"].poses == poses[0]
    assert hard["paper_rules-label"].front_end == replace(front_end, faults=Faults(label=0.1))
    assert hard["paper_rules-jitter"].front_end == front_end
    assert hard["paper_rules-jitter"].poses.noise.jitter_deg == 1.0
    switches = {row.name: row for row in table_rows("switches", poses, front_end, UNCHANGED)}
    assert switches["default-flip0"].front_end == replace(front_end, flip=0.0)
    assert switches["default-label"].front_end.flip == 0.1


def test_the_runtime_table_names_the_device(root: Path, tmp_path: Path) -> None:
    result = evaluate(
        *(root, "runtime", "--checkpoints", 0),
        *("--out", tmp_path, "--json", tmp_path / "t.json"),
    )
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "t.json").read_text())["rows"]
    assert all(row["device"] and total_ms(row["times_ms"]) > 0 for row in rows)
    assert "milliseconds" in result.output


def configurations(root_dir: Path, tmp_path: Path, settings: Sequence[str] = ()) -> Configurations:
    """The shipped files; the checkpoints of paper.yaml are empty folders, which pass for them."""
    folders = [
        f"{name}={tmp_path}"
        for name in (
            *("perception.detector_path", "perception.segmenter_path"),
            *("relations.world_model_path", "relations.probe_path"),
        )
    ]

    def configure(file: str, own: Sequence[str], row: str) -> Config:
        given = [*folders, "perception.threads=1", *own, *settings]
        return effective_config(root_dir / "config" / f"{file}.yaml", given)

    return Configurations(configure, load_config(root_dir / "config" / "paper.yaml"))


def test_rows_with_the_papers_networks_are_named_and_compared_with_the_paper(
    root_dir: Path, tmp_path: Path
) -> None:
    backend, files = FrontEndChoice("backend"), configurations(root_dir, tmp_path)
    rows = {row.name: row for row in table_rows("main", [PoseSource()], backend, files)}
    assert {name: row.printed for name, row in rows.items()} == {
        "fross": "FROSS",
        "kim": "Kim et al.",
        "paper": "DeWorldSG",
        "default": "",
    }
    assert rows["paper"].title == "DeWorldSG: RT-DETR, SAM 2, EGTR, V-JEPA 2"
    assert rows["fross"].title == "FROSS (own code): RT-DETR, EGTR"
    assert rows["default"].title.startswith("default: NanoDet, RGB-D masks, geometric relations")
    ablation = table_rows("ablation", [PoseSource()], backend, files)
    assert [row.printed for row in ablation] == [
        *("", "(b) + masks", "(c) + depth refinement", "(d) + DINOv2", "(e) + V-JEPA 2")
    ]
    poses = [PoseSource(kind) for kind in KINDS]
    posed = {row.name: row.printed for row in table_rows("pose", poses, backend, files)}
    assert posed["paper-ground-truth"] == "DeWorldSG"
    assert posed["fross-slam"] == "FROSS, estimated poses"
    assert posed["paper-odometry"] == posed["paper-perturbed"] == ""


@pytest.mark.parametrize(("inputs", "printed"), [("clip", True), ("clip_and_boxes", False)])
def test_a_probe_that_knows_the_subject_has_no_printed_row(
    root_dir: Path, tmp_path: Path, inputs: Literal["clip", "clip_and_boxes"], printed: bool
) -> None:
    files = configurations(root_dir, tmp_path)
    backbone = BackboneIdentity("vjepa2", 48, 32, 16)
    write_probe_card(tmp_path, ProbeCard(backbone, ("on",), inputs=inputs))
    rows = table_rows("ablation", [PoseSource()], FrontEndChoice("backend"), files)
    assert {row.name: bool(row.printed) for row in rows}["e"] == printed


@pytest.mark.parametrize(
    "setting",
    [
        *("lifting.tau=0.08", "merging.hellinger_threshold=0.6", "relations.fusion_alpha=1"),
        *(
            "relations.world_model=fake",
            "perception.segmenter=sam",
            "perception.score_threshold=0.5",
        ),
    ],
)
def test_a_row_with_a_changed_method_has_no_printed_row(
    root_dir: Path, tmp_path: Path, setting: str
) -> None:
    files = configurations(root_dir, tmp_path, [setting])
    rows = table_rows("main", [PoseSource()], FrontEndChoice("backend"), files)
    printed = {row.name: row.printed for row in rows}
    assert printed["paper"] == ""
    assert printed["fross"] == ("" if "score_threshold" in setting else "FROSS")


def test_without_the_papers_checkpoints_its_rules_run_on_the_embedded_perception(
    root_dir: Path, tmp_path: Path
) -> None:
    files = configurations(root_dir, tmp_path / "missing")
    rows = {row.name: row for row in table_rows("main", [PoseSource()], FrontEndChoice(), files)}
    assert list(rows) == ["fross", "kim", "paper_rules", "default"]
    title = "the paper's rules: NanoDet, RGB-D masks, geometric relations"
    assert rows["paper_rules"].title == title
    assert not any(row.printed for row in rows.values())


def test_printed_rows_are_of_the_same_data_set_and_method() -> None:
    def titles(table: str, layout: str, scans: Collection[str], *ran: str) -> list[str]:
        return [row.title for row in paper_rows(table, layout, scans, ran)]

    assert titles("main", "3rscan", {"a"}, "FROSS", "SGFN") == ["SGFN", "FROSS"]
    assert titles("main", "3rscan", {"a"}) == []
    assert titles("main", "replica", REPLICA_TEST_SCANS, "DeWorldSG") == ["DeWorldSG"]
    assert titles("main", "replica", {"rooms_0", "rooms_1"}, "DeWorldSG") == []
    assert titles("pose", "3rscan", {"a"}, "DeWorldSG") == []
    assert titles("ablation", "replica", REPLICA_TEST_SCANS, "(b) + masks") == []
    assert titles("runtime", "replica", {"a"}, "DeWorldSG") == ["DeWorldSG as printed"]
    assert titles("runtime", "replica", {"a"}) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("first",), "expected main, predictions, hard, pose, ablation, switches, runtime"),
        (("main", "--predictions", "p.json"), "expected NAME=FILE"),
        (("main", "--predictions", "IMP=none.json"), "none.json is not a file"),
        (("main", "--poses", "guessed"), "--poses guessed"),
        (("main", "--poses", "slam", "--poses", "perturbed"), "takes one --poses"),
        (("main", "--set", "best:lifting.tau=0.1"), "no row best"),
        (("main", "--set", "paper_rules:lifting.tao=0.1"), "there is no lifting.tao"),
    ],
)
def test_invalid_options_of_a_table_are_refused(
    root: Path, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    result = evaluate(root, *arguments, "--out", tmp_path)
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())


def test_a_table_without_a_finished_scan_is_an_error(root: Path, tmp_path: Path) -> None:
    result = evaluate(*(root, "main", "--scan", "room_9", "--workers", 1, "--out", tmp_path))
    assert result.exit_code == 1
    assert "failed:" in result.output


def test_names_and_titles_of_rows_are_unique_in_every_table() -> None:
    for table in TABLES:
        poses = [PoseSource(kind) for kind in KINDS]
        rows = table_rows(table, poses, FrontEndChoice("recorded"), UNCHANGED)
        assert len({row.name for row in rows}) == len(rows)
        assert len({row.title for row in rows}) == len(rows)


def test_the_printed_numbers_are_in_the_paper(shared_dir: Path) -> None:
    """Every printed row stands in the paper's source, number by number."""
    text = (shared_dir / "paper" / "deworldsg.tex").read_text(encoding="utf-8")
    for wrapper in ("\\textbf{", "}", " ", "\n"):
        text = text.replace(wrapper, "")
    every = [*MAIN_3DSSG, *POSE_REPLICA, *ABLATION_3DSSG]
    assert len(every) == 17
    for row in every:
        assert "&".join(f"{value:.1f}" for value in row.percents) in text, row
    for value in RUNTIME_MS.values():
        assert f"{value:.2f}ms" in text.replace("~", "").replace("\\", "")


def test_slam_poses_start_at_the_first_true_pose(tmp_path: Path) -> None:
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
    drops: Counter[str] = Counter()
    frames = Recording(source, Config().inputs).frames()
    posed = list(repose(frames, PoseSource("slam"), source, drops))
    assert drops == {"no_slam_pose": 1}
    np.testing.assert_allclose(posed[0].T_world_camera, true[0], atol=1e-9)
    offset = np.linalg.inv(true[0]) @ posed[2].T_world_camera
    assert offset[0, 3] == pytest.approx((np.linalg.inv(true[0]) @ true[3])[0, 3] + 0.03)
