"""A graph that continues from a map equals one that never stopped."""

import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import UNSET
from support.killing import full_disk, killed, moments_s, names
from support.merging import VOCABULARY, random_local_graphs
from support.spaces import seen_room
from support.surfaces import CHAIR, CUP, TABLE, WHOLE, frame, slab
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.config import Config, InputsConfig, MergingConfig, OutputConfig, RelationsConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import claim_map, continue_map, previous_of, read_map, write_map
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import LocalGraph, Relations

MUG = slab((0.5, 0, 1.05), (0.08, 0.08, 0.1))
# A table and a mug on it in a world whose y axis points up.
TOP, MUG_ON_TOP = slab((0, 0.7, 1), (1.2, 0.04, 0.8)), slab((0.2, 0.77, 1), (0.08, 0.1, 0.08))
CHAIR_BESIDE = slab((0.9, 0.25, 1), (0.4, 0.5, 0.4))


def config_of(**merging: object) -> Config:
    return Config(merging=MergingConfig(**merging), output=OutputConfig(min_existence=0.0))


def builder_of(*frames: LocalGraph, config: Config | None = None) -> GraphBuilder:
    builder = GraphBuilder(config_of() if config is None else config, VOCABULARY, "world")
    for local in frames:
        builder.integrate(local)
    return builder


def seen(times: int, **merging: object) -> GraphBuilder:
    """A table that some frames show."""
    frames = (frame(stamp, (WHOLE, TABLE)) for stamp in range(1, 1 + times))
    return builder_of(*frames, config=config_of(**merging))


def saved(builder: GraphBuilder, folder: Path) -> Path:
    write_map(builder, folder / "room.map")
    return folder / "room.map"


def observations(path: Path) -> list[int]:
    return read_map(Config(), path).graph.nodes.observations.tolist()


@pytest.mark.parametrize("association", ["surface", "paper"])
@pytest.mark.parametrize("seed", range(4))
def test_continuing_from_a_map_equals_not_stopping(tmp_path, association, seed):
    # A map leaves out hidden nodes. Here every node is published.
    config = config_of(association=association)
    frames = random_local_graphs(np.random.default_rng(seed), 90)
    whole = builder_of(*frames[:60], config=config)
    if not seed:  # more than the tables begin with
        assert len(whole.graph) > 64 or len(whole.graph.edges) > 64
    whole.graph.take_removals()
    path = saved(whole, tmp_path)
    before, again = path.read_bytes(), read_map(config, path)
    assert saved(again, tmp_path).read_bytes() == before
    assert again.full().nodes == whole.full().nodes
    for local in frames[60:]:
        assert again.integrate(local) == whole.integrate(local)
    one, other = (graph_files.to_arrays(b.graph.state()) for b in (again, whole))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def upright_frame(stamp: int) -> LocalGraph:
    """A table, a mug on it and a chair, from a level camera in a world whose y axis points up."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    relations = Relations(np.array([[1, 0]]), np.array([[3.0, -1.0, -3.0]]), np.ones(1))
    objects = ((TOP, TABLE), (MUG_ON_TOP, CUP), (CHAIR_BESIDE, CHAIR))
    return frame(stamp, *objects, T_world_camera=T, relations=relations)


@pytest.mark.parametrize("edge_belief", ["robust", "paper"])
def test_edges_of_a_map_are_equal_and_continue_equally(tmp_path, edge_belief):
    config = Config(relations=RelationsConfig(edge_belief=edge_belief))
    whole = builder_of(*map(upright_frame, range(1, 5)), config=config)
    again = read_map(config, saved(whole, tmp_path))
    np.testing.assert_array_equal(again.up.up_world(), whole.up.up_world())
    np.testing.assert_allclose(whole.up.up_world(), [0, 1, 0], atol=1e-9)
    assert [(e.subject, e.object, e.predicate) for e in whole.full().edges][:1] == [(2, 1, "on")]
    for stamp in range(5, 9):
        one, other = again.full(), whole.full()
        assert (one.nodes, one.edges) == (other.nodes, other.edges)
        assert len(whole.graph.votes) == (3 if edge_belief == "robust" else 0)
        for graph in (again.graph, whole.graph):
            assert {votes.frames for votes in graph.votes.values()} <= {stamp - 1}
        for builder in (whole, again):
            builder.integrate(upright_frame(stamp))


def version_1(arrays: dict[str, np.ndarray], votes: bool) -> dict[str, np.ndarray]:
    """It had revisions, as the last column of edges and the middle one of votes, and no `up`.

    Its first files had no votes, and no probabilities of existence.
    """
    header = {**msgspec.json.decode(arrays["header"].tobytes()), "version": 1, "revision": 99}
    edges, known = arrays["edge_counts"], arrays["vote_known"]
    left_out = {"up", "colours"}
    if not votes:
        left_out |= {"vote_pairs", "vote_known", "vote_counts", "existence"}
    return {
        **{name: values for name, values in arrays.items() if name not in left_out},
        "header": np.frombuffer(msgspec.json.encode(header), np.uint8),
        "revisions": np.arange(len(arrays["ids"])),
        "edge_counts": np.column_stack([edges, np.arange(len(edges))]),
        **({"vote_known": np.insert(known, 1, np.arange(len(known)), axis=1)} if votes else {}),
    }


@pytest.mark.parametrize("votes", [True, False])
def test_a_map_of_an_older_release_has_no_up_direction_and_may_have_no_votes(tmp_path, votes):
    builder = builder_of(*map(upright_frame, range(1, 5)))
    path = saved(builder, tmp_path)
    arrays = graph_files.read(path)
    graph_files.write(path, version_1(arrays, votes))
    again = read_map(Config(), path)
    state = graph_files.to_arrays(again.graph.state())
    for name in ("edge_counts", "edge_pairs", *(["vote_known", "vote_counts"] if votes else [])):
        np.testing.assert_array_equal(state[name], arrays[name], err_msg=name)
    np.testing.assert_array_equal(again.up.up_world(), [0, 0, 1])
    # Without an up direction, boxes stand on another axis.
    ours, theirs = (
        [msgspec.structs.replace(node, box=UNSET, existence=UNSET) for node in one.full().nodes]
        for one in (again, builder)
    )
    assert ours == theirs and bool(again.graph.votes) == votes
    again.integrate(upright_frame(9))
    np.testing.assert_allclose(again.up.up_world(), [0, 1, 0], atol=1e-9)


def test_hidden_nodes_are_dropped_and_ids_and_priors_continue(tmp_path):
    frames = [frame(stamp, (WHOLE, TABLE)) for stamp in range(1, 5)]
    builder = builder_of(*frames, config=Config())
    unsure = np.array([0.9, 0.2])
    assert builder.integrate(frame(5, (WHOLE, TABLE), (MUG, CUP), scores=unsure)) == [1, 2]
    pair, prediction = np.array([[CUP, TABLE]]), np.array([[0.7, 0.2, 0.1]])
    builder.prior.update(pair, prediction)
    again = read_map(Config(), saved(builder, tmp_path))
    np.testing.assert_allclose(again.prior.lookup(pair)[0], prediction)
    assert list(again.graph.nodes.slot_of) == [1]
    # The first update contains the whole map.
    update = again.update()
    assert [node.id for node in update.nodes] == [1] and not update.removed_nodes
    assert update.stamp == read_map(Config(), tmp_path / "room.map").full().stamp
    # Older than the map: another recording of the place.
    assert again.integrate(frame(2, (WHOLE, TABLE), (MUG, CUP))) == [1, 3]


@pytest.mark.parametrize("association", ["paper", "surface"])
def test_objects_of_another_rule_or_cell_size_are_recognised(tmp_path, association):
    path = saved(seen(4, association=association), tmp_path)
    arrays = graph_files.read(path)
    if association == "surface":
        # The cells themselves must not be used: they are not those of the object.
        arrays |= {"merging.cell_m": np.array(0.02), "merging.blocks": np.zeros(0)}
    graph_files.write(path, arrays)
    assert read_map(Config(), path).integrate(frame(6, (WHOLE, TABLE))) == [1]


# --- safe writing --------------------------------------------------------------------------------


def test_an_unwritable_map_is_refused_at_the_start(tmp_path):
    claim_map(tmp_path / "maps" / "room.map").release()
    assert names(tmp_path / "maps") == []
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match=r"map .*room\.map cannot be written: \w+"):
        claim_map(tmp_path / "file" / "room.map")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("--map out/scene_graph.json", "the result scene_graph.json and the map"),
        ("--map link/run.json", "the result run.json and the map"),
        ("--map out/a --save-trajectory out/a", "the trajectory and the map are one"),
        ("--map a --save-trajectory ./a.previous", "the trajectory and the map's previous"),
        ("--save-trajectory out/../out/config.yaml", "the result config.yaml and the trajectory"),
    ],
)
def test_a_run_does_not_write_over_its_own_files(tmp_path, monkeypatch, options, problem):
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    Path("link").symlink_to("out")
    # No such recording: the paths are looked at before it.
    done = CliRunner().invoke(app, ["run", "none", "--out", "out", *options.split()])
    assert done.exit_code == 2
    assert problem in " ".join(done.stderr.split())
    assert names(tmp_path / "out") == []


@pytest.mark.parametrize("name", ["a.json", "a.frames.json", "a.space.npz"])
def test_a_node_does_not_write_its_graph_over_its_map(tmp_path, name):
    pytest.importorskip("rclpy")
    from deworldsg_ros.ros.graph_keeper import GraphFiles
    from deworldsg_ros.ros.options import NodeOptions, Parameters

    parameters = Parameters(node=NodeOptions(str(tmp_path / "a.json"), str(tmp_path / name)))
    with pytest.raises(ConfigurationError, match="and the map are one file"):
        GraphFiles(SimpleNamespace(parameters=parameters))
    assert names(tmp_path) == []


def test_a_second_writer_of_a_map_is_refused_in_words(tmp_path):
    path = tmp_path / "room.map"
    with claim_map(path):
        write_map(seen(4), path)  # of the same process
        if os.fork() == 0:  # pragma: no cover
            code = 1
            with suppress(ConfigurationError):
                write_map(seen(5), path)
                code = 0
            os._exit(code)
        assert os.waitstatus_to_exitcode(os.wait()[1]) == 1
        with pytest.raises(
            ConfigurationError, match=r"map .*room\.map cannot be written: process "
        ):
            claim_map(path)
    write_map(seen(5), path)
    assert names(tmp_path) == ["room.map", "room.map.previous"]


def test_a_broken_map_falls_back_to_the_one_before_and_says_so(tmp_path):
    path = tmp_path / "room.map"
    assert continue_map(Config(), path) is None
    write_map(seen(4), path)
    write_map(seen(6), path)
    path.write_bytes(path.read_bytes()[:1000])
    continued = continue_map(Config(), path)
    assert continued is not None and not continued.newest
    assert continued.builder.graph.nodes.observations.tolist() == [4]
    for words in (f"map {path} cannot be used: ", "Continuing the map before it"):
        assert words in continued.message
    # The broken one is kept aside: the next write must not put it behind the whole one.
    write_map(continued.builder, path)
    assert names(tmp_path) == ["room.map", "room.map.broken", "room.map.previous"]
    for generation in (path, previous_of(path)):
        assert observations(generation) == [4]
    path.write_bytes(b"")
    previous_of(path).write_bytes(b"")
    with pytest.raises(ConfigurationError, match="cannot be used"):
        continue_map(Config(), path)


def test_a_kill_at_any_moment_leaves_a_whole_map(tmp_path):
    path = tmp_path / "room.map"
    builders = [seen(4), seen(5)]
    write_map(builders[0], path)
    for moment_s in moments_s(50, 0.03):
        turns = itertools.cycle(builders)
        killed(lambda turns=turns: write_map(next(turns), path), 0.005 + moment_s)
        assert observations(path)[0] in (4, 5)
        write_map(builders[0], path)
        assert names(tmp_path) == ["room.map", "room.map.previous"]


@contextmanager
def graph_node(path: Path, **values: object) -> Iterator[tuple[Any, Callable[[], None]]]:
    """A graph_node that writes this map, and how it sees an object."""
    rclpy = pytest.importorskip("rclpy")
    from std_msgs.msg import String
    from support.nodes_bench import Bench, local_graph, works

    from deworldsg_ros.nodes.graph_node import GraphNode

    values |= {"map_path": str(path), "output.min_existence": 0.0, "merging.association": "paper"}
    parameters = [rclpy.parameter.Parameter(name, value=value) for name, value in values.items()]
    with Bench(GraphNode, {"deworldsg/local_graph": String}, parameter_overrides=parameters) as at:
        yield (
            at,
            lambda: works(at, lambda: at.send(deworldsg__local_graph=local_graph(at.next_stamp()))),
        )


def test_a_node_writes_checkpoints_and_counts_what_cannot_be_written(tmp_path):
    path, config = tmp_path / "room.map", config_of(association="paper")
    with graph_node(path, map_period_s=0.2) as (at, see):
        see()
        at.expect(path.exists, "a checkpoint")
        assert list(read_map(config, path).graph.nodes.slot_of) == [1]
        with full_disk(100):
            see()
            at.expect(lambda: at.node.health.drops.get("map_not_written"), "the refusal")
        assert list(read_map(config, path).graph.nodes.slot_of) == [1]


def test_the_node_continues_its_map_and_writes_it_at_the_end(tmp_path):
    path = tmp_path / "maps" / "room.map"
    for _ in range(2):  # the second walk sees what the first one saw
        with graph_node(path) as (at, see):
            see()
            at.expect(lambda at=at: at.node.more_values().get("nodes") == "1", "one node")
    graph = read_map(config_of(association="paper"), path).graph
    assert list(graph.nodes.slot_of) == [1]
    assert graph.nodes.observations.tolist() >= [2]
    for generation in path.parent.iterdir():
        generation.write_text("no map")
    with pytest.raises(ConfigurationError, match=r"room\.map"), graph_node(path):
        pass


def test_rooms_are_in_the_graph_the_map_and_edits(tmp_path: Path) -> None:
    config = msgspec.structs.replace(config_of(), inputs=InputsConfig(world_up="z"))
    builder = builder_of(*(frame(stamp, (WHOLE, TABLE)) for stamp in range(1, 5)), config=config)
    assert builder.full().rooms is UNSET
    builder.space = seen_room()
    builder.find_rooms_and_things()
    (room,) = builder.full().rooms
    assert 8.0 < room.area_m2 < 12.5 and room.objects[0].id == 1
    update = builder.update()
    assert update.rooms == [room] and update.storeys_m == [pytest.approx(0.0, abs=0.05)]
    assert builder.snapshot().rooms == [room]
    builder.find_rooms_and_things()
    assert builder.update() is None  # nothing new
    path = saved(builder, tmp_path)
    for words, label in ((["study"], "study"), ([], room.label)):
        done = CliRunner().invoke(app, ["edit", str(path), "name_room", str(room.id), *words])
        assert done.exit_code == 0, done.output
        again = read_map(config, path)
        again.find_rooms_and_things()
        (kept,) = again.full().rooms
        assert (kept.id, kept.label) == (room.id, label)
    refused = CliRunner().invoke(app, ["edit", str(path), "name_room", "9", "study"])
    assert refused.exit_code != 0 and "room 9 is unknown; rooms: 1" in refused.output


def test_the_paper_has_no_rooms() -> None:
    builder = seen(4, association="paper")
    builder.space = seen_room()
    builder.find_rooms_and_things()
    assert builder.full().rooms is UNSET and not builder.rooms.arrays()
