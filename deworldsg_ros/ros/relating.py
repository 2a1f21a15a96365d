"""Relations of frames in a node: pairs at once, predictions from the world model's thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from deworldsg_ros.checkpoints.card import graph_predicates
from deworldsg_ros.checkpoints.required import require_checkpoints
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.graph_view import PublishedGraph
from deworldsg_ros.relations.registry import build_world_model
from deworldsg_ros.relations.stage import RelationReasoner
from deworldsg_ros.relations.worker import EvidenceWorker
from deworldsg_ros.relations.world_model import require_predicates
from deworldsg_ros.ros.models import WORLD_MODEL_LIMIT_S, Supervised, parse_faults
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.streams.frame_assemblers import PairingFrame


class Relating:
    """Stage d, for relation_node and deworldsg_node.

    Args:
        node: gives the parameters and the log.
        deliver: called with the evidence of each frame, and in another thread with each prediction.

    Attributes:
        graph: the published graph, which selects the pairs for the world model.
        needs_images: whether the world model cuts clips from images.
        follows_graph: whether the clips depend on the published graph: `learn` its updates.
    """

    def __init__(self, node: StageNode, deliver: Callable[[RelationEvidence], None]) -> None:
        config = node.parameters.relations
        report = node.get_logger().warning
        require_checkpoints(relations=config)
        world_model: Any = build_world_model(config, node.parameters.perception.device)
        if world_model is not None:
            faults = parse_faults(node.parameters.debug.faults)["world_model"]
            world_model = Supervised(
                "world model", world_model, WORLD_MODEL_LIMIT_S, self._reload, faults
            )
        self._config, self._model = config, world_model
        predicates = graph_predicates(node.parameters.perception)
        if predicates is not None:  # else the first local graph contains them
            require_predicates(world_model, predicates)
        self._deliver = deliver
        self._reasoner = RelationReasoner(config, world_model, report)
        self._world_model = EvidenceWorker(self._reasoner, deliver, report)
        self._world_model.start()
        self._newest_ns = 0
        self.graph = PublishedGraph()
        self.needs_images = world_model is not None
        self.follows_graph = self.needs_images and config.max_clips_per_s > 0
        if self.follows_graph:
            self._reasoner.watch(self.graph)

    def configure(self, config: RelationsConfig) -> None:
        """Use another threshold and another rate from the next frame on."""
        self._reasoner.configure(config)

    def problems(self) -> list[str]:
        """What is wrong with the world model, in words."""
        return [] if self._model is None else list(filter(None, [self._model.problem()]))

    def hung(self) -> str:
        """A world model that never returns, in words."""
        return "" if self._model is None else str(self._model.hung())

    def _reload(self) -> None:
        """Load the world model again, on the CPU."""
        self._model.replace(build_world_model(self._config, "cpu"))

    def relate(self, frame: PairingFrame) -> None:
        """Deliver the evidence of a frame; queue its clips."""
        if frame.local.stamp_ns < self._newest_ns:  # a recording was restarted
            self._reasoner.clear()
        self._newest_ns = frame.local.stamp_ns
        self._deliver(self._world_model.observe(frame.local, frame.rgb))

    def apply(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Note an update of the published graph."""
        self._world_model.learn(lambda: self.graph.apply(update))

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Take the published graph from a snapshot."""
        self._world_model.learn(lambda: self.graph.reset(snapshot))

    def values(self) -> dict[str, str]:
        """Numbers of clips by their state, for /diagnostics."""
        counters = self._reasoner.counters()
        clips = {"queued": counters.queued, "encoded": counters.encoded}
        clips["pending"] = counters.ready
        clips["waiting"] = counters.pending - counters.ready
        clips.update((f"dropped {reason}", n) for reason, n in sorted(counters.dropped.items()))
        return {f"clips {name}": str(count) for name, count in clips.items()}

    def close(self) -> None:
        """End the world model's thread."""
        self._world_model.stop()
