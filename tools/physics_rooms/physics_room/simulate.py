"""Physics of a room with MuJoCo: things fall into place, and what carries what is measured."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from .layout import Room, build_room
from .shapes import Item

STEP_S = 0.003
SETTLE_S = 1.5
LONGEST_S = 4.0
# A body is at rest below this speed (m/s, or rad/s at a reach of 0.3 m).
REST = 0.02
REMOVAL_S = 0.6
# A contact that lifts less than this carries nothing (a plate weighs 4 N).
MIN_LIFT_N = 0.02
# Who moves further than this, or drops by more than this (a plate is 8 mm thick), has fallen.
MOVED_M, DROPPED_M = 0.03, 0.004


@dataclass
class Touch:
    """Contact of two items: `upper` gets `force` (N, on average) from `lower`.

    Attributes:
        lift: vertical part of the force on `upper`, N; positive carries it.
        normals: unit normals that point into `upper`, one per contact point.
        points: contact points, room frame.
    """

    lift: float = 0.0
    normals: list[NDArray[np.float64]] = field(default_factory=list)
    points: list[NDArray[np.float64]] = field(default_factory=list)


@dataclass
class Outcome:
    """What the physics says.

    Attributes:
        touches: (upper number, lower number) to the contact, in both directions; 0 is the floor,
            −1 are the walls.
        falls_without: by item number, the items whose removal makes it fall.
        resting: whether everything came to rest.
    """

    touches: dict[tuple[int, int], Touch]
    falls_without: dict[int, set[int]]
    resting: bool


FLOOR, WALL = 0, -1


class World:
    """The MuJoCo model of a room.

    Args:
        items: numbered items; a welded item comes after its holder.
        size: of the room, m.
    """

    def __init__(self, items: list[Item], size: tuple[float, float, float]) -> None:
        self.items = items
        self.model = mujoco.MjModel.from_xml_string(_xml(items, size))
        self.data = mujoco.MjData(self.model)
        name = mujoco.mj_id2name
        body = [name(self.model, mujoco.mjtObj.mjOBJ_BODY, k) for k in range(self.model.nbody)]
        self.number = [int(b[1:]) if b.startswith("i") else FLOOR for b in body]
        self.body = {number: k for k, number in enumerate(self.number) if number}
        geom = [
            name(self.model, mujoco.mjtObj.mjOBJ_GEOM, k) or "" for k in range(self.model.ngeom)
        ]
        self.owner = np.array([
            WALL if geom[k].startswith("wall") else self.number[self.model.geom_bodyid[k]]
            for k in range(self.model.ngeom)
        ])  # fmt: skip

    def settle(self) -> bool:
        """Simulate until everything rests; returns whether it does. Moves the items."""
        steps = 0
        while steps * STEP_S < LONGEST_S:
            self._run(SETTLE_S if not steps else 0.5)
            steps += round((SETTLE_S if not steps else 0.5) / STEP_S)
            # Round things roll for long: slow them as a rough cloth would.
            self.data.qvel[:] *= 0.3
            self._run(0.15)
            if self._speed() < REST:
                break
        for item in self.items:
            k = self.body[item.number]
            item.position = self.data.xpos[k].copy()
            item.rotation = self.data.xmat[k].reshape(3, 3).copy()
        return self._speed() < REST

    def _run(self, seconds: float) -> None:
        mujoco.mj_step(self.model, self.data, nstep=round(seconds / STEP_S))

    def _speed(self) -> float:
        speeds = self.data.qvel.reshape(-1, 6)
        if not len(speeds):
            return 0.0
        return float(max(np.abs(speeds[:, :3]).max(), 0.3 * np.abs(speeds[:, 3:]).max()))

    def touches(self, samples: int = 12) -> dict[tuple[int, int], Touch]:
        """Contact forces, averaged over a few steps."""
        found: dict[tuple[int, int], Touch] = {}
        wrench = np.zeros(6)
        for _ in range(samples):
            mujoco.mj_step(self.model, self.data, nstep=2)
            for k in range(self.data.ncon):
                contact = self.data.contact[k]
                mujoco.mj_contactForce(self.model, self.data, k, wrench)
                frame = contact.frame.reshape(3, 3)
                force = frame.T @ wrench[:3]
                if wrench[0] < 1e-4:
                    continue
                first, second = (int(self.owner[g]) for g in contact.geom)
                for upper, lower, sign in ((second, first, 1.0), (first, second, -1.0)):
                    touch = found.setdefault((upper, lower), Touch())
                    touch.lift += sign * float(force[2]) / samples
                    touch.normals.append(sign * frame[0].copy())
                    touch.points.append(contact.pos.copy())
        return found

    def removals(self, touches: dict[tuple[int, int], Touch]) -> dict[int, set[int]]:
        """Remove each item that something touches; who then moves or drops falls without it."""
        parts = self._components(touches)
        free = {i.number for i in self.items if i.anchor == "free"}
        wanted: dict[int, set[int]] = {}
        for (upper, lower), touch in touches.items():
            if upper in free and lower > 0 and touch.lift > MIN_LIFT_N:
                root = self._root(lower)
                wanted.setdefault(root, set()).add(parts[upper])
                if root in parts:
                    wanted[root].add(parts[root])
        falls: dict[int, set[int]] = {}
        still = self.moved(set())
        pending = sorted(wanted)
        while pending:
            batch, busy, later = [], set(), []
            for number in pending:
                if wanted[number] & busy:
                    later.append(number)
                    continue
                busy |= wanted[number]
                batch.append(number)
            moved = self.moved(set(batch)) - still
            for number in batch:
                for other in moved:
                    if other != number and parts.get(other) in wanted[number]:
                        falls.setdefault(other, set()).add(number)
            pending = later
        self._follow_welds(falls, touches)
        return falls

    def _root(self, number: int) -> int:
        """The item that a welded item moves with."""
        by_number = {item.number: item for item in self.items}
        item = by_number[number]
        while item.anchor == "item":
            assert item.holder is not None
            item = item.holder
        return item.number

    def _follow_welds(
        self, falls: dict[int, set[int]], touches: dict[tuple[int, int], Touch]
    ) -> None:
        """A welded item goes with its holder: both for what it needs and for what needs it."""
        for (upper, lower), touch in touches.items():
            if (
                lower > 0
                and touch.lift > MIN_LIFT_N
                and self._root(lower) in falls.get(upper, set())
            ):
                falls[upper].add(lower)
        for item in self.items:
            if item.anchor == "item" and item.holder is not None:
                above = falls.get(item.holder.number, set())
                falls[item.number] = {item.holder.number} | above

    def _components(self, touches: dict[tuple[int, int], Touch]) -> dict[int, int]:
        """Groups of free items that touch each other; the number of a group by item."""
        free = [i.number for i in self.items if i.anchor == "free"]
        group = {number: number for number in free}

        def root(number: int) -> int:
            while group[number] != number:
                number = group[number]
            return number

        for a, b in touches:
            a, b = (self._root(n) if n > 0 else n for n in (a, b))
            if a in group and b in group:
                group[root(a)] = root(b)
        return {number: root(number) for number in free}

    def moved(self, removed: set[int]) -> set[int]:
        """Free items that move when some items are not there."""
        model = self.model
        types, affinities = model.geom_contype.copy(), model.geom_conaffinity.copy()
        gone = [
            k
            for k in range(model.ngeom)
            if self.owner[k] > 0 and self._root(int(self.owner[k])) in removed
        ]
        model.geom_contype[gone] = 0
        model.geom_conaffinity[gone] = 0
        trial = mujoco.MjData(model)
        trial.qpos[:] = self.data.qpos
        mujoco.mj_forward(model, trial)
        before = trial.xpos.copy()
        mujoco.mj_step(model, trial, nstep=round(REMOVAL_S / STEP_S))
        model.geom_contype[:], model.geom_conaffinity[:] = types, affinities
        way = trial.xpos - before
        far = (np.linalg.norm(way, axis=1) > MOVED_M) | (way[:, 2] < -DROPPED_M)
        return {i.number for i in self.items if i.anchor == "free" and far[self.body[i.number]]}


def simulate(items: list[Item], size: tuple[float, float, float]) -> Outcome:
    """Let everything fall into place, then measure contacts and removals. Moves the items."""
    world = World(items, size)
    resting = world.settle()
    touches = world.touches()
    return Outcome(touches, world.removals(touches), resting)


def settled_room(index: int, seed: int) -> tuple[Room, Outcome]:
    """A room at rest. What left the room is taken out, and the rest settles again."""
    for attempt in range(20):
        room = build_room(np.random.default_rng([seed, index, attempt]))
        outcome = simulate(room.items, room.size)
        gone = {i.number for i in room.items if i.anchor == "free" and _outside(i, room)}
        if gone:
            room.items = [
                i for i in room.items
                if i.number not in gone and not (i.holder and i.holder.number in gone)
            ]  # fmt: skip
            for number, item in enumerate(room.items, start=1):
                item.number = number
            outcome = simulate(room.items, room.size)
        if outcome.resting and sum(i.kind == "small" for i in room.items) >= 12:
            return room, outcome
    raise RuntimeError(f"room {index} of seed {seed} never came to rest in 20 attempts")


def _outside(item: Item, room: Room) -> bool:
    limit = np.array(room.size[:2]) / 2 + 0.05
    return bool(item.position[2] < -0.05 or (np.abs(item.position[:2]) > limit).any())


def _xml(items: list[Item], size: tuple[float, float, float]) -> str:
    w, d, h = size
    walls = [
        f'<geom name="wall{k}" type="box" size="{a} {b} {h / 2}" pos="{x} {y} {h / 2}"/>'
        for k, (a, b, x, y) in enumerate([
            (w / 2 + 0.2, 0.1, 0, d / 2 + 0.1), (w / 2 + 0.2, 0.1, 0, -d / 2 - 0.1),
            (0.1, d / 2, w / 2 + 0.1, 0), (0.1, d / 2, -w / 2 - 0.1, 0),
        ])
    ]  # fmt: skip
    children: dict[int, list[Item]] = {}
    for item in items:
        if item.anchor == "item" and item.holder is not None:
            children.setdefault(item.holder.number, []).append(item)
    bodies = [_body(item, children) for item in items if item.anchor != "item"]
    return f"""<mujoco>
<option timestep="{STEP_S}" integrator="implicitfast" cone="elliptic" impratio="3" iterations="30"/>
<size memory="200M"/>
<default>
<geom condim="4" friction="0.7 0.01 0.002" solref="0.008 1" solimp="0.95 0.99 0.001"/>
</default>
<worldbody><geom name="floor" type="plane" size="20 20 1"/>{"".join(walls)}
{chr(10).join(bodies)}</worldbody></mujoco>"""


def _body(item: Item, children: dict[int, list[Item]]) -> str:
    position, rotation = item.position, item.rotation
    if item.anchor == "item" and item.holder is not None:
        position = item.holder.rotation.T @ (position - item.holder.position)
        rotation = item.holder.rotation.T @ rotation
    solid = [p for p in item.parts if p.collides]
    volume = sum(_volume(p.shape, p.size) for p in solid)
    geoms = []
    for part in solid:
        mass = item.mass_kg * _volume(part.shape, part.size) / volume
        size = " ".join(f"{s:.6g}" for s in part.size)
        round_thing = part.shape in ("ellipsoid", "capsule")
        extra = ' condim="6" friction="0.7 0.01 0.01"' if round_thing else ""
        geoms.append(
            f'<geom type="{part.shape}" size="{size}" mass="{mass:.6g}" '
            f'pos="{_text(part.position)}" quat="{_quat(part.rotation)}"{extra}/>'
        )
    joint = "<freejoint/>" if item.anchor == "free" else ""
    inside = "".join(_body(child, children) for child in children.get(item.number, []))
    return (
        f'<body name="i{item.number}" pos="{_text(position)}" quat="{_quat(rotation)}">'
        f"{joint}{''.join(geoms)}{inside}</body>"
    )


def _volume(shape: str, size: tuple[float, ...]) -> float:
    if shape == "box":
        return 8.0 * size[0] * size[1] * size[2]
    if shape == "cylinder":
        return 2.0 * np.pi * size[0] ** 2 * size[1]
    if shape == "capsule":
        return np.pi * size[0] ** 2 * (2 * size[1] + 4 / 3 * size[0])
    return 4 / 3 * np.pi * size[0] * size[1] * size[2]


def _text(values) -> str:
    return " ".join(f"{v:.7g}" for v in values)


def _quat(rotation: NDArray[np.float64]) -> str:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return _text(quat)
