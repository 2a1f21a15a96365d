"""A node that joins streams by stamp and processes each complete frame in its own thread."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from deworldsg_ros.ros.node import CHECK_PERIOD_S, SPIN_PERIOD_S, StageNode
from deworldsg_ros.ros.threads import Worker
from deworldsg_ros.streams.assembler import Assembler
from deworldsg_ros.streams.frames import TOPICS

# A third of a second of a 30 Hz camera: a longer queue of a slow node adds latency only.
QUEUE_FRAMES = 10
# A node that has worked for so long without a pause does not keep up, and takes the newest frame
# each time. One that keeps up loses none, although poses at 10 Hz complete three frames of a 30 Hz
# camera at once.
MAX_BUSY_S = 0.2
# While a frame waits for the worker, images are taken from DDS at this period, all that are there.
# DDS drops the oldest of those that come faster. They cost the node no time. A camera at 30 Hz is
# slower: each of its images is taken when it arrives.
TAKE_PERIOD_S = 1 / 40
# Messages that no frame waits for are taken together after this time. It is less than the 83 ms in
# which a camera at 120 Hz fills the `IMAGE_DEPTH` of DDS.
COLLECT_PERIOD_S = 0.05
# Poses of a SLAM system come seconds after their image. The streams keep 256 images, which is 8 s
# at 30 Hz.
MAX_WAIT_S = 5.0

Out = TypeVar("Out")


class JoiningNode(StageNode, Generic[Out]):
    """Callbacks feed an assembler; a worker thread processes its complete frames in order.

    Args:
        name: node name.
        product: name of the output in /diagnostics.
        max_busy_s: a node without a pause for longer processes the newest frame, and drops the
            others; of more than QUEUE_FRAMES, the oldest is dropped in any case.
        max_wait_s: maximum time a frame waits for depth, camera_info or pose.
        options: arguments of rclpy's Node.
    """

    def __init__(
        self,
        name: str,
        product: str,
        *,
        max_busy_s: float = math.inf,
        max_wait_s: float = MAX_WAIT_S,
        **options: Any,
    ) -> None:
        super().__init__(name, product, **options)
        self._max_busy_s = max_busy_s
        self._max_wait_s = max_wait_s
        self._assembler: Assembler[Any, Out] | None = None
        self._worker: Worker[tuple[Callable[[], Out], float]] | None = None
        self._collecting = True
        self._collected_s = 0.0
        # While messages are taken: whether images are. A frame that is complete changes nothing, so
        # that the newest image is taken, too.
        self._taking_images: bool | None = None

    def assembler_options(self) -> dict[str, Any]:
        """Arguments of every assembler: topic names, maximum wait, counter of drops."""
        return {
            "topics": {name: self.resolve_topic_name(topic) for name, topic in TOPICS.items()},
            "max_wait_s": self._max_wait_s,
            "on_drop": self.drop,
        }

    def join(self, assembler: Assembler[Any, Out], work: Callable[[Out], None]) -> None:
        """Call `work` with each frame that the assembler completes; it publishes one product."""
        self._assembler = assembler

        def process(item: tuple[Callable[[], Out], float]) -> None:
            decode, joined_s = item
            with self.refusing():
                work(decode())
                self.health.published(time.monotonic() - joined_s)

        self._worker = Worker(
            self.get_name(),
            process,
            size=QUEUE_FRAMES,
            max_busy_s=self._max_busy_s,
            on_overrun=self._overrun,
            after=self.wake,
        )
        # The maximum wait also ends when no message arrives.
        self.every(CHECK_PERIOD_S, self.pump)

    def finish(self) -> None:
        """As `Worker.finish`: call it in `work`, before the product of a frame is published."""
        assert self._worker is not None
        self._worker.finish()

    def taking(self, add: Callable[..., None]) -> Callable[..., None]:
        """A callback that adds a message to the assembler and passes on complete frames."""

        def take(*arguments: Any) -> None:
            add(*arguments)
            self.pump()

        return take

    def pump(self) -> None:
        """Pass complete frames to the worker."""
        assert self._assembler is not None and self._worker is not None
        for joined in self._assembler.pop_joined(time.monotonic_ns()):
            self._worker.submit((joined, time.monotonic()))

    def wants_images(self) -> bool:
        """Whether to take images from DDS: not while a fresh frame waits for the worker."""
        if self._taking_images is not None:
            return self._taking_images
        return self._images_wanted_in_s() <= 0

    def longest_wait_s(self) -> float:
        """Seconds until waiting messages are looked at again, if none comes that is wanted."""
        wanted_in_s = self._images_wanted_in_s()
        return min(SPIN_PERIOD_S, wanted_in_s) if wanted_in_s > 0 else SPIN_PERIOD_S

    def _images_wanted_in_s(self) -> float:
        submitted_s = 0.0 if self._worker is None else self._worker.youngest_s()
        return submitted_s + TAKE_PERIOD_S - time.monotonic()

    def wants_depth(self) -> bool:
        """The same for depth images, which follow the RGB images."""
        return self.wants_rest() and self.wants_images()

    def wants_rest(self) -> bool:
        """Whether to take messages that belong to a frame: those of a frame that waits, else all
        together and rarely. A node thus wakes once a frame, and not for each of its messages.
        """
        assert self._assembler is not None
        return self._collecting or self._assembler.waiting > 0

    def before_taking(self) -> None:
        """Take all messages now and then."""
        self._taking_images = self._images_wanted_in_s() <= 0
        now_s = time.monotonic()
        self._collecting = now_s - self._collected_s >= COLLECT_PERIOD_S
        if self._collecting:
            self._collected_s = now_s

    def after_taking(self) -> None:
        """Take only what frames wait for."""
        self._collecting = False
        self._taking_images = None

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing inputs, in words."""
        return [] if self._assembler is None else self._assembler.waiting_for(now_ns)

    def more_values(self) -> dict[str, str]:
        """Number of frames in the queue."""
        return {} if self._worker is None else {"queue": str(self._worker.waiting)}

    def close(self) -> None:
        """End the thread."""
        if self._worker is not None:
            self._worker.stop()
        super().close()

    def _overrun(self, _: Any) -> None:
        self.drop("overrun", "the node processes fewer frames than arrive: dropped the oldest")
