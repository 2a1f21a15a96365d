"""From the released prediction files to the printed table, with made-up files of their layout."""

import json
import pickle

import numpy as np
import pytest
from support.evaluation import one_hot, segment, write_dataset
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.evaluation.rows import REPLICA_TEST_SCANS

SCAN = ((("chair", 1), ("table", 2)), ((1, 2, "near"),))


def write_released(path, scans, right):
    """Predictions with the right classes in the first `right` scans, as the release stores them."""
    content = {
        scan: {
            "pcd": [segment(1).astype(np.float32), segment(2).astype(np.float32)],
            "cls": np.array([one_hot(1 if number < right else 0), one_hot(2)], np.float32),
            "edge_index": np.array([[0], [1]]),
            "edge_cls": np.array([one_hot(0)], np.float32),
        }
        for number, scan in enumerate(scans)
    }
    path.write_bytes(pickle.dumps(content))


@pytest.mark.parametrize(
    ("layout", "scans", "name", "printed"),
    [
        ("3rscan", ("a", "b"), "DeWorldSG", {"relationship_recall": 0.502, "object_recall": 0.75}),
        ("replica", tuple(REPLICA_TEST_SCANS), "DeWorldSG", {"relationship_recall": 0.382}),
        # A method that the paper does not print has no printed row.
        ("3rscan", ("a", "b"), "Mine", None),
    ],
)
def test_one_command_prints_the_file_below_the_row_of_the_paper(
    tmp_path, layout, scans, name, printed
):
    root = write_dataset(tmp_path / "data", dict.fromkeys(sorted(scans), SCAN), layout=layout)
    file, out = tmp_path / "deworldsg_predictions.pkl", tmp_path / "out"
    write_released(file, sorted(scans), len(scans) - 1)
    words = ["evaluate", "table", "predictions", root, "--layout", layout, "--out", out]
    words += ["--predictions", f"{name}={file}", "--json", out / "t.json"]
    result = CliRunner().invoke(app, [str(word) for word in words])
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
    assert (out / "table.csv").is_file() and (out / "table.tex").is_file()
