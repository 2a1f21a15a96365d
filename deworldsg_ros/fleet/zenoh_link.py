"""Graphs over Zenoh: a feed answers what changed since a number, a follower asks.

A follower asks again and again. So a link that was cut, a router that was restarted and a robot
that joins late need no special case: the next answer contains everything that is missing.
"""

from __future__ import annotations

import json
import re
import threading
import time
import zlib
from collections.abc import Callable
from typing import Any

from msgspec import UNSET

from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import ChangeLog, GraphReplica

PREFIX = "deworldsg"
# Level 1 takes a quarter of the time of level 6, and a tenth more bytes.
COMPRESSION = 1
MAX_NAME = 64
ROBOT_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{MAX_NAME}}}")
# Each one takes a thread while it is asked, and the fleet keeps its last graph.
MAX_ROBOTS = 256
# The largest answer of a robot, packed and as JSON: ten thousand objects with their relations take
# half of it. Its objects take six times as much memory as the JSON.
MAX_PACKED_BYTES, MAX_ANSWER_BYTES = 16 * 2**20, 64 * 2**20
# Objects and relations of a robot's graph, however many answers it came in.
MAX_PARTS = 200_000
# A router is looked for so long, again and again: meanwhile signals and diagnostics are served.
CONNECT_S = 1.0
# A robot that has never answered keeps its place for so long, if another one needs it.
PATIENCE_S = 10.0
# A robot without a token and without an answer for so long is asked no more. If it comes back, its
# whole graph is sent again: that should not happen after each gap of a radio link.
GONE_S = 60.0


class NoRouterError(ConfigurationError):
    """No router answers yet."""


def open_session(connect: str = "", listen: str = "") -> Any:
    """A Zenoh session. It does not search the network for other routers.

    Args:
        connect: endpoints of routers, e.g. ``tcp/10.0.0.5:7447``, separated by commas.
        listen: endpoints on which this process is a router itself; empty = it is none.

    Raises:
        NoRouterError: if no router has answered for `CONNECT_S`.
        ConfigurationError: without the package eclipse-zenoh, for an endpoint that cannot be read,
            or one that is in use.
    """
    try:
        import zenoh
    except ImportError as error:
        raise ConfigurationError(
            "the fleet needs Zenoh: pip install 'deworldsg_ros[fleet]'"
        ) from error
    config = zenoh.Config()
    try:
        for key, value in {
            "mode": "router" if listen else "client",
            "connect/endpoints": _endpoints(connect),
            "connect/timeout_ms": 0 if listen else round(1000 * CONNECT_S),
            "connect/exit_on_failure": False,
            "listen/endpoints": _endpoints(listen),
            "scouting/multicast/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        kind = NoRouterError if "Unable to connect" in str(error) else ConfigurationError
        raise kind(
            f"no Zenoh session with connect {connect!r} and listen {listen!r}: {error}"
        ) from error


def _endpoints(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def robot_key(name: str) -> str:
    """Key of a robot's own graph, for the fleet."""
    return f"{PREFIX}/robots/{name}"


def part_key(name: str) -> str:
    """Key of the part of the fleet's graph that concerns a robot."""
    return f"{PREFIX}/parts/{name}"


class Feed:
    """Answers what changed in a graph.

    Args:
        session: of Zenoh.
        key: of the graph.
        log: the graph.
        refresh: called before each answer, to bring `log` up to date.

    Attributes:
        sent_bytes: size of all answers.
    """

    def __init__(
        self, session: Any, key: str, log: ChangeLog, refresh: Callable[[], object] | None = None
    ) -> None:
        self._log, self._refresh = log, refresh
        self.sent_bytes = 0
        self._queryable = session.declare_queryable(key, self._answer)

    def close(self) -> None:
        """Answer no more."""
        self._queryable.undeclare()

    def _answer(self, query: Any) -> None:
        with query:
            if self._refresh is not None:
                self._refresh()
            asked = query.parameters
            number = asked.get("since") or "0"
            since = int(number) if number.isdecimal() and len(number) < 19 else 0
            update = self._log.since(asked.get("session"), since)
            # An empty answer: nothing changed.
            packed = (
                b"" if update is None else zlib.compress(wire.encode(update).encode(), COMPRESSION)
            )
            self.sent_bytes += len(packed)
            query.reply(query.key_expr, packed)


class Follower:
    """Keeps a copy of a graph that a `Feed` serves.

    Args:
        session: of Zenoh.
        key: of the graph.

    Attributes:
        replica: the copy.
        received_bytes: size of all answers.
        others: answers of further feeds with this key, which are left out.
    """

    def __init__(self, session: Any, key: str) -> None:
        self._session, self._key = session, key
        self.replica = GraphReplica()
        self.received_bytes = self.others = 0
        self._feed = ""

    def ask(self, timeout_s: float) -> bool | None:
        """Ask once.

        Returns:
            Whether the graph changed; None = there was no answer.

        Raises:
            RefusedInput: for an answer that is not a valid update.
        """
        replica = self.replica
        parameters = f"since={replica.sequence}"
        if replica.session is not None:
            parameters += f";session={replica.session}"
        answered = None
        for reply in self._own(parameters, timeout_s):
            size = len(reply.ok.payload)
            self.received_bytes += size
            if size > MAX_PACKED_BYTES:
                raise RefusedInput(
                    "message_too_large",
                    f"an update has {size} bytes, packed: expected at most {MAX_PACKED_BYTES}",
                )
            with _UNPACKING:
                packed = reply.ok.payload.to_bytes()
                answered = bool(packed) and replica.apply(_unpacked(packed)) or bool(answered)
            parts = len(replica.nodes) + len(replica.edges)
            if parts > MAX_PARTS:
                self.replica = GraphReplica()
                raise RefusedInput(
                    "message_too_large",
                    f"a robot's graph has {parts} objects and relations: expected at most "
                    f"{MAX_PARTS}",
                )
        return answered

    def _own(self, parameters: str, timeout_s: float) -> list[Any]:
        """The answers of one feed: of the one that is followed, as long as it answers."""
        import zenoh

        replies = [
            reply
            for reply in self._session.get(
                f"{self._key}?{parameters}",
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            if reply.ok is not None
        ]
        feeds = [str(reply.replier_id) for reply in replies]
        if feeds and self._feed not in feeds:
            self._feed = feeds[0]
        self.others += len(set(feeds) - {self._feed})
        return [reply for reply, feed in zip(replies, feeds) if feed == self._feed]


# One answer at a time: the memory for it is taken once, however many robots there are.
_UNPACKING = threading.Lock()


def _unpacked(packed: bytes) -> wire.SceneGraphUpdateMessage:
    limit = MAX_ANSWER_BYTES
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, limit)
    except zlib.error as error:
        raise RefusedInput(
            "invalid_message", f"{len(packed)} bytes of an update: {error}"
        ) from error
    if not unpacker.eof:
        raise RefusedInput(
            "message_too_large",
            f"an update is cut, or larger than the {limit} bytes that are expected at most",
        )
    update = wire.decode(content, wire.SceneGraphUpdateMessage)
    if update.since is UNSET:
        raise RefusedInput("invalid_message", "an update without `since`: expected a number")
    return update


class Robots:
    """Follows the graphs of all robots that are on the network.

    Names that are none are refused (``invalid_robot``). When there are `MAX_ROBOTS`, a new one
    takes the place of one that has never answered for `PATIENCE_S`, else of the one that has been
    gone for longest; without such a place it is refused (``too_many_robots``). A robot that did not
    answer is asked on, and nobody waits for it.

    Args:
        session: of Zenoh.

    Attributes:
        followers: by name of the robot; those that have been gone for `GONE_S` are forgotten.
    """

    def __init__(self, session: Any) -> None:
        self._session = session
        self.followers: dict[str, Follower] = {}
        self._errors: list[Exception] = []
        # When each robot was met, was there, and answered; and those that are asked now.
        self._met_s: dict[str, float] = {}
        self._there_s: dict[str, float] = {}
        self._answered_s: dict[str, float] = {}
        self._asking: dict[str, _Asking] = {}
        self._silent: set[str] = set()
        self._forgotten: list[str] = []
        self._forgotten_bytes = 0

    @property
    def received_bytes(self) -> int:
        """Size of all answers."""
        followers = list(self.followers.values())  # the fleet's thread adds and forgets some
        return self._forgotten_bytes + sum(of.received_bytes for of in followers)

    def ask(self, timeout_s: float) -> dict[str, bool | None]:
        """Ask every robot once, all at the same time; wait for those that answered the last time.

        Returns:
            By name: whether its graph changed; None = it did not answer, or not yet.
        """
        prefix = robot_key("")
        for reply in self._session.liveliness().get(prefix + "*", timeout=timeout_s):
            if reply.ok is not None:
                self._meet(str(reply.ok.key_expr)[len(prefix) :])
        self._forget_gone()
        for name, follower in self.followers.items():
            if name not in self._asking:
                self._asking[name] = _Asking(follower, timeout_s)
        answers: dict[str, bool | None] = dict.fromkeys(self.followers)
        for name, asking in list(self._asking.items()):
            asking.join(None if name in self.followers and name not in self._silent else 0.0)
            if asking.is_alive():
                continue
            del self._asking[name]
            if asking.error is not None:
                self._errors.append(asking.error)
            if name not in self.followers:
                continue
            answers[name] = asking.changed
            if self.followers[name].others:
                self.followers[name].others = 0
                self._errors.append(
                    RefusedInput(
                        "same_name",
                        f"two robots are named '{name}': the first one is followed; expected "
                        "another `robot` for each fleet_link_node",
                    )
                )
            if asking.changed is None:
                self._silent.add(name)
            else:
                self._silent.discard(name)
                self._there_s[name] = self._answered_s[name] = time.monotonic()
        return answers

    def take_forgotten(self) -> list[str]:
        """Robots since the last call that gave their place to others; their graphs go, too."""
        forgotten, self._forgotten = self._forgotten, []
        return forgotten

    def take_errors(self) -> list[Exception]:
        """Refusals and errors since the last call."""
        errors, self._errors = self._errors, []
        return errors

    def _meet(self, name: str) -> None:
        """Follow a robot that is on the network."""
        if name in self.followers:
            self._there_s[name] = time.monotonic()
        elif not ROBOT_NAME.fullmatch(name):
            self._errors.append(
                RefusedInput(
                    "invalid_robot",
                    f"a robot is named {name[:MAX_NAME]!r}: expected at most {MAX_NAME} letters, "
                    "digits, _ and -",
                )
            )
        elif name not in self._answered_s and not self._make_place():
            self._errors.append(
                RefusedInput(
                    "too_many_robots",
                    f"robot '{name}' is ignored: expected at most {MAX_ROBOTS}",
                )
            )
        else:
            self.followers[name] = Follower(self._session, robot_key(name))
            self._met_s[name] = self._there_s[name] = time.monotonic()

    def _make_place(self) -> bool:
        """Whether there is a place for one more robot, also after one was forgotten."""
        known = {**self._answered_s, **self.followers}
        if len(known) < MAX_ROBOTS:
            return True
        now_s = time.monotonic()
        for name in self.followers:  # the one that was met first
            if name not in self._answered_s and now_s - self._met_s[name] > PATIENCE_S:
                self._forget(name)
                return True
        gone = [name for name in self._answered_s if name not in self.followers]
        if gone:
            name = min(gone, key=self._answered_s.__getitem__)
            del self._answered_s[name]
            self._forgotten.append(name)
        return bool(gone)

    def _forget_gone(self) -> None:
        """Each robot that is asked takes a thread, also one that never answers."""
        now_s = time.monotonic()
        for name in [name for name, at_s in self._there_s.items() if now_s - at_s > GONE_S]:
            self._forget(name)

    def _forget(self, name: str) -> None:
        del self._there_s[name], self._met_s[name]
        self._silent.discard(name)
        self._forgotten_bytes += self.followers.pop(name).received_bytes


class _Asking(threading.Thread):
    """Asks one robot; `changed` is as the answer of `Follower.ask`."""

    def __init__(self, follower: Follower, timeout_s: float) -> None:
        super().__init__(daemon=True)
        self.changed: bool | None = None
        self.error: Exception | None = None
        self._follower, self._timeout_s = follower, timeout_s
        self.start()

    def run(self) -> None:
        """Ask; one robot must not stop the others."""
        try:
            self.changed = self._follower.ask(self._timeout_s)
        except Exception as error:
            self.error = error
