"""A graph as a map: a file from which a later run continues.

It contains the graph, the state of merging, the priors of class pairs, the up direction, from which
frames everything comes, the space that the camera saw as free, and its rooms.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.base.files import (
    FileLock,
    check_different,
    check_writable,
    parse_json,
    paused_collector,
    read_regular,
    write_atomically,
)
from deworldsg_ros.base.words import counted, whole_number
from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.edits import GraphEdit
from deworldsg_ros.graph.nodes import MAX_ID
from deworldsg_ros.graph.provenance import FrameMemory, SeenFrames
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.graph_builder import GraphBuilder, graph_settings
from deworldsg_ros.merging.editing import EditReply
from deworldsg_ros.poses.trajectory import read_trajectory
from deworldsg_ros.relations.paper import ClassPairPrior, PriorState
from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.checks import checked, holds
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary

# Before the names of the arrays of merging.
_MERGING = "merging."
# So many ids are reserved at once, each time with a small file on the disk.
RESERVED_IDS = 100


def write_map(builder: GraphBuilder, path: Path) -> None:
    """Write a map; the map before it stays as `previous_of`.

    Raises:
        ConfigurationError: if it cannot be written, or another process writes it; an older file is
            then still there.
    """
    write_state(copy_state(builder), path)


def copy_state(builder: GraphBuilder) -> Arrays:
    """The content of a map, by name; the builder can go on while it is written."""
    builder.settle()
    prior = np.frombuffer(msgspec.json.encode(builder.prior.to_state()), np.uint8)
    memory = {_MERGING + name: np.array(v) for name, v in builder.merging.memory().items()}
    arrays = graph_files.to_arrays(builder.graph.state())
    seen = np.frombuffer(msgspec.json.encode(builder.frames.all(builder.graph)), np.uint8)
    up = np.array(builder.up.state())
    more: Arrays = {"prior": prior, "up": up, "seen_frames": seen, **builder.space.arrays()}
    more.update(builder.trail.arrays())
    more.update(builder.rooms.arrays())
    return {**arrays, **memory, **more}


def write_state(state: Arrays, path: Path) -> None:
    """Write the result of `copy_state`; as `write_map`."""
    with _writing(path), FileLock.unless_held(path):
        graph_files.write(path, state, previous=previous_of(path))


def previous_of(path: Path) -> Path:
    """Path of the generation before the map `path`."""
    return path.with_name(f"{path.name}.previous")


def apart_of(path: Path) -> Path:
    """Path of the graph of a run that was not found in the map `path`."""
    return path.with_name(f"{path.name}.apart")


def ids_of(path: Path) -> Path:
    """Path of the file that says from which id on no node of the map `path` was ever published."""
    return path.with_name(f"{path.name}.ids")


def write_first_id(path: Path, first_id: int) -> None:
    """Say from which id on no node of a map was ever published; then it is on the disk.

    Raises:
        ConfigurationError: if the file cannot be written.
    """
    with _writing(path):
        write_atomically(ids_of(path), f"{first_id}\n")


def first_id(path: Path) -> int:
    """The id of `write_first_id`; 1 without a file, or if it contains no number."""
    try:
        text = read_regular(ids_of(path), len(str(MAX_ID)) + 1).decode()
    except (OSError, ValueError):  # no number is no reason not to start
        return 1
    number = whole_number(text.strip())
    return number if number is not None and 1 <= number <= MAX_ID + 1 else 1


def check_paths(map_path: Path | None, others: Iterable[tuple[str, Path]]) -> None:
    """Test that a map, the generation before it, and what is written beside it are different files.

    Args:
        map_path: None = no map.
        others: what each is, in words, and its path.

    Raises:
        ConfigurationError: two are one file; the last one that is written would be left.
    """
    files = list(others)
    if map_path is not None:
        files += [("the map", map_path), ("the map's previous generation", previous_of(map_path))]
        files.append(("the map's ids", ids_of(map_path)))
        files.append(("a run that was not found in the map", apart_of(map_path)))
    try:
        check_different(files)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


def claim_map(path: Path) -> FileLock:
    """Make a map's folder, and take the right to write the map until `FileLock.release`.

    Raises:
        ConfigurationError: if the map could not be written there, or another process has the right.
    """
    with _writing(path):
        check_writable(path)
        return FileLock(path)


@dataclass(frozen=True)
class Continued:
    """A graph that continues from a map.

    Attributes:
        builder: the graph.
        message: the path and the size of the map, and why it is not the newest.
        newest: False if the newest map is broken, and this is the one before it.
    """

    builder: GraphBuilder
    message: str
    newest: bool


def continue_map(config: Config, path: Path) -> Continued | None:
    """Continue with the newest generation of a map that is whole; the caller has claimed it.

    No id that was ever published from this map is given to another node.

    Returns:
        None if there is no map yet.

    Raises:
        ConfigurationError: if the file is no map, and there is none before it.
    """
    previous = previous_of(path)
    if not path.exists() and not previous.exists():
        return None
    try:
        builder = read_map(config, path)
    except ConfigurationError as error:
        if not previous.exists():
            raise
        builder = read_map(config, previous)
        if path.exists():
            # The next write must not put it in place of the generation that is whole.
            path.replace(path.with_name(f"{path.name}.broken"))
        message = f"{error}. Continuing the map before it, {previous}: {_size(builder)}"
        builder.graph.skip_to(first_id(path))
        return Continued(builder, message, newest=False)
    builder.graph.skip_to(first_id(path))
    return Continued(builder, f"continuing map {path}: {_size(builder)}", newest=True)


def _size(builder: GraphBuilder) -> str:
    return f"{counted(len(builder.graph), 'node')} in frame '{builder.graph.frame_id}'"


def read_map(config: Config, path: Path) -> GraphBuilder:
    """Continue with the graph of a map; the first `GraphBuilder.update` contains all of it.

    Hidden nodes are dropped: they are not published. Everything in the file is checked here, before
    a kernel gets it: types, lengths, ranges and ids (`graph_checks`, `memory_checks`).

    Raises:
        ConfigurationError: if the file is no map; names the array, the value and what was expected.
    """
    try:
        with paused_collector():
            return _read(config, path)
    except (RefusedInput, ValueError, MemoryError) as error:
        reason = graph_files.reason_of(error).removeprefix(f"graph file {path}: ")
        raise ConfigurationError(f"map {path} cannot be used: {reason}") from error


def _read(config: Config, path: Path) -> GraphBuilder:
    arrays = graph_files.read(path)
    graph = graph_files.graph_from_arrays(arrays, str(path), **graph_settings(config.merging))
    for name in ("surface_points", "class_probabilities"):  # the largest that the graph has copied
        del arrays[name]
    prior = _prior(arrays, graph.vocabulary)
    for node_id in list(graph.nodes.slot_of):
        confirmed = graph.nodes.confirmed[graph.nodes.slot(node_id)]
        if not confirmed and not graph.edits.hides(node_id):
            graph.remove_node(node_id)
    graph.take_removals()
    builder = GraphBuilder(config, graph.vocabulary, graph.frame_id, graph, prior)
    memory = {
        name.removeprefix(_MERGING): values
        for name, values in arrays.items()
        if name.startswith(_MERGING)
    }
    builder.merging.restore(graph, memory)
    if "up" in arrays:  # not in maps of older releases
        builder.up.restore(arrays["up"])
    builder.space.restore(arrays)
    builder.trail.restore(arrays)
    builder.rooms = RoomMap.restored(arrays)
    if "seen_frames" in arrays:  # nor this
        builder.frames = FrameMemory(_seen_frames(arrays, graph.vocabulary))
    return builder


def edit_map(path: Path, request: GraphEdit) -> EditReply:
    """Make an operator's edit in a map, or undo the newest one; the map before it stays.

    Raises:
        ConfigurationError: if the file is no map, or cannot be written.
        RefusedInput: ``invalid_request``, with the reason; the file is unchanged.
    """
    try:  # a request that was made without its limits would be in the map
        request = msgspec.convert(msgspec.to_builtins(request), type(request))
    except msgspec.ValidationError as error:
        raise RefusedInput("invalid_request", str(error)) from error
    with _changing(path) as builder:
        return builder.edit(request)


def follow_trajectory(path: Path, trajectory_path: Path) -> EditReply:
    """Move a map as a trajectory that SLAM has corrected says; the map before it stays.

    Args:
        path: the map.
        trajectory_path: TUM file with poses of the camera in the frame of the map.

    Raises:
        ConfigurationError: if the file is no map, or cannot be written, or the trajectory is of
            another time; the map is unchanged.
        TrajectoryError: if the trajectory cannot be read.
    """
    known = read_trajectory(trajectory_path, "tum")
    stamps_ns = np.array(known.keys, np.int64)
    with _changing(path) as builder:
        nodes = builder.graph.nodes
        if not builder.trail.keyframe:
            raise ConfigurationError(
                f"map {path} has no poses of its frames: expected a map of this release"
            )
        newest_ns = builder.newest_ns
        seen_ns = [int(nodes.first_seen_ns[nodes.slots].min(initial=newest_ns)), newest_ns]
        if stamps_ns[-1] < seen_ns[0] or stamps_ns[0] > seen_ns[1]:
            raise ConfigurationError(
                f"trajectory {trajectory_path} has poses {_span(stamps_ns)}, and map {path} frames "
                f"{_span(seen_ns)}: expected stamps of one clock"
            )
        before = {node_id: nodes.means[slot].copy() for node_id, slot in nodes.slot_of.items()}
        builder.trail.T_body_camera = np.eye(4)
        builder.apply_trajectory(stamps_ns, known.T_world_cameras)
        builder.settle()
        builder.find_rooms_and_things()
        after = {node_id: nodes.means[slot] for node_id, slot in nodes.slot_of.items()}
        steps_m = [float(np.linalg.norm(after[i] - before[i])) for i in after]
    moved = sum(step_m > 0 for step_m in steps_m)
    text = f"{counted(moved, 'object')} moved, by up to {max(steps_m, default=0.0):.2f} m"
    if len(before) > len(after):
        text += f"; {len(before) - len(after)} merged with others that they met"
    return EditReply("follow", [], text)


def _span(stamps_ns: Sequence[int] | Int64) -> str:
    return f"from {stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s"


@contextmanager
def _changing(path: Path) -> Iterator[GraphBuilder]:
    """The graph of a map, which is written at the end; after an error, the map is as it was."""
    if not path.is_file():
        what = "a folder, and " if path.is_dir() else ""
        raise ConfigurationError(
            f"map {path} is {what}no map: expected a file that graph_node (map_path) or `deworldsg "
            "run RECORDING --out OUT --map FILE` has written"
        )
    lock = claim_map(path)
    try:
        of_paper = MergingConfig(association="paper")
        merging = MergingConfig() if _is_of_surface_rule(path) else of_paper
        builder = read_map(Config(merging=merging), path)
        builder.graph.skip_to(first_id(path))
        yield builder
        write_map(builder, path)
    finally:
        lock.release()


def _is_of_surface_rule(path: Path) -> bool:
    try:
        return graph_files.header_of(graph_files.read(path)).even_gaussians
    except (RefusedInput, ValueError) as error:
        raise ConfigurationError(f"map {path} cannot be used: {error}") from error


def _prior(arrays: Arrays, vocabulary: Vocabulary) -> ClassPairPrior:
    content = checked(arrays, "prior", np.uint8, None).tobytes()
    state = parse_json(content, PriorState)
    seen = state.class_count, state.predicate_count
    expected = len(vocabulary.classes), len(vocabulary.predicates)
    if seen[0] > expected[0] or seen[1] != expected[1]:  # the prior learns classes later
        raise ValueError(
            f"its priors are of {seen[0]} classes and {seen[1]} predicates: expected the graph's "
            f"{expected[0]} and {expected[1]}"
        )
    return ClassPairPrior.from_state(state)


def _seen_frames(arrays: Arrays, vocabulary: Vocabulary) -> list[SeenFrames]:
    content = checked(arrays, "seen_frames", np.uint8, None).tobytes()
    seen = parse_json(content, list[SeenFrames])
    names = {frame.name for item in seen for frame in item.clearest}
    unknown = names.difference(vocabulary.classes, vocabulary.predicates)
    holds("seen_frames (name)", not unknown, "classes and predicates of the graph")
    return seen


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigurationError(f"map {path} cannot be written: {error.strerror}") from error
