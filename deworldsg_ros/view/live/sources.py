"""Graphs to view: a file, or a recording that is processed while it is shown."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import Protocol

from deworldsg_ros.graph.graph_files import GRAPH_FILE
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.view.live.camera import CameraView, view_of
from deworldsg_ros.view.live.state import OnError
from deworldsg_ros.wire.follow import Copy


class Sink(Copy, Protocol):
    """Shows a copy of a graph; its methods may be called from any thread.

    Attributes:
        url: its address.
    """

    url: str

    def see(self, space: SeenSpace) -> None:
        """Show what the camera saw of the room of a saved graph."""
        ...

    def look(self, view: CameraView) -> None:
        """Show a frame of the camera."""
        ...

    def correct(self, change: TrailChange) -> None:
        """Move what the camera saw: its poses were corrected."""
        ...

    def say(self, why_empty: str) -> None:
        """Change the reason why there are no objects."""
        ...

    def close(self) -> None:
        """End."""
        ...


PAGE_PORT, FOXGLOVE_PORT = 8080, 8765
# So many ports are tried.
MOST_PORTS = 100


def open_sink(
    host: str, port: int, why_empty: str, *, foxglove: bool, on_error: OnError | None = None
) -> Sink:
    """A page, or a server for Foxglove.

    Args:
        host: address to listen on.
        port: the next free port from this one on is taken; 0 = the usual one.
        why_empty: shown while there are no objects.
        foxglove: whether Foxglove is served.
        on_error: as `Viewer`; the server for Foxglove has no thread of its own.

    Raises:
        ImportError: without the package of Foxglove.
        ConfigurationError: if this machine cannot listen there.
    """
    port = _free_port(host, port or (FOXGLOVE_PORT if foxglove else PAGE_PORT))
    if foxglove:
        from deworldsg_ros.view.live.foxglove import FoxgloveServer

        return FoxgloveServer(host, port)
    from deworldsg_ros.view.live.server import Viewer

    return Viewer(host, port, why_empty, on_error)


def _free_port(host: str, first: int) -> int:
    for port in range(first, min(first + MOST_PORTS, 2**16)):
        try:
            socket.create_server((host, port)).close()
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise ConfigurationError(
                    f"cannot listen on host {host}, port {port}: {error.strerror}; expected an "
                    "address of this machine"
                ) from error
        else:
            return port
    raise ConfigurationError(f"no port of {host} from {first} on is free: give another port")


def is_graph(path: Path) -> bool:
    """Whether a path is that of a saved graph, and not of a recording."""
    return path.suffix == ".json" or (path / GRAPH_FILE).is_file()


def show_recording(
    sink: Sink,
    pipeline: Pipeline,
    frames: Iterable[RgbdFrame],
    refuse: Callable[[RefusedInput], None],
) -> Generator[int, None, None]:
    """Process frames and show the graph after each; gives the number of objects after each.

    Args:
        sink: shows the graph.
        pipeline: processes the frames.
        frames: of a recording, in order.
        refuse: called for each frame that cannot be used.
    """
    with closing(pipeline.process_all(frames)) as results:
        for frame, result in results:
            if isinstance(result, RefusedInput):
                refuse(result)
                yield 0 if pipeline.builder is None else pipeline.builder.confirmed
                continue
            assert pipeline.builder is not None
            update = pipeline.builder.update()
            if update is not None:
                sink.apply(update)
            sink.look(view_of(result.local, result.node_ids, frame.rgb, result.perceived.instances))
            yield pipeline.builder.confirmed
    builder = pipeline.builder
    while builder is not None and builder.waiting:  # a map in parts, or surfaces
        if (update := builder.update()) is not None:
            sink.apply(update)
