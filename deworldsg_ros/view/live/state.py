"""The state of the live viewer, without a network: what was recorded, and what is news to whom."""

from __future__ import annotations

import bisect
import ipaddress
import logging
import math
import secrets
import socket
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np

from deworldsg_ros.client.objects import Point, SceneObject, scene_object
from deworldsg_ros.graph.extent import DEFAULT_UP, surface_points
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.graph.surface import Surface
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8, UInt16
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.vocabulary import verb_of
from deworldsg_ros.view.colours import class_colours, predicate_colours, view_axes
from deworldsg_ros.view.live.camera import BestViews, CameraView, Shot, Shots, jpeg, with_masks
from deworldsg_ros.view.live.history import History, Recipe
from deworldsg_ros.view.page import (
    cloud_values,
    edge_values,
    path_values,
    room_values,
    surface_values,
    values_of,
    why,
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


# --- What the pages show: values that are encoded once, and what each page has of them.

# Points of an object that are collected from the frames, if the messages of the graph have none.
POINTS_OF_OBJECT = 256
# Points of the scene: more slow down a phone.
MOST_POINTS = 100_000
# The camera's way has a place every so many metres; a long one loses every second place.
STEP_M, MOST_PLACES = 0.03, 20_000
# Graphs of earlier moments that are kept for the pages that show them.
MOST_SCENES = 4
# Surface points and images are large: they follow in these periods.
CLOUDS_PERIOD_S, IMAGE_PERIOD_S = 1.0, 0.2


@dataclass(frozen=True)
class Scene:
    """The graph at one moment as the page gets it, in JSON.

    Attributes:
        nodes, edges: each value by id, or by subject and object. Of an unchanged value, the same
            bytes.
        labels, predicates: their names, those of the oldest objects first.
        frame_id, stamp_ns: of the graph.
    """

    nodes: dict[int, bytes]
    edges: dict[Pair, bytes]
    labels: tuple[str, ...]
    predicates: tuple[str, ...]
    frame_id: str
    stamp_ns: int


def scene_of(recipe: Recipe, up: Point) -> Scene:
    """The graph of an earlier moment. It takes long: a tenth of a second and more."""
    replica, axes = recipe.replica(), view_axes(up)
    items = {
        node_id: scene_object(node, replica.frame_id, up) for node_id, node in replica.nodes.items()
    }
    nodes = {node_id: _node_json(item, axes) for node_id, item in items.items()}
    edges = {pair: _json(edge_values(edge)) for pair, edge in replica.edges.items()}
    return _scene(replica, items, nodes, edges)


def _scene(
    replica: GraphReplica,
    items: Mapping[int, SceneObject],
    nodes: Mapping[int, bytes],
    edges: Mapping[Pair, bytes],
) -> Scene:
    """A graph with its values, without what cannot be shown."""
    shown = {node_id: text for node_id, text in nodes.items() if text}
    return Scene(
        shown,
        {pair: text for pair, text in edges.items() if pair[0] in shown and pair[1] in shown},
        tuple(dict.fromkeys(items[i].label for i in sorted(items))),
        tuple(dict.fromkeys(edge.predicate for edge in replica.edges.values())),
        replica.frame_id,
        replica.stamp_ns,
    )


def _node_json(item: SceneObject, axes: Float64) -> bytes:
    """The values of an object; empty, and a line in the log, if they cannot be computed."""
    try:
        return _json(values_of(item, axes))
    except ValueError as error:
        text = "live view: object %d is left out: %s"
        logging.getLogger(__name__).error(text, item.id, error)
        return b""


@dataclass
class PageView:
    """What one page has, and what its user has chosen.

    Attributes:
        moment: number of the shown moment; None = the newest one.
        wants_images: whether it shows those of the camera.
    """

    moment: int | None = None
    wants_images: bool = True
    nodes: dict[int, bytes] = field(default_factory=dict)
    edges: dict[Pair, bytes] = field(default_factory=dict)
    clouds: dict[int, bytes] = field(default_factory=dict)
    photos: dict[int, bytes] = field(default_factory=dict)
    head: bytes = b""
    moments: bytes = b""
    places: tuple[int, int] = (0, 0)
    camera_ns: int | None = None
    image_ns: int | None = None
    surface: tuple[int, int] = (0, 0)
    surface_gone: int = 0
    clouds_s: float = -math.inf
    image_s: float = -math.inf


class LiveState:
    """Applies updates and frames of the camera, and says what is news for a page.

    Attributes:
        history: the graph after each update.
        crops: the best photo of each object.
        why_empty: shown while there are no objects.
    """

    def __init__(self, why_empty: str = "waiting for the graph") -> None:
        self.history = History()
        self.crops = BestViews()
        self.why_empty = why_empty
        self._shots = Shots()
        self._up: Point | None = None
        self._axes = view_axes(DEFAULT_UP)
        self._items: dict[int, SceneObject] = {}
        self._nodes: dict[int, bytes] = {}  # empty for what cannot be shown
        self._scenes: OrderedDict[int, Scene] = OrderedDict()  # of the past
        self._session: str | None = None
        self._edges: dict[Pair, tuple[wire.EdgeState, bytes]] = {}
        self._predicates: dict[str, int] = {}
        self._colours: dict[int, str] = {}
        self._points: dict[int, Float32] = {}
        self._clouds: dict[int, tuple[Any, int, bytes]] = {}
        self._space, self._surface = SeenSpace(), Surface()
        self._surface_gone: list[int] = []  # rows, in the order in which they went
        self._places: list[tuple[int, Float64]] = []
        self._redrawn = 0  # how often the places became others

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Continue with a snapshot."""
        self.history.reset(snapshot)
        self._begin_session()

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; as `History.apply`."""
        applied = self.history.apply(update)
        if applied:
            self._begin_session()
            self.crops.merge(update.removed_nodes)
            for node in update.removed_nodes:
                self._points.pop(node.id, None)
        return applied

    def look(self, view: CameraView) -> None:
        """Take a frame of the camera: its way, its image, photos and points of its objects."""
        self.crops.add(view)
        self._follow()  # the colours
        image = with_masks(view, self._colours)
        self._shots.add(
            Shot(
                view.stamp_ns,
                view.T_world_camera,
                view.fov_rad,
                view.aspect,
                b"" if image is None else jpeg(image),
            )
        )
        place = view.T_world_camera[:3, 3]
        if not self._places or math.dist(place, self._places[-1][1]) >= STEP_M:
            self._places.append((view.stamp_ns, place))
        if len(self._places) > MOST_PLACES:
            self._places, self._redrawn = self._places[::2], self._redrawn + 1
        if view.local is not None:
            if self._space.note(_with_colours(view.local, view.rgb)):
                self._add(*list(self._space.views())[-1])
            for node_id, points in zip(view.node_ids, view.local.surface_points_world):
                known = self._points.get(node_id, np.zeros((0, 3), np.float32))
                self._points[node_id] = np.concatenate([known, points])[-POINTS_OF_OBJECT:]

    def see(self, space: SeenSpace) -> None:
        """Take the views of a saved graph: the surface of its room."""
        for view in space.views():
            self._add(*view)

    def correct(self, change: TrailChange) -> None:
        """Move the room and the camera's way: SLAM has corrected the poses."""
        stamps_ns = np.array([stamp_ns for stamp_ns, _ in self._places], np.int64)
        self._places = [
            (stamp_ns, T[:3, :3] @ place + T[:3, 3])
            for (stamp_ns, place), T in zip(self._places, change.at(stamps_ns))
        ]
        self._redrawn += 1
        self._points.clear()  # frames bring them again
        self._space.move(change)
        self._surface.clear()
        self._surface_gone = []
        self.see(self._space)

    def _add(self, depth_mm: UInt16, rgb: UInt8, camera: Float64, pose: Float64) -> None:
        begun, gone = self._surface.begun, self._surface.gone.copy()
        self._surface.add(depth_mm, rgb, camera, pose)
        if self._surface.begun != begun:
            self._surface_gone = []
        else:
            new = np.flatnonzero(self._surface.gone[: len(gone)] & ~gone)
            self._surface_gone += new.tolist()

    def recipe(self, page: PageView) -> tuple[Recipe, Point] | None:
        """What `scene_of` needs for a page in the past; None if nothing is to be made."""
        if page.moment is None or page.moment in self._scenes:
            return None
        found = self.history.at(page.moment)
        return None if found is None else (found, self._up or DEFAULT_UP)

    def remember(self, moment: int, scene: Scene) -> None:
        """Keep the graph of an earlier moment for the next `news`."""
        self._scenes[moment] = scene
        while len(self._scenes) > MOST_SCENES:
            self._scenes.popitem(last=False)

    def news(self, page: PageView, now_s: float) -> list[str | bytes]:
        """Messages that bring a page up to date; empty if it is.

        A page that is slow asks seldom: what was between is left out. A page in the past gets what
        `remember` was told, or the newest graph.

        Args:
            page: what the page has; it is updated.
            now_s: of a clock that only goes on.
        """
        self._follow()
        scene = self._scenes.get(page.moment) if page.moment is not None else None
        scene = scene or self._newest()
        for node_id in page.nodes.keys() - scene.nodes.keys():  # the page forgets them, too
            page.clouds.pop(node_id, None)
            page.photos.pop(node_id, None)
        parts = [
            *_changes("nodes", "removed", page.nodes, scene.nodes),
            *_changes("edges", "removedEdges", page.edges, scene.edges),
            *self._head_news(page, scene),
            *self._surface_news(page, now_s),
            *self._cloud_news(page, scene, now_s),
            *self._camera_news(page, scene, now_s),
        ]
        texts: list[str | bytes] = [f"{{{','.join(parts)}}}"] if parts else []
        return texts + self._image_news(page, scene, now_s)

    def why(self, subject: int, object_: int) -> list[str]:
        """Where the belief in a relation of the newest graph comes from; empty if it is gone."""
        edge = self.history.newest.edges.get((subject, object_))
        self._follow()
        if edge is None or not {subject, object_} <= self._items.keys():
            return []
        return why(edge, self._items)

    def _follow(self) -> None:
        """Encode what changed in the newest graph."""
        newest = self.history.newest
        if self._up != up_of(newest):  # every value is another
            self._scenes.clear()
            self._up = up_of(newest)
            self._axes = view_axes(self._up)
            self._items, self._nodes, self._edges, self._clouds = {}, {}, {}, {}
            self._surface.begun += 1  # its values are others, too
            self._redrawn += 1
        changed = False
        for node_id in self._items.keys() - newest.nodes.keys():
            del self._items[node_id], self._nodes[node_id]
            self._clouds.pop(node_id, None)
            changed = True
        for node_id, node in newest.nodes.items():
            known = self._items.get(node_id)
            if known is None or known.state is not node:
                item = scene_object(node, newest.frame_id, self._up)
                self._items[node_id] = item
                self._nodes[node_id] = _node_json(item, self._axes)
                changed = True
        for pair in self._edges.keys() - newest.edges.keys():
            del self._edges[pair]
        for pair, edge in newest.edges.items():
            if pair not in self._edges or self._edges[pair][0] is not edge:
                self._edges[pair] = edge, _json(edge_values(edge))
        if changed:
            colours = class_colours(self._items[i].label for i in sorted(self._items))
            self._colours = {i: colours[item.label] for i, item in self._items.items()}

    def _newest(self) -> Scene:
        """The newest graph, after `_follow`."""
        edges = {pair: text for pair, (_, text) in self._edges.items()}
        return _scene(self.history.newest, self._items, self._nodes, edges)

    def _begin_session(self) -> None:
        """Ids of another session are of other objects."""
        if self.history.session != self._session:
            self._session = self.history.session
            self.crops, self._points, self._places = BestViews(), {}, []
            self._redrawn += 1
            self._space, self._surface_gone = SeenSpace(), []
            self._surface.clear()

    def _head_news(self, page: PageView, scene: Scene) -> list[str]:
        # A predicate keeps its colour: the first one that came is the first of the palette.
        for predicate in scene.predicates:
            self._predicates.setdefault(predicate, -len(self._predicates))
        head = _json(
            {
                "colours": class_colours(scene.labels),
                "tints": predicate_colours(self._predicates),
                "verbs": {predicate: verb_of(predicate) for predicate in self._predicates},
                "frame_id": scene.frame_id,
                "hidden": {},
                "rooms": room_values(self.history.newest.rooms, self._axes),
                "why": self.why_empty,
            }
        )
        moments = _json(
            {
                "first": self.history.first,
                "last": self.history.last,
                "shown": page.moment,
                "late_s": round((self.history.newest.stamp_ns - scene.stamp_ns) / 1e9, 1),
            }
        )
        parts = [f'"head":{head.decode()}'] if head != page.head else []
        if moments != page.moments:
            parts.append(f'"moments":{moments.decode()}')
        page.head, page.moments = head, moments
        return parts

    def _surface_news(self, page: PageView, now_s: float) -> list[str]:
        """The points of the room that a page lacks, and the rows of those that went."""
        surface = self._surface
        if now_s - page.clouds_s < CLOUDS_PERIOD_S:
            return []
        begun, count = page.surface
        start, gone = (count, page.surface_gone) if begun == surface.begun else (0, 0)
        went = self._surface_gone[gone:]
        if (surface.begun, len(surface)) == page.surface and not went:
            return []
        page.surface, page.surface_gone = (surface.begun, len(surface)), len(self._surface_gone)
        values = {"from": start, "gone": went}
        if len(surface):
            new = slice(start, None)
            points = surface.points[new], surface.colours[new], surface.sides[new]
            values |= surface_values(surface, points, self._axes)
        return [f'"surface":{_json(values).decode()}']

    def _cloud_news(self, page: PageView, scene: Scene, now_s: float) -> list[str]:
        if now_s - page.clouds_s < CLOUDS_PERIOD_S:
            return []
        page.clouds_s = now_s
        clouds = self._encoded_clouds()
        shown = {node_id: clouds[node_id] for node_id in scene.nodes if node_id in clouds}
        stamps = self.crops.stamps()
        photos = {i: _json([i, stamps[i]]) for i in scene.nodes if i in stamps}
        return [
            *_changes("clouds", "removedClouds", page.clouds, shown),
            *_changes("photos", "removedPhotos", page.photos, photos),
        ]

    def _encoded_clouds(self) -> dict[int, bytes]:
        """Surface points of the newest objects; only what changed is encoded again."""
        clouds: dict[int, tuple[Any, Float32 | Float64]] = {}
        for node_id, item in self._items.items():
            own = surface_points(item.state)
            seen = self._points.get(node_id)
            if len(own):
                clouds[node_id] = item.state, own
            elif seen is not None:
                clouds[node_id] = seen, seen
        stride = max(1, -(-sum(len(points) for _, points in clouds.values()) // MOST_POINTS))
        for node_id, (source, points) in clouds.items():
            known = self._clouds.get(node_id)
            if known is None or known[0] is not source or known[1] != stride:
                item = self._items[node_id]
                text = _json(cloud_values(item, points[::stride], self._axes))
                self._clouds[node_id] = source, stride, text
        return {node_id: self._clouds[node_id][2] for node_id in clouds}

    def _shot(self, page: PageView, scene: Scene) -> Shot | None:
        return self._shots.last(None if page.moment is None else scene.stamp_ns)

    def _camera_news(self, page: PageView, scene: Scene, now_s: float) -> list[str]:
        """The way up to the shown moment, and where the camera is."""
        count = len(self._places)
        if page.moment is not None:
            count = bisect.bisect_right(self._places, scene.stamp_ns, key=lambda item: item[0])
        redrawn, known = page.places
        start = min(known, count) if redrawn == self._redrawn else 0
        parts = []
        if (self._redrawn, count) != page.places:
            places = np.array([place for _, place in self._places[start:count]]).reshape(-1, 3)
            path = _json(path_values(places, self._axes)).decode()
            parts = [f'"path":{path},"from":{start}']
            page.places = self._redrawn, count
        shot = self._shot(page, scene)
        if shot is not None and shot.stamp_ns != page.camera_ns:
            page.camera_ns = shot.stamp_ns
            camera = {
                "centre": path_values(shot.T_world_camera[None, :3, 3], self._axes)[0],
                # Columns of the rotation: right, down and forward.
                "axes": path_values(shot.T_world_camera[:3, :3].T, self._axes),
                "fov": round(shot.fov_rad, 4),
                "aspect": round(shot.aspect, 4),
            }
            parts.append(f'"camera":{_json(camera).decode()}')
        return parts

    def _image_news(self, page: PageView, scene: Scene, now_s: float) -> list[str | bytes]:
        """The image of the camera as a JPEG file."""
        shot = self._shot(page, scene)
        if (
            shot is None
            or not shot.image
            or not page.wants_images
            or page.image_ns == shot.stamp_ns
            or now_s - page.image_s < IMAGE_PERIOD_S
        ):
            return []
        page.image_ns, page.image_s = shot.stamp_ns, now_s
        return [shot.image]


def _with_colours(local: LocalGraph, rgb: UInt8 | None) -> LocalGraph:
    """A local graph of a node of another release, with colours of the image."""
    grid = local.depth_grid
    if grid is None or grid.rgb is not None or rgb is None:
        return local
    if rgb.shape[:2] != (grid.intrinsics.height, grid.intrinsics.width):
        return local
    every = slice(grid.stride_px // 2, None, grid.stride_px)
    return replace(local, depth_grid=replace(grid, rgb=rgb[every, every]))


def _changes(
    name: str,
    removed: str,
    known: dict[Any, bytes],
    present: Mapping[Any, bytes],
) -> list[str]:
    """The values that a page lacks and those that are gone, as members of a JSON object."""
    new = [text for at, text in present.items() if known.get(at) != text]
    gone = [at for at in known if at not in present]
    for at in gone:
        del known[at]
    known.update(present)
    parts = [f'"{name}":{_list(new)}'] if new else []
    return [*parts, f'"{removed}":{_json(gone).decode()}'] if gone else parts


def _list(texts: list[bytes]) -> str:
    return f"[{b','.join(texts).decode()}]"


_json = msgspec.json.encode


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
