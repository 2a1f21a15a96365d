"""Prediction files: the open format, and official pickles that may be hostile."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from support.evaluation import one_hot

from deworldsg_ros.evaluation.predictions import read_predictions
from deworldsg_ros.scene.errors import EvaluationError


def official(dtype=np.float64, **changes):
    return {
        "pcd": [np.arange(6, dtype=dtype).reshape(2, 3), np.zeros((0, 3)), np.ones((1, 3), ">f4")],
        "cls": np.array([one_hot(0), one_hot(1), one_hot(2)], dtype),
        "edge_index": np.array([[0, 1], [2, 0]]),
        "edge_cls": np.asfortranarray(np.array([[0.5, 0.5], [1.0, 0.0]], dtype)),
        "mean": np.zeros((3, 3)),
        "cov": None,
        **changes,
    }


def read(path, content):
    """Predictions in a pickle (bytes) or in the open format (scans)."""
    if not isinstance(content, bytes):
        content = {"num_classes": 3, "num_predicates": 2, "scans": content}
        content = json.dumps(content).encode()
    path.write_bytes(content)
    return read_predictions(path)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int8])
def test_pickles_of_every_protocol(tmp_path, protocol, dtype):
    expected = official(dtype)
    found = read(tmp_path / "p.pkl", pickle.dumps({"a": expected}, protocol))["a"]
    assert found.class_scores.dtype == dtype
    assert (found.class_scores == expected["cls"]).all()
    assert (found.edges == expected["edge_index"].T).all()
    assert (found.edge_scores == expected["edge_cls"]).all()
    for points, segment in zip(found.points_world, expected["pcd"]):
        assert points.shape == segment.shape and (points == segment).all()
    none = {name: expected[name][:0] for name in ("pcd", "cls", "edge_cls")}
    none["edge_index"] = np.zeros((2, 0), int)
    assert len(read(tmp_path / "p.pkl", pickle.dumps({"a": none}, protocol))["a"]) == 0


class Hostile:
    """Runs a command when it is unpickled in the ordinary way."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("place", ["top", "value", "dtype", "key"])
def test_a_pickle_cannot_run_anything(tmp_path, place):
    marker = tmp_path / "ran"
    hostile = Hostile(Path.touch, marker)
    content = {
        "top": hostile,
        "value": {"a": official(mean=hostile)},
        "dtype": {"a": official(mean=Hostile(np.dtype, hostile))},
        "key": {"a": official(mean=[{(1, 2): [hostile]}])},
    }[place]
    with pytest.raises(EvaluationError, match="refused"):
        read(tmp_path / "p.pkl", pickle.dumps(content))
    assert not marker.exists()
    pickle.loads((tmp_path / "p.pkl").read_bytes())
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
        # An array that claims more than it has.
        pickle.dumps({"a": official()}, 2).replace(b"K\x02K\x03\x86", b"K\x7fK\x03\x86"),
        # A node below 0.
        pickle.dumps({"a": official(edge_index=np.array([[-1, 0], [-1, 1]]))}),
    ],
)
def test_other_content_is_refused(tmp_path, content):
    with pytest.raises(EvaluationError, match=r"p\.pkl"):
        read(tmp_path / "p.pkl", content)


def test_open_format(tmp_path):
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
    found = read(tmp_path / "p.json", {"a": scan})["a"]
    assert found.edges.tolist() == [[1, 0], [1, 2]]
    assert found.class_scores[0].tolist() == [0, 0, 1]
    assert np.isnan(found.class_scores[1, 1]) and np.isnan(found.edge_scores[1, 0])
    assert [len(points) for points in found.points_world] == [1, 0]
    assert len(found.notes) == 1
    assert len(read(tmp_path / "p.json", {"a": {"nodes": [], "edges": []}})["a"]) == 0


@pytest.mark.parametrize(
    ("node", "edges", "expected"),
    [
        ({"class_index": 3, "points": []}, [], "from 0 to 2"),
        ({"class_probabilities": [1.0], "points": []}, [], "expected 3"),
        ({"points": []}, [], "class_index"),
        ({"class_index": 0, "points": [[1, 2]]}, [], r"\(n, 3\)"),
        ({"class_index": 0, "points": []}, [{"subject": -1, "object": 0}], "0 or more"),
    ],
)
def test_a_bad_entry_of_the_open_format_is_refused_with_its_scan(tmp_path, node, edges, expected):
    edges = [{**edge, "predicate_probabilities": [1.0, 0.0]} for edge in edges]
    with pytest.raises(EvaluationError, match=expected) as error:
        read(tmp_path / "p.json", {"scan 7": {"nodes": [node], "edges": edges}})
    assert "scan 7" in str(error.value)
