"""Subscriptions that take what is published: reliable or best effort, raw or compressed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def reliable(depth: int, *, latched: bool = False) -> QoSProfile:
    """Reliable, keep last; latched = transient local."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def best_effort(depth: int) -> QoSProfile:
    """Best effort, keep last."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT
    )


@dataclass(frozen=True)
class Source:
    """A topic and type that a stream may come on.

    Attributes:
        topic: name; relative names are the node's.
        kind: message class.
        type_name: as the graph names it: package/msg/Name.
    """

    topic: str
    kind: type
    type_name: str


def source(topic: str, kind: type) -> Source:
    """A source of a message class."""
    package = kind.__module__.split(".")[0]
    return Source(topic, kind, f"{package}/msg/{kind.__name__}")


@dataclass(frozen=True)
class Choice:
    """What to subscribe to."""

    source: Source
    reliable: bool


@dataclass(frozen=True)
class Offer:
    """What one publisher offers."""

    topic: str
    type_name: str
    reliable: bool


def choose(sources: Sequence[Source], offers: Sequence[Offer], reliability: str) -> Choice:
    """The first source that somebody publishes, and the reliability that matches them all.

    A best-effort publisher and a reliable subscriber never match, so reliable needs every
    publisher's offer. While nobody publishes it is the first source, reliable: then nothing of a
    reliable publisher is lost at the start.

    Args:
        sources: in order of preference.
        offers: of all publishers.
        reliability: auto, reliable or best_effort.
    """
    chosen, matching = sources[0], list[Offer]()
    for candidate in sources:
        found = [
            offer
            for offer in offers
            if (offer.topic, offer.type_name) == (candidate.topic, candidate.type_name)
        ]
        if found:
            chosen, matching = candidate, found
            break
    if reliability == "auto":
        return Choice(chosen, all(offer.reliable for offer in matching))
    return Choice(chosen, reliability == "reliable")


class AutoSubscription:
    """A subscription that is made anew when the publishers turn out to be others.

    Args:
        node: an rclpy node.
        sources: in order of preference.
        callback: given each message.
        reliability: auto, reliable or best_effort.
        depth: messages that DDS keeps.

    Attributes:
        was_published: whether a publisher was ever there.
    """

    def __init__(
        self,
        node: Any,
        sources: Sequence[Source],
        callback: Callable[[Any], None],
        *,
        reliability: str,
        depth: int = 10,
    ) -> None:
        self._node = node
        self._sources = [
            Source(node.resolve_topic_name(item.topic), item.kind, item.type_name)
            for item in sources
        ]
        self._callback = callback
        self._reliability = reliability
        self._depth = depth
        self._choice: Choice | None = None
        self._subscription: Any = None
        self.was_published = False
        self.check()

    @property
    def topic(self) -> str:
        """The full name of the topic that is subscribed to."""
        assert self._choice is not None
        return self._choice.source.topic

    def check(self) -> bool:
        """Look at the publishers, subscribe anew where need be; True where it did."""
        offers = self._offers()
        self.was_published = self.was_published or bool(offers)
        choice = choose(self._sources, offers, self._reliability)
        # When the publishers go, what they were is the best guess of what comes back.
        if choice == self._choice or (self._choice is not None and not offers):
            return False
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = self._node.create_subscription(
            choice.source.kind,
            choice.source.topic,
            self._callback,
            reliable(self._depth) if choice.reliable else best_effort(self._depth),
        )
        self._choice = choice
        return True

    def describe(self) -> str:
        """Topic, type and reliability, for the log and the diagnostics."""
        assert self._choice is not None
        kind = self._choice.source.type_name
        return f"{self.topic} [{kind}] {'reliable' if self._choice.reliable else 'best effort'}"

    def _offers(self) -> list[Offer]:
        return [
            Offer(
                topic,
                info.topic_type,
                info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT,
            )
            for topic in dict.fromkeys(item.topic for item in self._sources)
            for info in self._node.get_publishers_info_by_topic(topic)
        ]
