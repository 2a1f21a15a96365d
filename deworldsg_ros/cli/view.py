"""`deworldsg view`: a graph on a web page of this machine, from a file, a recording or live."""

from __future__ import annotations

import os
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.outputs import print_drops
from deworldsg_ros.cli.terminal import frame_progress, node_command
from deworldsg_ros.graph.graph_files import graph_path, read_graph
from deworldsg_ros.graph.provenance import read_space
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.posing import PoseChoice, choose_poses, posed_frames
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

if TYPE_CHECKING:
    from deworldsg_ros.view.live.sources import Sink

VIEWER = "viewer_node"
# Surface points are part of what is shown.
WITH_POINTS = "output.include_surface_points=true"
EMPTY_FILE = "the graph of this file is empty: no object was seen often enough"


@dataclass(frozen=True)
class ViewOptions:
    """The source of a page, and its address.

    Attributes:
        path: graph or recording; None = live.
        host, port: of the page.
        foxglove: whether Foxglove is served instead.
        namespace: of the robot, for a live graph.
        config_path, settings: configuration of a recording.
        topics, dataset: of a recording.
        odometry: whether the poses are estimated from the images.
    """

    path: Path | None
    host: str
    port: int
    foxglove: bool
    namespace: str
    config_path: Path | None
    settings: tuple[str, ...]
    topics: TopicChoice
    dataset: DatasetOptions
    odometry: bool


def view_graph(options: ViewOptions, console: Console) -> None:
    """Show the page until Ctrl-C.

    Raises:
        DeWorldSGError: for unusable input, or without the package of Foxglove.
    """
    if options.foxglove and find_spec("foxglove") is None:
        raise ConfigurationError(
            "deworldsg view --foxglove needs the package foxglove-sdk: pip install "
            "'deworldsg_ros[foxglove]'"
        )
    if options.path is None:
        _become_viewer_node(options)
        return
    from deworldsg_ros.view.live.sources import is_graph, open_sink

    graph = read_graph(options.path) if is_graph(options.path) else None
    why_empty = EMPTY_FILE if graph is not None else "loading the models"
    sink = open_sink(options.host, options.port, why_empty, foxglove=options.foxglove)
    with closing(sink) as viewer:
        console.print(f"view: {viewer.url}", highlight=False, soft_wrap=True)
        if graph is not None:
            viewer.reset(graph)
            space = read_space(graph_path(options.path))
            if space is not None:
                viewer.see(space)
        else:
            _show_recording(viewer, options, console)
        console.print("press Ctrl-C to end", highlight=False)
        wait_for_interrupt()


def wait_for_interrupt() -> None:
    """Wait until Ctrl-C, which is the usual end."""
    with suppress(KeyboardInterrupt):
        threading.Event().wait()


def _become_viewer_node(options: ViewOptions) -> None:
    """Replace this process by viewer_node."""
    command = [*node_command(VIEWER), "--ros-args"]
    command += ["-p", f"host:='{options.host}'", "-p", f"port:={options.port}"]
    command += ["-p", f"foxglove:={str(options.foxglove).lower()}"]
    if options.namespace:
        command += ["-r", f"__ns:={options.namespace}"]
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)
    os.environ["PYTHONUNBUFFERED"] = "1"
    os.execvp(command[0], command)


def _show_recording(viewer: Sink, options: ViewOptions, console: Console) -> None:
    from deworldsg_ros.cli.run import build_pipeline
    from deworldsg_ros.view.live.sources import show_recording

    assert options.path is not None
    config = effective_config(options.config_path, [WITH_POINTS, *options.settings])
    poses = PoseChoice(odometry=options.odometry)
    source = open_source(
        options.path,
        topics=options.topics,
        inputs=config.inputs,
        options=options.dataset,
        need_poses=poses.need_poses,
    )
    with closing(source):
        recording = Recording(choose_poses(source, poses, config), config.inputs)
        pipeline = build_pipeline(config, None, console)
        viewer.say("no object was seen often enough yet")
        refused: Counter[str] = Counter()
        refuse = _counter(refused, recording)
        with frame_progress(console) as progress:
            task = progress.add_task("building the graph", total=recording.frame_count, note="")
            frames = posed_frames(recording, poses, refuse)
            for nodes in show_recording(viewer, pipeline, frames, refuse):
                progress.update(task, advance=1, note=f"{nodes} objects")
    drops = {"recording": dict(recording.drops), "pipeline": dict(refused)}
    print_drops(console, recording.losses, drops, recording.reasons)


def _counter(refused: Counter[str], recording: Recording) -> Callable[[RefusedInput], None]:
    lock = threading.Lock()

    def refuse(refusal: RefusedInput) -> None:
        with lock:  # odometry and the jump gate run in the thread that reads the frames
            refused[refusal.reason] += 1
            recording.reasons.setdefault(refusal.reason, str(refusal))

    return refuse
