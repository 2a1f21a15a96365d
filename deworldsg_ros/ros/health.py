"""The state of a node for /diagnostics: rates, latencies, drops by reason, missing inputs."""

from __future__ import annotations

import re
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

OK, WARN, ERROR = 0, 1, 2

# The reason of an unexpected exception.
INTERNAL_ERROR = "internal_error"
# Reasons with this prefix raise no warning: one camera stream is faster than the other, or than the
# node.
UNMATCHED_PREFIX = "unmatched_"
# Reasons with this prefix count messages that the node never had.
LOST_PREFIX = "lost_"
DROPPED, LEFT_OUT, RECEIVED = "dropped ", "objects left out ", "received "
# Connected subscriptions of a topic that the node publishes.
LISTENERS = "listeners of "
# Nodes of the graph that are not published.
HIDDEN = "hidden, "
# /diagnostics is shared with other programs. A count of a node has no more digits than 64 bits.
COUNT = re.compile(r"[0-9]{1,18}")
TOTAL = re.compile(r"(?<![0-9-])([0-9]{1,18}) in total")


@dataclass(frozen=True)
class Report:
    """One status of /diagnostics.

    Attributes:
        level: OK, WARN or ERROR.
        message: one sentence.
        values: all values, by name.
    """

    level: int
    message: str
    values: dict[str, str]


class Health:
    """Counts between two reports, and since the start; safe to use from several threads.

    Args:
        product: output of the node in the message, e.g. "frame graphs".
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
        """Count a product, and the time since its inputs were complete."""
        with self._lock:
            self._published += 1
            if latency_s is not None:
                self._latencies_ms.append(1e3 * latency_s)

    def dropped(self, reason: str, number: int = 1, example: str = "") -> None:
        """Count a drop; the report contains the newest example of each reason."""
        with self._lock:
            self._drops[reason] += number
            if example:
                self._examples[reason] = example.splitlines()[0]

    def left_out(self, reasons: Mapping[str, int]) -> None:
        """Count objects that a processed frame lacks; they raise no warning."""
        with self._lock:
            self._left_out.update(reasons)

    @property
    def drops(self) -> dict[str, int]:
        """Number of drops since the start, by reason."""
        with self._lock:
            return dict(self._drops)

    @property
    def products(self) -> int:
        """Number of products since the start."""
        with self._lock:
            return self._published

    def report(
        self,
        now_s: float,
        waiting_for: Sequence[str] = (),
        values: Mapping[str, str] | None = None,
        *,
        in_turn: bool = True,
    ) -> Report:
        """Summarise the time since the last report.

        Args:
            now_s: monotonic clock, seconds.
            waiting_for: missing inputs, in words.
            values: further values, by name.
            in_turn: False: the next report counts from the same time on as this one.
        """
        with self._lock:
            elapsed_s = max(now_s - self._reported_s, 1e-9) if self._reported_s is not None else 0.0
            rate = _rate(self._published - self._published_before, elapsed_s)
            drops = {
                reason: count
                for reason, count in sorted((self._drops - self._drops_before).items())
                if not reason.startswith(UNMATCHED_PREFIX)
            }
            counted = self._counted(rate, elapsed_s)
            message = "; ".join(waiting_for) or f"{rate:.1f} {self._product} per second"
            for reason, count in drops.items():
                example = self._examples.get(reason, "no example")
                message += f"; dropped {count} {reason}: {example}"
            if in_turn:
                self._begin_period(now_s)
        missing = {f"waiting for {at}": text for at, text in enumerate(waiting_for, 1)}
        level = WARN if waiting_for or drops else OK
        return Report(
            ERROR if INTERNAL_ERROR in drops else level,
            message,
            {**counted, **missing, **(values or {})},
        )

    def _counted(self, rate: float, elapsed_s: float) -> dict[str, str]:
        values = {f"{self._product} per second": f"{rate:.1f}", "total": str(self._published)}
        for topic, count in sorted(self._received.items()):
            received = _rate(count - self._received_before[topic], elapsed_s)
            values[f"{RECEIVED}{topic}"] = f"{received:.1f} per second, {count} in total"
        if self._latencies_ms:
            values["latency mean ms"] = f"{np.mean(self._latencies_ms):.1f}"
            values["latency p95 ms"] = f"{np.percentile(self._latencies_ms, 95):.1f}"
        for reason, count in sorted(self._drops.items()):
            values[f"{DROPPED}{reason}"] = str(count)
            if reason in self._examples:
                values[f"example {reason}"] = self._examples[reason]
        for reason, count in sorted(self._left_out.items()):
            values[f"{LEFT_OUT}{reason}"] = str(count)
        return values

    def _begin_period(self, now_s: float) -> None:
        self._reported_s = now_s
        self._latencies_ms = []
        self._received_before = self._received.copy()
        self._published_before = self._published
        self._drops_before = self._drops.copy()


def counts_in(values: Mapping[str, str], prefix: str) -> dict[str, int]:
    """Counts by reason in a report's values; `prefix` is DROPPED, LEFT_OUT or HIDDEN.

    A value that is no count is left out.
    """
    return {
        key[len(prefix) :]: int(value)
        for key, value in values.items()
        if key.startswith(prefix) and COUNT.fullmatch(value)
    }


def count_in(values: Mapping[str, str], key: str) -> int:
    """A count in a report's values; 0 if it is not there, or no count."""
    value = values.get(key, "")
    return int(value) if COUNT.fullmatch(value) else 0


def received_in(values: Mapping[str, str], topic: str) -> int:
    """Number of messages received on a topic since the start, in a report's values."""
    match = TOTAL.search(values.get(f"{RECEIVED}{topic}", ""))
    return int(match[1]) if match else 0


def _rate(count: int, elapsed_s: float) -> float:
    return count / elapsed_s if elapsed_s else 0.0
