"""FROSS and Kim et al. on cases small enough to be computed by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from deworldsg_ros.evaluation.baselines import (
    BASELINES,
    BaselineGraph,
    BaselineNode,
    BaselinePipeline,
    Fross,
    Kim,
    box_covariance,
    build_baseline,
    class_similarity,
    colour_histogram,
    densest_colour,
    evaluation_points,
    position_similarities,
    top_classes,
    window_points,
    without_outliers,
)
from deworldsg_ros.evaluation.runner import to_prediction
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import EvaluationError, RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary
from deworldsg_ros.wire import messages as wire

VOCABULARY = Vocabulary(("book", "chair", "table", "lamp"), ("near", "on"))
CAMERA = Intrinsics(500.0, 500.0, 320.0, 240.0, 640, 480)
NO_RELATIONS = Relations.none(2)


def frame_graph(
    boxes: Sequence[Sequence[float]],
    classes: Sequence[Sequence[float]] | None = None,
    relations: Relations = NO_RELATIONS,
    stamp_ns: int = 0,
) -> FrameGraph:
    count = len(boxes)
    probabilities = classes if classes is not None else [[0.0, 1.0, 0.0, 0.0]] * count
    return FrameGraph(
        stamp_ns,
        "camera",
        640,
        480,
        VOCABULARY,
        np.array(boxes, np.float64).reshape(-1, 4),
        np.array(probabilities, np.float64).reshape(-1, 4),
        np.full(count, 0.9),
        relations,
    )


def node(
    mean: Sequence[float] = (0, 0, 0),
    scores: Sequence[float] = (0, 1, 0, 0),
    weight: float = 1.0,
    variance: float = 0.01,
    colours: Sequence[int] = (),
) -> BaselineNode:
    return BaselineNode(
        np.array(mean, np.float64),
        variance * np.eye(3),
        np.array(scores, np.float64),
        weight,
        np.array([mean], np.float64),
        0,
        0,
        colours=np.array(colours, np.int64),
    )


def related(*pairs: tuple[int, int, int]) -> Relations:
    """Pairs with the index of their predicate."""
    logits = np.array([np.where(np.arange(2) == p, 3.0, -3.0) for _, _, p in pairs]).reshape(-1, 2)
    ends = np.array([(s, o) for s, o, _ in pairs], np.int64).reshape(-1, 2)
    return Relations(ends, logits, np.ones(len(pairs)))


def graph_of(method: Fross | Kim) -> BaselineGraph:
    return BaselineGraph(VOCABULARY, "world", method.choose, method.fuse)


def test_fross_lifts_the_centre_of_the_box() -> None:
    depth_m = np.full((480, 640), 2.0, np.float32)
    lifted = Fross().lift(
        frame_graph([[270, 190, 371, 291]]),
        None,
        depth_m,
        CAMERA,
        np.eye(4),  # type: ignore[arg-type]
    )
    # Centre (320.5, 240.5), cut to (320, 240): straight ahead.
    np.testing.assert_allclose(lifted.nodes[0].mean_world, [0, 0, 2.0])
    # A side of 101 px at 2 m and f = 500 is 0.404 m, uniform: side²/12. Along z their mean.
    variance = (101 * 2 / 500) ** 2 / 12
    np.testing.assert_allclose(
        lifted.nodes[0].covariance_world, np.diag([variance] * 3), atol=1e-12
    )
    # The grid from 320 - 25 on, every 50 pixels, below 320 + 25: one point, at (295, 215).
    np.testing.assert_allclose(lifted.nodes[0].points_world, [[-0.1, -0.1, 2.0]])
    assert lifted.nodes[0].weight == 1.0


def test_fross_covariance_is_positive_definite_off_the_axis_too() -> None:
    covariance = box_covariance(600, 30, 40, 200, 3.0, CAMERA)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
    assert np.linalg.eigvalsh(covariance).min() > 0
    # What the Jacobian sees of it is the box's own covariance, but for what z got on top.
    x, y = (600 - 320) / 500, (30 - 240) / 500
    jacobian = np.array([[500 / 3, 0, -x * 500 / 9], [0, 500 / 3, -y * 500 / 9]])
    inverse = np.linalg.pinv(jacobian)
    bare = inverse @ np.diag([40**2 / 12, 200**2 / 12]) @ inverse.T
    np.testing.assert_allclose(
        jacobian @ bare @ jacobian.T, np.diag([40**2 / 12, 200**2 / 12]), atol=1e-9
    )
    on_top = covariance - bare
    assert on_top[2, 2] == pytest.approx((bare[0, 0] + bare[1, 1]) / 2)
    assert np.abs(on_top[:2]).max() < 1e-12


def test_fross_rotates_with_the_pose() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [1, 2, 3]
    depth_m = np.full((480, 640), 2.0, np.float32)
    seen = frame_graph([[300, 140, 340, 340]])
    lifted = Fross().lift(seen, None, depth_m, CAMERA, T).nodes[0]  # type: ignore[arg-type]
    np.testing.assert_allclose(lifted.mean_world, [1, 2, 5])
    assert lifted.covariance_world[0, 0] > 20 * lifted.covariance_world[1, 1]


def test_fross_drops_objects_without_depth_at_the_centre() -> None:
    depth_m = np.full((480, 640), 2.0, np.float32)
    depth_m[240, 320] = 0.0
    boxes = [[270, 190, 370, 290], [100, 100, 100.5, 200], [10, 10, 60, 60]]
    lifted = Fross().lift(frame_graph(boxes), None, depth_m, CAMERA, np.eye(4))  # type: ignore[arg-type]
    assert lifted.rows == [2]
    assert lifted.drops == {"no_centre_depth": 1, "empty_box": 1}


def test_fross_evaluation_points_leave_out_invalid_depth() -> None:
    depth_m = np.zeros((480, 640), np.float32)
    depth_m[:, 320:] = 1.0
    points = evaluation_points(320, 240, 400, 200, depth_m, CAMERA, np.eye(4))
    # Columns 220, 270, 320, 370 and rows 190, 240; the first two columns have no depth.
    np.testing.assert_allclose(
        points, [[0, -0.1, 1], [0.1, -0.1, 1], [0, 0, 1], [0.1, 0, 1]], atol=1e-12
    )


def test_fross_merges_two_equal_gaussians() -> None:
    graph = graph_of(Fross())
    for _ in range(3):
        graph.integrate([node(weight=2.0)], NO_RELATIONS, 0)
    assert len(graph.nodes) == 1
    merged = next(iter(graph.nodes.values()))
    assert merged.observations == 3
    assert merged.weight == 6.0
    np.testing.assert_allclose(merged.covariance_world, 0.01 * np.eye(3))


def test_fross_merges_one_class_only_and_the_nearest() -> None:
    others = [
        node((0.05, 0, 0), (1, 0, 0, 0)),
        node((0.2, 0, 0)),
        node((-0.1, 0, 0)),
    ]
    assert Fross().choose(node(), others) == 2
    assert Fross().choose(node(), others[:1]) is None
    assert Fross().choose(node(), []) is None


@pytest.mark.parametrize(("threshold_distance", "merges"), [(0.99, True), (1.01, False)])
def test_fross_threshold(threshold_distance: float, merges: bool) -> None:
    # Equal covariances σ²I: HD² = 1 - exp(-d² / 8σ²) = 0.85² at d² = -8σ² ln(1 - 0.85²).
    distance = math.sqrt(-8 * 0.01 * math.log(1 - 0.85**2)) * threshold_distance
    chosen = Fross().choose(node(), [node((distance, 0, 0))])
    assert (chosen == 0) is merges


def test_fross_fuses_by_numbers_of_points() -> None:
    fused = Fross().fuse(node((0, 0, 0), weight=3.0), node((1, 0, 0), (0, 0.6, 0.4, 0), weight=1.0))
    np.testing.assert_allclose(fused.mean_world, [0.25, 0, 0])
    assert fused.covariance_world[0, 0] == pytest.approx(0.01 + 3 / 16)
    np.testing.assert_allclose(fused.class_scores, [0, 0.9, 0.1, 0])
    assert fused.weight == 4.0
    # 0 and 0 count as 1 and 1.
    fused = Fross().fuse(node((0, 0, 0), weight=0.0), node((1, 0, 0), weight=0.0))
    np.testing.assert_allclose(fused.mean_world, [0.5, 0, 0])
    assert fused.weight == 0.0


def test_a_node_that_absorbed_another_is_compared_again() -> None:
    """The third node reaches neither of the two that were there, but closes the gap."""
    method = Fross()
    reach = math.sqrt(-8 * 0.01 * math.log(1 - 0.85**2))
    graph = graph_of(method)
    graph.integrate([node((0, 0, 0)), node((1.6 * reach, 0, 0))], NO_RELATIONS, 0)
    assert len(graph.nodes) == 2
    ids = graph.integrate([node((0.8 * reach, 0, 0), variance=0.05)], NO_RELATIONS, 1)
    assert list(graph.nodes) == ids
    assert graph.nodes[ids[0]].observations == 3


def test_relations_are_counted_and_follow_their_nodes() -> None:
    graph = graph_of(Fross())
    first = [node((0, 0, 0)), node((5, 0, 0), (1, 0, 0, 0))]
    graph.integrate(first, related((1, 0, 1)), 0)
    graph.integrate(first, related((1, 0, 1), (0, 1, 0)), 1)
    graph.integrate(first, related((1, 0, 0)), 2)
    message = graph.message()
    assert [(e.observations, e.predicate) for e in message.edges] == [(1, "near"), (3, "on")]
    assert message.edges[1].probability == pytest.approx(2 / 3, abs=1e-4)
    # It is a message like any other.
    assert wire.decode(wire.encode(message), wire.SceneGraphMessage) == message


def test_a_relation_within_one_node_is_dropped() -> None:
    graph = graph_of(Fross())
    ids = graph.integrate([node(), node()], related((0, 1, 1)), 0)
    assert len(set(ids)) == 1
    assert not graph.counts
    # And an edge whose ends become one later.
    reach = math.sqrt(-8 * 0.01 * math.log(1 - 0.85**2))
    graph = graph_of(Fross())
    graph.integrate([node(), node((1.6 * reach, 0, 0))], related((0, 1, 1)), 0)
    assert len(graph.counts) == 1
    graph.integrate([node((0.8 * reach, 0, 0), variance=0.05)], NO_RELATIONS, 1)
    assert not graph.counts


@pytest.mark.parametrize(
    ("side", "first", "last"),
    [(20, 106, 114), (29, 108, 120), (30, 112, 118), (60, 124, 136), (200, 180, 220)],
)
def test_kim_windows(side: int, first: int, last: int) -> None:
    depth_m = np.ones((480, 640), np.float32)
    points = window_points(np.array([100, 100, 100 + side, 100 + side], float), depth_m, CAMERA)
    columns = np.unique(np.rint(points[:, 0] * 500 + 320).astype(int))
    assert (columns[0], columns[-1]) == (first, last)


def test_kim_leaves_out_far_points_and_outliers() -> None:
    depth_m = np.full((480, 640), 1.0, np.float32)
    depth_m[200, 200] = 12.0
    box = np.array([100, 100, 300, 300], float)
    assert len(window_points(box, depth_m, CAMERA)) == 41 * 41 - 1
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(10), [0]), axis=-1).reshape(-1, 3) * 0.01
    with_stray = np.concatenate([grid, [[5.0, 5.0, 5.0]]])
    kept = without_outliers(with_stray)
    np.testing.assert_array_equal(kept, grid)
    assert len(without_outliers(grid[:10])) == 10


def test_kim_needs_more_than_ten_points() -> None:
    rgb = np.zeros((480, 640, 3), np.uint8)
    depth_m = np.zeros((480, 640), np.float32)
    depth_m[200, 195:205] = 1.0
    box = [[100, 100, 300, 300]]
    lifted = Kim().lift(frame_graph(box), rgb, depth_m, CAMERA, np.eye(4))
    assert (lifted.nodes, lifted.drops) == ([], {"few_window_points": 1})
    depth_m[200, 185:215] = 1.0
    lifted = Kim().lift(frame_graph(box), rgb, depth_m, CAMERA, np.eye(4))
    assert len(lifted.nodes) == 1
    assert lifted.nodes[0].mean_world[2] == pytest.approx(1.0)


def test_kim_classes() -> None:
    assert top_classes(np.array([0.1, 0.4, 0.2, 0.3])) == {1, 2, 3}
    assert top_classes(np.array([0.0, 1.0, 0.0, 0.0])) == {1}
    assert top_classes(np.array([0.1, 0.7, 0.1, 0.1])) == {1}
    three = frozenset({1, 2, 3})
    found = [class_similarity(three, frozenset(other)) for other in ({4, 5, 6}, {1, 5, 6}, {1, 2})]
    assert found == [0.0, 0.8, 0.9]
    assert class_similarity(three, three) == 1.0
    assert class_similarity(frozenset({1}), frozenset({1})) == 1.0
    assert class_similarity(frozenset(), frozenset()) == 0.0


def test_kim_positions() -> None:
    # 0.56 m is 0.112 of 5 m; at 1.12 m it is a half.
    means = np.array([[0.5, 0.5, 0.5], [1.12, 0, 0], [1.12, 1.12, -1.12]])
    np.testing.assert_allclose(position_similarities(np.zeros(3), means), [1, 2.5 / 3, 0.5])


def test_kim_colours() -> None:
    rgb = np.zeros((20, 20, 3), np.uint8)
    rgb[:, :] = (250, 5, 5)
    rgb[:3] = (0, 0, 250)
    histogram = colour_histogram(rgb, np.array([0, 0, 19, 19], float))
    assert histogram.sum() == 400
    assert sorted(histogram[histogram > 0].tolist()) == [60, 340]
    # The middle of the bin, (240, 16, 16), is nearest to red.
    assert densest_colour(histogram) == (255, 0, 0)


def test_kim_similarity_and_threshold() -> None:
    red, blue = np.zeros(512, np.int64), np.zeros(512, np.int64)
    red[7 * 64], blue[7] = 1, 1
    me = node(scores=(0.1, 0.6, 0.2, 0.1), colours=red.tolist())
    same = node((0.1, 0, 0), (0.1, 0.5, 0.3, 0.1), colours=red.tolist())
    other = node((1.12, 0, 0), (0.0, 0.0, 0.0, 1.0), colours=blue.tolist())
    similarities = Kim().similarities(me, [same, other])
    colour = 1 - math.sqrt(2) / math.sqrt(3)
    np.testing.assert_allclose(similarities, [1.0, 0.4 * 2.5 / 3 + 0.1 * colour], atol=0.01)
    assert Kim().choose(me, [other, same]) == 1
    assert Kim().choose(me, [other]) is None
    assert Kim().choose(me, []) is None
    np.testing.assert_allclose(Kim().fuse(me, same).class_scores, [0.2, 1.1, 0.5, 0.2])


class Still:
    """The same box and relation in every frame."""

    def __init__(self, boxes: Sequence[Sequence[float]], relations: Relations) -> None:
        self.boxes, self.relations = boxes, relations

    def perceive(self, frame: RgbdFrame) -> Perceived:
        classes = np.eye(4)[: len(self.boxes)]
        seen = frame_graph(self.boxes, classes.tolist(), self.relations, frame.stamp_ns)
        return Perceived(seen, np.zeros((480, 640), np.uint16), {})


def posed_frame(stamp_ns: int, depth_m: np.ndarray) -> RgbdFrame:
    return RgbdFrame(stamp_ns, np.zeros((480, 640, 3), np.uint8), depth_m, CAMERA, np.eye(4))


@pytest.mark.parametrize("name", list(BASELINES))
def test_a_still_camera_sees_each_object_once(name: str) -> None:
    boxes = [[20, 20, 120, 120], [200, 100, 330, 300], [450, 200, 600, 420]]
    # The second has no depth at all: its relation cannot be result.
    depth_m = np.full((480, 640), 2.0, np.float32)
    depth_m[100:301, 200:331] = 0.0
    perceiver = Still(boxes, related((0, 2, 1), (0, 1, 0)))
    pipeline = BaselinePipeline(build_baseline(name), perceiver)
    with pytest.raises(RefusedInput, match="no frame"):
        pipeline.graph()
    for stamp in range(4):
        pipeline.process(posed_frame(stamp, depth_m))
    graph = pipeline.graph()
    assert [item.label for item in graph.nodes] == ["book", "table"]
    assert [item.observations for item in graph.nodes] == [4, 4]
    assert [(edge.predicate, edge.observations) for edge in graph.edges] == [("on", 4)]
    assert sum(pipeline.drops.values()) == 4
    prediction = to_prediction(graph, VOCABULARY, sampled=False)
    assert [len(points) for points in prediction.points_world] == [
        len(surface_points(item)) for item in graph.nodes
    ]
    assert {stage: times.count for stage, times in pipeline.times_s.items()} == {
        "perception": 4,
        "lifting": 4,
        "merging": 4,
    }


def test_an_unknown_baseline_is_refused_by_name() -> None:
    with pytest.raises(EvaluationError, match=r"'frost': expected one of fross, kim"):
        build_baseline("frost")
