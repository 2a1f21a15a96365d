"""Prediction files: the open format, and official pickles that may be hostile."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.evaluation import one_hot, write_predictions

from deworldsg_ros.evaluation.predictions import ScanPrediction, read_predictions
from deworldsg_ros.scene.errors import EvaluationError


def official(dtype: Any = np.float64) -> dict[str, Any]:
    return {
        "pcd": [np.arange(6, dtype=dtype).reshape(2, 3), np.zeros((0, 3)), np.ones((1, 3), ">f4")],
        "cls": np.array([one_hot(0), one_hot(1), one_hot(2)], dtype),
        "edge_index": np.array([[0, 1], [2, 0]]),
        "edge_cls": np.asfortranarray(np.array([[0.5, 0.5], [1.0, 0.0]], dtype)),
        "mean": np.zeros((3, 3)),
        "cov": None,
    }


def write_json(path: Path, scans: Any) -> Path:
    path.write_text(json.dumps({"num_classes": 3, "num_predicates": 2, "scans": scans}))
    return path


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int8])
def test_pickles_of_every_protocol(tmp_path: Path, protocol: int, dtype: Any) -> None:
    path = tmp_path / "p.pkl"
    expected = official(dtype)
    path.write_bytes(pickle.dumps({"a": expected}, protocol))
    read = read_predictions(path)["a"]
    assert read.class_scores.dtype == dtype
    assert (read.class_scores == expected["cls"]).all()
    assert (read.edges == expected["edge_index"].T).all()
    assert (read.edge_scores == expected["edge_cls"]).all()
    for points, segment in zip(read.points_world, expected["pcd"]):
        assert points.shape == segment.shape
        assert (points == segment).all()


def test_empty_scan(tmp_path: Path) -> None:
    path = tmp_path / "p.pkl"
    nothing = {
        "pcd": [],
        "cls": np.zeros((0, 3)),
        "edge_index": np.zeros((2, 0), int),
        "edge_cls": np.zeros((0, 2)),
    }
    path.write_bytes(pickle.dumps({"a": nothing}))
    assert len(read_predictions(path)["a"]) == 0
    assert (
        len(
            read_predictions(write_json(tmp_path / "p.json", {"a": {"nodes": [], "edges": []}}))[
                "a"
            ]
        )
        == 0
    )


class Hostile:
    """Runs a command when it is unpickled in the ordinary way."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("index", ["top", "value", "dtype", "key"])
def test_a_pickle_cannot_run_anything(tmp_path: Path, index: str) -> None:
    marker = tmp_path / "ran"
    hostile = Hostile(Path.touch, marker)
    content: Any = {
        "top": hostile,
        "value": {"a": {**official(), "mean": hostile}},
        "dtype": {"a": {**official(), "mean": Hostile(np.dtype, hostile)}},
        "key": {"a": {**official(), "mean": [{(1, 2): [hostile]}]}},
    }[index]
    path = tmp_path / "p.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(EvaluationError, match="refused"):
        read_predictions(path)
    assert not marker.exists()
    pickle.loads(path.read_bytes())
    assert marker.exists(), "the test itself: an ordinary reader runs it"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no pickle",
        pickle.dumps(official())[:-20],
        pickle.dumps(np.array([{"an": "object"}], object)),
        pickle.dumps(np.array(["text"])),
        pickle.dumps({1, 2}),
        pickle.dumps(Path("x")),
        pickle.dumps(eval),
        # A BUILD that sets attributes of what a name stands for.
        b"cnumpy.core.multiarray\n_reconstruct\n(N}S'x'\nI1\nstb.",
        b"cnumpy\nndarray\n(N}S'name'\nS'dtype'\nstb.",
    ],
)
def test_other_content_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "p.pkl"
    path.write_bytes(content)
    with pytest.raises(EvaluationError, match=r"p\.pkl"):
        read_predictions(path)


def test_an_array_that_claims_more_than_it_has_is_refused(tmp_path: Path) -> None:
    content = pickle.dumps({"a": official()}, 2).replace(b"K\x02K\x03\x86", b"K\x7fK\x03\x86")
    path = tmp_path / "p.pkl"
    path.write_bytes(content)
    with pytest.raises(EvaluationError, match="expected"):
        read_predictions(path)


def test_open_format(tmp_path: Path) -> None:
    scan = {
        "nodes": [
            {"id": 5, "class_index": 2, "points": [[0, 0, 0]]},
            {"id": 3, "class_probabilities": [0.1, None, 0.2], "points": []},
        ],
        "edges": [
            {"subject": 3, "object": 5, "predicate_probabilities": [0.5, 0.5]},
            {"subject": 3, "object": 9, "predicate_probabilities": [float("nan"), 0.5]},
        ],
    }
    read = read_predictions(write_json(tmp_path / "p.json", {"a": scan}))["a"]
    assert read.edges.tolist() == [[1, 0], [1, 2]]
    assert read.class_scores[0].tolist() == [0, 0, 1]
    assert np.isnan(read.class_scores[1, 1])
    assert np.isnan(read.edge_scores[1, 0])
    assert [len(points) for points in read.points_world] == [1, 0]
    assert len(read.notes) == 1


@pytest.mark.parametrize(
    ("node", "edge", "expected"),
    [
        ({"class_index": 3, "points": []}, None, "from 0 to 2"),
        ({"class_probabilities": [1.0], "points": []}, None, "expected 3"),
        ({"points": []}, None, "class_index"),
        ({"class_index": 0, "points": [[1, 2]]}, None, r"\(n, 3\)"),
        ({"class_index": 0, "points": []}, {"subject": -1, "object": 0}, "expected 0 or more"),
    ],
)
def test_open_format_errors_state_the_expected_value(
    tmp_path: Path, node: Any, edge: Any, expected: str
) -> None:
    edges = [{**edge, "predicate_probabilities": [1.0, 0.0]}] if edge else []
    path = write_json(tmp_path / "p.json", {"scan 7": {"nodes": [node], "edges": edges}})
    with pytest.raises(EvaluationError, match=expected) as error:
        read_predictions(path)
    assert "scan 7" in str(error.value)


def test_negative_nodes_of_a_pickle_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.pkl"
    path.write_bytes(
        pickle.dumps({"a": {**official(), "edge_index": np.array([[-1, 0], [-1, 1]])}})
    )
    with pytest.raises(EvaluationError, match="expected 0 or more"):
        read_predictions(path)


def test_round_trip(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    expected = ScanPrediction(
        (generator.normal(size=(4, 3)), np.zeros((0, 3))),
        generator.random((2, 3)),
        np.array([[1, 0]]),
        generator.random((1, 2)),
    )
    path = tmp_path / "p.json"
    write_predictions(path, {"a": expected}, 3, 2)
    read = read_predictions(path)["a"]
    assert (read.class_scores == expected.class_scores).all()
    assert (read.edge_scores == expected.edge_scores).all()
    assert (read.edges == expected.edges).all()
    assert (read.points_world[0] == expected.points_world[0]).all()
