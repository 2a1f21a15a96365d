"""What a node tells about itself: rates, latencies, drops by reason, what it waits for."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

OK, WARN, ERROR = 0, 1, 2

# Counted under this, an exception was not foreseen.
INTERNAL_ERROR = "internal_error"
# Counted, but no cause for alarm: one camera stream is faster than the other, or than the work.
HARMLESS_PREFIX = "unmatched_"


@dataclass(frozen=True)
class Report:
    """One line of /diagnostics.

    Attributes:
        level: OK, WARN or ERROR.
        message: what matters most, in one sentence.
        values: everything, by name.
    """

    level: int
    message: str
    values: dict[str, str]


class Health:
    """Counts between two reports, and since the start; safe to use from several threads.

    Args:
        product: what the node makes, for the message: "frame graphs".
    """

    def __init__(self, product: str) -> None:
        self._product = product
        self._lock = threading.Lock()
        self._reported_s: float | None = None
        self._received: Counter[str] = Counter()
        self._received_before: Counter[str] = Counter()
        self._published = 0
        self._published_before = 0
        self._latencies_ms: list[float] = []
        self._drops: Counter[str] = Counter()
        self._drops_before: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    def received(self, topic: str) -> None:
        """Count a message."""
        with self._lock:
            self._received[topic] += 1

    def published(self, latency_s: float | None = None) -> None:
        """Count a product, and how long it took from its inputs on."""
        with self._lock:
            self._published += 1
            if latency_s is not None:
                self._latencies_ms.append(1e3 * latency_s)

    def dropped(self, reason: str, number: int = 1, example: str = "") -> None:
        """Count a drop; the newest example of each reason is told."""
        with self._lock:
            self._drops[reason] += number
            if example:
                self._examples[reason] = example.splitlines()[0]

    def left_out(self, reasons: Mapping[str, int]) -> None:
        """Count objects that a frame went on without; every frame has some."""
        with self._lock:
            self._left_out.update(reasons)

    @property
    def drops(self) -> dict[str, int]:
        """Number of drops since the start, by reason."""
        with self._lock:
            return dict(self._drops)

    def report(
        self, now_s: float, waiting_for: Sequence[str] = (), values: Mapping[str, str] | None = None
    ) -> Report:
        """Sum up the time since the last report.

        Args:
            now_s: a clock that only goes forward, seconds.
            waiting_for: what is missing, in words.
            values: more to tell, by name.
        """
        with self._lock:
            elapsed_s = max(now_s - self._reported_s, 1e-9) if self._reported_s is not None else 0.0
            rate = _rate(self._published - self._published_before, elapsed_s)
            new_drops = self._drops - self._drops_before
            latencies_ms, self._latencies_ms = self._latencies_ms, []
            told = {f"{self._product} a second": f"{rate:.1f}", "total": str(self._published)}
            for topic, count in sorted(self._received.items()):
                received = _rate(count - self._received_before[topic], elapsed_s)
                told[f"received {topic}"] = f"{received:.1f} a second, {count} in all"
            if latencies_ms:
                told["latency mean ms"] = f"{np.mean(latencies_ms):.1f}"
                told["latency p95 ms"] = f"{np.percentile(latencies_ms, 95):.1f}"
            for reason, count in sorted(self._drops.items()):
                told[f"dropped {reason}"] = str(count)
                if reason in self._examples:
                    told[f"why {reason}"] = self._examples[reason]
            for reason, count in sorted(self._left_out.items()):
                told[f"objects left out {reason}"] = str(count)
            self._reported_s = now_s
            self._received_before = self._received.copy()
            self._published_before = self._published
            self._drops_before = self._drops.copy()
        for index, text in enumerate(waiting_for):
            told[f"waiting for {index + 1}"] = text
        told.update(values or {})
        serious = {
            reason: count
            for reason, count in new_drops.items()
            if not reason.startswith(HARMLESS_PREFIX)
        }
        message = f"{rate:.1f} {self._product} a second"
        if waiting_for:
            message = "; ".join(waiting_for)
        if serious:
            message += "".join(
                f"; dropped {count} {reason}: {told.get(f'why {reason}', 'no example')}"
                for reason, count in sorted(serious.items())
            )
        level = WARN if waiting_for or serious else OK
        return Report(ERROR if INTERNAL_ERROR in serious else level, message, told)


def _rate(count: int, elapsed_s: float) -> float:
    return count / elapsed_s if elapsed_s else 0.0
