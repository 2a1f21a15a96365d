"""deworldsg_node: the four stages in one process; the camera in, /scene_graph out.

Between the stages, neither images nor graphs go over DDS. Perception and lifting run in one thread,
the graph and the world model in their own.
"""

from __future__ import annotations

import sys
from typing import Any

from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.ros.graph_keeper import GraphKeeper
from deworldsg_ros.ros.graph_services import GraphServices
from deworldsg_ros.ros.models import PerceivingNode, Relating
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.options import LIVE_GRAPH, LIVE_LIFTING, LIVE_RELATIONS
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.streams.frames import PairingFrame
from deworldsg_ros.view.markers import markers
from deworldsg_ros.wire import messages as wire


class DeworldsgNode(PerceivingNode):
    """Stages a to d as a node.

    Raises:
        ConfigurationError: for a map file that cannot be read or written.
    """

    LIVE = (*PerceivingNode.LIVE, *LIVE_LIFTING, *LIVE_RELATIONS, *LIVE_GRAPH)

    def __init__(self, **options: Any) -> None:
        super().__init__("deworldsg_node", "frames", **options)
        self._lifting = Lifting(self.parameters.lifting)
        self._lifting.warm_up()
        self._relating = Relating(self, self._deliver)
        self.graph = GraphKeeper(self, markers, self._updated)
        self._answers = GraphServices(self, self.graph)
        self.listen_to_camera(self._process)

    def _process(self, frame: RgbdFrame) -> None:
        perceived = self.perceive(frame)
        local = self._lifting.lift_frame(perceived.frame_graph, perceived.instances, frame)
        self.health.left_out(local.drops)
        self.finish()
        self.graph.submit(lambda: self.graph.integrate(local))
        self._relating.relate(PairingFrame(local, frame.rgb))

    def _deliver(self, evidence: RelationEvidence) -> None:
        self.graph.submit_evidence(lambda: self.graph.add_evidence(evidence))

    def _updated(self, update: wire.SceneGraphUpdateMessage, latency_s: float) -> None:
        if self._relating.follows_graph:
            self._relating.apply(update)

    def configure(self) -> None:
        """Take changed parameters."""
        super().configure()
        self._lifting.configure(self.parameters.lifting)
        self._relating.configure(self.parameters.relations)
        self.graph.submit(lambda: self.graph.configure(self.parameters))

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing inputs, models that fail or hang, and problems of the graph, in words."""
        missing = super().waiting_for(now_ns)
        return [*missing, *self._relating.problems(), *self.graph.problems()]

    def hung(self) -> str:
        """A model that never returns, in words."""
        return super().hung() or self._relating.hung()

    def more_values(self) -> dict[str, str]:
        """The size of the graph, and numbers of clips by their state."""
        return {**super().more_values(), **self._relating.values(), **self.graph.values()}

    def close(self) -> None:
        """End the threads, and write the map file."""
        super().close()
        self._relating.close()
        self._answers.close()
        self.graph.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(DeworldsgNode, args)


if __name__ == "__main__":
    sys.exit(main())
