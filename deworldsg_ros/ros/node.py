"""The base of every node: parameters, guarded callbacks, subscriptions, diagnostics, shutdown."""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import os
import signal
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as rcl
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from std_msgs.msg import String

from deworldsg_ros.base.kernels import COMPILING, on_compilation
from deworldsg_ros.base.words import visible, visible_lines
from deworldsg_ros.ros.health import (
    ERROR,
    INTERNAL_ERROR,
    LISTENERS,
    LOST_PREFIX,
    UNMATCHED_PREFIX,
    Health,
    Report,
)
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.parameters import LiveParameters, declare
from deworldsg_ros.ros.qos import AutoSubscription, LossCounter, Source, reliable
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError, RefusedInput
from deworldsg_ros.wire import messages as wire

# --- Waiting for messages without rclpy's executor, which serves timers and services only.
#
# For every message, the executor makes a new wait set of all entities of the node, QoS events
# included: a millisecond of Python on a busy machine, as much as a node's work on a small message.

# Messages of each topic that are taken in one go; then timers and services have their turn.
MAX_PASSES = 10


def take_waiting(node: StageNode) -> None:
    """Take all messages that are wanted now, at most `MAX_PASSES` of each topic."""
    for _ in range(MAX_PASSES):
        taken = 0
        for subscription in list(node.subscriptions):
            # DDS drops a text that it cannot decode, and says nothing.
            is_text = subscription.msg_type is String
            with subscription.handle:
                if not subscription.callback_group.can_execute(subscription):
                    continue
                message = subscription.handle.take_message(subscription.msg_type, is_text)
            if message is None:
                continue
            taken += 1
            with node.refusing():
                if is_text:
                    message = (_text_of(message[0], subscription.topic_name), message[1])
                has_info = subscription._callback_type is not Subscription.CallbackType.MessageOnly
                subscription.callback(*message if has_info else message[:1])
        if not taken:
            return


def _text_of(serialized: bytes, topic: str) -> String:
    try:
        return deserialize_message(serialized, String)
    except Exception as error:  # the class of rclpy's error is not public
        raise RefusedInput(
            "invalid_message",
            f"{topic}: {len(serialized)} bytes are no std_msgs/String: {error}",
        ) from error


class _TimersAndServices(SingleThreadedExecutor):
    """Takes no messages: those are for `take_waiting`."""

    def can_execute(self, entity: Any) -> bool:
        return not isinstance(entity, Subscription) and bool(super().can_execute(entity))


class Waiting:
    """Waits until a node has something to do.

    Args:
        node: its callbacks run in the thread that waits.
    """

    def __init__(self, node: StageNode) -> None:
        self._node = node
        self._executor = _TimersAndServices(context=node.context)
        self._executor.add_node(node)
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
            # One call serves one of them, and each request that still waits for its answer is one.
            for _ in range(1 + len(self._executor._tasks)):
                self._executor.spin_once(timeout_sec=0)

    def close(self) -> None:
        """Serve nothing more."""
        self._executor.shutdown(timeout_sec=1.0)


# --- What a node says about itself: the message of /diagnostics, and log lines of drops.

# Minimum time between two log lines with the same reason.
LOG_PERIOD_S = 10.0


class DropLog:
    """Logs drops, each reason at most once per LOG_PERIOD_S; safe to use from several threads.

    Args:
        logger: of rclpy.
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged_s: dict[str, float] = {}
        self._lock = threading.Lock()

    def write(self, reason: str, message: str) -> None:
        """Log a drop."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._logged_s.get(reason, -LOG_PERIOD_S) < LOG_PERIOD_S:
                return
            self._logged_s[reason] = now_s
        if reason == INTERNAL_ERROR:  # with a traceback
            self._logger.error(f"{reason}: {visible_lines(message)}")
        elif reason.startswith(UNMATCHED_PREFIX):
            self._logger.debug(f"{reason}: {visible(message)}")
        else:
            self._logger.warning(f"{reason}: {visible(message)}")


def diagnostic_array(report: Report, name: str, full_name: str) -> DiagnosticArray:
    """The message of a report, without a stamp."""
    status = DiagnosticStatus(
        level=bytes([report.level]),
        name=f"{name}: {full_name}",
        message=report.message,
        hardware_id="deworldsg_ros",
        values=[KeyValue(key=key, value=value) for key, value in report.values.items()],
    )
    return DiagnosticArray(status=[status])


# --- The process of a node: signals and exit codes.

EXIT_USAGE = 2
# A model never returns: EX_SOFTWARE of sysexits.h.
EXIT_HUNG = 70
# "true": a launch file or systemd starts the process again when it ends.
RESPAWN_VARIABLE = "DEWORLDSG_RESPAWN"
NO_SECURITY = ConfigurationError(
    "ROS_SECURITY_ENABLE is true, but this middleware was built without security, as the wheels of "
    "ROS 2 are: source a ROS 2 Jazzy of the system, or unset ROS_SECURITY_ENABLE"
)


def run_process(body: Callable[[threading.Event], int], args: list[str] | None = None) -> int:
    """Initialise ROS, run a function, shut ROS down.

    Args:
        body: called with an event that SIGINT and SIGTERM set; returns the exit code.
        args: command line; None = that of the process.

    Returns:
        The exit code of `body`; 2 for unusable input; 0 after an interrupt.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    # rclpy's own handlers would shut the context down while callbacks still publish.
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # an unreadable parameter file, or malformed --ros-args
        return refuse(error)
    try:
        return body(stop)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except DeWorldSGError as error:
        return refuse(error)
    except RuntimeError as error:  # RCLError, which rclpy does not export
        if "security libraries" not in str(error):
            raise
        return refuse(NO_SECURITY)
    finally:
        rclpy.try_shutdown()


def refuse(error: Exception, code: int = EXIT_USAGE) -> int:
    """Print an error on the standard error; return the exit code."""
    print(f"error: {visible_lines(str(error))}", file=sys.stderr)
    return code


# --- The base of every node: parameters, guarded callbacks, subscriptions, diagnostics, shutdown.

# Publishers that appear or change are noticed after this time.
CHECK_PERIOD_S = 0.25
# The usual rate of /diagnostics; diagnostic_aggregator calls a status stale after 5 s.
DIAGNOSTICS_PERIOD_S = 1.0
# Topics of every node, whose listeners it does not report.
NOT_ITS_WORK = ("/diagnostics", "/parameter_events")
# Longest delay until a signal is noticed, and until messages are taken that nothing waits for.
SPIN_PERIOD_S = 0.05
# A node that serves nothing for so long is taken as lost: a call in it holds the lock of Python's
# interpreter, which loading a library or compiling a kernel holds for seconds.
STUCK_S = 60.0
# A thread of Python code lets the others run after this time (Python's default is 5 ms), so that a
# message does not wait for the stage's thread.
SWITCH_S = 0.001
# Begins the names of parameters that override the QoS of a topic.
OVERRIDES = "qos_overrides."
# Nodes that exist, also those whose constructor has not ended.
_begun: weakref.WeakSet[Node] = weakref.WeakSet()


class StageNode(Node):
    """A node around one stage.

    Callbacks made by `guarded` never raise. Refused input is counted under its reason; an
    unexpected exception is counted as ``internal_error`` and logged with its traceback.

    ``qos_overrides./TOPIC.publisher.POLICY`` and ``….subscription.POLICY`` apply as in other ROS 2
    nodes. Only overrides that are given become parameters: the QoS of the camera's topics follows
    their publishers without one.

    Args:
        name: node name.
        product: name of the output in /diagnostics.
        options: arguments of rclpy's Node.

    Attributes:
        parameters: present values.
        health: counts for /diagnostics.

    Raises:
        ConfigurationError: for an unknown parameter or a value out of range.
    """

    PARAMETERS: type[msgspec.Struct] = Parameters
    # Names of the parameters that `configure` takes while the node runs.
    LIVE: tuple[str, ...] = ()

    def __init__(self, name: str, product: str, **options: Any) -> None:
        super().__init__(name, **options)
        _begun.add(self)
        self.parameters: Any = declare(self, self.PARAMETERS, self.LIVE, (OVERRIDES,))
        self.get_logger().info("loading")
        on_compilation(lambda: self.get_logger().info(COMPILING))
        LiveParameters(self)
        self.health = Health(product)
        self._drop_log = DropLog(self.get_logger())
        self._subscriptions_to_check: list[AutoSubscription] = []
        self._json_losses: dict[str, LossCounter] = {}
        self._listeners: dict[str, str] = {}
        self._woken = self.create_guard_condition(lambda: None)
        # Real time: with use_sim_time, timers on the node's clock would stop without /clock.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.every(CHECK_PERIOD_S, self._check_publishers)
        self.every(DIAGNOSTICS_PERIOD_S, self.diagnose)

    def check(self, parameters: Any) -> None:
        """Raise ConfigurationError for parameters that cannot be taken; for subclasses."""

    def configure(self) -> None:
        """Take changed `parameters`, those of `LIVE`; for subclasses."""

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing inputs, in words; for subclasses."""
        return []

    def hung(self) -> str:
        """The call that never returns, in words; "" = none; for subclasses."""
        return ""

    def more_values(self) -> dict[str, str]:
        """Further values of /diagnostics, by name; for subclasses."""
        return {}

    def before_taking(self) -> None:
        """Called before waiting messages are taken; for subclasses."""

    def after_taking(self) -> None:
        """Called when waiting messages were taken; for subclasses."""

    def longest_wait_s(self) -> float:
        """How long to wait for messages at most; for subclasses."""
        return SPIN_PERIOD_S

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
        """As rclpy's; raises ConfigurationError for an override that rclpy does not take."""
        arguments = (msg_type, topic, qos_profile)
        return self._create(super().create_publisher, "publisher", arguments, options)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Any:
        """As rclpy's; raises ConfigurationError for an override that rclpy does not take."""
        arguments = (msg_type, topic, callback, qos_profile)
        return self._create(super().create_subscription, "subscription", arguments, options)

    def unused_overrides(self) -> list[str]:
        """The overrides of topics that the node does not have so far."""
        return [name for name in self._qos_overrides() if not self.has_parameter(name)]

    def wake(self) -> None:
        """Let the executor's thread look again which messages are wanted; from any thread."""
        self._woken.trigger()

    def close(self) -> None:
        """End threads before the node is destroyed; for subclasses to extend."""

    def every(self, period_s: float, function: Callable[[], None]) -> None:
        """Call a function periodically, in real time."""
        self.create_timer(period_s, self.guarded(function), clock=self._steady)

    def guarded(self, function: Callable[..., None]) -> Callable[..., None]:
        """The function, with its exceptions counted and logged instead of raised."""

        def call(*arguments: Any) -> None:
            with self.refusing():
                function(*arguments)

        return call

    @contextlib.contextmanager
    def refusing(self) -> Iterator[None]:
        """Count and log exceptions of the block."""
        try:
            yield
        except RefusedInput as refusal:
            self.drop(refusal.reason, str(refusal))
        except Exception as error:  # the node has to survive an unexpected message
            # During shutdown the context is invalid and publishing fails: this is no error.
            if rclpy.ok(context=self.context):
                self.drop(INTERNAL_ERROR, f"{error}\n{traceback.format_exc()}")

    def drop(self, reason: str, message: str, number: int = 1) -> None:
        """Count a drop and log it, each reason at most once per LOG_PERIOD_S."""
        self.health.dropped(reason, number, message)
        self._drop_log.write(reason, message)

    def listen(
        self,
        name: str,
        sources: Sequence[Source],
        callback: Callable[[Any], None],
        reliability: str,
        depth: int = 10,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> AutoSubscription:
        """Subscribe to the first source that is published, with a matching reliability.

        `is_wanted` as in `AutoSubscription`.
        """

        def received(message: Any) -> None:
            self.health.received(name)
            callback(message)

        subscription = AutoSubscription(
            self,
            sources,
            self.guarded(received),
            reliability=reliability,
            depth=depth,
            is_wanted=is_wanted,
            on_lost=self._lost(name),
        )
        self._subscriptions_to_check.append(subscription)
        return subscription

    def listen_json(
        self,
        topic: str,
        kind: type[wire.M],
        callback: Callable[[wire.M], None],
        depth: int,
        submit: Callable[[Callable[[], None]], None] = lambda call: call(),
    ) -> None:
        """Subscribe to JSON messages of one type.

        Args:
            topic: name of the topic.
            kind: type of the messages.
            callback: called with each message.
            depth: messages that DDS keeps.
            submit: queues a call for another thread, which then decodes the message. A message that
                the queue drops thus costs nothing.
        """
        losses = LossCounter(self._lost(topic.rsplit("/", 1)[-1]))
        self._json_losses[topic] = losses

        def received(message: Any, info: dict[str, Any]) -> None:
            losses.count(info)
            self.health.received(topic)
            submit(lambda: callback(wire.decode(message.data, kind)))

        guarded = self.guarded(received)
        # rclpy gives the information to a callback of two arguments only.
        self.create_subscription(
            String, topic, lambda message, info: guarded(message, info), reliable(depth)
        )

    def json_publisher(self, topic: str, depth: int) -> Callable[[wire.Message], None]:
        """A function that publishes JSON messages on a topic."""
        publish = self.text_publisher(topic, depth)
        return lambda message: publish(wire.encode(message))

    def text_publisher(
        self, topic: str, depth: int, *, latched: bool = False
    ) -> Callable[[str], None]:
        """A function that publishes texts on a topic."""
        publisher = self.create_publisher(String, topic, reliable(depth, latched=latched))
        return lambda text: publisher.publish(String(data=text))

    def _qos_overrides(self) -> list[str]:
        # rclpy's own publishers are made before it has read the overrides.
        given = getattr(self, "_parameter_overrides", {})
        return [name for name in given if name.startswith(OVERRIDES)]

    def _create(
        self, create: Any, kind: str, arguments: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        prefix = f"{OVERRIDES}{self.resolve_topic_name(arguments[1])}.{kind}."
        names = [name for name in self._qos_overrides() if name.startswith(prefix)]
        if not names:
            return create(*arguments, **options)
        try:
            policies = [QoSPolicyKind[name[len(prefix) :].upper()] for name in names]
            options["qos_overriding_options"] = QoSOverridingOptions(policies)
            return create(*arguments, **options)
        except (KeyError, RuntimeError, InvalidParameterTypeException, ParameterException) as error:
            given = ", ".join(
                f"{name} = {self._parameter_overrides[name].value!r}" for name in names
            )
            raise ConfigurationError(
                f"{self.get_name()}: {given}: {error}; expected policies of "
                "rclpy.qos.QoSPolicyKind with their values, e.g. reliability: best_effort"
            ) from error

    def _lost(self, name: str) -> Callable[[int], None]:
        """A function that counts lost messages of a stream."""
        return lambda number: self.drop(
            f"{LOST_PREFIX}{name}", f"{number} of {name} were published and not taken", number
        )

    def _check_publishers(self) -> None:
        for topic, losses in self._json_losses.items():
            losses.publishers = self.count_publishers(topic)
        for subscription in self._subscriptions_to_check:
            if subscription.check():
                self.get_logger().info(f"listening to {subscription.describe()}")
        before, self._listeners = self._listeners, _listeners_of(self)
        if self._listeners != before:
            self.diagnose(in_turn=False)  # who has just connected learns the state

    def diagnose(self, in_turn: bool = True) -> None:
        """Publish the state of the node on /diagnostics; `in_turn` as in `Health.report`."""
        described = _described(self._subscriptions_to_check)
        values = {**described, **self._listeners, **self.more_values()}
        if hung := self.hung():
            self.get_logger().error(hung, throttle_duration_sec=LOG_PERIOD_S)
        self._diagnostics.publish(_diagnostic_message(self, values, bool(hung), in_turn))


def _described(subscriptions: Sequence[AutoSubscription]) -> dict[str, str]:
    return {
        f"listening to {number}": subscription.describe()
        for number, subscription in enumerate(subscriptions, 1)
    }


def _diagnostic_message(
    node: StageNode, values: dict[str, str], is_error: bool, in_turn: bool
) -> DiagnosticArray:
    now_ns = time.monotonic_ns()
    missing = node.waiting_for(now_ns)
    report = node.health.report(now_ns / 1e9, missing, values, in_turn=in_turn)
    if is_error:
        report = replace(report, level=ERROR)
    message = diagnostic_array(report, node.get_name(), node.get_fully_qualified_name())
    message.header.stamp = node.get_clock().now().to_msg()
    return message


def _listeners_of(node: StageNode) -> dict[str, str]:
    return {
        f"{LISTENERS}{publisher.topic_name}": str(publisher.get_subscription_count())
        for publisher in node.publishers
        if publisher.topic_name not in NOT_ITS_WORK
    }


def serve(node: StageNode, waiting: Waiting) -> None:
    """Wait for messages, timers and services, and serve them; at most `longest_wait_s`."""
    with node.refusing():
        waiting.spin_once(node.longest_wait_s())
        node.before_taking()
        take_waiting(node)
        node.after_taking()


def end_if_stuck() -> None:
    """End the process, with the stacks of its threads, if this is not called again in STUCK_S.

    A thread of C does it, which does not need the lock of Python's interpreter.
    """
    faulthandler.dump_traceback_later(STUCK_S, exit=True)


def run(make_node: Callable[[], StageNode], args: list[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM; return the exit code of `run_process`.

    A node whose model never returns also ends, if something starts it again; so does one that
    serves nothing for STUCK_S.
    """

    def body(stop: threading.Event) -> int:
        others = set(_begun)
        try:
            node = make_node()
        except BaseException:
            # Fast DDS sometimes waits without end for a node that is there when the process ends.
            for unfinished in set(_begun) - others:
                unfinished.destroy_node()
            raise
        is_respawned, hung = os.environ.get(RESPAWN_VARIABLE) == "true", ""
        sys.setswitchinterval(SWITCH_S)
        # A full collection stops all threads. It would look at all objects of the imported modules
        # each time, which takes 100 ms.
        gc.collect()
        gc.freeze()
        try:
            waiting = Waiting(node)
            for override in node.unused_overrides():
                node.get_logger().warning(f"{override} has no effect: there is no such topic yet")
            if is_respawned:
                node.every(DIAGNOSTICS_PERIOD_S, end_if_stuck)
            node.get_logger().info("ready")
            while not (stop.is_set() or hung) and rclpy.ok():
                serve(node, waiting)
                hung = node.hung() if is_respawned else ""
            if hung:
                node.diagnose()
            waiting.close()
        finally:
            faulthandler.cancel_dump_traceback_later()
            node.close()
            node.destroy_node()
        if hung:
            print(f"error: {hung}", file=sys.stderr, flush=True)
        return EXIT_HUNG if hung else 0

    code = run_process(body, args)
    if code == EXIT_HUNG:
        os._exit(code)  # the interpreter's own end could wait for the model
    return code
