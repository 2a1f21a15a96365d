"""The store: what the database says is what the messages say, whatever happens."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
import typer.testing
from support.reference_updates import diff

from deworldsg_ros.cli.app import app
from deworldsg_ros.cli.store import add_joined
from deworldsg_ros.client.changes import MOVED_M
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.store import Store, StoreError
from deworldsg_ros.store.store import DATABASE_FILE, MESSAGES_FILE, StoreWriter, time_ns_from_text
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica, empty_scene_graph, join

SECOND = 10**9
HOSTILE = [
    "cup",
    "'}) DETACH DELETE o //",
    'a "quoted", label $names {key: 1} \\',
    "\u2028\u202e\u00ad",
    "`; DROP TABLE Object; --",
    "",
    "ünïcödé 杯 \U0001f375",
]


def node(node_id: int, label: str = "cup", x: float = 0.0, seen: int = 1) -> wire.NodeState:
    """An object whose box has its centre at (x, 0, 0)."""
    return wire.NodeState(
        id=node_id,
        label=label,
        classes=[wire.Belief(label, 0.8)],
        mean_m=[x, 0.0, 0.0],
        covariance_m2=[0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01],
        observations=seen,
        first_seen=wire.stamp_from_ns(SECOND),
        last_seen=wire.stamp_from_ns(SECOND),
        existence=0.5,
        box=wire.GravityBox([x, 0.0, 0.0], [0.1, 0.1, 0.1], [0.0, 0.0, 0.0, 1.0]),
    )


def edge(a: int, b: int, predicate: str = "on", probability: float = 0.75) -> wire.EdgeState:
    """A relation."""
    beliefs = [wire.Belief(predicate, probability)]
    return wire.EdgeState(a, b, predicate, probability, beliefs, "visual", 0.1, 3)


def graph(
    sequence: int,
    stamp_s: float,
    nodes: list[wire.NodeState],
    edges: list[wire.EdgeState] | None = None,
    session: str | msgspec.UnsetType = "s",
) -> wire.SceneGraphMessage:
    """A whole graph."""
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=wire.stamp_from_ns(round(stamp_s * SECOND)),
        frame_id="map",
        session=session,
        sequence=sequence,
        nodes=nodes,
        edges=edges or [],
    )


def random_messages(seed: int, number: int) -> list[wire.SceneGraphMessage]:
    """A session's graphs: objects come, move, change their labels and go, with relations."""
    rng = random.Random(seed)
    graphs = [empty_scene_graph("map")]
    nodes: dict[int, wire.NodeState] = {}
    edges: dict[tuple[int, int], wire.EdgeState] = {}
    for sequence in range(1, number + 1):
        for _ in range(rng.randint(0, 5)):
            i = rng.randint(1, 12)
            nodes[i] = node(i, rng.choice(HOSTILE), rng.choice([0.0, 0.01, 0.5]), sequence)
        for i in rng.sample(sorted(nodes), k=min(len(nodes), rng.randint(0, 2))):
            del nodes[i]
        edges = {pair: item for pair, item in edges.items() if set(pair) <= nodes.keys()}
        for _ in range(rng.randint(0, 4)):
            if len(nodes) > 1:
                a, b = rng.sample(sorted(nodes), 2)
                edges[a, b] = edge(a, b, rng.choice(HOSTILE), rng.random())
        for pair in rng.sample(sorted(edges), k=min(len(edges), rng.randint(0, 2))):
            del edges[pair]
        graphs.append(
            graph(
                sequence,
                sequence,
                [nodes[i] for i in sorted(nodes)],
                [edges[pair] for pair in sorted(edges)],
            )
        )
    return graphs


def updates(graphs: list[wire.SceneGraphMessage]) -> list[wire.SceneGraphUpdateMessage]:
    """The updates between a session's graphs."""
    found = [diff(a, b) for a, b in zip(graphs, graphs[1:])]
    return [msgspec.structs.replace(update, session="s") for update in found]


def content(store: Store) -> tuple[list[list[object]], list[list[object]]]:
    """Objects and relations of a database."""
    objects = store.ask(
        "MATCH (o:Object) RETURN o.id, o.label, o.probability, o.x, o.observations ORDER BY o.id"
    )
    relations = store.ask(
        "MATCH (a:Object)-[r:Relation]->(b:Object) RETURN a.id, b.id, r.predicate, r.probability "
        "ORDER BY a.id, b.id"
    )
    return objects.rows, relations.rows


def expected(message: wire.SceneGraphMessage) -> tuple[list[list[object]], list[list[object]]]:
    """The same of a message."""
    return (
        [[n.id, n.label, 0.4, n.mean_m[0], n.observations] for n in message.nodes],
        [[e.subject, e.object, e.predicate, e.probability] for e in message.edges],
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_database_is_the_graph_after_every_commit(tmp_path: Path, seed: int) -> None:
    graphs = random_messages(seed, 25)
    rng = random.Random(seed)
    with StoreWriter(tmp_path) as writer:
        for current, update in zip(graphs[1:], updates(graphs)):
            assert writer.add(update)
            assert not writer.add(update)
            if rng.random() < 0.5:
                writer.commit()
                assert content(Store(tmp_path)) == expected(current)
    store = Store(tmp_path)
    assert content(store) == expected(graphs[-1])
    before = store.ask("MATCH (s:Stay) RETURN s.* ORDER BY s.key").rows
    with StoreWriter(tmp_path) as writer:
        writer.rebuild()
    assert content(store) == expected(graphs[-1])
    assert store.ask("MATCH (s:Stay) RETURN s.* ORDER BY s.key").rows == before


@pytest.mark.parametrize("at_once", [True, False])
def test_where_everything_was_at_each_time(tmp_path: Path, at_once: bool) -> None:
    graphs = random_messages(7, 30)
    with StoreWriter(tmp_path) as writer:
        for update in updates(graphs):
            writer.add(update)
            if not at_once:
                writer.commit()
    store = Store(tmp_path)
    for current in graphs[1:]:
        stays = store.at(wire.ns_from_stamp(current.stamp))
        assert {(s.node, s.label) for s in stays} == {(n.id, n.label) for n in current.nodes}
        where = {n.id: n.mean_m[0] for n in current.nodes}
        assert all(abs(s.position_m[0] - where[s.node]) <= MOVED_M for s in stays)
    assert store.at(SECOND - 1) == []


@pytest.mark.parametrize("seed", range(3))
def test_joined_updates_have_the_effect_of_all(tmp_path: Path, seed: int) -> None:
    graphs = random_messages(seed, 24)
    one_by_one = updates(graphs)
    messages = [*one_by_one[:8], graphs[8], *one_by_one[8:]]
    replica = GraphReplica()
    for start in range(0, 24, 4):
        assert replica.apply(join(one_by_one[start : start + 4]))
        assert replica.message() == graphs[start + 4]
    with StoreWriter(tmp_path) as writer:
        assert add_joined(writer, messages[:5]) == 1
        assert add_joined(writer, messages[5:]) == 2  # the whole graph is known
        assert add_joined(writer, []) == 0
    assert content(Store(tmp_path)) == expected(graphs[-1])


def test_where_the_cup_was(tmp_path: Path) -> None:
    with StoreWriter(tmp_path) as writer:
        writer.add(graph(1, 100.0, [node(1, x=0.0), node(2, "dining table")], [edge(1, 2)]))
        writer.add(graph(2, 110.0, [node(1, x=0.05), node(2, "dining table")]))  # it trembles
        writer.add(graph(3, 120.0, [node(1, x=2.0), node(2, "desk")]))
        writer.add(graph(4, 130.0, [node(2, "desk")]))
    store = Store(tmp_path)

    def cups(seconds: float) -> list[float]:
        return [stay.position_m[0] for stay in store.at(round(seconds * SECOND), "cup")]

    assert [cups(s) for s in (99, 100, 119, 120, 129, 130)] == [[], [0.0], [0.0], [2.0], [2.0], []]
    assert [s.label for s in store.at(115 * SECOND, "tables")] == ["dining table"]
    assert store.at(125 * SECOND, "table") == []
    assert store.ask("MATCH (s:Stay) RETURN count(*)").rows == [[4]]


def test_a_new_session_replaces_the_graph_and_keeps_the_history(tmp_path: Path) -> None:
    with StoreWriter(tmp_path) as writer:
        writer.add(graph(5, 10.0, [node(1), node(2)], [edge(1, 2)], session="a"))
        first = diff(empty_scene_graph("map"), graph(1, 20.0, [node(1, "bowl")]))
        assert writer.add(msgspec.structs.replace(first, session="b"))
        with pytest.raises(RefusedInput, match="older than the newest"):
            writer.add(graph(9, 15.0, [node(3)], session="c"))
    store = Store(tmp_path)
    assert content(store) == ([[1, "bowl", 0.4, 0.0, 1]], [])
    assert [(s.node, s.label) for s in store.at(10 * SECOND)] == [(1, "cup"), (2, "cup")]
    assert [(s.node, s.label) for s in store.at(20 * SECOND)] == [(1, "bowl")]


def test_what_does_not_fit_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    graphs = random_messages(1, 5)
    changes = updates(graphs)
    with StoreWriter(tmp_path) as writer:
        writer.add(changes[0])
        size = (tmp_path / MESSAGES_FILE).stat().st_size
        other = msgspec.structs.replace(changes[1], session="other")
        far = msgspec.structs.replace(graphs[2], frame_id="odom", nodes=[node(1)])
        for message, reason in ((changes[2], "lost_updates"), (other, "lost_updates")):
            with pytest.raises(RefusedInput) as refusal:
                writer.add(message)
            assert refusal.value.reason == reason
        with pytest.raises(RefusedInput, match="frame 'odom': expected 'map'"):
            writer.add(far)
        assert (tmp_path / MESSAGES_FILE).stat().st_size == size
        assert writer.add(changes[1])  # it goes on
        # A relation with an object that is not there, as in a file of someone else.
        writer.add(graph(9, 50.0, [node(1)], [edge(1, 2), edge(2, 1), edge(1, 1)]))
    assert content(Store(tmp_path))[1] == [[1, 1, "on", 0.75]]


def test_strings_are_values_wherever_they_come_from(tmp_path: Path) -> None:
    folder = tmp_path / 'it\'s a "store" $x'
    nodes = [node(i, label) for i, label in enumerate(HOSTILE, 1)]
    edges = [edge(1, i, label) for i, label in enumerate(HOSTILE, 1)]
    with StoreWriter(folder) as writer:
        writer.add(graph(1, 1.0, nodes, edges))  # loaded at once
        one_by_one = diff(graph(1, 1.0, []), graph(2, 2.0, nodes[::-1], edges))
        writer.add(msgspec.structs.replace(one_by_one, session="s"))
    store = Store(folder)
    for number, label in enumerate(HOSTILE, 1):
        found = store.ask("MATCH (o:Object) WHERE o.label = $label RETURN o.id", {"label": label})
        assert found.rows == [[number]]
        found = store.ask(
            "MATCH ()-[r:Relation {predicate: $p}]->(o:Object) RETURN o.id", {"p": label}
        )
        assert found.rows == [[number]]
    assert len(store.at(SECOND)) == len(HOSTILE)
    assert store.at(SECOND, HOSTILE[1]) is not None


@pytest.mark.parametrize(
    ("cypher", "problem"),
    [
        ("FOO", "begins with 'FOO': expected MATCH"),
        ("MATCH (o:Object) RETRUN o", "input"),
        ("MATCH (o:Nothing) RETURN o", "Nothing"),
        ("MATCH (o:Object) DETACH DELETE o", "read-only"),
        ("MATCH (o:Object) SET o.x = 1", "read-only"),
        ("DROP TABLE Relation", "begins with 'DROP'"),
        ("", "begins with ''"),
        ("MATCH (o:Object) RETURN o.id; MATCH (o:Object) RETURN o.x", "more than one statement"),
        ("CALL show_functions() RETURN *", "begins with 'CALL'"),
        ("WITH 1 AS x CALL show_functions() RETURN x", "CALL is no part of a question"),
    ],
)
def test_a_question_that_cannot_be_answered(tmp_path: Path, cypher: str, problem: str) -> None:
    with StoreWriter(tmp_path) as writer:
        writer.add(graph(1, 1.0, [node(1)]))
    store = Store(tmp_path)
    with pytest.raises(StoreError, match=f"the question cannot be answered: .*{problem}"):
        store.ask(cypher)
    assert len(content(store)[0]) == 1


LOADED = "LOAD FROM 'FILE' (file_format='csv', header=false) RETURN *"


@pytest.mark.parametrize(
    "cypher",
    [
        LOADED,
        f"UNWIND [1] AS x {LOADED}",
        # A number ends where a word begins.
        f"UNWIND [1] AS x WITH x LIMIT 1{LOADED}",
        # For ladybug, the first of these comments ends later; for others, a string begins in it.
        f"UNWIND [1] AS x /***/ ' */ {LOADED} // '",
        f"UNWIND [1] AS x /* ' */ {LOADED} /* ' */",
        f"UNWIND ['\\''] AS x {LOADED} //'",
        f"RETURN 1; {LOADED}",
        "COPY (MATCH (o:Object) RETURN o.id) TO 'FILE'",
        "PROFILE COPY (MATCH (o:Object) RETURN o.id) TO 'FILE'",
        "EXPORT DATABASE 'FILE.folder'",
        "ATTACH 'FILE' AS other (dbtype lbug)",
        "INSTALL httpfs",
    ],
)
def test_a_question_neither_reads_nor_writes_other_files(tmp_path: Path, cypher: str) -> None:
    with StoreWriter(tmp_path / "store") as writer:
        writer.add(graph(1, 1.0, [node(1)]))
    file = tmp_path / "mine.csv"
    file.write_text("a secret\n")
    with pytest.raises(StoreError, match="the question cannot be answered: "):
        print(Store(tmp_path / "store").ask(cypher.replace("FILE", str(file))).rows)
    assert file.read_text() == "a secret\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.csv", "store"]


def test_strings_names_and_comments_of_a_question_are_free(tmp_path: Path) -> None:
    with StoreWriter(tmp_path) as writer:
        writer.add(graph(1, 1.0, [node(1, "load; // it")]))
    ask = Store(tmp_path).ask
    found = ask("match (o:Object) where o.label = 'load; // it' return o.id AS `copy`;")
    assert (found.columns, found.rows) == (["copy"], [[1]])
    cypher = '/* LOAD it; */ OPTIONAL MATCH (o:Object) // CALL\nRETURN "it\'s /* ", o.id //'
    assert ask(cypher).rows == [["it's /* ", 1]]


def test_a_damaged_database_is_made_anew(tmp_path: Path) -> None:
    message = graph(1, 1.0, [node(1), node(2)], [edge(1, 2)])
    with StoreWriter(tmp_path) as writer:
        writer.add(message)
    database = tmp_path / DATABASE_FILE
    whole = database.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no database" * 1000):
        database.write_bytes(damaged)
        assert content(Store(tmp_path)) == expected(message)
    database.unlink()
    assert content(Store(tmp_path)) == expected(message)


def test_a_line_that_was_cut_off_is_dropped_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    graphs = random_messages(3, 4)
    with StoreWriter(tmp_path) as writer:
        for update in updates(graphs)[:3]:
            writer.add(update)
    messages = tmp_path / MESSAGES_FILE
    whole = messages.read_bytes()
    messages.write_bytes(whole + b'{"schema":{"name":"scene_graph_upd')
    with StoreWriter(tmp_path) as writer:
        assert messages.read_bytes() == whole
        writer.add(updates(graphs)[3])
    assert content(Store(tmp_path)) == expected(graphs[4])
    lines = messages.read_bytes().splitlines(keepends=True)
    lines[1] = b'{"schema": 3}\n'
    messages.write_bytes(b"".join(lines))
    with pytest.raises(StoreError, match=rf"byte {len(lines[0])}: SceneGraphMessage: "):
        StoreWriter(tmp_path).rebuild()


def test_one_writer_at_a_time_and_readers_meanwhile(tmp_path: Path) -> None:
    with StoreWriter(tmp_path) as writer:
        writer.add(graph(1, 1.0, [node(1)]))
        writer.commit()
        writer.add(graph(2, 2.0, [node(1), node(2)]))
        with pytest.raises(BlockingIOError, match="writes it"):
            StoreWriter(tmp_path)
        assert len(content(Store(tmp_path))[0]) == 1  # the last commit
    assert len(content(Store(tmp_path))[0]) == 2


def test_no_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no store in .*deworldsg store add"):
        Store(tmp_path / "missing")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        StoreWriter(tmp_path / "file")


def test_the_extra_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ladybug", None)
    with pytest.raises(StoreError, match=r"pip install 'deworldsg_ros\[store\]'"):
        StoreWriter(tmp_path)


KILLED = """
import sys
from pathlib import Path
from deworldsg_ros.store.store import StoreWriter
from store.test_store import random_messages, updates
with StoreWriter(Path(sys.argv[1])) as writer:
    for number, update in enumerate(updates(random_messages(5, 400))):
        writer.add(update)
        print(number, flush=True)
        if number % 7 == 6:
            writer.commit()
"""


@pytest.mark.slow
def test_a_killed_writer_leaves_every_message_and_a_store_that_opens(
    tmp_path: Path, root_dir: Path
) -> None:
    graphs = random_messages(5, 400)
    paths = os.pathsep.join([str(root_dir), str(root_dir / "test"), *sys.path])
    rng = random.Random(0)
    for attempt in range(6):
        folder = tmp_path / str(attempt)
        process = subprocess.Popen(
            [sys.executable, "-c", KILLED, folder],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.5))
        process.send_signal(signal.SIGKILL)
        added = [1, *map(int, process.stdout.read().split())]
        process.wait()
        head = Store(folder).head
        assert head.sequence >= added[-1]
        assert content(Store(folder)) == expected(graphs[head.sequence])
        with StoreWriter(folder) as writer:
            assert writer.add(updates(graphs)[head.sequence])


def test_a_replica_of_the_messages_is_the_graph(tmp_path: Path) -> None:
    graphs = random_messages(11, 20)
    with StoreWriter(tmp_path) as writer:
        for update in updates(graphs):
            writer.add(update)
    replica = GraphReplica()
    for line in (tmp_path / MESSAGES_FILE).read_bytes().splitlines():
        replica.apply(wire.decode(line, wire.SceneGraphUpdateMessage))
    assert replica.message() == graphs[-1]


NEWEST = 1_700_000_000 * SECOND


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("12.5", 12.5),
        ("5 min ago", NEWEST / SECOND - 300),
        ("0.5h ago", NEWEST / SECOND - 1800),
        ("2023-11-14T22:13:20+00:00", 1_700_000_000),
        ("2023-11-14T23:13:20+01:00", 1_700_000_000),
    ],
)
def test_times(text: str, seconds: float) -> None:
    assert time_ns_from_text(text, NEWEST) == round(seconds * SECOND)


def test_times_of_the_newest_day() -> None:
    at_ten = time_ns_from_text("10:00", NEWEST)
    moment = time.localtime(at_ten // SECOND)
    assert (moment.tm_hour, moment.tm_min) == (10, 0)
    assert abs(at_ten - NEWEST) < 24 * 3600 * SECOND
    assert time_ns_from_text("9:05:01", NEWEST) == at_ten - (54 * 60 + 59) * SECOND


@pytest.mark.parametrize("text", ["", "soon", "25:00", "1e400", "1..2", "99999999999", "5 y ago"])
def test_no_time(text: str) -> None:
    with pytest.raises(StoreError, match=r"expected 10:00, "):
        time_ns_from_text(text, NEWEST)


def test_the_commands(tmp_path: Path) -> None:
    runner = typer.testing.CliRunner()
    file, store = tmp_path / "graph.json", str(tmp_path / "store")

    def run(*arguments: str) -> typer.testing.Result:
        return runner.invoke(app, ["store", *arguments])

    file.write_text(json.dumps(json.loads(wire.encode(graph(1, 100.0, [node(1)]))), indent=2))
    assert run("add", store, str(file)).stdout == f"1 message added to {store}\n"
    cypher = "MATCH (o:Object) WHERE o.label = $label RETURN o.id, o.x"
    assert json.loads(run("ask", store, cypher, "label=cup", "--json").stdout) == [
        {"o.id": 1, "o.x": 0.0}
    ]
    assert "o.id" in run("ask", store, cypher, "label=cup").stdout
    found = json.loads(run("at", store, "100", "cup", "--json").stdout)
    assert [(item["id"], item["until_s"]) for item in found] == [(1, None)]
    assert "cup #1" in run("at", store, "0 s ago").stdout
    assert run("rebuild", store).exit_code == 0
    for arguments in (
        ["add", store],
        ["add", store, str(tmp_path / "missing.json")],
        ["ask", store, "FOO"],
        ["ask", store, cypher, "label"],
        ["at", store, "soon"],
        ["rebuild", str(tmp_path)],
    ):
        result = run(*arguments)
        assert result.exit_code == 2 and result.stderr.startswith("error: ")
