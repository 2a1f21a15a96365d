"""Two graphs in one: the transform between them, their common objects, and their sum."""

import msgspec
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from support.view import SAVED, make_graph, make_node

from deworldsg_ros.client import ClientError, SceneGraph, changes, combine
from deworldsg_ros.client.combine import Known, align
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.camera import rigid_motion, rotation_angle_deg
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire

FOLDER = SceneGraph.load(SAVED)


def turned(graph: SceneGraph, T: np.ndarray) -> SceneGraph:
    """A graph in another world frame; its points to the millimetre."""
    return SceneGraph(combine.combine(SceneGraph(make_graph()), graph, T).message)


def part_of(graph: SceneGraph, nodes: list[wire.NodeState]) -> SceneGraph:
    """A graph with these nodes, and the edges between them."""
    ids = {node.id for node in nodes}
    edges = [edge for edge in graph.message.edges if {edge.subject, edge.object} <= ids]
    return SceneGraph(msgspec.structs.replace(graph.message, nodes=nodes, edges=edges))


@pytest.mark.parametrize(
    ("angle", "place"), [(0.0, (0, 0, 0)), (2.5, (5, -3, 1)), (-1.2, (-200, 70, -0.5))]
)
def test_the_transform_between_two_world_frames_is_found(angle, place):
    T = rigid_motion(np.array(place, float), angle * np.array([0.0, 0.0, 1.0]))
    found = align(list(FOLDER), list(turned(FOLDER, T)))
    rest = found.T_a_b @ T
    assert np.linalg.norm(rest[:3, 3]) < 0.05
    assert rotation_angle_deg(rest[:3, :3]) < 0.5
    assert found.matched >= 0.9 * len(FOLDER)
    assert found.confidence == pytest.approx(align(list(FOLDER), list(FOLDER)).confidence, abs=0.01)
    assert 0.1 < found.confidence <= 1.0


def test_parts_of_a_room_that_overlap_are_merged(room):
    def part(keep):
        return part_of(room, [item.state for item in room if keep(item.position_m[1])])

    T = rigid_motion(np.array([3.0, -2.0, 0.5]), np.array([0.0, 0.0, 2.0]))
    first, second = part(lambda y: y < 0.5), turned(part(lambda y: y > -0.6), T)
    combined = combine.combine(first, second)
    assert combined.confidence > 0.1
    whole = SceneGraph(combined.message)
    assert not whole.changes_since(room)
    assert len(whole) == len(room)
    assert len(combined.pairs) == len(first) + len(second) - len(room)
    assert rotation_angle_deg((combined.T_a_b @ T)[:3, :3]) < 0.5
    assert "cup #13 is on dining table #5" in {item.text for item in whole.relations()}
    both = {pair.before.id for pair in combined.pairs}
    for item in first:
        assert whole[item.id].observations == item.observations * (2 if item.id in both else 1)


@pytest.mark.parametrize("seed", range(5))
def test_what_the_last_merge_knows_changes_nothing(room, seed):
    rng, known = np.random.default_rng(seed), Known()

    def changed(graph):
        nodes = list(graph.message.nodes)
        for at in rng.permutation(len(nodes))[:3].tolist():
            mean = [value + 0.01 for value in nodes[at].mean_m]
            more = nodes[at].observations + 1
            nodes[at] = msgspec.structs.replace(nodes[at], mean_m=mean, observations=more)
        del nodes[rng.integers(len(nodes))]
        return part_of(graph, nodes)

    first, second, T = room, room, np.eye(4)
    for step in range(8):
        first, second = changed(first), changed(second)
        if step == 5:
            T = rigid_motion(np.array([0.02, 0.0, 0.0]), np.array([0.0, 0.0, 0.01]))
        fresh, again = combine.combine(first, second, T), combine.combine(first, second, T, known)
        assert wire.encode(again.message) == wire.encode(fresh.message)
        assert again.ids == fresh.ids


def test_graphs_of_different_rooms_are_not_merged(room):
    rng = np.random.default_rng(0)
    other = [make_node(item.id, item.label, rng.uniform(-3, 3, 3) * [1, 1, 0.3]) for item in room]
    tilted = rigid_motion(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    for message, T, words in (
        (make_graph(other), None, "give the transform"),
        (make_graph([make_node(1, "lamp")]), None, "no two objects of equal classes"),
        (room.message, tilted, "the same up"),
    ):
        with pytest.raises(ClientError, match=words):
            combine.combine(room, SceneGraph(message), T)
    with pytest.raises(RefusedInput):
        combine.combine(room, room, np.ones((4, 4)))


@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_of_a_motion_is_the_sum_over_the_objects(seed):
    """Against plain loops over all pairs of objects."""
    a, b = objects(12, seed), objects(7, seed + 10)
    evidence, rng = combine._Evidence(a, b), np.random.default_rng(seed)
    motions = rng.uniform(-1, 1, (5, 4)) * [3.0, 1.0, 1.0, 0.2]
    middle = np.mean([item.position_m for item in b], axis=0)
    listed = [k for item in (*a, *b) for k in item.classes]
    share = {name: 0.0 for name in {k.label for k in listed}}
    for k in listed:
        share[k.label] += k.probability / (len(a) + len(b))
    places = np.array([item.position_m for item in a])
    density = len(a) / np.prod(np.ptp(places[:, :2], axis=0) + 1.0)
    expected = []
    for heading, *shift in motions:
        cos, sin = np.cos(heading), np.sin(heading)
        total = 0.0
        for item in b:
            x, y, z = np.subtract(item.position_m, middle)
            place = np.array([cos * x - sin * y, sin * x + cos * y, z]) + shift
            ratio = 0.0
            for other in a:
                of_a = {k.label: k.probability for k in other.classes}
                gain = combine.WRONG_NAME + sum(
                    k.probability * of_a.get(k.label, 0.0) / share[k.label] for k in item.classes
                )
                if gain < combine.LEAST_AGREEMENT:
                    continue
                lengths = np.hypot(*other.size_m[:2]) - np.hypot(*item.size_m[:2])
                heights = other.size_m[2] - item.size_m[2]
                flat = combine.CENTRE_M**2 + (combine.PARTLY * lengths) ** 2
                high = combine.HEIGHT_M**2 + (combine.PARTLY * heights) ** 2
                right, ahead, rise = np.subtract(other.position_m, place)
                exponent = (right**2 + ahead**2) / flat + rise**2 / high
                ratio += gain / density / (2 * np.pi * flat) * np.exp(-exponent / 2)
            beside = [
                o for o in b if o.label == item.label
                and np.linalg.norm(np.subtract(o.position_m, item.position_m)) <= combine.ROW_M
            ]  # fmt: skip
            total += np.log(combine.ABSENT + (1 - combine.ABSENT) * ratio) / len(beside)
        expected.append(total)
    assert evidence.scores(motions) == pytest.approx(expected, rel=1e-9)


def test_a_transform_is_no_better_known_than_the_objects_tell():
    """A ring of chairs fits in eight ways; one lamp beside it tells which."""
    angles = np.arange(8) * np.pi / 4
    ring = [
        make_node(i + 1, "chair", (2 * np.cos(t), 2 * np.sin(t), 0)) for i, t in enumerate(angles)
    ]
    lamp = make_node(9, "lamp", (2.0, 0.7, 0.0))
    vague = SceneGraph(make_graph(ring))
    found = combine.alignments(list(vague), list(vague))
    assert found[0].confidence < 0.5
    clear = SceneGraph(make_graph([*ring, lamp, make_node(10, "cup", (0.5, -0.3, 0.4))]))
    found = combine.alignments(list(clear), list(clear))
    assert found[0].confidence > combine.MIN_CONFIDENCE
    assert found[0].T_a_b == pytest.approx(np.eye(4), abs=1e-6)
    assert [item.evidence_nats for item in found] == sorted(
        (item.evidence_nats for item in found), reverse=True
    )


def test_a_third_of_the_objects_may_have_moved_and_names_may_be_unsure(room):
    rng = np.random.default_rng(1)
    nodes = [item.state for item in room]
    T = rigid_motion(np.array([4.0, 1.0, 0.0]), np.array([0.0, 0.0, 2.2]))
    changed = []
    for node in list(SceneGraph(turned(room, T).message)):
        state = node.state
        if rng.random() < 1 / 3:
            shift = rng.uniform(-1.5, 1.5, 3) * [1, 1, 0]
            state = combine.moved_object(
                node, rigid_motion(shift, np.zeros(3)), node.frame_id, node.up
            ).state
        unsure = [wire.Belief(state.label, 0.4), wire.Belief("thing", 0.3)]
        changed.append(msgspec.structs.replace(state, named=False, label="object", classes=unsure))
    found = align(list(room), list(SceneGraph(make_graph(changed))))
    rest = found.T_a_b @ T
    assert found.confidence > combine.MIN_CONFIDENCE
    assert np.linalg.norm(rest[:3, 3]) < 0.1
    assert rotation_angle_deg(rest[:3, :3]) < 2.0
    assert len(nodes) > found.matched >= 0.4 * len(nodes)


def test_sums_of_a_merge_are_those_that_a_message_may_have():
    most, same = 2**63 - 1, np.eye(4)
    many = SceneGraph(make_graph([make_node(1, "cup", observations=most)]))
    whole = wire.encode(combine.combine(many, many, same).message)
    assert wire.decode(whole, wire.SceneGraphMessage).nodes[0].observations == most
    last = SceneGraph(make_graph([make_node(most, "cup")]))
    other = SceneGraph(make_graph([make_node(1, "dog", (9, 0, 0)), make_node(2, "cat", (0, 9, 0))]))
    with pytest.raises(ClientError, match="2 objects need new ids"):
        combine.combine(last, other, same)
    assert combine.combine(other, last, same).ids == {most: 3}
    assert combine.combine(last, last, same).ids == {most: most}


def test_a_name_of_one_graph_is_that_of_both():
    unnamed = make_node(1, "object", named=False, classes=[wire.Belief("cup", 0.4)])
    graphs = [SceneGraph(make_graph([node])) for node in (unnamed, make_node(1, "cup"))]
    for a, b, name in ((0, 0, "object"), (0, 1, "cup"), (1, 0, "cup")):
        (node,) = combine.combine(graphs[a], graphs[b], np.eye(4)).message.nodes
        assert (node.label, node.named) == (name, name == "cup")


def objects(count: int, seed: int) -> list[SceneObject]:
    rng = np.random.default_rng(seed)
    labels, places = rng.choice(["cup", "chair", "lamp"], count), rng.uniform(0, 3, (count, 3))
    sizes = rng.uniform(0.001, 0.1, (count, 3))
    rows = enumerate(zip(labels.tolist(), places, sizes), start=1)
    return list(SceneGraph(make_graph([make_node(i, a, b, np.diag(c)) for i, (a, b, c) in rows])))


@pytest.mark.parametrize("counts", [(0, 0), (0, 3), (1, 1), (3, 8), (40, 60), (60, 40)])
def test_the_assignment_is_that_of_all_pairs(counts):
    before, after = objects(counts[0], 1), objects(counts[1], 2)
    table = np.array([[changes._place_cost(a, b) for b in after] for a in before])
    table = table.reshape(len(before), len(after))
    rows, columns = linear_sum_assignment(np.where(np.isfinite(table), table, 1e6))
    expected = [
        (before[a].id, after[b].id) for a, b in zip(rows, columns) if np.isfinite(table[a, b])
    ]
    found = [(pair.before.id, pair.after.id) for pair in changes.matched_by_place(before, after)]
    assert found == expected
    assert len(found) > 5 or min(counts) < 40
