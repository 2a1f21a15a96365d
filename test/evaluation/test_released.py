"""From the released prediction files to the printed table, with made-up files of their layout."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from support.evaluation import one_hot, segment, write_dataset
from typer.testing import CliRunner, Result

from deworldsg_ros.cli.app import app
from deworldsg_ros.config import load_config, to_mapping
from deworldsg_ros.evaluation.rows import REPLICA_TEST_SCANS

SCAN = ((("chair", 1), ("table", 2)), ((1, 2, "near"),))


def write_released(path: Path, scans: list[str], right: int) -> Path:
    """Predictions with the right classes in the first `right` scans, as the release stores them."""
    content = {}
    for number, scan in enumerate(scans):
        chair = one_hot(1 if number < right else 0)
        content[scan] = {
            "pcd": [segment(1).astype(np.float32), segment(2).astype(np.float32)],
            "cls": np.array([chair, one_hot(2)], np.float32),
            "edge_index": np.array([[0], [1]]),
            "edge_cls": np.array([one_hot(0)], np.float32),
        }
    path.write_bytes(pickle.dumps(content))
    return path


def table(root: Path, layout: str, file: Path, out: Path, name: str = "DeWorldSG") -> Result:
    words = ["evaluate", "table", "predictions", root, "--layout", layout, "--out", out]
    words += ["--predictions", f"{name}={file}", "--json", out / "t.json"]
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize(
    ("layout", "scans", "printed"),
    [
        ("3rscan", ["scan_a", "scan_b"], {"relationship_recall": 0.502, "object_recall": 0.75}),
        ("replica", sorted(REPLICA_TEST_SCANS), {"relationship_recall": 0.382}),
    ],
)
def test_one_command_prints_the_file_below_the_row_of_the_paper(
    tmp_path: Path, layout: str, scans: list[str], printed: dict[str, float]
) -> None:
    root = write_dataset(tmp_path / "data", dict.fromkeys(scans, SCAN), layout=layout)
    out = tmp_path / "out"
    out.mkdir()
    file = write_released(tmp_path / "deworldsg_predictions.pkl", scans, len(scans) - 1)
    result = table(root, layout, file, out)
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row for row in json.loads((out / "t.json").read_text())["rows"]}
    assert list(rows) == ["printed DeWorldSG", "DeWorldSG"]
    assert rows["printed DeWorldSG"].items() >= printed.items()
    expected = (len(scans) - 1) / len(scans)
    assert rows["DeWorldSG"]["relationship_recall"] == pytest.approx(expected)
    assert rows["DeWorldSG"]["predicate_recall"] == 1.0
    assert (out / "table.csv").is_file() and (out / "table.tex").is_file()


def test_a_method_that_the_paper_does_not_print_has_no_printed_row(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data", {"scan_a": SCAN}, layout="3rscan")
    (tmp_path / "out").mkdir()
    file = write_released(tmp_path / "mine.pkl", ["scan_a"], 1)
    result = table(root, "3rscan", file, tmp_path / "out", "Mine")
    assert result.exit_code == 0
    rows = json.loads((tmp_path / "out" / "t.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["Mine"]
    assert "only beside a row of the same method" in result.output


def test_the_table_of_predictions_needs_a_file(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data", {"scan_a": SCAN}, layout="3rscan")
    words = ["evaluate", "table", "predictions", root, "--layout", "3rscan", "--out", tmp_path]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 2 and "--predictions NAME=FILE" in result.stderr


def test_released_yaml_differs_from_paper_yaml_in_what_options_can_say(root_dir: Path) -> None:
    paper, released = (
        to_mapping(load_config(root_dir / "config" / name))
        for name in ("paper.yaml", "released.yaml")
    )
    different = {
        f"{section}.{field}": value
        for section, values in released.items()
        for field, value in values.items()
        if value != paper[section][field]
    }
    assert different == {
        "perception.segmenter": "sam3",
        "perception.segmenter_path": "./models/sam3",
        "relations.entropy_threshold_nats": 0.0,
    }
