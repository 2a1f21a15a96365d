"""A node that takes the camera's frames and runs perception on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec

from deworldsg_ros.checkpoints.required import require_checkpoints
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.ros.diagnosed import TURNED
from deworldsg_ros.ros.inputs import (
    WANTED_DEPTH,
    listen_camera_info,
    listen_depth,
    listen_pose,
    listen_rgb,
)
from deworldsg_ros.ros.joining import MAX_BUSY_S, JoiningNode
from deworldsg_ros.ros.models import PERCEPTION_LIMIT_S, Supervised, parse_faults
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.streams.frame_assemblers import FrameAssembler


class PerceivingNode(JoiningNode[RgbdFrame]):
    """Stage a on the frames of the camera, for segmentation_node and deworldsg_node.

    Args:
        name: node name.
        product: name of the output in /diagnostics.
        options: arguments of rclpy's Node.
    """

    LIVE: tuple[str, ...] = ("perception.score_threshold", "perception.max_relations")

    def __init__(self, name: str, product: str, **options: Any) -> None:
        super().__init__(name, product, max_busy_s=MAX_BUSY_S, **options)
        inputs = self.parameters.inputs
        require_checkpoints(self.parameters.perception)
        self._perception = build_perception(self.parameters.perception, world_up=inputs.world_up)
        faults = parse_faults(self.parameters.debug.faults)
        self._models: dict[str, Supervised] = {}

        def supervise(part: str, backend: Any) -> Supervised:
            self._models[part] = Supervised(
                part.replace("_", " "), backend, PERCEPTION_LIMIT_S, self._reload, faults[part]
            )
            return self._models[part]

        self._perception.watch(supervise)
        self._frames = FrameAssembler(inputs, **self.assembler_options())
        self._turns: Counter[int] = Counter()

    def listen_to_camera(self, work: Callable[[RgbdFrame], None]) -> None:
        """Subscribe to the camera, and call `work` with each complete frame."""
        frames = self._frames
        self.join(frames, work)
        listen_camera_info(self, self.taking(frames.add_camera_info))
        listen_pose(self, frames)
        listen_depth(self, self.taking(frames.add_depth), self.wants_depth, WANTED_DEPTH)
        listen_rgb(self, self.taking(frames.add_rgb), self.wants_images, WANTED_DEPTH)

    def configure(self) -> None:
        """Take changed parameters."""
        self._perception.configure(self.parameters.perception)

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing inputs, and models that fail or hang, in words."""
        problems = [model.problem() for model in self._models.values()]
        return [*super().waiting_for(now_ns), *filter(None, problems)]

    def hung(self) -> str:
        """A model that never returns, in words."""
        return next(filter(None, (model.hung() for model in self._models.values())), "")

    def _reload(self) -> None:
        """Load all models again, on the CPU: a GPU that failed once fails for this process."""
        config = msgspec.structs.replace(self.parameters.perception, device="cpu")
        self.get_logger().warning("loading the models again, on the CPU")
        fresh = build_perception(config, world_up=self.parameters.inputs.world_up)
        fresh.watch(lambda part, backend: self._models[part].replace(backend))

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The results of a frame, in the camera's frame; failures and drops are counted."""
        perceived = self._perception.perceive(frame)
        self._turns[perceived.turns] += 1
        self.health.left_out(perceived.drops)
        for reason, message in perceived.failures.items():
            self.drop(reason, message)
        graph = replace(perceived.frame_graph, frame_id=self._frames.camera_frame)
        return replace(perceived, frame_graph=graph)

    def more_values(self) -> dict[str, str]:
        """Frames that were turned upright for the detector, by angle."""
        turned = {f"{TURNED}{90 * n} degrees": str(k) for n, k in self._turns.items() if n}
        return {**super().more_values(), **turned}
