"""The files of a node's graph: its map, and the JSON that ~/save writes."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.files import write_atomically
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import Continued, check_paths
from deworldsg_ros.ros.map_keeper import MapKeeper
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.seen_frames import path_beside, write_seen
from deworldsg_ros.scene.seen_space import space_path, write_space
from deworldsg_ros.words import counted


class GraphFiles:
    """Reads and writes the files that the parameters name.

    Args:
        node: for its parameters, the log and the counts.

    Attributes:
        map: None without a map.

    Raises:
        ConfigurationError: if the map file cannot be written, or is that of `save_path`.
    """

    def __init__(self, node: StageNode) -> None:
        self._node = node
        options = node.parameters.node
        self._save_path = Path(options.save_path).absolute()
        self.map: MapKeeper | None = None
        if options.map_path:
            self._check_paths(Path(options.map_path))
            self.map = MapKeeper(node, Path(options.map_path).absolute(), options.map_period_s)

    def _check_paths(self, map_path: Path) -> None:
        path = self._save_path
        beside = [("its frames", path_beside(path)), ("its space", space_path(path))]
        check_paths(map_path, [("save_path", path), *beside])

    def continued_map(self) -> Continued | None:
        """The graph of the map file, if there is one; raises ConfigurationError if it has none."""
        continued = None if self.map is None else self.map.continued(self._node.parameters)
        if continued is not None:
            log = self._node.get_logger()
            log.info(continued.message) if continued.newest else log.warning(continued.message)
        return continued

    def save(self, builder: GraphBuilder | None) -> tuple[bool, str]:
        """Write the whole graph, with surface points, as JSON; and the map file.

        Returns:
            whether everything was written, and a sentence.
        """
        if builder is None:
            return False, "no graph yet: no local graph has arrived"
        message = builder.full()
        try:
            self._save_path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._save_path, wire.encode(message))
            stamp_ns = wire.ns_from_stamp(message.stamp)
            write_seen(self._save_path, stamp_ns, builder.frames.all(builder.graph))
            write_space(self._save_path, builder.space)
        except OSError as error:
            return False, f"{self._save_path}: {error}"
        nodes, edges = counted(len(message.nodes), "node"), counted(len(message.edges), "edge")
        said = f"{self._save_path}: {nodes}, {edges}"
        if self.map is None:
            return True, said
        saved, about_map = self.map.save(builder)
        return saved, f"{said}; {about_map}"

    def changed(self) -> None:
        """Note that the graph differs from the last checkpoint of the map."""
        if self.map is not None:
            self.map.changed()

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next checkpoint is due, 0 = now; None = there is none."""
        return None if self.map is None else self.map.wait_s(now_s)

    def checkpoint(self, builder: GraphBuilder | None) -> None:
        """Copy the graph, and write the map in the background."""
        if self.map is not None and builder is not None:
            self.map.checkpoint(builder)

    def close(self, builder: GraphBuilder | None, *, busy: bool) -> None:
        """Write the map, unless its graph is busy, and log it."""
        if self.map is None:
            return
        written, message = False, f"map {self.map.path}: not written, the graph is busy"
        if not busy:
            written, message = self.map.save(builder)
        self.map.close()
        log = self._node.get_logger()
        log.info(message) if written else log.warning(message)
