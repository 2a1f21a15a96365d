"""The state of a viewer, without a browser: what was recorded, and what of it is shown to whom."""

from __future__ import annotations

import ipaddress
import logging
import secrets
import socket
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.objects import Point, Relation, relation_of
from deworldsg_ros.graph.extent import DEFAULT_UP
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.view.live.camera import BestViews, CameraView, Shot, Shots, jpeg, with_masks
from deworldsg_ros.view.live.drawing import (
    Drawing,
    Filter,
    ObjectTable,
    Shape,
    draw,
    node_colours,
    rgb_of,
    rotations,
)
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica

# --- What becomes of an exception in the thread of the page, which goes on.

OnError = Callable[[Exception], None]


class LogOnce:
    """Logs the first exception of each type: a step of the page may fail ten times a second."""

    def __init__(self) -> None:
        self._types: set[type[Exception]] = set()

    def __call__(self, error: Exception) -> None:
        """Log an exception with its traceback."""
        if type(error) not in self._types:
            self._types.add(type(error))
            logging.getLogger(__name__).error("the page goes on after an error", exc_info=error)


# --- What was recorded: the graph after each numbered update, for the time slider.

# A moment is found by applying at most so many updates to a snapshot.
BLOCK = 100
# The oldest moments are forgotten beyond so many bytes, packed: minutes of a busy room at 30 Hz,
# hours of a quiet one.
MOST_BYTES = 64_000_000
# So large a part of them begins a new block, whose moments are forgotten together.
BLOCK_PART = 16


class _Block:
    """A snapshot, the first moment of the block, and the updates after it; JSON, packed."""

    def __init__(self, start: wire.SceneGraphMessage) -> None:
        self._start, self._updates = _packed(start), list[bytes]()
        self.size_bytes = len(self._start)

    def __len__(self) -> int:
        return 1 + len(self._updates)

    def add(self, update: wire.SceneGraphUpdateMessage) -> None:
        """Add the next moment."""
        packed = _packed(update)
        self._updates.append(packed)
        self.size_bytes += len(packed)

    def at(self, moment: int) -> GraphReplica:
        """The graph at a moment of the block."""
        replica = GraphReplica()
        replica.reset(wire.decode(zlib.decompress(self._start), wire.SceneGraphMessage))
        for packed in self._updates[:moment]:
            replica.apply(wire.decode(zlib.decompress(packed), wire.SceneGraphUpdateMessage))
        return replica


def _packed(message: wire.Message) -> bytes:
    return zlib.compress(wire.encode(message).encode(), 1)


class History:
    """The graph after each update. Moments are numbered from 0; the oldest are forgotten.

    Args:
        most_bytes: that the moments take, about.

    Attributes:
        newest: the graph now.
        first: number of the oldest moment that is kept.
    """

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self.newest = GraphReplica()
        self.first = 0
        self._most_bytes = most_bytes
        self._blocks: list[_Block] = []

    @property
    def size_bytes(self) -> int:
        """That the moments take."""
        return sum(block.size_bytes for block in self._blocks)

    @property
    def session(self) -> str | None:
        """The session of the graph."""
        return self.newest.session

    @property
    def sequence(self) -> int:
        """Number of the newest update."""
        return self.newest.sequence

    @property
    def last(self) -> int:
        """Number of the newest moment; `first` - 1 if there is none."""
        return self.first + sum(map(len, self._blocks)) - 1

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Continue with a snapshot: of a file, or after lost updates."""
        self.newest.reset(snapshot)
        self._begin(snapshot)

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; False for one that is known.

        Raises:
            RefusedInput: ``lost_updates`` or ``other_session``, as `GraphReplica.apply`.
        """
        if not self.newest.apply(update):
            return False
        # The first update of a session replaces the graph, so it begins a block too.
        if not self._blocks or update.sequence == 1 or self._is_full(self._blocks[-1]):
            self._begin(self.newest.message())
        else:
            self._blocks[-1].add(update)
            self._forget()
        return True

    def at(self, moment: int) -> GraphReplica:
        """The graph at a moment; the nearest one that is kept."""
        left = min(max(moment, self.first), self.last) - self.first
        for block in self._blocks:
            if left < len(block):
                return block.at(left)
            left -= len(block)
        return GraphReplica()

    def _is_full(self, block: _Block) -> bool:
        return len(block) >= BLOCK or block.size_bytes * BLOCK_PART >= self._most_bytes

    def _begin(self, snapshot: wire.SceneGraphMessage) -> None:
        self._blocks.append(_Block(snapshot))
        self._forget()

    def _forget(self) -> None:
        while len(self._blocks) > 1 and self.size_bytes > self._most_bytes:
            self.first += len(self._blocks.pop(0))


# --- The state of a viewer, without a browser: what was recorded, and what of it is shown.

# Points of an object that are collected from the frames, if the messages of the graph have none.
POINTS_OF_OBJECT = 256
# Points of the scene: more slow down a phone.
MOST_POINTS = 100_000
# Hidden predicates that are named above the controls; of more it says the number.
MOST_NAMES = 3
# The floor is drawn below the lowest objects, of which a few may be wrong.
FLOOR_PERCENTILE = 5.0


@dataclass
class LiveState:
    """Applies updates and camera views, and draws the moment that is chosen.

    Attributes:
        history: the graph after each update.
        crops: the best photo of each object.
        shots: the frames of the camera.
        filter, shape, selected: what the user chose.
        moment: number of the shown moment; None = the newest one.
        why_empty: shown while there are no objects.
    """

    history: History = field(default_factory=History)
    crops: BestViews = field(default_factory=BestViews)
    shots: Shots = field(default_factory=Shots)
    filter: Filter = Filter()
    shape: Shape = "boxes"
    selected: int | None = None
    moment: int | None = None
    why_empty: str = "waiting for the graph"

    def __post_init__(self) -> None:
        self.table = ObjectTable()
        self.edges: dict[Pair, wire.EdgeState] = {}
        self.shown = self.history.newest
        self._points: dict[int, Float32] = {}
        self._colours: dict[int, str] = {}

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Continue with a snapshot."""
        self.history.reset(snapshot)

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; as `History.apply`."""
        applied = self.history.apply(update)
        if applied:
            self.crops.merge(update.removed_nodes)
            for node in update.removed_nodes:
                self._points.pop(node.id, None)
        return applied

    def look(self, view: CameraView) -> None:
        """Take a frame of the camera: its way, its image, photos and points of its objects."""
        self.crops.add(view)
        image = with_masks(view, self._colours)
        self.shots.add(
            Shot(
                view.stamp_ns,
                view.T_world_camera,
                view.fov_rad,
                view.aspect,
                b"" if image is None else jpeg(image),
            )
        )
        if view.local is not None:
            for node_id, points in zip(view.node_ids, view.local.surface_points_world):
                known = self._points.get(node_id, np.zeros((0, 3), np.float32))
                self._points[node_id] = np.concatenate([known, points])[-POINTS_OF_OBJECT:]

    def draw(self) -> Drawing:
        """The drawing of the chosen moment; only what changed is computed again."""
        newest = self.history.newest
        self.shown = newest if self.moment is None else self.history.at(self.moment)
        if self.table.sync(self.shown.nodes, self.shown.frame_id, up_of(self.shown)):
            self._colours = node_colours(self.table)
        self.edges = dict(self.shown.edges)
        if self.selected not in self.table:
            self.selected = None
        return draw(self.table, self.edges, self.filter, self.shape, self.selected)

    def points(self) -> tuple[Float32, UInt8]:
        """Surface points (n, 3) of the drawn objects, and their colours (n, 3)."""
        parts, tints = [], []
        for node_id, item in self.table.objects.items():
            points = item.surface_m if len(item.surface_m) else self._points.get(node_id)
            if points is not None and len(points) and item.label not in self.filter.hidden_classes:
                parts.append(np.asarray(points, np.float32))
                tints.append(self._colours[node_id])
        if not parts:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        points = np.concatenate(parts)
        colours = np.repeat(rgb_of(tints), [len(part) for part in parts], axis=0)
        stride = -(-len(points) // MOST_POINTS)
        return points[::stride], colours[::stride]

    def frames(self) -> list[Shot]:
        """Frames of the camera up to the shown moment."""
        return self.shots.until(None if self.moment is None else self.shown.stamp_ns)

    def relations_of(self, node_id: int) -> list[Relation]:
        """Relations of an object that is drawn, the most probable first."""
        objects = self.table.objects
        found = [
            relation_of(edge, objects[edge.subject], objects[edge.object], None)
            for pair, edge in self.edges.items()
            if node_id in pair and pair[0] in objects and pair[1] in objects
        ]
        return sorted(found, key=lambda item: -item.probability)

    def summary(self, drawing: Drawing) -> list[str]:
        """The size of the graph, and the moment; why it is empty."""
        objects, relations = len(self.table), len(self.edges)
        if not objects:
            return ["no objects", self.why_empty]
        shown = len(drawing.arrows) + len(drawing.lines)
        hidden = sorted(
            self.filter.hidden_predicates & {edge.predicate for edge in self.edges.values()}
        )
        names = ", ".join(hidden) if len(hidden) <= MOST_NAMES else f"{len(hidden)} predicates"
        without = f" ({names} {'is' if len(hidden) == 1 else 'are'} hidden)" if hidden else ""
        lines = [
            f"{counted(objects, 'object')}, {counted(relations, 'relation')}",
            f"shown: {counted(len(drawing.ids), 'object')}, {counted(shown, 'relation')}" + without,
            f"world frame: {self.shown.frame_id}",
        ]
        if self.moment is not None:
            late_s = (self.history.newest.stamp_ns - self.shown.stamp_ns) / 1e9
            lines.append(f"update {self.shown.sequence}, {late_s:.1f} s before the newest")
        return lines

    def bounds(self) -> tuple[Float64, Float64] | None:
        """Lower and upper corner (3,) of what is drawn; None = nothing."""
        if not len(self.table):
            return None
        half = np.einsum("nij,nj->ni", np.abs(rotations(self.table.wxyzs)), self.table.sizes / 2)
        return (self.table.centres - half).min(axis=0), (self.table.centres + half).max(axis=0)

    def floor_m(self) -> float:
        """Height along up below which few objects reach."""
        up = np.array(up_of(self.shown))
        bottoms = self.table.centres @ up - self.table.sizes[:, 2] / 2
        return float(np.percentile(bottoms, FLOOR_PERCENTILE))


def up_of(replica: GraphReplica) -> Point:
    """Unit vector against gravity; +z if the messages do not tell it."""
    up = replica.up
    return DEFAULT_UP if up is None else (up[0], up[1], up[2])


# --- Who may see it.


class Guard:
    """Checks each request to a server: only the address that the server prints opens it.

    So a page of another site, in a browser on this machine, cannot read the server.

    Args:
        host: address that the server listens on.
        scheme: http or ws.
        origins: of pages that may connect beside the server's own; `LOCAL` = any of this machine.

    Attributes:
        refused: number of refused requests by reason: host, origin, token.
    """

    LOCAL = "local"

    def __init__(self, host: str, scheme: str, origins: tuple[str, ...] = ()) -> None:
        name = socket.gethostname().lower()
        self._names = {"localhost", name, f"{name}.local", host.lower()} - {""}
        self._host, self._scheme, self._origins = host, scheme, origins
        self._path = f"/{secrets.token_urlsafe(16)}"
        self.refused: Counter[str] = Counter()

    def url(self, port: int) -> str:
        """The address to print; its path is a secret of 128 bits."""
        host = self._host
        address = _address(host)
        if address is not None and address.is_unspecified:
            host = "localhost"  # an address that means all of this machine's leads nowhere
        host = f"[{host}]" if ":" in host else host
        return f"{self._scheme}://{host}:{port}{self._path}"

    def path(self, target: str, headers: Any) -> str | None:
        """The path of a request without the secret; None for a request to refuse, with 403.

        Args:
            target: path and query of the request.
            headers: of the request, with `get_all` by name.
        """
        hosts, origins = (headers.get_all(name) or [] for name in ("Host", "Origin"))
        rest = target[len(self._path) :]
        given = target[: len(self._path)].encode(errors="replace")
        if len(hosts) != 1 or not self._is_here(hosts[0]):
            problem = "host"
        elif not all(self._is_known(origin, hosts[0]) for origin in origins):
            problem = "origin"
        elif not secrets.compare_digest(given, self._path.encode()) or rest[:1] not in "/?":
            problem = "token"
        else:
            return rest if rest.startswith("/") else f"/{rest}"
        if not self.refused[problem]:
            text = "live view: refused a request (%s): open the printed address; more are counted"
            logging.getLogger(__name__).warning(text, problem)
        self.refused[problem] += 1
        return None

    def _is_here(self, host: str) -> bool:
        """Whether a name is no other machine's. A page can rebind a name, but no address."""
        name = _name_of(f"//{host}")
        return name in self._names or _address(name) is not None

    def _is_known(self, origin: str, host: str) -> bool:
        if origin in (f"http://{host}", f"https://{host}", *self._origins):
            return True
        name = _name_of(origin)
        address = _address(name)
        is_local = name == "localhost" or (address is not None and address.is_loopback)
        return is_local and self.LOCAL in self._origins


def _name_of(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
