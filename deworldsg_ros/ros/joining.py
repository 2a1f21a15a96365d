"""A node that joins streams and works on what is complete, in a thread of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from deworldsg_ros.ros.node import CHECK_PERIOD_S, StageNode
from deworldsg_ros.ros.worker import Worker
from deworldsg_ros.streams.assembler import Assembler
from deworldsg_ros.streams.posed import TOPICS

Out = TypeVar("Out")


class JoiningNode(StageNode, Generic[Out]):
    """Callbacks feed an assembler; what it completes is worked on in order, in a thread."""

    def __init__(self, name: str, product: str, **options: Any) -> None:
        super().__init__(name, product, **options)
        self._assembler: Assembler[Any, Out] | None = None
        self._worker: Worker[tuple[Out, float]] | None = None

    def assembler_options(self) -> dict[str, Any]:
        """Arguments that every assembler takes: names, patience, where drops are counted."""
        return {
            "topics": {name: self.resolve_topic_name(topic) for name, topic in TOPICS.items()},
            "patience_s": self.parameters.node.patience_s,
            "on_drop": self.drop,
        }

    def join(self, assembler: Assembler[Any, Out], work: Callable[[Out], None]) -> None:
        """Work on what the assembler completes; `work` publishes one product a call."""
        self._assembler = assembler

        def do(item: tuple[Out, float]) -> None:
            joined, joined_s = item
            with self.refusing():
                work(joined)
                self.health.published(time.monotonic() - joined_s)

        size = self.parameters.node.queue_size
        self._worker = Worker(self.get_name(), do, size=size, on_overrun=self._overrun)
        # What waits in vain is given up even when nothing comes any more.
        self.every(CHECK_PERIOD_S, self.pump)

    def taking(self, add: Callable[..., None]) -> Callable[..., None]:
        """A callback that adds to the assembler, then passes on what is complete."""

        def take(*arguments: Any) -> None:
            add(*arguments)
            self.pump()

        return take

    def pump(self) -> None:
        """Pass on what is complete."""
        assert self._assembler is not None and self._worker is not None
        for joined in self._assembler.pop_ready(time.monotonic_ns()):
            self._worker.submit((joined, time.monotonic()))

    def waiting_for(self, now_ns: int) -> list[str]:
        """What the assembler lacks."""
        return [] if self._assembler is None else self._assembler.waiting_for(now_ns)

    def more_values(self) -> dict[str, str]:
        """How much work waits."""
        return {} if self._worker is None else {"queue": str(self._worker.waiting)}

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until all work is done; False where time ran out."""
        return self._worker is None or self._worker.wait_idle(timeout_s)

    def close(self) -> None:
        """End the thread."""
        if self._worker is not None:
            self._worker.stop()
        super().close()

    def _overrun(self) -> None:
        size = self.parameters.node.queue_size
        self.drop("overrun", f"the work is slower than the frames: the oldest of {size} goes")
