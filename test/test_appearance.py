"""What objects look like, from the frames to the nodes of the graph and to maps."""

import numpy as np
import pytest
from support.merging import VOCABULARY, local_graph

from deworldsg_ros.config import Config, MergingConfig, OutputConfig
from deworldsg_ros.graph.graph import copy_node
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.scene.frame_graph import LocalGraph

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
    graph.move_node(copied, np.eye(4))
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
