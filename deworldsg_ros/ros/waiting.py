"""Waiting for messages without rclpy's executor, which serves timers and services only.

For every message, the executor makes a new wait set of all entities of the node, QoS events
included: a millisecond of Python on a busy machine, as much as a node's work on a small message.
"""

from __future__ import annotations

from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as rcl
from rclpy.node import Node
from rclpy.subscription import Subscription

# Messages of each topic that are taken in one go; then timers and services have their turn.
MAX_PASSES = 10


def take_waiting(node: Node) -> None:
    """Take all messages that are wanted now, at most `MAX_PASSES` of each topic."""
    for _ in range(MAX_PASSES):
        taken = 0
        for subscription in list(node.subscriptions):
            with subscription.handle:
                if not subscription.callback_group.can_execute(subscription):
                    continue
                message = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if message is not None:
                taken += 1
                has_info = subscription._callback_type is not Subscription.CallbackType.MessageOnly
                subscription.callback(*message if has_info else message[:1])
        if not taken:
            return


class Waiting:
    """Waits until a node has something to do.

    Args:
        node: its callbacks run in the thread that waits.
        executor: serves the timers and services of the node.
    """

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self._node = node
        self._executor = executor
        self._sizes: tuple[int, ...] = ()
        self._set: Any = None

    def spin_once(self, timeout_s: float) -> None:
        """Wait for wanted messages, a timer or a service, and serve the timer or service."""
        node = self._node
        wanted = [item for item in node.subscriptions if item.callback_group.can_execute(item)]
        others = {
            "timer": list(node.timers),
            "client": list(node.clients),
            "service": list(node.services),
            "guard_condition": [self._executor._guard],
        }
        guards = [*node.guards, self._executor._guard]
        sizes = (len(wanted), len(guards), *map(len, list(others.values())[:3]))
        if sizes != self._sizes:
            self._sizes = sizes
            self._set = rcl.WaitSet(*sizes, 0, node.context.handle)
        wait_set = self._set
        wait_set.clear_entities()
        for item in wanted:
            wait_set.add_subscription(item.handle)
        for item in guards:
            wait_set.add_guard_condition(item.handle)
        for kind in ("timer", "client", "service"):
            for item in others[kind]:
                getattr(wait_set, f"add_{kind}")(item.handle)
        wait_set.wait(int(timeout_s * 1e9))
        if any(
            item.handle.pointer in ready
            for kind, items in others.items()
            if (ready := wait_set.get_ready_entities(kind))
            for item in items
        ):
            self._executor.spin_once(timeout_sec=0)
