"""What the graph says of small rooms: the true support, and none of the edges once said wrongly.

Each room is a few objects of COCO classes with sampled surfaces. An edge is said if its predicate
has a probability of at least 0.5.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pytest
from support.room_nodes import Thing, bowl, chair, plant, room, said, table, thing, vote

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.client.explain import explain_relation, is_contradicted
from deworldsg_ros.config import Config, RelationsConfig
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.wire import messages as wire

Edge = tuple[str, str, str]
# Frames that showed all objects of a room.
FRAMES = 40
# Relations that hold in the other direction too, under another name.
CONVERSES = {"above": "under", "under": "above"}


def edges(text: str) -> list[Edge]:
    return [tuple(edge.split()) for edge in text.split(", ") if edge]


class Case(NamedTuple):
    """A room with the edges that hold in it, and some that were once said of such a room."""

    name: str
    things: dict[str, Thing]
    true: list[Edge]
    wrong: list[Edge]


def case(name: str, true: str, wrong: str, **things: Thing) -> Case:
    return Case(name, things, edges(true), edges(wrong))


def on_table(label: str, x: float, y: float, *size: float) -> Thing:
    return thing(label, x, y, 0.74, *size)


TABLE = table(0, 0)
BOTTLE = on_table("bottle", 0.3, 0.25, 0.075, 0.075, 0.3)
OVEN = thing("oven", 0.0, 0.0, 0.0, 0.6, 0.6, 0.86)

CASES = [
    case(
        "a chair under a table",
        "",
        "chair on table, table on chair, chair under table",
        table=TABLE, chair=chair(0, 0.45),
    ),
    case(
        "a bottle on a table, a chair beside it",
        "bottle on table",
        "bottle on chair, bottle above chair",
        table=TABLE, chair=chair(0.3, 0.5), bottle=BOTTLE,
    ),
    case(
        "a bottle 2.5 m from a refrigerator",
        "bottle on table",
        "bottle against fridge, table against fridge",
        table=TABLE, fridge=thing("refrigerator", 3.4, 0.0, 0.0, 0.66, 0.7, 1.76), bottle=BOTTLE,
    ),
    case(
        "a tv on the wall, 1.8 m from a table and higher",
        "",
        "tv above table, tv on table, table under tv",
        table=TABLE, tv=thing("tv", 0, 2.25, 1.0, 1.1, 0.06, 0.65),
    ),
    case(
        "a microwave on an oven",
        "microwave on oven",
        "microwave above oven, oven on microwave, microwave in oven",
        oven=OVEN, microwave=thing("microwave", 0, 0.05, 0.86, 0.5, 0.4, 0.29),
    ),
    case(
        "a microwave on a counter, beside an oven",
        "microwave on counter",
        "microwave on oven, microwave above oven",
        counter=table(-0.87, 0, 1.1, 0.6, 0.9), oven=OVEN,
        microwave=thing("microwave", -0.6, 0.05, 0.9, 0.5, 0.4, 0.29),
    ),
    case(
        "a vase beside a plant on a table",
        "vase on table, plant on table",
        "vase against plant, plant in vase, vase on plant, table against vase, table against plant",
        table=TABLE, vase=on_table("vase", -0.2, 0, 0.14, 0.14, 0.26), plant=plant(0.05, 0, 0.74),
    ),
    case(
        "a bowl on a counter, beside a refrigerator",
        "bowl on counter",
        "bowl on fridge, bowl against fridge, bowl in fridge",
        counter=table(0, 0, 1.6, 0.6, 0.9), bowl=bowl(0.6, 0, 0.9),
        fridge=thing("refrigerator", 1.16, 0, 0, 0.66, 0.66, 1.76),
    ),
    case(
        "a screen on a table",
        "screen on table",
        "table under screen, screen above table, table on screen",
        table=TABLE, screen=on_table("tv", 0, 0.1, 0.55, 0.12, 0.4),
    ),
    case(
        "a cup on one of two tables",
        "cup on table",
        "cup on other, table on other, cup above other",
        table=TABLE, other=table(0, 0.81), cup=on_table("cup", 0.4, 0.1, 0.09, 0.09, 0.1),
    ),
    case(
        "things side by side on a table",
        "cup on table, bowl on table, book on table",
        "cup on bowl, bowl on cup, cup on book, cup in bowl",
        table=TABLE, cup=on_table("cup", 0.1, 0, 0.09, 0.09, 0.1), bowl=bowl(0.3, 0, 0.74),
        book=on_table("book", -0.2, 0, 0.2, 0.28, 0.03),
    ),
]  # fmt: skip
every_case = pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])


def see(builder, ids, votes: Mapping[Edge, int]) -> None:
    """All objects were seen in `FRAMES` frames; some of these voted for the edges."""
    voted: dict[frozenset[str], int] = {}
    for (subject, predicate, object_), frames in votes.items():
        pair = frozenset((subject, object_))
        frames = min(frames, FRAMES - voted.get(pair, 0))
        voted[pair] = voted.get(pair, 0) + frames
        vote(builder, ids[subject], ids[object_], predicate, frames, CONVERSES.get(predicate))
    names = list(ids)
    for row, name in enumerate(names):
        for other in names[:row]:
            rest = FRAMES - voted.get(frozenset((name, other)), 0)
            vote(builder, ids[name], ids[other], None, rest)


def check(case: Case, told: dict[Edge, float]) -> None:
    """All of the true edges are said, and none of the wrong ones."""
    assert [edge for edge in case.wrong if told.get(edge, 0.0) >= 0.5] == []
    assert [edge for edge in case.true if told.get(edge, 0.0) < 0.5] == []


@every_case
def test_the_true_support_is_said(case: Case) -> None:
    for seed in range(2):  # by the surfaces alone
        builder, ids = room(case.things, seed=seed)
        check(case, said(builder, ids))
    # In nearly half of the frames the head saw the true edges, in a few it saw the wrong ones.
    see(builder, ids, {**dict.fromkeys(case.true, 18), **dict.fromkeys(case.wrong, 2)})
    check(case, said(builder, ids))


@pytest.mark.parametrize(
    ("case", "edge"),
    [
        pytest.param(case, edge, id=f"{case.name}: {' '.join(edge)}")
        for case in CASES
        for edge in case.wrong
        # Leaves hide the rim of a vase: what every frame says may be so.
        if edge != ("plant", "in", "vase")
    ],
)
def test_no_wrong_edge_is_said_even_if_every_frame_says_so(case: Case, edge: Edge) -> None:
    """The embedded head errs where its rules are misled, and then in all frames."""
    builder, ids = room(case.things)
    see(builder, ids, {edge: FRAMES})
    assert said(builder, ids).get(edge, 0.0) < 0.5


@every_case
def test_without_a_world_model_the_frames_alone_count(case: Case) -> None:
    builder, ids = room(case.things, Config(relations=RelationsConfig(world_model="none")))
    assert said(builder, ids) == {}
    see(builder, ids, dict.fromkeys(case.true, 36))
    check(case._replace(wrong=[]), said(builder, ids))


def test_near_are_the_next_ones_of_a_row() -> None:
    """The bounds of the books overlap with those of all others."""
    books = {f"b{i}": on_table("book", 0.05 * i - 0.3, 0, 0.05, 0.15, 0.2) for i in range(5)}
    cup = on_table("cup", 0.5, 0, 0.1, 0.1, 0.1)
    told = said(*room({"table": TABLE, **books, "cup": cup}))
    near = {frozenset(edge[::2]) for edge, p in told.items() if edge[1] == "near" and p > 0.5}
    assert near >= {frozenset((f"b{i}", f"b{i + 1}")) for i in range(4)}
    far = (("b0", "b3"), ("b0", "b4"), ("b1", "b4"), ("b4", "cup"), ("b0", "table"))
    assert not near & set(map(frozenset, far))


@pytest.mark.slow
def graph_of(recording: Path) -> wire.SceneGraphMessage:
    pipeline = Pipeline(Config())
    source = open_source(recording)
    try:
        for frame in Recording(source).frames():
            pipeline.process(frame)
    finally:
        source.close()
    return pipeline.graph()


def contradictions(graph: wire.SceneGraphMessage) -> list[str]:
    """What the explanations of published edges contradict."""
    relations = SceneGraph(graph).relations()
    assert relations and all(relation.measured_m is not None for relation in relations)
    return [str(explain_relation(item)) for item in relations if is_contradicted(item)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["office", "redkitchen"])
def test_no_explanation_contradicts_its_edge(shared_dir: Path, name: str) -> None:
    assert contradictions(graph_of(shared_dir / "data" / name)) == []


def test_the_shipped_recording() -> None:
    """With the embedded perception; the wrong edges are those of release 0.2.0."""
    graph = graph_of(Path(__file__).parents[2] / "bags" / "demo_room")
    assert contradictions(graph) == []
    labels = {node.id: node.label.replace(" ", "_") for node in graph.nodes}
    told = [
        (labels[edge.subject], edge.predicate, labels[edge.object])
        for edge in graph.edges
        if edge.probability >= 0.5
    ]
    wrong = edges(
        "chair on dining_table, bottle on chair, bottle against refrigerator, "
        "tv above dining_table, dining_table under tv, microwave on oven, "
        "vase against potted_plant, dining_table against vase, bowl on refrigerator"
    )
    assert not set(wrong) & set(told)
    on_table = {edge[0] for edge in told if edge[1:] == ("on", "dining_table")}
    assert {"bottle", "cup", "bowl", "vase", "laptop"} <= on_table
    assert len(told) < 60
