"""Questions to a graph; with the index they are answered as by a look at every object."""

import itertools
import math
import subprocess
import sys
from dataclasses import FrozenInstanceError

import msgspec
import numpy as np
import pytest
from support.view import box_at, make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.boxes import gap_m
from deworldsg_ros.client.explain import explain_object
from deworldsg_ros.client.graph import _fits, distance_m
from deworldsg_ros.client.meanings import is_class
from deworldsg_ros.client.questions import ask
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire

LABELS = ["cup", "table", "dining table", "chair", "mug cup"]


@pytest.fixture
def small():
    """A cup on a table, a chair near the table, and a shelf far away."""
    nodes = [
        make_node(1, "cup", (0.0, 0.0, 0.80), np.diag([0.001, 0.001, 0.001])),
        make_node(2, "dining table", (0.0, 0.0, 0.60), np.diag([0.1, 0.05, 0.01])),
        make_node(3, "chair", (1.2, 0.0, 0.45), np.diag([0.02, 0.02, 0.05])),
        make_node(4, "shelf", (5.0, 0.0, 1.0), np.diag([0.02, 0.1, 0.2])),
    ]
    edges = [make_edge(1, 2, "standing on", 0.9), make_edge(2, 3, "near", 0.8)]
    return SceneGraph(make_graph(nodes, edges))


def ids(items) -> list[int]:
    return [item.id for item in items]


def test_an_empty_graph_answers_nothing():
    graph = SceneGraph(make_graph())
    assert len(graph) == 0
    assert graph.objects("cup") == graph.relations() == graph.on("table") == []
    assert graph.up == (0.0, 0.0, 1.0)
    with pytest.raises(ClientError, match="'cup'.* none"):
        graph.one("cup")
    with pytest.raises(ClientError, match="near"):
        graph.objects(within=1.0)


def test_an_object_without_a_name(small):
    cup = msgspec.structs.replace(small[1].state, label="object", named=False)
    cup = msgspec.structs.replace(cup, existence=0.9, classes=[wire.Belief("cup", 0.4)])
    graph = SceneGraph(make_graph([cup, small[2].state], [make_edge(1, 2, "on", 0.9)]))
    item = graph[1]
    assert (item.name, item.is_named, item.probability) == ("object #1", False, 0.9)
    assert item.probability_of("cup") == pytest.approx(0.36)
    assert ids(graph.objects("cup")) == [] and ids(graph.objects("object")) == [1]
    found = ask(graph, "what is on the table").found
    assert ids(graph.on("table")) == ids(answer.item for answer in found) == [1]
    said = str(explain_object(item, graph.relations(1)))
    assert "no class is probable enough for a name: cup 40%; all others 60%" in said


class SeenLeft:
    """Space where all before y = 5 was seen: free, but for the floor."""

    def look(self, points):
        seen, low = points[:, 1] < 5.0, points[:, 2] < 0.5
        return seen & ~low, seen & low


def test_what_is_known_of_a_place(small):
    def known(text, graph):
        return graph.explain(text).values["known"]

    def hidden(label, x, reason):
        return wire.HiddenNode(label, [x, 0.0, 0.5], 0.3, 4, reason)

    unnamed = make_node(
        9, "object", (-3.0, 0.0, 0.4), named=False, classes=[wire.Belief("chair", 0.4)]
    )
    message = msgspec.structs.replace(
        small.message,
        nodes=[*small.message.nodes, unnamed],
        hidden=[
            hidden("chair", 5.0, "seen too little"),
            hidden("cup", 7.0, "absent from its position"),
        ],
    )
    graph = SceneGraph(message)
    graph.space = SeenLeft()
    found = graph.explain("chair near (1.1, 0.1)")
    assert found.subject == "chair near (1.10, 0.10), within 1 m: chair #3 is there"
    assert [item["id"] for item in found.values["objects"]] == [3, 2]
    assert known("chair near (0, 0) within 20 cm", graph).startswith("other objects are there")
    assert "a chair with 0%" in str(graph.explain("chair near (0, 0) within 20 cm"))
    assert known("chair near (-3, 0)", graph) == "object #9 may be it"
    assert "no class is probable enough" in str(graph.explain("chair near (-3, 0)"))
    with pytest.raises(ClientError, match="without exponents"):
        graph.explain("chair near (1e999, 0)")
    assert known("chair near (5.2, 0)", graph) == "hidden: seen too little"
    gone = "removed: absent from its position"
    assert known("chair near (7, 0)", graph) == f"something else there is {gone}"
    assert known("cup near (7, 0)", graph) == known("anything near (7, 0)", graph) == gone
    assert known("anything near (-3, 0)", graph) == "object #9 is there"
    assert known("cup near (-9, 0)", graph) == "nothing was detected there, though it was in view"
    assert known("cup near (-9, 40)", graph) == "never in view"
    assert "100% never in view" in str(graph.explain("cup near (-9, 40)"))
    # With three numbers the height counts, and without a height none does.
    assert known("chair near (1.2, 0, 4)", graph) != known("chair near (1.2, 0)", graph)
    # A copy of the topics knows neither hidden objects nor space.
    told = str(small.explain("cup near (-9, 40) within 0.5 m"))
    assert "not in this message" in told and "not known here" in told
    # In a world with y up, two numbers are x and z.
    tall = SceneGraph(msgspec.structs.replace(small.message, up=[0.0, 1.0, 0.0]))
    assert known("chair near (1.2, 0.45) within 5 cm", tall) == "chair #3 is there"
    with pytest.raises(ClientError, match="'xyzzy'"):
        graph.explain("xyzzy near (0, 0)")


def test_relations_from_both_ends_and_paths(small):
    (on,) = small.relations("cup", "on")
    assert on.text == "cup #1 is standing on dining table #2"
    assert small.relations("cup", "lying on") == []
    assert ids(small.on("table")) == [1]
    assert ids(small.on(2, "chair")) == []
    (near,) = small.relations("chair", "near", "table")
    assert (near.subject.id, near.object.id, near.probability) == (3, 2, 0.8)
    assert near.unrelated == pytest.approx(0.2)
    assert len(small.relations(predicate="near")) == len(small.relations_of("chair")) == 1
    assert [(i.subject.id, i.object.id) for i in small.path("cup", "chair")] == [(1, 2), (2, 3)]
    assert small.path("cup", "shelf") == []
    # With an edge from the chair that says "under", the symmetric one is the table's.
    edges = [*small.message.edges, make_edge(3, 2, "under", 0.3)]
    assert SceneGraph(make_graph(small.message.nodes, edges)).relations("chair", "near") == []


def test_objects_are_frozen_and_tell_everything(small):
    cup = small[1]
    assert (cup.name, cup.probability, cup.box_source) == ("cup #1", 0.9, "gaussian")
    assert cup.other_classes == pytest.approx(0.0)
    assert cup.size_m == pytest.approx([12**0.5 * 0.0316] * 3, abs=2e-3)
    assert cup.to_dict()["sure"]
    with pytest.raises(FrozenInstanceError):
        cup.label = "bowl"
    with pytest.raises(ClientError, match="object 9 .* 4 objects"):
        small[9]
    doubtful = SceneGraph(make_graph([msgspec.structs.replace(cup.state, existence=0.5)]))[1]
    assert doubtful.probability == pytest.approx(0.45)
    assert not doubtful.is_sure


def test_a_triplet_is_as_probable_as_its_relation_and_its_ends_together(small):
    (near,) = small.relations("chair", "near", "table")
    ends = near.subject.probability * near.object.probability
    assert near.triplet_probability == pytest.approx(0.8 * ends)
    assert near.to_dict()["triplet_probability"] == pytest.approx(0.8 * ends, abs=1e-3)
    # The relation is as probable as before, and the sentence is not.
    chair, table = (small[i].state for i in (3, 2))
    doubtful = msgspec.structs.replace(chair, existence=0.3)
    (same,) = SceneGraph(make_graph([doubtful, table], small.message.edges)).relations("chair")
    assert same.probability == 0.8 and same.triplet_probability < 0.3
    (on,) = SceneGraph(make_graph([chair, table], [make_edge(3, 2, "on", 0.95)])).relations()
    assert on.is_sure and not same.is_sure
    # Without a name, it is enough that the thing exists.
    thing = msgspec.structs.replace(chair, named=False, label="object", existence=0.9)
    (of_thing,) = SceneGraph(make_graph([thing, table], small.message.edges)).relations(3)
    assert of_thing.triplet_probability == pytest.approx(0.8 * 0.9 * near.object.probability)


def test_heights_follow_the_up_direction():
    node = make_node(1, "cup", (0.0, -2.0, 0.0), np.diag([0.01, 0.0003, 0.01]))
    cup = SceneGraph(make_graph([node], up=[0.0, -1.0, 0.0]))[1]
    assert cup.height_m == pytest.approx(2.0)
    assert cup.size_m[2] == pytest.approx((12 * 0.0003) ** 0.5, abs=2e-3)
    assert cup.footprint.low == pytest.approx(2.0 - cup.size_m[2] / 2, abs=1e-3)


def test_a_file_of_version_1_is_read(room, tmp_path):
    assert room.message.schema.version == 1
    assert len(room) == 34
    (cup,) = room.on("dining table", "cup")
    assert cup.position_m == pytest.approx((-0.80, -0.15, 0.80), abs=0.03)
    assert cup.box_source == "surface"
    assert cup.size_m[2] == pytest.approx(0.104, abs=0.02)
    assert len(cup.surface_m) == 60
    assert room.hidden is None
    with pytest.raises(RefusedInput, match="cannot be read"):
        SceneGraph.load(tmp_path / "nowhere.json")


def test_the_client_of_files_needs_no_ros():
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "import deworldsg_ros.client as c; c.SceneGraph\n"
        "assert not {'numba', 'scipy'} & set(sys.modules)\n"  # which take a second to import
        "try: c.SceneGraphClient\nexcept ImportError: print('needs ROS')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "needs ROS\n"


@pytest.mark.parametrize(
    ("asked", "label", "same"),
    [
        ("", "cup", False),
        ("Cups", "cup", True),
        ("table", "dining table", True),
        ("dining table", "table", False),
        ("dining_tables", "dining table", True),
        ("shelves", "shelf", True),
        ("teddy", "teddy bear", True),
        ("bear", "teddy bear", True),
        ("teddy", "bear", False),
        ("sofas", "couch", True),
        ("fridge", "refrigerator", True),
        ("cup", "mug", True),
        ("mug", "cup", False),
        ("seat", "office chair", True),
        ("appliances", "oven", True),
        ("cup", "oven", False),
        ("glass", "wine glass", True),
    ],
)
def test_names_of_classes(asked, label, same):
    assert is_class(asked, label) == same


# --- the index ---------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["boxes", "some boxes"])
def graph(request):
    """120 objects in 6 m x 6 m, 300 relations; some objects without a box, some without a class."""
    rng = np.random.default_rng(3)
    nodes = []
    for number in range(1, 121):
        where = rng.uniform(-3, 3, 3)
        label, other = rng.choice(LABELS, 2, replace=False).tolist()
        box = box_at(where, rng.uniform(0.05, 1.5, 3), 2 * rng.uniform(0, math.pi))
        node = make_node(
            *(number, label, where, np.diag(rng.uniform(0.001, 0.1, 3))),
            classes=[wire.Belief(label, 0.6), wire.Belief(other, float(rng.uniform(0, 0.4)))],
            existence=float(rng.uniform(0.3, 1.0)),
            box=box if request.param == "boxes" or number % 3 else msgspec.UNSET,
        )
        nodes.append(node)
    names = ["on", "near", "under"]
    edges = [
        make_edge(*pair, str(rng.choice(names)), float(rng.uniform(0.3, 0.9)))
        for pair in {tuple(rng.integers(1, 125, 2).tolist()) for _ in range(300)}
    ]
    return SceneGraph(make_graph(nodes, edges))


@pytest.mark.parametrize("label", [None, "cup", "tables", "elephant"])
@pytest.mark.parametrize("least", [None, 0.0, 0.2, 0.5])
def test_objects(graph, label, least):
    expected = {item.id for item in graph if _fits(item, label, least)}
    assert set(ids(graph.objects(label, min_probability=least))) == expected
    for near in ((0.5, -1.0, 0.2), graph[7], graph[9]):
        by_hand = sorted((distance_m(graph[i], near), i) for i in expected if graph[i] is not near)
        for within in (0.0, 0.3, 1.0, 20.0, None):
            found = graph.objects(label, near=near, within=within, min_probability=least)
            assert ids(found) == [i for gap, i in by_hand if within is None or gap <= within]


def test_neighbours(graph):
    for item in list(graph)[:20]:
        gaps = sorted(
            (gap_m(item.footprint, other.footprint), other.id) for other in graph if other != item
        )
        near = [(gap, i) for gap, i in gaps if gap <= 0.4]
        found = graph.neighbours(item, 0.4)
        assert [other.id for other, _ in found] == [i for _, i in near]
        assert [gap for _, gap in found] == pytest.approx([gap for gap, _ in near])


@pytest.mark.parametrize("predicate", [None, "on", "near"])
def test_relations(graph, predicate):
    everything = graph.relations(None, predicate)
    of_each = [relation for i in range(1, 121) for relation in graph.relations(i, predicate)]
    for subject, object_ in itertools.product([None, "cup", "table", 5, 9, 124], repeat=2):
        is_subject, is_object = graph._chooser(subject), graph._chooser(object_)
        forward = [r for r in everything if is_subject(r.subject) and is_object(r.object)]
        found = graph.relations(subject, predicate, object_)
        assert all(is_subject(r.subject) and is_object(r.object) for r in found)
        assert all(relation in found for relation in forward)
        assert all(relation in everything or relation in of_each for relation in found)


def test_words(graph):
    def answers(question):
        return {answer.item.id for answer in ask(graph, question).found}

    assert answers("cup on table") and answers("cup near anything")
    near = graph.objects(near=(0.0, 0.0, 0.0), within=1.0)
    assert answers("anything near (0,0,0) within 1 m") == {
        item.id for item in near if item.probability >= 0.05
    }
    assert answers("chair within 0.5 m of table") == {
        item.id
        for item, other in itertools.permutations(graph, 2)
        if item.probability_of("chair") * other.probability_of("table") >= 0.05
        and other.probability_of("table") >= 0.05
        and gap_m(item.footprint, other.footprint) <= 0.5
    }
