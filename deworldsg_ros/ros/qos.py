"""Subscriptions that adapt to the publishers: reliable or best effort, raw or compressed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
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
    """A possible topic and type of a stream.

    Attributes:
        topic: topic name.
        kind: message class.
        type_name: ROS name of the type, ``package/msg/Name``.
    """

    topic: str
    kind: type
    type_name: str


def source(topic: str, kind: type) -> Source:
    """The source of a topic and message class."""
    package = kind.__module__.split(".")[0]
    return Source(topic, kind, f"{package}/msg/{kind.__name__}")


@dataclass(frozen=True)
class Choice:
    """A source to subscribe to, and the reliability."""

    source: Source
    reliable: bool


@dataclass(frozen=True)
class Offer:
    """Topic, type and reliability of a publisher."""

    topic: str
    type_name: str
    reliable: bool


def choose(sources: Sequence[Source], offers: Sequence[Offer], reliability: str) -> Choice:
    """The first source with a publisher, and a reliability that matches all its publishers.

    DDS connects no reliable subscriber to a best-effort publisher. Without publishers the choice is
    the first source, reliable: the first messages of a reliable publisher are then not lost.

    Args:
        sources: in order of preference.
        offers: all publishers.
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


class _WantedGroup(MutuallyExclusiveCallbackGroup):
    """Lets the executor take messages only while they are wanted."""

    def __init__(self, is_wanted: Callable[[], bool]) -> None:
        super().__init__()
        self._is_wanted = is_wanted

    def can_execute(self, entity: Any) -> bool:
        """Whether the executor may take a message."""
        return self._is_wanted() and bool(super().can_execute(entity))


class LossCounter:
    """Counts the messages of one publisher that were published and not taken, by their numbers.

    Args:
        on_lost: called with the number of messages that are missing before one that arrived.
    """

    def __init__(self, on_lost: Callable[[int], None]) -> None:
        self._on_lost = on_lost
        self._before: int | None = None
        # Each publisher counts its own messages, so gaps tell nothing of two.
        self.publishers = 1

    def restart(self) -> None:
        """Forget the last number: the subscription is another one."""
        self._before = None

    def count(self, info: Mapping[str, Any]) -> None:
        """Note the information on a message that arrived."""
        number = info["publication_sequence_number"] if self.publishers == 1 else None
        before, self._before = self._before, number
        if before is not None and number is not None and number > before + 1:
            self._on_lost(number - before - 1)


class AutoSubscription:
    """A subscription that is recreated when the publishers change type or reliability.

    Args:
        node: rclpy node.
        sources: in order of preference.
        callback: called with each message.
        reliability: auto, reliable or best_effort.
        depth: messages that DDS keeps.
        is_wanted: whether to take messages now; DDS keeps the newest `depth`.
        on_lost: called with the number of messages that were published and not taken.

    Attributes:
        was_published: whether there has been a publisher.
    """

    def __init__(
        self,
        node: Any,
        sources: Sequence[Source],
        callback: Callable[[Any], None],
        *,
        reliability: str,
        depth: int = 10,
        is_wanted: Callable[[], bool] = lambda: True,
        on_lost: Callable[[int], None] = lambda number: None,
    ) -> None:
        self._node = node
        self._group = _WantedGroup(is_wanted)
        self._losses = LossCounter(on_lost)
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
        """Full name of the subscribed topic."""
        assert self._choice is not None
        return self._choice.source.topic

    def check(self) -> bool:
        """Compare with the publishers; True if the subscription was recreated."""
        offers = self._offers()
        self._losses.publishers = len(offers)
        self.was_published = self.was_published or bool(offers)
        choice = choose(self._sources, offers, self._reliability)
        # After the last publisher ends, keep the choice: the same publisher is likely to return.
        if choice == self._choice or (self._choice is not None and not offers):
            return False
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = self._node.create_subscription(
            choice.source.kind,
            choice.source.topic,
            self._receive,
            reliable(self._depth) if choice.reliable else best_effort(self._depth),
            callback_group=self._group,
        )
        self._choice = choice
        self._losses.restart()
        return True

    def describe(self) -> str:
        """Topic, type and reliability, in words."""
        assert self._choice is not None
        kind = self._choice.source.type_name
        best_effort = self._subscription.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        return f"{self.topic} [{kind}] {'best effort' if best_effort else 'reliable'}"

    def _receive(self, message: Any, info: dict[str, Any]) -> None:
        self._losses.count(info)
        self._callback(message)

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
