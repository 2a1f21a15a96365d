"""What objects look like, from the frames to the nodes of the graph and to maps."""

import numpy as np
import pytest
from support.merging import VOCABULARY, local_graph, move_node

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.config import Config, MergingConfig, OutputConfig
from deworldsg_ros.graph import embeddings
from deworldsg_ros.graph.embeddings import Looks, NodeEmbeddings, embeddings_message
from deworldsg_ros.graph.graph import copy_node
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.perception.protocols import Detections, unit_embeddings
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Embeddings, LocalGraph
from deworldsg_ros.wire import messages as wire

RED, BLUE, UNKNOWN = [50.0, 60.0, 40.0], [40.0, 0.0, -50.0], [np.nan] * 3


def config_of(association: str) -> Config:
    merging = MergingConfig(association=association)
    return Config(merging=merging, output=OutputConfig(min_existence=0.0))


def frame(stamp_ns: int, *at_m: float, **changes: object) -> LocalGraph:
    """Cups of 10 cm at these places along x."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-0.05, 0.05, (200, 3)) + [0.0, 0.0, 2.0]
    points = tuple((cloud + [x_m, 0, 0]).astype(np.float32) for x_m in at_m)
    means = np.array([one.mean(axis=0) for one in points], np.float64)
    covariances = np.stack([1e-3 * np.eye(3)] * len(at_m))
    classes = np.tile([0.97, 0.01, 0.01, 0.01], (len(at_m), 1))
    return local_graph(stamp_ns, means, covariances, classes, points=points, **changes)


def colours(*rows: list[float], pixels: tuple[int, ...] = ()) -> dict[str, object]:
    counts = {"pixel_counts": np.array(pixels)} if pixels else {}
    return {"colours_lab": np.array(rows, np.float32), **counts}


@pytest.mark.parametrize("association", ["surface", "paper"])
def test_colours_are_means_over_the_pixels_of_all_frames(association, tmp_path):
    builder = GraphBuilder(config_of(association), VOCABULARY, "world")
    a, b = builder.integrate(frame(1, 0.0, 2.0))
    builder.integrate(frame(2, 0.0, 2.0, **colours(RED, UNKNOWN, pixels=(100, 100))))
    builder.integrate(frame(3, 0.0, 2.0, **colours(BLUE, UNKNOWN, pixels=(300, 100))))
    seen = {node.id: node.colour_lab for node in builder.full().nodes}
    assert seen[a] == [42.5, 15.0, -27.5] and not isinstance(seen[b], list)
    (one, other) = builder.update().nodes
    assert one.colour_lab == seen[a]

    write_map(builder, tmp_path / "room.map")
    builder = read_map(config_of(association), tmp_path / "room.map")
    builder.integrate(frame(4, 0.0, 2.0, **colours(UNKNOWN, BLUE, pixels=(100, 100))))
    graph = builder.graph
    colour = {node.id: node.colour_lab for node in builder.full().nodes}
    assert colour == {a: seen[a], b: BLUE}
    # A copy, a node that moved, and one that was merged have the colours of all their frames.
    copied = copy_node(graph, a)
    move_node(graph, copied, np.eye(4))
    graph.take_over(b, copied)
    assert graph.nodes.colours[graph.nodes.slot(b), 3] == 500
    graph.merge_nodes(a, b)
    sums = graph.nodes.colours[graph.nodes.slot(a)]
    np.testing.assert_allclose(sums[:3], 200 * np.array(RED) + 700 * np.array(BLUE))
    graph.remove_node(a)
    assert not graph.nodes.colours.any()


def test_a_colour_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="colours contain 900"):
        frame(1, 0.0, **colours([900.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="lightness -3"):
        frame(1, 0.0, **colours([-3.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"shape \(2, 3\): expected \(1, 3\)"):
        frame(1, 0.0, **colours(RED, RED))
    with pytest.raises(ValueError, match="colours contain nan"):
        frame(1, 0.0, **colours([50.0, np.nan, 0.0]))


# --- embeddings ----------------------------------------------------------------------------------

MODEL = "a/clip"


def shown(*vectors: list[float], model: str = MODEL) -> dict[str, object]:
    rows = np.arange(len(vectors))
    return {"embeddings": unit_embeddings(np.array(vectors, np.float32), rows, model)}


def around(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def add(nodes: NodeEmbeddings, node_id: int, degrees: float, vector: np.ndarray) -> None:
    unit = unit_embeddings(vector[None].astype(np.float32), np.arange(1), MODEL)
    nodes.add(node_id, 3.0 * around(degrees), unit.vectors[0], MODEL)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("viewpoints", [1, 3, 8, 12])
def test_each_viewpoint_counts_once_however_many_frames_it_has(viewpoints):
    rng = np.random.default_rng(viewpoints)
    seen = rng.normal(size=(viewpoints, 20, 16))
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    nodes, means = NodeEmbeddings(), []
    for number, frames in enumerate(seen):
        used = frames[: 1 + 4 * (number % 5)]
        for index, vector in enumerate(used):
            add(nodes, 7, 28 * number + 5 * (index % 2), vector)
        means.append(unit(used.mean(axis=0)))
    np.testing.assert_allclose(nodes.of([7])[7], unit(np.sum(means, axis=0)), atol=4e-3)
    assert len(nodes.views[7].frames) == min(viewpoints, embeddings.MAX_VIEWPOINTS + 1)
    # Nothing is lost in two halves that are merged.
    halves = NodeEmbeddings()
    for number, frames in enumerate(seen):
        for index, vector in enumerate(frames[: 1 + 4 * (number % 5)]):
            add(halves, 1 + number % 2, 28 * number + 5 * (index % 2), vector)
    halves.merge(1, 2)
    np.testing.assert_allclose(halves.of([1])[1], nodes.of([7])[7], atol=4e-3)
    assert 2 not in halves.views and 2 in halves.changed
    # Nodes that moved have turned.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    before = nodes.views[7].directions.copy()
    nodes.turn(7, turn)
    np.testing.assert_allclose(nodes.views[7].directions, before @ turn.T)


@pytest.mark.parametrize("association", ["surface", "paper"])
def test_embeddings_follow_their_nodes_into_maps_and_files(association, tmp_path):
    config = config_of(association)
    builder = GraphBuilder(config, VOCABULARY, "world")
    east, north = [5.0, 0, 0, 0], [0, 2.0, 0, 0]
    a, b, c = builder.integrate(frame(1, 0.0, 2.0, 4.0, **shown(east, [0.0] * 4, [np.nan] * 4)))
    for stamp in range(2, 5):
        builder.integrate(frame(stamp, 0.0, 2.0, **shown(east, north)))
    message = embeddings_message(builder.graph.embeddings, False, 4, "world")
    assert [node.id for node in message.nodes] == [a, b] and message.removed == []
    assert embeddings_message(builder.graph.embeddings, False, 4, "world") is None

    # Of another model: the rest of the frame is merged.
    seen = int(builder.graph.nodes.observations[builder.graph.nodes.slot(a)])
    builder.integrate(frame(5, 0.0, 2.0, **shown(north, east, model="b/clip")))
    assert list(builder.refused) == ["embedding_model_mismatch"]
    assert "'b/clip' with 4 values" in builder.refused["embedding_model_mismatch"]
    assert builder.graph.nodes.observations[builder.graph.nodes.slot(a)] == seen + 1
    assert builder.graph.embeddings.model == MODEL

    write_map(builder, tmp_path / "room.map")
    again = read_map(config, tmp_path / "room.map")
    for one in (builder, again):
        one.integrate(frame(6, 0.0, 2.0, 4.0, **shown(east, north, [0.0, 0, 1, 1])))
    for name, values in builder.graph.embeddings.arrays().items():
        np.testing.assert_array_equal(again.graph.embeddings.arrays()[name], values)

    full = builder.full()
    path = write_graph(tmp_path, full)
    embeddings.write_embeddings(path, wire.ns_from_stamp(full.stamp), builder.graph.embeddings)
    graph = SceneGraph.load(tmp_path)
    assert [(item.id, cosine) for item, cosine in graph.similar([1, 2, 0, 0], 2)] == [
        (b, pytest.approx(2 / 5**0.5, abs=1e-3)),
        (a, pytest.approx(1 / 5**0.5, abs=1e-3)),
    ]
    np.testing.assert_allclose(graph.embedding(b), [0, 1, 0, 0], atol=1e-3)
    with pytest.raises(ClientError, match=r"shape \(3,\)"):
        graph.similar([1, 2, 3])
    graph.take_embeddings(tmp_path / "room.map")  # it has no vector of the third object
    assert graph.embedding(a) is not None and graph.embedding(c) is None

    # An operator's copy, a merge and the end of a node.
    nodes, vectors = builder.graph, builder.graph.embeddings
    copied = copy_node(nodes, a)
    nodes.take_over(c, copied)
    nodes.merge_nodes(a, b)
    np.testing.assert_allclose(vectors.of([a])[a], unit(np.array([1.0, 1, 0, 0])), atol=2e-3)
    nodes.remove_node(a)
    assert list(vectors.views) == [c]
    message = embeddings_message(vectors, False, 7, "world")
    assert {a, b} <= set(message.removed) and [node.id for node in message.nodes] == [c]


def test_a_graph_without_embeddings_says_so_and_that_of_another_run_has_none(tmp_path):
    builder = GraphBuilder(config_of("paper"), VOCABULARY, "world")
    builder.integrate(frame(1, 0.0, **shown([1.0, 0])))
    path = write_graph(tmp_path, builder.full())
    embeddings.write_embeddings(path, 99, builder.graph.embeddings)
    graph = SceneGraph.load(tmp_path)
    assert graph.embedding(1) is None
    with pytest.raises(ClientError, match="no object of the graph has an embedding"):
        graph.similar([1.0, 0])
    embeddings.embeddings_path(path).write_bytes(b"no file of arrays")
    with pytest.raises(RefusedInput, match=r"scene_graph\.embeddings\.npz"):
        SceneGraph.load(tmp_path)


@pytest.mark.parametrize(
    ("vectors", "model", "words"),
    [
        (np.ones((1, 2049)), MODEL, "2049 values: expected 1 to 2048"),
        (np.ones((1, 0)), MODEL, "0 values"),
        (np.ones((1, 4)), "", "the name of their model"),
        (np.ones((1, 4)), "x" * 257, "257 characters"),
    ],
)
def test_embeddings_of_a_detector_are_checked(vectors, model, words):
    boxes, chances = np.zeros((1, 4)), np.ones((1, 1))
    with pytest.raises(ValueError, match=words):
        Detections(boxes, chances, np.ones(1), embeddings=vectors, embedding_model=model)


def test_embeddings_that_cannot_be_are_refused():
    rows = np.arange(1)
    with pytest.raises(ValueError, match="not of length 1"):
        Embeddings(rows, np.full((1, 4), np.nan, np.float16), MODEL)
    with pytest.raises(ValueError, match="rows"):
        frame(1, 0.0, embeddings=Embeddings(rows + 1, np.eye(4, dtype=np.float16)[:1], MODEL))


def test_messages_of_embeddings_bring_a_copy_up_to_date():
    def said(whole: bool, *nodes: tuple[int, list[float]], removed: tuple[int, ...] = ()) -> Looks:
        message = embeddings_message(NodeEmbeddings(), True, 1, "map") or wire.EmbeddingsMessage(
            schema=wire.schema_of(wire.EmbeddingsMessage),
            stamp=wire.Stamp(1, 0),
            frame_id="map",
            whole=whole,
            model=MODEL,
            nodes=[wire.NodeEmbedding(i, np.array(v, "<f2").tobytes()) for i, v in nodes],
            removed=list(removed),
        )
        return wire.decode(wire.encode(message), wire.EmbeddingsMessage)

    looks = Looks("", {}).after(said(True, (1, [1.0, 0]), (2, [0, 1.0])))
    looks = looks.after(said(False, (3, [0.6, 0.8]), removed=(1,)))
    assert looks.similar([0.0, 1.0]) == [(2, 1.0), (3, pytest.approx(0.8, abs=1e-3))]
    assert list(looks.after(said(True, (9, [1.0, 0]))).vectors) == [9]
    with pytest.raises(ValueError, match="other lengths"):
        looks.after(said(False, (4, [1.0, 0, 0])))
    with pytest.raises(ValueError, match="not of length 1"):
        looks.after(said(False, (4, [3.0, 0])))


def test_the_node_publishes_what_changed_to_whoever_listens():
    rclpy = pytest.importorskip("rclpy")
    from std_msgs.msg import String
    from support.nodes_bench import Bench

    from deworldsg_ros.client import SceneGraphClient
    from deworldsg_ros.nodes.graph_node import GraphNode
    from deworldsg_ros.wire.codec import local_graph_to_message

    values = {"merging.association": "paper", "output.min_existence": 0.0}
    parameters = [rclpy.parameter.Parameter(name, value=value) for name, value in values.items()]
    with Bench(GraphNode, {"deworldsg/local_graph": String}, parameter_overrides=parameters) as at:

        def send(**changes: object) -> None:
            local = frame(at.next_stamp(), 0.0, 2.0, **changes)
            text = wire.encode(local_graph_to_message(local))
            at.send(deworldsg__local_graph=String(data=text))

        def looks(client: SceneGraphClient, node_id: int) -> bool:
            return client.newest is not None and client.newest.embedding(node_id) is not None

        send(**shown([1.0, 0], [0.0, 0]))
        with SceneGraphClient(embeddings=True) as client, SceneGraphClient() as other:
            at.expect(lambda: looks(client, 1), "the first embedding")
            assert client.graph.embedding(2) is None
            send(**shown([1.0, 0], [0, 1.0]))
            at.expect(lambda: looks(client, 2), "the second embedding")
            assert [item.id for item, _ in client.graph.similar([0, 1.0])] == [2, 1]
            assert other.graph.looks is None
            send(**shown([1.0, 0], [0, 1.0], model="b/clip"))
            at.expect(lambda: at.node.health.drops.get("embedding_model_mismatch"), "the refusal")
        with SceneGraphClient(embeddings=True) as late:
            at.expect(lambda: looks(late, 1) and looks(late, 2), "all embeddings")
