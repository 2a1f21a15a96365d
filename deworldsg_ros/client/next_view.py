"""Where to look next: the pose on the floor from which a view is expected to tell most.

What a view would tell is counted in nats of entropy, as in the choice of views for volumes
[C. Connolly, "The determination of next best views", ICRA 1985; S. Isler et al., "An information
gain formulation for active volumetric 3D reconstruction", ICRA 2016], here of objects: of their
names, of whether they exist, of their relations, and of objects that may be in space that no view
has shown. It is divided by the way, as in H. González-Baños and J.-C. Latombe, "Navigation
strategies for exploring indoor environments", IJRR 2002.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from deworldsg_ros.client.boxes import point_gaps_m, polygon_gap_m
from deworldsg_ros.client.goals import Robot, floor_m, pose_fields, pose_stamped
from deworldsg_ros.client.objects import HiddenObject, Point, Rooms, SceneObject
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.provenance import MIN_DEPTH_M, SeenSpace
from deworldsg_ros.graph.seen_cells import (
    AZIMUTHS,
    CELL_M,
    RANGE_M,
    YAWS,
    Looks,
    Reach,
    SeenCells,
    ViewCamera,
    clarity,
    enclosed,
    reach,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.vocabulary import verb_of
from deworldsg_ros.wire import messages as wire

# Places that are tried are so far apart; farther, if they would be more.
STEP_M, MOST_PLACES = 0.5, 250
# A new object tells so much: that it exists, and its name. Nats.
NEW_NATS = 4.0
# The density of objects to begin with: as if PRIOR had been seen in PRIOR_M3 cubic metres.
PRIOR, PRIOR_M3 = 4.0, 20.0
# Small objects that a view from afar has missed are within so much of a surface.
MISSED_M = 0.3
# A view from a new side resolves this part of what is not known of an object, at most.
RESOLVED = 0.5
# Sides of an object: the angle of a view decides what it tells anew.
SECTORS = 12
# A view of a known object from farther away tells little.
NODE_RANGE_M = 4.0
# Standing still and turning cost as much as so much of the way: radian, and each view.
TURN_M, VIEW_M = 0.05, 0.1
# For people, in place of a pose.
NOTHING = "nothing is worth a look: no space, name, object or relation would be told better"
# A robot may stand so far beside the known cells.
MOST_BESIDE_M = 1.0
# Less is not worth a look, nats.
LEAST_NATS = 0.1


@dataclass(frozen=True)
class NextView:
    """A pose on the floor from which to look.

    Attributes:
        position_m: on the floor, world frame.
        orientation_xyzw: x axis where the camera is to look, z axis up.
        frame_id: the world frame.
        stamp_ns: of the graph.
        reason: why, in words.
        nats: what the view is expected to tell, by kind: ``space``, ``names``, ``existence``,
            ``relations``.
        objects: ids of the objects that it is expected to tell of, the most telling first.
        path_m: length of the way there; None = it is not known where the robot is.
    """

    position_m: Point
    orientation_xyzw: tuple[float, float, float, float]
    frame_id: str
    stamp_ns: int
    reason: str
    nats: dict[str, float]
    objects: tuple[int, ...]
    path_m: float | None

    @property
    def gain_nats(self) -> float:
        """What the view is expected to tell."""
        return sum(self.nats.values())

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with the fields of a geometry_msgs/PoseStamped."""
        return {
            **pose_fields(self),
            "reason": self.reason,
            "gain_nats": round(self.gain_nats, 3),
            "nats": {kind: round(value, 3) for kind, value in self.nats.items()},
            "objects": list(self.objects),
            "path_m": None if self.path_m is None else round(self.path_m, 2),
        }

    def pose_stamped(self) -> Any:
        """The pose as geometry_msgs/PoseStamped; needs ROS 2."""
        return pose_stamped(self)


class Asked(Protocol):
    """What `next_view` needs of a `SceneGraph`."""

    message: wire.SceneGraphMessage
    frame_id: str
    stamp_ns: int
    up: Point
    space: SeenSpace | None

    def __iter__(self) -> Iterator[SceneObject]:
        """The objects."""

    @property
    def hidden(self) -> list[HiddenObject] | None:
        """What was detected and is no object yet."""

    @property
    def rooms(self) -> Rooms:
        """The rooms."""


@dataclass
class Items:
    """What is not sure of objects (n), hidden ones last, in the frame of the cells.

    Attributes:
        ids: 0 = hidden.
        centers: (n, 3); radii: (n,) metres.
        names, exists: (n,) entropy of the name, and of the existence, nats.
        sides: (n, SECTORS) best `clarity` of views from each side.
        words: for people: what a view may tell.
        edges: (e, 2) rows of uncertain relations; doubts: (e,) nats; questions: in words.
    """

    ids: list[int]
    centers: Float64
    radii: Float64
    names: Float64
    exists: Float64
    words: list[str]
    edges: Int64
    doubts: Float64
    questions: list[str]
    sides: Float64 = field(default_factory=lambda: np.zeros((0, SECTORS)))


def binary_nats(probability: float) -> float:
    """Entropy of yes or no."""
    p = min(max(probability, 1e-12), 1.0 - 1e-12)
    return -p * math.log(p) - (1.0 - p) * math.log(1.0 - p)


def name_nats(item: SceneObject) -> float:
    """Entropy of the name of an object; 0 if an operator gave it."""
    if item.is_labelled_by_hand:
        return 0.0
    if item.entropy_nats is not None:
        return max(item.entropy_nats, 0.0)
    shares = [belief.probability for belief in item.classes] + [item.other_classes]
    return -sum(share * math.log(share) for share in shares if share > 0.0)


def items_of(graph: Asked, axes: Float64) -> Items:
    """What is not sure in a graph."""
    objects, hidden = list(graph), graph.hidden or []
    rows = {item.id: row for row, item in enumerate(objects)}
    edges = [e for e in graph.message.edges if e.subject in rows and e.object in rows]
    places = [item.position_m for item in objects] + [item.position_m for item in hidden]
    sizes = [max(item.size_m[:2]) / 2.0 for item in objects] + [0.15] * len(hidden)
    existence = [1.0 if item.existence is None else item.existence for item in objects]
    return Items(
        ids=[item.id for item in objects] + [0] * len(hidden),
        centers=np.array(places).reshape(-1, 3) @ axes.T,
        radii=np.array(sizes),
        names=np.array([name_nats(item) for item in objects] + [0.0] * len(hidden)),
        exists=np.array([binary_nats(p) for p in existence + [item.existence for item in hidden]]),
        words=[_doubt(item) for item in objects]
        + [f"whether there is {_a(i.label)}" for i in hidden],
        edges=np.array([(rows[e.subject], rows[e.object]) for e in edges], np.int64).reshape(-1, 2),
        doubts=np.array([binary_nats(edge.probability) for edge in edges]),
        questions=[
            f"whether {objects[rows[e.subject]].name} {verb_of(e.predicate)} "
            f"{objects[rows[e.object]].name}"
            for e in edges
        ],
    )


def _doubt(item: SceneObject) -> str:
    others = [belief.label for belief in item.classes if belief.label != item.label]
    return f"{item.name} may be {_a(others[0])}" if others else f"what {item.name} is"


def _a(label: str) -> str:
    return f"{'an' if label[:1] in 'aeiou' else 'a'} {label}"


def sides_seen(items: Items, cells: SeenCells, looks: Looks) -> Float64:
    """How clearly (n, SECTORS) objects were seen from each side by the views of cells."""
    sides = np.zeros((len(items.ids), SECTORS))
    if not len(cells.poses) or not len(items.ids):
        return sides
    turns = cells.axes @ cells.poses[:, :3, :3]
    starts = cells.poses[:, :3, 3] @ cells.axes.T
    ways = items.centers - starts[:, None]
    x, y, z = np.einsum("vik,vni->kvn", turns, ways)
    fx, fy, cx, cy = cells.cameras.T[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = x * fx / z + cx, y * fy / z + cy
    height, width = cells.shape
    shown = (z > MIN_DEPTH_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    distances = np.linalg.norm(ways, axis=2)
    views, rows = np.nonzero(shown & (distances < RANGE_M))
    sees = looks.clear(starts[views], items.centers[rows], items.radii[rows])
    views, rows = views[sees], rows[sees]
    sectors = sector(-ways[views, rows])
    np.maximum.at(sides, (rows, sectors), clarity(distances[views, rows]))
    return sides


def sides_of_surface(graph: Asked, axes: Float64) -> Float64:
    """The same of objects whose views are not known, by where their surface points are."""
    sides = []
    for item in graph:
        points = item.surface_m - item.position_m
        counts = (
            np.bincount(sector(points @ axes.T), minlength=SECTORS)
            if len(points)
            else np.zeros(SECTORS)
        )
        sides.append(np.clip(SECTORS / 2 * counts / max(len(points), 1), 0.0, 1.0))
    sides += [np.zeros(SECTORS)] * len(graph.hidden or [])
    return np.array(sides).reshape(-1, SECTORS)


def sector(ways: Float64) -> Int64:
    """The side (n,) of an object in which directions (n, 3) from it are."""
    angle = np.arctan2(ways[:, 1], ways[:, 0]) * SECTORS / (2.0 * np.pi)
    return np.asarray(np.floor(angle).astype(np.int64) % SECTORS)


def novelty(sides: Float64, clear: Float64, side: Int64) -> Float64:
    """Which part of what a view tells of an object is new.

    Args:
        sides: (n, SECTORS) of the objects.
        clear: (n,) `clarity` of the view.
        side: (n,) from which it looks. Views from beside it tell half as much of this side.
    """
    rows = np.arange(len(sides))
    beside = np.maximum(sides[rows, (side + 1) % SECTORS], sides[rows, side - 1])
    had = np.maximum(sides[rows, side], 0.5 * beside)
    return np.asarray(np.maximum(clear - had, 0.0) / of_many(sides))


def of_many(sides: Float64) -> Float64:
    """By how much less (n,) one more view of objects tells, for the sides that were seen."""
    return np.asarray(1.0 + 0.5 * (sides > 0.3).sum(axis=1))


@dataclass
class Views:
    """What views from places (n) and in directions (YAWS) are expected to tell, in nats.

    Attributes:
        places: (n, 2) in the frame of the cells.
        way_m: (n,) to each place.
        nats: (n, YAWS) of each kind.
        parts: of each kind but space: place, yaw and nats of each item in view, and its row.
    """

    places: Float64
    way_m: Float64
    nats: dict[str, Float64]
    parts: dict[str, tuple[Int64, Bool, Float64, Int64]]

    def told(self, kind: str, place: int, yaw: int) -> tuple[Int64, Float64]:
        """The rows of the items of a kind that one view tells of, the most telling first."""
        at, in_view, nats, rows = self.parts[kind]
        inside = (at == place) & in_view[:, yaw]
        order = np.argsort(-nats[inside], kind="stable")
        return rows[inside][order], nats[inside][order]


def next_view(
    graph: Asked,
    *,
    robot: Robot = Robot(),
    start: Point | None = None,
    camera: ViewCamera | None = None,
    cells: SeenCells | None = None,
) -> NextView | None:
    """The pose from which a view is expected to tell most for its way; None = nothing is worth it.

    Args:
        graph: a `SceneGraph`. Unseen space counts only if it has the views of the camera (`space`).
            Without them, its rooms are free space, else the area of its objects.
        robot: that is to stand there.
        start: where it is, world frame; None = where the newest view was taken. Without views, the
            way does not count then.
        camera: on the robot; None = that of the newest view.
        cells: what earlier calls have seen; the views of the graph are added. A graph keeps 128
            views, and what these do not show any more counts as unseen without `cells`.

    Raises:
        ClientError: if nothing is known of the space and the objects, or there are no numbers.
    """
    if start is not None and not (len(start) == 3 and np.isfinite(start).all()):
        raise ClientError(f"start {start}: expected three finite numbers")
    cells = SeenCells(graph.up) if cells is None else cells
    if graph.space is not None:
        cells.add(graph.space)
    has_views = cells.hits.size > 0
    if not has_views:
        cells = cells_of_rooms(graph)
    items = items_of(graph, cells.axes)
    camera = ViewCamera.of(cells) if camera is None else camera
    here = cells.poses[-1, :3, 3] if start is None and has_views else start
    state, floor = cells.state, cells.floor_m
    origin = None if here is None else (cells.axes @ here)[:2]
    if here is not None and origin is not None:
        low = CELL_M * cells.first[:2]
        beside = np.maximum(low - origin, origin - low - CELL_M * np.array(state.shape[:2])).max()
        if beside > MOST_BESIDE_M:
            raise ClientError(
                f"the robot, at {[round(float(value), 1) for value in here]}, is {beside:.1f} m "
                "beside what is known of the space"
            )
    reached = reach(cells, state, robot.radius_m, robot.height_m, origin)
    looks = Looks(cells, state, camera, floor)
    items.sides = (
        sides_seen(items, cells, looks) if has_views else sides_of_surface(graph, cells.axes)
    )
    views = views_from(places_of(reached), reached, looks, items)
    gains = np.sum(list(views.nats.values()), axis=0)
    # A place tells what a whole turn there tells: to turn costs little.
    told = gains.mean(axis=1) * 2.0 * np.pi / camera.width_rad
    told[gains.max(axis=1) < LEAST_NATS] = 0.0
    if not told.any():
        return None
    way_m, turns = (
        (0.0, np.zeros(YAWS)) if here is None else (views.way_m, _turns(cells, has_views))
    )
    place = int((told / (VIEW_M + way_m)).argmax())
    yaw = int((gains[place] / (VIEW_M + TURN_M * turns)).argmax())
    return _answer(graph, cells, views, looks, items, (place, yaw), here)


def _turns(cells: SeenCells, has_views: bool) -> Float64:
    """By how much (YAWS,) the camera turns from the newest view."""
    if not has_views:
        return np.zeros(YAWS)
    ahead = cells.axes @ cells.poses[-1, :3, 2]
    yaws = np.arange(YAWS) * 2.0 * np.pi / YAWS - math.atan2(ahead[1], ahead[0])
    return np.asarray(np.abs((yaws + np.pi) % (2.0 * np.pi) - np.pi))


def places_of(reached: Reach) -> Int64:
    """Cells (n, 2) to which a robot can get, evenly spread around where it is."""
    here = np.array(np.unravel_index(int(reached.way_m.argmin()), reached.way_m.shape))
    known = np.argwhere(np.isfinite(reached.way_m))
    step = round(STEP_M / CELL_M)
    while True:
        chosen = known[((known - here) % step == 0).all(axis=1)]
        if len(chosen) <= MOST_PLACES:
            return chosen
        step += 1


def views_from(chosen: Int64, reached: Reach, looks: Looks, items: Items) -> Views:
    """What views from cells (n, 2) are expected to tell."""
    places = reached.centers(chosen)
    volumes, areas = looks.unseen(places)
    density = (len(items.ids) + PRIOR) / (looks.seen_m3 + PRIOR_M3)
    azimuths = (np.arange(AZIMUTHS) + 0.5) * 2.0 * np.pi / AZIMUTHS
    space = density * NEW_NATS * (volumes + MISSED_M * areas) @ looks.by_yaw(azimuths)
    unlike = looks.unlike_views(places)
    nats = {"space": space * unlike}
    # Of each place and each object in view: how much of it is new.
    ways = items.centers - np.column_stack([places, np.full(len(places), looks.height_m)])[:, None]
    flat, rises = np.linalg.norm(ways[..., :2], axis=2), ways[..., 2]
    camera = looks.camera
    angles = np.arctan2(rises, flat) + camera.down_rad
    near = (
        (flat < NODE_RANGE_M) & (flat > items.radii + 0.2) & (np.abs(angles) < camera.tall_rad / 2)
    )
    at, rows = np.nonzero(near)
    starts = np.column_stack([places[at], np.full(len(at), looks.height_m)])
    sees = looks.clear(starts, items.centers[rows], items.radii[rows])
    at, rows = at[sees], rows[sees]
    directions = -ways[at, rows]
    clear = clarity(np.linalg.norm(directions, axis=1))
    new = RESOLVED * novelty(items.sides[rows], clear, sector(directions))
    # Whether it is there, a view from a side that was seen tells, too: a detector misses at times.
    again = RESOLVED * clear / of_many(items.sides[rows])
    in_view = looks.by_yaw(np.arctan2(-directions[:, 1], -directions[:, 0]))
    parts = {
        "names": (at, in_view, new * items.names[rows], rows),
        "existence": (at, in_view, again * items.exists[rows], rows),
        "relations": _relations(at, rows, new, in_view, items),
    }
    for kind, (of, inside, values, _) in parts.items():
        nats[kind] = np.zeros((len(places), YAWS))
        np.add.at(nats[kind], of, values[:, None] * inside * unlike[of])
    return Views(places, reached.way_m[tuple(chosen.T)], nats, parts)


def _relations(
    at: Int64, rows: Int64, new: Float64, in_view: Bool, items: Items
) -> tuple[Int64, Bool, Float64, Int64]:
    """What views tell of uncertain relations, with both objects in view; as `Views.parts`."""
    count = len(items.ids) + 1
    keys = at * count + rows  # ascending
    found = []
    for number, (a, b) in enumerate(items.edges.tolist()):
        if items.doubts[number] < 0.01:
            continue
        mine, theirs = np.flatnonzero(rows == a), at[rows == b]
        mine = mine[np.isin(at[mine], theirs)]
        other = np.searchsorted(keys, at[mine] * count + b)
        values = np.minimum(new[mine], new[other]) * items.doubts[number]
        found.append((at[mine], in_view[mine] & in_view[other], values, np.full(len(mine), number)))
    if not found:
        none = np.zeros(0, np.int64)
        return none, np.zeros((0, YAWS), np.bool_), np.zeros(0), none
    of, inside, values, numbers = (np.concatenate(part) for part in zip(*found))
    return of, inside, values, numbers


def _answer(
    graph: Asked,
    cells: SeenCells,
    views: Views,
    looks: Looks,
    items: Items,
    best: tuple[int, int],
    here: Any,
) -> NextView:
    place, row = best
    yaw = row * 2.0 * np.pi / YAWS
    axes = cells.axes
    forward = np.array([math.cos(yaw), math.sin(yaw), 0.0]) @ axes
    turn = quaternion_from_rotation(
        np.stack([forward, np.cross(axes[2], forward), axes[2]], axis=1)
    ).tolist()
    x, y, z = (np.append(views.places[place], looks.floor_m) @ axes).tolist()
    nats = {kind: float(values[best]) for kind, values in views.nats.items()}
    kind = max(nats, key=lambda name: nats[name])
    told = {name: views.told(name, *best) for name in ("names", "existence", "relations")}
    if kind == "space":
        middle = looks.middle(views.places[place], yaw)
        now = views.places[place] if here is None else (axes @ here)[:2]
        ahead_m = float(np.hypot(*(middle[:2] - views.places[place])))
        reason = "to see " + (
            _beyond(graph, middle, now) or f"what no view has shown, {ahead_m:.1f} m ahead"
        )
    else:
        first = int(told[kind][0][0])
        reason = {
            "names": lambda: items.words[first],
            "existence": lambda: f"to see {_is_there(items, first)}",
            "relations": lambda: f"to see {items.questions[first]}",
        }[kind]()
    shares: dict[int, float] = {}
    for name in ("names", "existence"):
        for item, value in zip(*told[name]):
            if items.ids[item]:
                shares[items.ids[item]] = shares.get(items.ids[item], 0.0) + float(value)
    return NextView(
        position_m=(x, y, z),
        orientation_xyzw=(turn[0], turn[1], turn[2], turn[3]),
        frame_id=graph.frame_id,
        stamp_ns=graph.stamp_ns,
        reason=reason,
        nats=nats,
        objects=tuple(i for i in sorted(shares, key=lambda i: -shares[i]) if shares[i] > 0.01),
        path_m=None if here is None else float(views.way_m[place]),
    )


def _is_there(items: Items, row: int) -> str:
    if not items.ids[row]:
        return items.words[row]
    name = items.words[row].partition(" may be")[0].removeprefix("what ").removesuffix(" is")
    return f"whether {name} is there"


def _beyond(objects: Iterable[SceneObject], middle: Float64, now: Float64) -> str | None:
    """The object that a place (3,) which was not seen is beneath, or behind, from a place (2,)."""
    line = np.array([now, middle[:2]])
    found = []
    for item in objects:
        box = item.footprint
        gap = float(point_gaps_m(middle[:2], box.corners[None])[0])
        if gap < 0.1 and middle[2] < box.high:
            return f"{'beneath' if middle[2] < box.low + 0.2 else 'beside'} {item.name}"
        if gap < 1.0 and polygon_gap_m(line, box.corners) == 0.0 and middle[2] < box.high + 0.3:
            found.append((gap, item.name))
    return f"behind {min(found)[1]}" if found else None


def cells_of_rooms(graph: Asked) -> SeenCells:
    """Cells where only a message is known: its rooms, else the area of its objects, are free.

    All beyond counts as something, and the boxes of the objects, too.

    Raises:
        ClientError: if there is neither.
    """
    from scipy.spatial import ConvexHull, QhullError  # slow to import, and only for goals

    objects, axes = list(graph), horizontal_axes(graph.up)
    outlines = [np.array(room.outline_m).reshape(-1, 3) @ axes.T for room in graph.rooms]
    areas = [outline[:, :2] for outline in outlines if len(outline) > 2]
    floor = float(outlines[0][0, 2]) if areas else 0.0
    if not areas:
        corners = np.array([item.footprint.corners for item in objects]).reshape(-1, 2)
        try:
            hull = corners[ConvexHull(corners).vertices]
        except (QhullError, ValueError) as error:
            raise ClientError(
                "nothing is known of the space around: no views of the camera, no rooms, and no "
                "three objects that are apart"
            ) from error
        areas = [
            hull
            + 0.6
            * (hull - hull.mean(axis=0))
            / np.linalg.norm(hull - hull.mean(axis=0), axis=1)[:, None]
        ]
        floor = floor_m(objects)
    boxes = [(item.footprint.corners, item.footprint.low, item.footprint.high) for item in objects]
    cells = enclosed(graph.up, areas, floor, boxes)
    if cells is None:
        raise ClientError("the rooms are too large: expected less than 100 m by 100 m")
    return cells
