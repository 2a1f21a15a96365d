"""Graphs to view: a file, or a recording that is processed while it is shown."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import Protocol

from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.following import Copy
from deworldsg_ros.scene.graph_file import GRAPH_FILE
from deworldsg_ros.view.live.camera import CameraView, view_of


class Sink(Copy, Protocol):
    """Shows a copy of a graph; its methods may be called from any thread.

    Attributes:
        url: its address.
    """

    url: str

    def look(self, view: CameraView) -> None:
        """Show a frame of the camera."""
        ...

    def say(self, why_empty: str) -> None:
        """Change the reason why there are no objects."""
        ...

    def close(self) -> None:
        """End."""
        ...


FOXGLOVE_PORT = 8765


def open_sink(host: str, port: int, why_empty: str, *, foxglove: bool) -> Sink:
    """A page of viser, or a server for Foxglove; raises ImportError without its package."""
    if foxglove:
        from deworldsg_ros.view.live.foxglove import FoxgloveServer

        return FoxgloveServer(host, FOXGLOVE_PORT)
    from deworldsg_ros.view.live.server import Viewer

    return Viewer(host, port, why_empty)


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
