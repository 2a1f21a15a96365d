"""A map is data from outside: whatever it contains, it is refused with one error or is whole."""

import io
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from support.merging import VOCABULARY
from support.surfaces import CHAIR, CUP, TABLE, frame, slab

from deworldsg_ros.base.array_file import read_arrays
from deworldsg_ros.config import Config, OutputConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.relations.paper import ClassPairPrior
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

CONFIG = Config(output=OutputConfig(min_existence=0.0))
OBJECTS = [
    (slab((0, 0.7, 1), (0.5, 0.04, 0.4))[:200], TABLE),
    (slab((0.1, 0.77, 1), (0.08, 0.1, 0.08)), CUP),
    (slab((0.9, 0.25, 1), (0.4, 0.5, 0.4))[:200], CHAIR),
]

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of three nodes, with edges, votes and all of the memory of the surface rule."""
    builder = GraphBuilder(CONFIG, VOCABULARY, "world")
    for stamp in range(1, 6):
        builder.integrate(frame(stamp, *OBJECTS))
    builder.graph.add_visual(1, 2, np.ones(3), 10**8)
    builder.graph.add_visual(3, 2, np.ones(3), 10**8)
    builder.graph.add_votes(1, 2, np.ones((2, 3)) / 3)
    for node_id in (1, 2, 3):
        builder.graph.embeddings.add(node_id, np.ones(3), np.eye(4, dtype=np.float16)[0], "clip")
    path = tmp_path_factory.mktemp("map") / "good.map"
    write_map(builder, path)
    assert len(read_map(CONFIG, path).graph) == 3
    return path


def changed(name: str, change: Callable[[Any], Any]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {**arrays, name: change(arrays[name].copy())}


def put(place: Any, value: Any) -> Callable[[Any], Any]:
    """Overwrite a part of an array."""

    def change(array: Any) -> Any:
        array[place] = value
        return array

    return change


def field(name: str, place: Any, value: Any) -> Callable[[Arrays], Arrays]:
    """Overwrite a field of the records."""

    def change(array: Any) -> Any:
        array[name][place] = value
        return array

    return changed("merging.records", change)


def as_json(content: Any) -> Any:
    return np.frombuffer(msgspec.json.encode(content), np.uint8)


LABEL = {"id": 1, "kind": "set_label", "stamp_ns": 1, "nodes": [1], "label": "pot"}


def edit(**values: Any) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {**arrays, "edits": as_json([{**LABEL, **values}])}


def header(**values: Any) -> Callable[[Arrays], Arrays]:
    def change(array: Any) -> Any:
        return as_json({**msgspec.json.decode(array.tobytes()), **values})

    return changed("header", change)


ATTACKS: dict[str, Callable[[Arrays], Arrays]] = {
    # Each of these ended the process, or hung it, before maps were checked.
    **{
        f"no {name}": lambda arrays, name=name: {k: v for k, v in arrays.items() if k != name}
        for name in ("merging.records", "merging.blocks", "ids", "header")
    },
    "blocks are shorter than their counts": changed("merging.blocks", lambda a: a[:-5]),
    "counts of 2^31": changed("merging.block_counts", put(0, 2**31)),
    "counts of 2^62, whose sum overflows to the right one": changed(
        "merging.block_counts", lambda a: a + np.array([2**62, 2**62, 2**63 - 1])[: len(a)]
    ),
    "negative counts": changed("merging.block_counts", lambda a: a + np.array([-9999, 9999, 0])),
    "masks are shorter": changed("merging.masks", lambda a: a[:-1]),
    "scores are shorter": changed("merging.scores", lambda a: a[:-1]),
    "blocks as int8": changed("merging.blocks", lambda a: a.astype(np.int8)),
    "masks as float64": changed("merging.masks", lambda a: a.astype(np.float64)),
    "all ids 0": changed("ids", lambda a: a * 0),
    "successors in a circle": lambda arrays: {
        **header(next_id=99)(arrays),
        "successors": np.array([[10, 11], [11, 12], [12, 10], [13, 10]]),
    },
    "an id succeeds itself": lambda arrays: {
        **header(next_id=99)(arrays),
        "successors": np.array([[10, 10]]),
    },
    "a label beyond the classes": field("labels", (0, 0), 4),
    "a visibility beyond the table": field("view_visibility", 0, 9),
    # Each of these was believed.
    "a mean of NaN": changed("means", put((0, 0), np.nan)),
    "an infinite mean": changed("means", put((1, 2), np.inf)),
    "a covariance of 1e300": changed("covariances", lambda a: a * 1e300),
    "a covariance that is not symmetric": changed("covariances", put((0, 0, 1), 9.0)),
    "a covariance that is not positive": changed("covariances", lambda a: -a),
    "negative probabilities": changed("class_probabilities", put(0, [-1.0, 2.0, 0.0, 0.0])),
    "probabilities that sum to 2": changed("class_probabilities", put(0, 0.5)),
    "duplicate ids": changed("ids", put(1, 1)),
    "next_id below an id": header(next_id=2),
    "existence of 7": changed("existence", put(0, 7.0)),
    "a colour of NaN": changed("colours", lambda a: a * np.nan),
    "a lightness of 500": changed("colours", lambda a: a + [500.0, 0.0, 0.0, 1.0]),
    "embeddings of NaN": changed("embedding_vectors", lambda a: a * np.nan),
    "viewpoints that are not there": changed("embedding_counts", lambda a: a + 1),
    "an embedding of no node": changed("embedding_ids", put(0, 77)),
    "no observations": changed("observations", put(0, 0)),
    "a weight of 0": changed("weights", put(0, 0.0)),
    "first seen after last seen": changed("first_seen_ns", put(0, 10**18)),
    "a stamp beyond 32-bit seconds": changed("last_seen_ns", put(0, 2**62)),
    "points of NaN": changed("surface_points", put((0, 0), np.nan)),
    "points without a node": changed("surface_point_counts", put(0, 0)),
    "an edge to no node": changed("edge_pairs", put((0, 1), 77)),
    "an edge of a node with itself": changed("edge_pairs", put((0, 1), 1)),
    "the same edge twice": changed("edge_pairs", lambda a: a * 0 + a[0]),
    "edge logits of infinity": changed("edge_visual_logits", put((0, 0), np.inf)),
    "negative frames of an edge": changed("edge_counts", put((0, 0), -1)),
    "logits of an edge without frames": changed("edge_counts", put((0, 0), 0)),
    "votes of NaN": changed("vote_counts", put((0, 0, 0), np.nan)),
    "more votes than frames": changed("vote_counts", put((0, 0, 0), 99.0)),
    "votes that are not there": changed("vote_known", put((1, 1), 1)),
    "votes with more columns": changed("vote_known", lambda a: np.tile(a, 2)),
    "a live node that was removed": lambda arrays: {**arrays, "successors": np.array([[1, 0]])},
    "a joint pair of one node": changed("merging.joint", put((0, 1), 1)),
    "two records of one node": field("node_id", 1, 1),
    "a record with a score of NaN": field("best_score", 0, np.nan),
    "a record without a name": field("labels", 0, -1),
    "a record whose name has no probability": field("joint", 0, 0.0),
    "more detections than frames": field("view_detected", 0, 1e6),
    "looks that are all detections": changed("merging.looks", lambda a: a * 0 + 5.0),
    "no fates": changed("merging.fates", lambda a: a * 0),
    "more contradictions than viewpoints": changed("merging.said", lambda a: a + [1, 0]),
    "a block twice": changed("merging.blocks", lambda a: a * 0 + a[0]),
    "a block beyond space": changed("merging.blocks", put(0, -1)),
    "an empty mask": changed("merging.masks", put(0, 0)),
    "scores of -128": changed("merging.scores", put((0, 0), -128)),
    "an up direction of 1e300": changed("up", lambda a: a + 1e300),
    "an up direction of 3 numbers": changed("up", lambda a: a[:3]),
    "no priors": lambda arrays: {k: v for k, v in arrays.items() if k != "prior"},
    "priors of other classes": changed("prior", lambda a: as_json(ClassPairPrior(2, 5).to_state())),
    "priors that are no JSON": changed("prior", lambda a: a[:-3]),
    "priors nested without end": lambda arrays: {
        **arrays,
        "prior": np.frombuffer(b"[" * 100_000, np.uint8),
    },
    "a header of a list": changed("header", lambda a: np.frombuffer(b"[]", np.uint8)),
    "10^9 surface points a node": header(surface_point_capacity=10**9),
    "10^12 remembered frames": header(remembered_frames=10**12),
    # Clients would refuse the messages of its graph.
    "a class with a control character": header(classes=["a", "b\x1b[2J", "c", "d"]),
    "a class of 5000 characters": header(classes=["a", "b" * 5000, "c", "d"]),
    "a predicate with a line feed": header(predicates=["on", "near", "under\n"]),
    "a frame_id with a control character": header(frame_id="map\x1b[2J"),
    "a frame_id of 1000 characters": header(frame_id="m" * 1000),
    "10^4 classes": header(classes=list(map(str, range(10_000)))),
    "first seen before 1970": changed("first_seen_ns", put(0, -1)),
    "an edge seen before 1970": changed("edge_counts", put((0, 1), -1)),
    "frames before 1970": changed("frame_stamps_ns", put(0, -1)),
    "more surface points than a message": header(surface_point_capacity=4097),
    "ids beyond the keys of pairs": header(next_id=2**31 + 1),
    "a label that ends with a line feed": edit(label="pot\n"),
    "an edit before 1970": edit(stamp_ns=-1),
    "an edit of no kind": edit(kind="paint"),
    "an edit of no node": edit(nodes=[99]),
    "a deleted node that is published": edit(kind="delete"),
    "a merge of nodes that are published": edit(kind="merge", nodes=[3], replaced=[1, 2]),
    "a merge into two": edit(kind="merge", nodes=[1, 2]),
    "edits of nothing": lambda arrays: {**arrays, "edits": as_json([{}])},
    "frames of an unknown class": changed(
        "seen_frames", lambda a: np.frombuffer(a.tobytes().replace(b"table", b"t\\u001b"), np.uint8)
    ),
    "a version of text": header(version="1"),
    "a version to come": header(version=3),
    "no means": lambda arrays: {k: v for k, v in arrays.items() if k != "means"},
    "no fates in it": lambda arrays: {k: v for k, v in arrays.items() if k != "merging.fates"},
}

# An error names the array, the value and the expectation.
WORDS = {
    "existence of 7": "existence contains 7.0: expected 0 to 1",
    "duplicate ids": "ids contains a value twice",
    "an edit of no node": "id 99",
    "an up direction of 3 numbers": "up direction",
    "priors of other classes": "2 classes",
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_hostile_map_is_refused(good: Path, tmp_path: Path, attack: str) -> None:
    path = tmp_path / "bad.map"
    graph_files.write(path, ATTACKS[attack](graph_files.read(good)))
    with pytest.raises(ConfigurationError, match=r"map .*bad\.map cannot be used: \w+") as refused:
        read_map(CONFIG, path)
    assert WORDS.get(attack, "") in str(refused.value)
    if attack in list(WORDS)[:3]:  # a saved graph is checked as well
        with pytest.raises(RefusedInput) as refusal:
            graph_files.load(path)
        assert refusal.value.reason == "invalid_graph_file"


def test_an_edit_and_a_class_twice_are_no_attacks(good: Path, tmp_path: Path) -> None:
    arrays = edit()(graph_files.read(good))
    graph_files.write(tmp_path / "room.map", header(classes=["a", "a", "b", "c"])(arrays))
    with pytest.raises(ConfigurationError, match="classes and predicates of the graph"):
        read_map(CONFIG, tmp_path / "room.map")
    del arrays["seen_frames"]
    graph_files.write(tmp_path / "room.map", header(classes=["a", "a", "b", "c"])(arrays))
    nodes = read_map(CONFIG, tmp_path / "room.map").full().nodes
    assert [node.label for node in nodes] == ["pot", "a", "b"]


def repacked(path: Path, target: Path, change: Callable[[str, bytes], bytes], kind: int) -> Path:
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(target, "w", kind) as copy:
        for member in archive.infolist():
            copy.writestr(member.filename, change(member.filename, archive.read(member)))
    return target


def test_a_small_file_does_not_unpack_to_a_large_one(good: Path, tmp_path: Path) -> None:
    packed = io.BytesIO()
    np.save(packed, np.zeros(1 << 27, np.uint8))
    huge = packed.getvalue()
    for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        target = tmp_path / f"{kind}.map"
        repacked(good, target, lambda n, c: huge if n.startswith("ids") else c, kind)
        assert target.stat().st_size < 10**6
        with pytest.raises(ConfigurationError, match="its arrays are compressed"):
            read_map(CONFIG, target)


@pytest.mark.parametrize(
    "head",
    [
        b"{'descr': '<i8', 'fortran_order': False, 'shape': (4611686018427387904,), }",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
        b"{'descr': '<U9', 'fortran_order': False, 'shape': (3,), }",
        b"{'descr': '<i8', 'fortran_order': False, 'shape': (" + b"1, " * 60 + b"), }",
        b"(" * 9000,
        b"-" * 9000,
        b"'" + b"\n" * 10,
        b"\xff" * 30,
    ],
)
def test_headers_of_arrays_are_not_evaluated(good: Path, tmp_path: Path, head: bytes) -> None:
    head += b"\n"
    array = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(24)
    target = repacked(
        good,
        tmp_path / "bad.map",
        lambda name, content: array if name == "ids.npy" else content,
        zipfile.ZIP_STORED,
    )
    with pytest.raises(ConfigurationError, match="cannot be used: array "):
        read_map(CONFIG, target)


def test_a_flipped_bit_is_noticed(good: Path, tmp_path: Path) -> None:
    content = bytearray(good.read_bytes())
    at = content.index(graph_files.read(good)["means"].tobytes())
    content[at + 3] ^= 1
    (tmp_path / "bad.map").write_bytes(content)
    with pytest.raises(ConfigurationError, match="Bad CRC-32"):
        read_map(CONFIG, tmp_path / "bad.map")


def test_what_is_no_file_of_arrays_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.map")
    (tmp_path / "text.map").write_text("hello")
    for path, says in (
        (tmp_path / "pipe.map", "expected a"),
        (Path("/dev/zero"), "expected a"),
        (tmp_path, "expected a"),
        (tmp_path / "text.map", "text.map cannot be used"),
        (tmp_path / "absent.map", "No such file"),
    ):
        with pytest.raises(ConfigurationError, match=says):
            read_map(CONFIG, path)


def test_the_arrays_of_a_map_are_those_that_numpy_reads(good: Path) -> None:
    arrays = read_arrays(good)
    with np.load(good, allow_pickle=False) as archive:
        assert sorted(archive.files) == sorted(arrays)
        for name in archive.files:
            np.testing.assert_array_equal(arrays[name], archive[name], err_msg=name)
            assert arrays[name].flags.writeable, "kernels are compiled for writable arrays"


def test_a_map_of_the_first_release_is_read(good: Path, tmp_path: Path) -> None:
    # Its records have padding between the fields.
    arrays = graph_files.read(good)
    packed = arrays["merging.records"]
    aligned = np.dtype([(name, packed.dtype[name]) for name in packed.dtype.names], align=True)
    assert aligned.itemsize > packed.dtype.itemsize
    path = tmp_path / "old.map"
    graph_files.write(path, {**arrays, "merging.records": packed.astype(aligned)})
    write_map(read_map(CONFIG, path), tmp_path / "again.map")
    write_map(read_map(CONFIG, good), tmp_path / "new.map")
    assert (tmp_path / "again.map").read_bytes() == (tmp_path / "new.map").read_bytes()


PROGRAM = """
import sys, numpy as np
from pathlib import Path
from test_hostile_maps import CONFIG, OBJECTS, VOCABULARY, GraphBuilder, frame, write_map
np.full(1 << 20, 0xAB, np.uint8)  # other content in freed memory
builder = GraphBuilder(CONFIG, VOCABULARY, "world")
for stamp in range(1, 5):
    builder.integrate(frame(stamp, *OBJECTS))
write_map(builder, Path(sys.argv[1]))
"""


@pytest.mark.slow
def test_equal_graphs_give_equal_bytes_in_any_process(tmp_path: Path) -> None:
    folder = Path(__file__).parent
    maps = []
    for seed in ("0", "1", "random"):
        target = tmp_path / f"{seed}.map"
        path = os.pathsep.join((str(folder), str(folder.parent)))
        environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": path}
        environment |= {"NUMBA_NUM_THREADS": "1"} if seed == "0" else {}
        command = [sys.executable, "-c", PROGRAM, str(target)]
        subprocess.run(command, env=environment, check=True, timeout=100)
        maps.append(target.read_bytes())
    assert maps[0] == maps[1] == maps[2]
