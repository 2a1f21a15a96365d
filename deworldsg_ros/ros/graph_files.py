"""The files of a node's graph: its map, and the JSON that ~/save writes."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.files import write_atomically
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import Continued, claim_map, continue_map, write_map
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import ConfigurationError


class GraphFiles:
    """Reads and writes the files that the parameters name; no other process may write the map.

    Raises:
        ConfigurationError: if the map file cannot be written.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._save_path = Path(parameters.node.save_path).absolute()
        map_path = parameters.node.map_path
        self.map_path = Path(map_path).absolute() if map_path else None
        self._lock = None if self.map_path is None else claim_map(self.map_path)

    def continued_map(self) -> Continued | None:
        """The graph of the map file, if there is one; raises ConfigurationError if it has none."""
        if self.map_path is None:
            return None
        return continue_map(self._parameters, self.map_path)

    def close(self) -> None:
        """Let other processes write the map."""
        if self._lock is not None:
            self._lock.release()

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
        except OSError as error:
            return False, f"{self._save_path}: {error}"
        said = f"{self._save_path}: {len(message.nodes)} nodes, {len(message.edges)} edges"
        if self.map_path is None:
            return True, said
        saved, about_map = self.save_map(builder)
        return saved, f"{said}; {about_map}"

    def save_map(self, builder: GraphBuilder | None) -> tuple[bool, str]:
        """Write the map file; returns as `save`."""
        if self.map_path is None or builder is None:
            return False, "no map written: no local graph has arrived"
        try:
            write_map(builder, self.map_path)
        except ConfigurationError as error:
            return False, str(error)
        return True, f"map {self.map_path}: {builder.confirmed} nodes"
