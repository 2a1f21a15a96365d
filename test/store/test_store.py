"""The store: what the database says is what the messages say, whatever happens."""

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
from support.cli import printed, refusal
from support.killing import full_disk
from support.view import box_at, make_edge, make_graph, make_node, random_graphs, updates_of

from deworldsg_ros.cli.store import add_joined
from deworldsg_ros.client.changes import MOVED_M
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import APART_SESSION
from deworldsg_ros.store import Store, StoreError, database
from deworldsg_ros.store.store import DATABASE_FILE, MESSAGES_FILE, StoreWriter, time_ns_from_text
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica, join

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


def random_session(seed: int, count: int) -> list[wire.SceneGraphMessage]:
    return random_graphs(seed, count, HOSTILE, [0.0, 0.01, 0.5])


def node(node_id: int, label: str = "cup", x: float = 0.0) -> wire.NodeState:
    """An object whose box has its centre at (x, 0, 0)."""
    return make_node(node_id, label, (x, 0, 0), existence=0.5, box=box_at((x, 0, 0)))


def graph(sequence: int, stamp_s: float, nodes, edges=(), session="s") -> wire.SceneGraphMessage:
    stamp = wire.stamp_from_ns(round(stamp_s * SECOND))
    return make_graph(nodes, edges, sequence=sequence, stamp=stamp, session=session)


def written(folder: Path, *messages) -> Store:
    """A store of these messages."""
    with StoreWriter(folder) as writer:
        for message in messages:
            writer.add(message)
    return Store(folder)


def content(store: Store) -> tuple[list[list[object]], list[list[object]]]:
    """Objects and relations of a database."""
    with store.opened() as database:  # `ask` starts a process for each question
        objects = database.answer(
            "MATCH (o:Object) RETURN o.id, o.label, o.probability, o.x, o.observations "
            "ORDER BY o.id"
        )
        relations = database.answer(
            "MATCH (a:Object)-[r:Relation]->(b:Object) RETURN a.id, b.id, r.predicate, "
            "r.probability ORDER BY a.id, b.id"
        )
    return objects.rows, relations.rows


def expected(message: wire.SceneGraphMessage) -> tuple[list[list[object]], list[list[object]]]:
    """The same of a message."""
    return (
        [[n.id, n.label, 0.45, n.mean_m[0], n.observations] for n in message.nodes],
        [[e.subject, e.object, e.predicate, e.probability] for e in message.edges],
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_database_is_the_graph_after_every_commit(tmp_path, seed):
    graphs, rng = random_session(seed, 25), random.Random(seed)
    with StoreWriter(tmp_path) as writer:
        for current, update in zip(graphs[1:], updates_of(graphs)):
            assert writer.add(update)
            assert not writer.add(update)
            if rng.random() < 0.5:
                writer.commit()
                assert content(Store(tmp_path)) == expected(current)
    store = Store(tmp_path)
    assert content(store) == expected(graphs[-1])
    before = store.ask("MATCH (s:Stay) RETURN s.* ORDER BY s.key").rows
    with StoreWriter(tmp_path, anew=True):
        pass
    assert content(store) == expected(graphs[-1])
    assert store.ask("MATCH (s:Stay) RETURN s.* ORDER BY s.key").rows == before
    replica = GraphReplica()
    for line in (tmp_path / MESSAGES_FILE).read_bytes().splitlines():
        replica.apply(wire.decode(line, wire.SceneGraphUpdateMessage))
    assert replica.message() == graphs[-1]


@pytest.mark.parametrize("at_once", [True, False])
def test_where_everything_was_at_each_time(tmp_path, at_once):
    graphs = random_session(7, 30)
    with StoreWriter(tmp_path) as writer:
        for update in updates_of(graphs):
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
def test_joined_updates_have_the_effect_of_all(tmp_path, seed):
    graphs = random_session(seed, 24)
    one_by_one = updates_of(graphs)
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


def test_where_the_cup_was(tmp_path):
    store = written(
        tmp_path,
        graph(1, 100.0, [node(1, x=0.0), node(2, "dining table")], [make_edge(1, 2)]),
        graph(2, 110.0, [node(1, x=0.05), node(2, "dining table")]),  # it trembles
        graph(3, 120.0, [node(1, x=2.0), node(2, "bench")]),
        graph(4, 130.0, [node(2, "bench")]),
    )

    def cups(seconds):
        return [stay.position_m[0] for stay in store.at(round(seconds * SECOND), "cup")]

    assert [cups(s) for s in (99, 100, 119, 120, 129, 130)] == [[], [0.0], [0.0], [2.0], [2.0], []]
    for seconds, label, reason in (
        (99, "cup", "the history begins at"),
        (110, "bench", "the first bench came at"),
        (130, "cup", "the last cup was gone at"),
        (130, "fridge", "no fridge was ever there; there were bench, cup, dining table"),
    ):
        assert store.at(seconds * SECOND, label) == []
        assert store.why_nothing(seconds * SECOND, label).startswith(reason)
    assert [s.label for s in store.at(115 * SECOND, "tables")] == ["dining table"]
    assert store.at(125 * SECOND, "table") == []
    assert store.ask("MATCH (s:Stay) RETURN count(*)").rows == [[4]]


def test_a_new_session_replaces_the_graph_and_keeps_the_history(tmp_path):
    begun = [graph(n, 20.0 * n, [node(1, "bowl")] * n, session="b") for n in (0, 1)]
    messages = [graph(5, 10.0, [node(1), node(2)], [make_edge(1, 2)], "a"), *updates_of(begun)]
    store = written(tmp_path, *messages)
    with StoreWriter(tmp_path) as writer, pytest.raises(RefusedInput, match="older"):
        writer.add(graph(9, 15.0, [node(3)], session="c"))
    assert content(store) == ([[1, "bowl", 0.45, 0.0, 5]], [])
    assert [(s.node, s.label) for s in store.at(10 * SECOND)] == [(1, "cup"), (2, "cup")]
    assert [(s.node, s.label) for s in store.at(20 * SECOND)] == [(1, "bowl")]


def test_what_does_not_fit_is_refused_and_changes_nothing(tmp_path):
    graphs = random_session(1, 5)
    first, second, third, *_ = updates_of(graphs)
    other = msgspec.structs.replace(second, session="other")
    far = msgspec.structs.replace(graphs[2], frame_id="odom", nodes=[node(1)])
    with StoreWriter(tmp_path) as writer:
        writer.add(first)
        before = (tmp_path / MESSAGES_FILE).read_bytes()
        for message, reason in ((third, "lost_updates"), (other, "lost_updates"), (far, "odom")):
            with pytest.raises(RefusedInput) as refused:
                writer.add(message)
            assert reason in f"{refused.value.reason} {refused.value}"
        apart = graph(9, 90.0, [node(7)], session=f"{APART_SESSION}b")
        assert not writer.add(apart)  # it waits to be found in its map
        assert (tmp_path / MESSAGES_FILE).read_bytes() == before
        assert writer.add(second)  # it goes on
        # A relation with an object that is not there, as in a file of someone else.
        edges = [make_edge(1, 2), make_edge(2, 1), make_edge(1, 1)]
        writer.add(graph(9, 50.0, [node(1)], edges))
    assert content(Store(tmp_path))[1] == [[1, 1, "on", 0.8]]


def test_strings_are_values_wherever_they_come_from(tmp_path):
    nodes = [node(i, label) for i, label in enumerate(HOSTILE, 1)]
    edges = [make_edge(1, i, label) for i, label in enumerate(HOSTILE, 1)]
    one_by_one = [graph(1, 1.0, []), graph(2, 2.0, nodes[::-1], edges)]
    folder = tmp_path / 'it\'s a "store" $x'
    store = written(folder, graph(1, 1.0, nodes, edges), *updates_of(one_by_one))
    relation = "MATCH ()-[r:Relation {predicate: $label}]->(o:Object)"
    for number, label in enumerate(HOSTILE, 1):
        for match in ("MATCH (o:Object) WHERE o.label = $label", relation):
            assert store.ask(f"{match} RETURN o.id", {"label": label}).rows == [[number]]
    assert len(store.at(SECOND)) == len(HOSTILE)
    assert store.at(SECOND, HOSTILE[1]) is not None


LOADED = "LOAD FROM 'FILE' (file_format='csv', header=false) RETURN *"


@pytest.mark.parametrize(
    ("cypher", "problem"),
    [
        ("FOO", "'FOO'"),
        ("MATCH (o:Object) RETRUN o", "input"),
        ("MATCH (o:Nothing) RETURN o", "Nothing"),
        ("MATCH (o:Object) DETACH DELETE o", "read-only"),
        ("MATCH (o:Object) SET o.x = 1", "read-only"),
        ("DROP TABLE Relation", "'DROP'"),
        ("", "''"),
        ("MATCH (o:Object) RETURN o.id; MATCH (o:Object) RETURN o.x", "one statement"),
        ("CALL show_functions() RETURN *", "'CALL'"),
        ("WITH 1 AS x CALL show_functions() RETURN x", "CALL"),
        # Other files are neither read nor written.
        (LOADED, ""),
        (f"UNWIND [1] AS x {LOADED}", ""),
        # A number ends where a word begins.
        (f"UNWIND [1] AS x WITH x LIMIT 1{LOADED}", ""),
        # For ladybug, the first of these comments ends later; for others, a string begins in it.
        (f"UNWIND [1] AS x /***/ ' */ {LOADED} // '", ""),
        (f"UNWIND [1] AS x /* ' */ {LOADED} /* ' */", ""),
        (f"UNWIND ['\\''] AS x {LOADED} //'", ""),
        (f"RETURN 1; {LOADED}", ""),
        ("COPY (MATCH (o:Object) RETURN o.id) TO 'FILE'", ""),
        ("PROFILE COPY (MATCH (o:Object) RETURN o.id) TO 'FILE'", ""),
        ("EXPORT DATABASE 'FILE.folder'", ""),
        ("ATTACH 'FILE' AS other (dbtype lbug)", ""),
        ("INSTALL httpfs", ""),
    ],
)
def test_what_is_no_question_is_refused(tmp_path, cypher, problem):
    store = written(tmp_path / "store", graph(1, 1.0, [node(1)]))
    file = tmp_path / "mine.csv"
    file.write_text("a secret\n")
    with pytest.raises(StoreError, match=f"the question cannot be answered: .*{problem}"):
        print(store.ask(cypher.replace("FILE", str(file))).rows)
    assert file.read_text() == "a secret\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.csv", "store"]
    assert len(content(store)[0]) == 1


def test_strings_names_and_comments_of_a_question_are_free(tmp_path):
    ask = written(tmp_path, graph(1, 1.0, [node(1, "load; // it")])).ask
    found = ask("match (o:Object) where o.label = 'load; // it' return o.id AS `copy`;")
    assert (found.columns, found.rows) == (["copy"], [[1]])
    cypher = '/* LOAD it; */ OPTIONAL MATCH (o:Object) // CALL\nRETURN "it\'s /* ", o.id //'
    assert ask(cypher).rows == [["it's /* ", 1]]


def test_a_damaged_database_is_made_anew(tmp_path):
    message = graph(1, 1.0, [node(1), node(2)], [make_edge(1, 2)])
    written(tmp_path, message)
    database = tmp_path / DATABASE_FILE
    whole = database.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no database" * 1000):
        database.write_bytes(damaged)
        assert content(Store(tmp_path)) == expected(message)
    database.unlink()
    assert content(Store(tmp_path)) == expected(message)


def test_a_line_that_was_cut_off_is_dropped_and_a_damaged_one_is_named(tmp_path):
    graphs = random_session(3, 4)
    *first, last = updates_of(graphs)
    written(tmp_path, *first)
    messages = tmp_path / MESSAGES_FILE
    whole = messages.read_bytes()
    messages.write_bytes(whole + b'{"schema":{"name":"scene_graph_upd')
    with StoreWriter(tmp_path) as writer:
        assert messages.read_bytes() == whole
        writer.add(last)
    assert content(Store(tmp_path)) == expected(graphs[4])
    lines = messages.read_bytes().splitlines(keepends=True)
    lines[1] = b'{"schema": 3}\n'
    messages.write_bytes(b"".join(lines))
    with pytest.raises(StoreError, match=f"byte {len(lines[0])}"):
        StoreWriter(tmp_path, anew=True)


@pytest.mark.parametrize(
    ("cypher", "parameters"),
    [
        ("RETURN $a", {"a": 10**30}),
        ("RETURN $a", {"a": object()}),
        ("RETURN $a", {"a": [[1], "x", {"y": []}]}),
        ("RETURN $a", {}),
        ("RETURN $b", {"a": 1}),
        ("MATCH (o:Object) WHERE o.id = $a RETURN o.label", {"a": "cup"}),
        ("MATCH (o:Nothing) RETURN o", {}),
    ],
)
def test_a_question_is_answered_or_refused_in_one_line(tmp_path, cypher, parameters):
    store = written(tmp_path, graph(1, 1.0, [node(1)]))
    try:
        assert store.ask(cypher, parameters).columns
    except StoreError as error:
        assert "cannot be answered" in str(error) and "\n" not in str(error)


def test_a_question_has_bounds(tmp_path, monkeypatch):
    store = written(tmp_path, graph(1, 1.0, [node(1)]))
    assert len(store.ask("UNWIND range(1, 1000) AS x RETURN x").rows) == 1000
    with pytest.raises(StoreError, match="it has 20000000 rows; expected at most"):
        store.ask("UNWIND range(1, 20000000) AS x RETURN x")
    monkeypatch.setattr(database, "QUESTION_LIMIT_S", 3.0)
    many = " ".join(f"UNWIND range(1, 3000) AS x{i}" for i in range(4))
    started_s = time.monotonic()
    with pytest.raises(StoreError, match="more than 3 s"):
        store.ask(f"{many} RETURN sum(x0 * x1 + x2 * x3)")
    assert time.monotonic() - started_s < 20.0


@pytest.mark.parametrize(
    "question",
    [
        "UNWIND range(1, 10000000000) AS x RETURN count(x)",  # 80 GB
        f"RETURN {'NOT ' * 12_000}true",  # ends ladybug
        f"RETURN {'[' * 1000}1{']' * 1000}",
    ],
)
def test_a_question_that_ends_the_database_does_not_end_its_asker(tmp_path, question):
    store = written(tmp_path, graph(1, 1.0, [node(1)]))
    with pytest.raises(StoreError, match="cannot be answered"):
        store.ask(question)
    assert store.ask("MATCH (o:Object) RETURN o.id").rows == [[1]]


@pytest.mark.parametrize("name", [MESSAGES_FILE, DATABASE_FILE, "graph.lock"])
def test_a_pipe_in_place_of_a_file_is_refused(tmp_path, name):
    written(tmp_path, graph(1, 1.0, [node(1)]))
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    message = tmp_path / "graph.json"
    message.write_text(wire.encode(graph(2, 2.0, [node(1)])))
    assert "pipe" in refusal("store", "add", tmp_path, message)


@pytest.mark.parametrize("seed", range(8))
def test_a_flipped_database_gives_an_answer_or_one_line(tmp_path, seed):
    messages = random_session(seed, 20)
    written(tmp_path, *messages)
    path = tmp_path / DATABASE_FILE
    content = bytearray(path.read_bytes())
    random_bytes = random.Random(seed)
    for _ in range(200):
        content[random_bytes.randrange(len(content))] ^= 1 << random_bytes.randrange(8)
    path.write_bytes(content)
    for words in (
        ("ask", tmp_path, "MATCH (o:Object) RETURN o.id, o.label"),
        ("at", tmp_path, "0"),
    ):
        code = f"from deworldsg_ros.cli.app import app; app({['store', *map(str, words)]})"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert "Traceback" not in done.stderr, done.stderr
        # Ladybug itself may crash on a damaged file.
        assert done.returncode in (0, 2, -signal.SIGSEGV, -signal.SIGABRT), done


def test_a_full_disk_is_one_line_and_loses_no_message(tmp_path):
    first = graph(1, 1.0, [node(1)])
    store = written(tmp_path, first)
    size_bytes = (tmp_path / DATABASE_FILE).stat().st_size
    with full_disk(size_bytes // 2), pytest.raises((StoreError, OSError)):
        written(tmp_path, graph(2, 2.0, [node(i) for i in range(1, 3000)]))
    written(tmp_path, graph(3, 3.0, [node(1), node(2)]))
    assert len(store.ask("MATCH (o:Object) RETURN o.id").rows) == 2


def test_a_last_line_without_its_end_is_kept_and_a_cut_file_is_named(tmp_path):
    store = written(tmp_path, graph(1, 10.0, [node(1)]), graph(2, 11.0, [node(1), node(2)]))
    messages, database = tmp_path / MESSAGES_FILE, tmp_path / "graph.lbug"
    whole = messages.read_bytes()
    messages.write_bytes(whole[:-1])
    with StoreWriter(tmp_path):
        pass
    assert messages.read_bytes() == whole
    messages.write_bytes(b"")
    with pytest.raises(StoreError, match="was cut"), StoreWriter(tmp_path):
        pass
    assert database.is_file()
    messages.write_bytes(whole + b"{}\n")
    with pytest.raises(StoreError, match="byte"), StoreWriter(tmp_path, anew=True):
        pass
    assert database.is_file()
    messages.write_bytes(whole)
    notes = tmp_path / "graph.lbug_notes.txt"
    notes.write_text("mine")
    with StoreWriter(tmp_path, anew=True):
        pass
    assert notes.read_text() == "mine" and len(content(store)[0]) == 2


@pytest.mark.parametrize("torn", [b"{", b'{"sch', b'{"schema":{"name":"scene_gr'])
def test_a_first_line_that_was_cut_off_is_dropped(tmp_path, torn):
    (tmp_path / MESSAGES_FILE).write_bytes(torn)
    with StoreWriter(tmp_path) as writer:
        assert writer.add(graph(1, 10.0, [node(1)]))
    assert len(content(Store(tmp_path))[0]) == 1


def test_messages_with_other_spaces_are_those_of_a_store(tmp_path):
    file = tmp_path / "graph.json"
    file.write_text(json.dumps(json.loads(wire.encode(graph(1, 10.0, [node(1)]))), indent=2))
    with StoreWriter(tmp_path / "store") as writer:
        writer.add_file(file)
    messages = tmp_path / "store" / MESSAGES_FILE
    whole = messages.read_bytes()
    messages.write_bytes(whole + b'{"sch')
    with StoreWriter(tmp_path / "store"):
        assert messages.read_bytes() == whole


def test_a_file_of_others_is_not_emptied(tmp_path):
    (tmp_path / MESSAGES_FILE).write_text("my diary")
    with pytest.raises(StoreError, match="no messages"), StoreWriter(tmp_path):
        pass
    assert (tmp_path / MESSAGES_FILE).read_text() == "my diary"


def test_one_writer_at_a_time_and_readers_meanwhile(tmp_path):
    with StoreWriter(tmp_path) as writer:
        writer.add(graph(1, 1.0, [node(1)]))
        writer.commit()
        writer.add(graph(2, 2.0, [node(1), node(2)]))
        with pytest.raises(BlockingIOError, match="writes it"):
            StoreWriter(tmp_path)
        assert len(content(Store(tmp_path))[0]) == 1  # the last commit
    assert len(content(Store(tmp_path))[0]) == 2


def test_no_store_and_no_extra(tmp_path, monkeypatch):
    with pytest.raises(StoreError, match="deworldsg store add"):
        Store(tmp_path / "missing")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        StoreWriter(tmp_path / "file")
    monkeypatch.setitem(sys.modules, "ladybug", None)
    with pytest.raises(StoreError, match=r"pip install 'deworldsg_ros\[store\]'"):
        StoreWriter(tmp_path)


KILLED = """
import sys
from pathlib import Path
from deworldsg_ros.store.store import StoreWriter
from store.test_store import random_session, updates_of
with StoreWriter(Path(sys.argv[1])) as writer:
    for number, update in enumerate(updates_of(random_session(5, 400))):
        writer.add(update)
        print(number, flush=True)
        if number % 7 == 6:
            writer.commit()
"""


@pytest.mark.slow
@pytest.mark.parametrize("attempt", range(6))
def test_a_killed_writer_leaves_every_message_and_a_store_that_opens(tmp_path, root_dir, attempt):
    graphs = random_session(5, 400)
    paths = os.pathsep.join([str(root_dir), str(root_dir / "test"), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, tmp_path],
        env={**os.environ, "PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(random.Random(attempt).uniform(0.0, 0.5))
    process.send_signal(signal.SIGKILL)
    added = [1, *map(int, process.stdout.read().split())]
    process.wait()
    head = Store(tmp_path).head
    assert head.sequence >= added[-1]
    assert content(Store(tmp_path)) == expected(graphs[head.sequence])
    with StoreWriter(tmp_path) as writer:
        assert writer.add(updates_of(graphs)[head.sequence])


NEWEST = 1_700_000_000 * SECOND


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("12.5", 12.5),
        ("now", NEWEST / SECOND),
        ("99999 d ago", 0),
        ("5 min ago", NEWEST / SECOND - 300),
        ("0.5h ago", NEWEST / SECOND - 1800),
        ("2023-11-14T22:13:20+00:00", 1_700_000_000),
        ("2023-11-14T23:13:20+01:00", 1_700_000_000),
    ],
)
def test_times(text, seconds):
    assert time_ns_from_text(text, NEWEST) == round(seconds * SECOND)


def test_times_of_the_newest_day():
    at_ten = time_ns_from_text("10:00", NEWEST)
    assert time.localtime(at_ten // SECOND)[3:5] == (10, 0)
    assert abs(at_ten - NEWEST) < 24 * 3600 * SECOND
    assert time_ns_from_text("9:05:01", NEWEST) == at_ten - (54 * 60 + 59) * SECOND


@pytest.mark.parametrize("text", ["", "soon", "25:00", "1e400", "1..2", "9999-01-01", "5 y ago"])
def test_no_time(text):
    with pytest.raises(StoreError, match="10:00|2262"):
        time_ns_from_text(text, NEWEST)


def test_the_commands(tmp_path):
    file, store = tmp_path / "graph.json", tmp_path / "store"
    file.write_text(json.dumps(json.loads(wire.encode(graph(1, 100.0, [node(1)]))), indent=2))
    assert printed("store", "add", store, file) == f"1 message added to {store}\n"
    cypher = "MATCH (o:Object) WHERE o.label = $label RETURN o.id, o.x"
    asked = ("store", "ask", store, cypher, "label=cup")
    assert json.loads(printed(*asked, "--json")) == [{"o.id": 1, "o.x": 0.0}]
    assert "o.id" in printed(*asked)
    (found,) = json.loads(printed("store", "at", store, "100", "cup", "--json"))
    assert (found["id"], found["until_s"]) == (1, None)
    assert "cup #1" in printed("store", "at", store, "now")
    assert "no sofa was ever there" in printed("store", "at", store, "now", "sofa")
    printed("store", "rebuild", store)
    for words in (
        ["add", store],
        ["add", store, tmp_path / "missing.json"],
        ["ask", store, "FOO"],
        ["ask", store, cypher, "label"],
        ["at", store, "soon"],
        ["rebuild", tmp_path],
    ):
        assert refusal("store", *words).startswith("error: ")


def room_of(room_id: int, label: str, to: int, objects: dict[int, float]) -> wire.RoomState:
    corners = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [0.0, 2.0, 0.0]]
    doors = [wire.Doorway(to, [0.0, 0.0, 0.0], 0.8)]
    inside = [wire.RoomObject(*item) for item in objects.items()]
    return wire.RoomState(room_id, label, [wire.Belief(label, 0.9)], 0, corners, 4.0, doors, inside)


def test_rooms_are_those_of_the_newest_message_that_has_some(tmp_path):
    nodes = [node(1), node(2, "oven")]
    first = graph(1, 1, nodes)
    first.rooms = [room_of(1, "kitchen", 2, {1: 0.8, 2: 1.0}), room_of(2, HOSTILE[1], 1, {})]
    first.storeys_m = [0.0]
    # An update without rooms leaves them; an object that goes leaves its room.
    second = graph(2, 2, nodes[:1])
    store = written(tmp_path, first, *updates_of([first, second]))
    asked = "MATCH (o:Object)-[i:Inside]->(r:Room) RETURN o.id, r.label, i.probability"
    assert store.ask(asked).rows == [[1, "kitchen", 0.8]]
    doors = "MATCH (a:Room)-[d:Doorway]->(b:Room) RETURN a.id, b.label, d.width_m ORDER BY a.id"
    assert store.ask(doors).rows == [[1, HOSTILE[1], 0.8], [2, "kitchen", 0.8]]
    (third,) = updates_of([second, graph(3, 3, nodes[:1])])
    third.rooms, third.storeys_m = [room_of(2, "office", 9, {1: 0.6, 77: 1.0})], [0.0]
    store = written(tmp_path, third)
    assert store.ask(asked).rows == [[1, "office", 0.6]]
    assert store.ask("MATCH (r:Room) RETURN r.id, r.x, r.area_m2").rows == [[2, 1.0, 4.0]]
    with StoreWriter(tmp_path, anew=True):
        pass
    assert store.ask(asked).rows == [[1, "office", 0.6]]
    # A whole graph without rooms has none.
    assert written(tmp_path, graph(1, 4, nodes, session="t")).ask(asked).rows == []
