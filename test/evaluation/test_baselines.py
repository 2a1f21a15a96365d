"""FROSS and Kim et al. on cases small enough to be computed by hand."""

import math

import numpy as np
import pytest

from deworldsg_ros.evaluation import baselines
from deworldsg_ros.evaluation.baselines import (
    BaselineGraph,
    BaselineNode,
    BaselinePipeline,
    Fross,
    Kim,
)
from deworldsg_ros.lifting.stage import box_covariance
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import EvaluationError, RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary

VOCABULARY = Vocabulary(("book", "chair", "table", "lamp"), ("near", "on"))
CAMERA = Intrinsics(500.0, 500.0, 320.0, 240.0, 640, 480)
BLACK = np.zeros((480, 640, 3), np.uint8)
NO_RELATIONS = Relations.none(2)
# FROSS merges two equal covariances σ²I up to here: HD² = 1 - exp(-d² / 8σ²) = 0.85².
REACH_M = math.sqrt(-8 * 0.01 * math.log(1 - 0.85**2))


def frame_graph(boxes, classes=None, relations=NO_RELATIONS, stamp_ns=0):
    count = len(boxes)
    classes = np.tile([0.0, 1.0, 0.0, 0.0], (count, 1)) if classes is None else classes
    boxes, scores = np.array(boxes, float), np.full(count, 0.9)
    return FrameGraph(stamp_ns, "camera", 640, 480, VOCABULARY, boxes, classes, scores, relations)


def lift(method, boxes, depth_m, T=np.eye(4)):
    return method.lift(frame_graph(boxes), BLACK, depth_m, CAMERA, T)


def depth_of(value):
    return np.full((480, 640), value, np.float32)


def node(mean=(0, 0, 0), scores=(0, 1, 0, 0), weight=1.0, variance=0.01, colours=()):
    mean, scores = np.array(mean, float), np.array(scores, float)
    colours = np.array(colours, np.int64)
    return BaselineNode(
        mean, variance * np.eye(3), scores, weight, mean[None], 0, 0, colours=colours
    )


def related(*pairs):
    """Pairs with the index of their predicate."""
    logits = np.array([np.where(np.arange(2) == p, 3.0, -3.0) for _, _, p in pairs])
    return Relations(np.array(pairs, np.int64)[:, :2], logits, np.ones(len(pairs)))


def test_fross_lifts_the_centre_of_the_box():
    (lifted,) = lift(Fross(), [[270, 190, 371, 291]], depth_of(2.0)).nodes
    # Centre (320.5, 240.5), cut to (320, 240): straight ahead.
    np.testing.assert_allclose(lifted.mean_world, [0, 0, 2.0])
    # A side of 101 px at 2 m and f = 500 is 0.404 m, uniform: side²/12. Along z their mean.
    variance = (101 * 2 / 500) ** 2 / 12
    np.testing.assert_allclose(lifted.covariance_world, variance * np.eye(3), atol=1e-12)
    # Off the axis: what the Jacobian sees of it is the box's own covariance; z gets a mean on top.
    x, y = (600 - 320) / 500, (30 - 240) / 500
    inverse = np.linalg.pinv([[500 / 3, 0, -x * 500 / 9], [0, 500 / 3, -y * 500 / 9]])
    expected = inverse @ np.diag([40**2 / 12, 200**2 / 12]) @ inverse.T
    expected[2, 2] += (expected[0, 0] + expected[1, 1]) / 2
    found = box_covariance(600, 30, 40, 200, 3.0, CAMERA)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    T = np.eye(4)
    T[:3] = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
    (turned,) = lift(Fross(), [[300, 140, 340, 340]], depth_of(2.0), T).nodes
    np.testing.assert_allclose(turned.mean_world, [1, 2, 5])
    assert turned.covariance_world[0, 0] > 20 * turned.covariance_world[1, 1]
    depth_m = depth_of(2.0)
    depth_m[240, 320] = 0.0
    boxes = [[270, 190, 370, 290], [100, 100, 100.5, 200], [10, 10, 60, 60]]
    lifted = lift(Fross(), boxes, depth_m)
    assert (lifted.rows, lifted.drops) == ([2], {"no_centre_depth": 1, "empty_box": 1})


def test_fross_merges_the_nearest_of_its_class_up_to_the_threshold_by_numbers_of_points():
    others = [node((0.05, 0, 0), (1, 0, 0, 0)), node((0.2, 0, 0)), node((-0.1, 0, 0))]
    assert Fross().choose(node(), others) == 2
    assert Fross().choose(node(), others[:1]) is Fross().choose(node(), []) is None
    assert Fross().choose(node(), [node((0.99 * REACH_M, 0, 0))]) == 0
    assert Fross().choose(node(), [node((1.01 * REACH_M, 0, 0))]) is None
    fused = Fross().fuse(node(weight=3.0), node((1, 0, 0), (0, 0.6, 0.4, 0)))
    np.testing.assert_allclose(fused.mean_world, [0.25, 0, 0])
    assert fused.covariance_world[0, 0] == pytest.approx(0.01 + 3 / 16)
    np.testing.assert_allclose(fused.class_scores, [0, 0.9, 0.1, 0])
    assert fused.weight == 4.0


def test_a_node_that_absorbed_another_is_compared_again():
    """The third node reaches neither of the two that were there, but closes the gap."""
    graph = BaselineGraph(VOCABULARY, "world", Fross().choose, Fross().fuse)
    graph.integrate([node(), node((1.6 * REACH_M, 0, 0))], related((0, 1, 1)), 0)
    assert len(graph.nodes) == 2 and len(graph.counts) == 1
    ids = graph.integrate([node((0.8 * REACH_M, 0, 0), variance=0.05)], NO_RELATIONS, 1)
    assert [item.observations for item in graph.nodes.values()] == [3] and list(graph.nodes) == ids
    # Both ends of the edge are one node now.
    assert not graph.counts


def test_kim_leaves_out_far_points_and_outliers():
    box = [100, 100, 300, 300]
    depth_m = depth_of(1.0)
    depth_m[200, 200] = 12.0
    assert len(baselines.window_points(np.array(box, float), depth_m, CAMERA)) == 41 * 41 - 1
    grid = 0.01 * np.array([(x, y, 0) for y in range(10) for x in range(10)])
    kept = baselines.without_outliers(np.vstack([grid, [[5.0, 5.0, 5.0]]]))
    np.testing.assert_array_equal(kept, grid)
    # More than ten points are needed.
    for columns, drops in (((195, 205), {"few_window_points": 1}), ((185, 215), {})):
        depth_m = depth_of(0.0)
        depth_m[200, slice(*columns)] = 1.0
        lifted = lift(Kim(), [box], depth_m)
        assert lifted.drops == drops
        assert [item.mean_world[2] for item in lifted.nodes] == pytest.approx([1.0] * (not drops))


def test_kim_compares_classes_positions_and_colours():
    assert baselines.top_classes(np.array([0.1, 0.4, 0.2, 0.3])) == {1, 2, 3}
    assert baselines.top_classes(np.array([0.1, 0.7, 0.1, 0.1])) == {1}
    three = frozenset({1, 2, 3})
    for other, expected in (({4, 5, 6}, 0.0), ({1, 5, 6}, 0.8), ({1, 2}, 0.9), (three, 1.0)):
        assert baselines.class_similarity(three, frozenset(other)) == expected
    # The middle of the densest bin, (240, 16, 16), is nearest to red.
    rgb = np.full((20, 20, 3), (250, 5, 5), np.uint8)
    rgb[:3] = (0, 0, 250)
    histogram = baselines.colour_histogram(rgb, np.array([0, 0, 19, 19], float))
    assert sorted(histogram[histogram > 0].tolist()) == [60, 340]
    assert baselines.densest_colour(histogram) == (255, 0, 0)
    red, blue = np.zeros((2, 512), np.int64)
    red[7 * 64], blue[7] = 1, 1
    me = node(scores=(0.1, 0.6, 0.2, 0.1), colours=red)
    same = node((0.1, 0, 0), (0.1, 0.5, 0.3, 0.1), colours=red)
    # 0.56 m is 0.112 of 5 m; at 1.12 m the similarity of a coordinate is a half.
    other = node((1.12, 0, 0), (0.0, 0.0, 0.0, 1.0), colours=blue)
    expected = [1.0, 0.4 * 2.5 / 3 + 0.1 * (1 - math.sqrt(2) / math.sqrt(3))]
    np.testing.assert_allclose(Kim().similarities(me, [same, other]), expected, atol=0.01)
    assert Kim().choose(me, [other, same]) == 1
    assert Kim().choose(me, [other]) is Kim().choose(me, []) is None
    np.testing.assert_allclose(Kim().fuse(me, same).class_scores, [0.2, 1.1, 0.5, 0.2])


class Still:
    """The same boxes and relations in every frame. The second object has no depth."""

    def perceive(self, frame):
        boxes = [[20, 20, 120, 120], [200, 100, 330, 300], [450, 200, 600, 420]]
        relations = related((0, 2, 1), (0, 1, 0))
        seen = frame_graph(boxes, np.eye(4)[:3], relations, frame.stamp_ns)
        return Perceived(seen, np.zeros((480, 640), np.uint16), {})


@pytest.mark.parametrize("name", list(baselines.BASELINES))
def test_a_still_camera_sees_each_object_once(name):
    depth_m = depth_of(2.0)
    depth_m[100:301, 200:331] = 0.0
    pipeline = BaselinePipeline(baselines.build_baseline(name), Still())
    with pytest.raises(RefusedInput, match="no frame"):
        pipeline.graph()
    for stamp in range(4):
        pipeline.process(RgbdFrame(stamp, BLACK, depth_m, CAMERA, np.eye(4)))
    graph = pipeline.graph()
    assert [(item.label, item.observations) for item in graph.nodes] == [("book", 4), ("table", 4)]
    assert [(edge.predicate, edge.observations) for edge in graph.edges] == [("on", 4)]
    assert sum(pipeline.drops.values()) == 4
    with pytest.raises(EvaluationError, match="frost.*fross, kim"):
        baselines.build_baseline("frost")
