"""What moves if something is taken: piles with answers that are known, and supports all the way."""

import json
import math

import pytest
from support.view import box_at, make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.questions import ask


def scene(boxes, edges=()):
    """A graph of boxes: id to label, low corner and size; edges (a, b, predicate, probability)."""
    nodes = []
    for node_id, (label, low, size) in boxes.items():
        center = tuple(a + b / 2 for a, b in zip(low, size))
        nodes.append(make_node(node_id, label, center, box=box_at(center, size)))
    return SceneGraph(make_graph(nodes, [make_edge(a, b, name, p) for a, b, name, p in edges]))


TABLE = {1: ("dining table", (0.0, 0.0, 0.0), (1.2, 0.8, 0.74))}
# A pan on a plate on the table, a cup beside them, a spoon in the pan.
KITCHEN = {
    **TABLE,
    2: ("plate", (0.2, 0.2, 0.74), (0.25, 0.25, 0.02)),
    3: ("pan", (0.23, 0.23, 0.76), (0.2, 0.2, 0.06)),
    4: ("spoon", (0.28, 0.3, 0.772), (0.1, 0.03, 0.03)),
    5: ("cup", (0.8, 0.4, 0.74), (0.08, 0.08, 0.1)),
}
SUPPORTS = [(2, 1, "on", 0.9), (3, 2, "on", 0.8), (4, 3, "in", 0.9), (5, 1, "on", 0.95)]
# A plank on two blocks, and a weight on its end beyond one of them.
BRIDGE = {
    1: ("dining table", (0.0, 0.0, 0.0), (1.6, 0.8, 0.7)),
    2: ("box", (0.3, 0.3, 0.7), (0.1, 0.1, 0.1)),
    3: ("box", (0.9, 0.3, 0.7), (0.1, 0.1, 0.1)),
    4: ("board", (0.28, 0.3, 0.8), (0.74, 0.1, 0.02)),
}
# A plank that a weight holds on its only block.
LEVER = {
    1: ("dining table", (0.0, 0.0, 0.0), (1.6, 0.8, 0.7)),
    2: ("box", (0.3, 0.3, 0.7), (0.2, 0.2, 0.1)),
    3: ("board", (0.3, 0.35, 0.8), (0.6, 0.1, 0.02)),
    4: ("box", (0.3, 0.35, 0.82), (0.12, 0.1, 0.3)),
}


def moved(graph, which):
    return {item.id: chance for item, chance in graph.if_removed(which).moves}


def test_what_rests_on_something_all_the_way_up():
    graph = scene(KITCHEN, SUPPORTS)
    found = {item.id: chance for item, chance in graph.resting_on("dining table")}
    assert found == pytest.approx({5: 0.95, 2: 0.9, 3: 0.72, 4: 0.648})
    assert [item.id for item, _ in graph.resting_on("plate")] == [3, 4]
    assert graph.resting_on("spoon") == []


def test_supports_that_go_round_end():
    graph = scene(KITCHEN, [(2, 3, "on", 0.9), (3, 2, "on", 0.9)])
    assert [item.id for item, _ in graph.resting_on(2)] == [3]


def test_a_question_for_what_rests_on_something_all_the_way_up():
    graph = scene(KITCHEN, SUPPORTS)
    direct = ask(graph, "what rests on the table").found
    assert {answer.item.id for answer in direct} == {2, 5}
    every = ask(graph, "what rests on the dining table, all the way up?").found
    # 0.9 is the probability of each class.
    assert {a.item.id: a.probability for a in every} == pytest.approx(
        {5: 0.95 * 0.81, 2: 0.9 * 0.81, 3: 0.72 * 0.81, 4: 0.648 * 0.81}
    )
    assert "all the way down" in every[0].evidence
    assert ask(graph, "how many spoons are on the plate all the way up").count == 1
    with pytest.raises(ClientError, match="before 'all the way up'"):
        ask(graph, "cup near table all the way up")
    with pytest.raises(ClientError, match="expected"):
        ask(graph, "all the way up")


def test_a_pile_falls_from_below_and_is_taken_from_above():
    pytest.importorskip("mujoco")
    graph = scene(KITCHEN, SUPPORTS)
    assert set(moved(graph, "table")) == {2, 3, 4, 5}
    assert moved(graph, "plate").keys() == {3, 4}
    assert graph.if_removed("cup").is_safe and moved(graph, "cup") == {}
    order = graph.order_to_take("plate")
    assert [step.item.label for step in order.steps] == ["spoon", "pan", "plate"]
    assert order.is_safe and order.to_dict()["steps"][0]["object"]["label"] == "spoon"
    clearing = graph.order_to_clear("dining table")
    names = [step.item.label for step in clearing.steps]
    assert sorted(names) == ["cup", "pan", "plate", "spoon"] and clearing.is_safe
    assert names.index("spoon") < names.index("pan") < names.index("plate")
    assert graph.if_removed("plate").lines[0].startswith("plate #2: not safe")


def test_boxes_alone_show_what_rests_on_what():
    pytest.importorskip("mujoco")
    graph = scene(KITCHEN)
    assert set(moved(graph, "table")) == {2, 3, 4, 5}
    # The spoon begins 1 cm above the bottom of the pan, as far as boxes are wrong: nothing is sure.
    assert not graph.if_removed("pan").is_safe


def test_a_plank_on_two_blocks_needs_both():
    pytest.importorskip("mujoco")
    graph = scene(BRIDGE, [(2, 1, "on", 0.9), (3, 1, "on", 0.9), (4, 2, "on", 0.9)])
    for block in (2, 3):
        assert moved(graph, block)[4] > 0.9
    assert [step.item.id for step in graph.order_to_take(3).steps] == [4, 3]


def test_a_weight_that_holds_a_plank_is_not_taken_first():
    pytest.importorskip("mujoco")
    graph = scene(LEVER, [(2, 1, "on", 0.9), (3, 2, "on", 0.9), (4, 3, "on", 0.9)])
    removal = graph.if_removed(4)  # the supports alone say that nothing rests on it
    assert dict(((i.id, c) for i, c in removal.moves))[3] > 0.9 and not removal.is_safe


def test_what_is_attached_goes_along_and_needs_no_step():
    pytest.importorskip("mujoco")
    boxes = {
        **TABLE,
        2: ("pot", (0.2, 0.2, 0.74), (0.2, 0.2, 0.2)),
        3: ("potted plant", (0.2, 0.2, 0.9), (0.2, 0.2, 0.4)),
    }
    graph = scene(boxes, [(2, 1, "on", 0.9), (3, 2, "attached to", 0.95)])
    assert moved(graph, 2)[3] > 0.9 and graph.if_removed(2).is_safe
    assert [step.item.id for step in graph.order_to_take(2).steps] == [2]


def test_a_book_that_leans_moves_with_the_one_that_it_leans_on():
    pytest.importorskip("mujoco")
    boxes = {
        1: ("shelf", (0.0, 0.0, 0.0), (1.0, 0.3, 1.0)),
        2: ("book", (0.40, 0.05, 1.0), (0.04, 0.2, 0.25)),
        3: ("book", (0.445, 0.05, 1.0), (0.10, 0.2, 0.24)),
    }
    graph = scene(boxes, [(2, 1, "on", 0.9), (3, 1, "on", 0.9)])
    lean = math.radians(15)
    normal = (math.cos(lean), 0.0, math.sin(lean))  # its top leans to -x, where book 2 is
    across = (-math.sin(lean), 0.0, math.cos(lean))
    covariance = [
        [
            1e-4 * normal[i] * normal[k] + 6e-3 * across[i] * across[k] + 3e-3 * (i == k == 1)
            for k in range(3)
        ]
        for i in range(3)
    ]
    nodes = [
        make_node(item.id, item.label, item.position_m, covariance, box=item.state.box)
        if item.id == 3
        else item.state
        for item in graph
    ]
    leaning = SceneGraph(make_graph(nodes, graph.message.edges))
    assert moved(graph, 2) == {} and moved(leaning, 2)[3] > 0.9
    assert moved(leaning, 3) == {}


def test_answers_are_the_same_each_time():
    pytest.importorskip("mujoco")
    edges = [(2, 1, "on", 0.6), (3, 1, "on", 0.9), (4, 2, "on", 0.5), (4, 3, "on", 0.3)]
    first, again = (json.dumps(scene(BRIDGE, edges).if_removed(2).to_dict()) for _ in range(2))
    assert first == again


def test_what_is_not_there_is_named():
    pytest.importorskip("mujoco")
    graph = scene(KITCHEN, SUPPORTS)
    for ask_for in (graph.if_removed, graph.order_to_take, graph.order_to_clear):
        with pytest.raises(ClientError, match="99"):
            ask_for(99)
    assert graph.order_to_clear("spoon").steps == ()


def test_without_mujoco_the_error_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ClientError, match=r"pip install 'deworldsg_ros\[physics\]'"):
        scene(KITCHEN, SUPPORTS).if_removed("cup")
    assert len(scene(KITCHEN, SUPPORTS).resting_on("plate")) == 2


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_piles_of_the_simulator_fall_as_it_says():
    """Planks on two blocks, with weights: the supports alone find half of what falls."""
    pytest.importorskip("mujoco")
    from bench.falls import measure

    score = measure("piles", 36, 3)
    precision, recall, _ = score.rates(score.said)
    _, recall_of_supports, _ = score.rates(score.symbolic)
    assert precision >= 0.9 and recall >= 0.9 > recall_of_supports
    assert score.steps > 10 and score.false_safe == 0
