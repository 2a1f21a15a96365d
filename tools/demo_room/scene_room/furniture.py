"""Furniture and appliances in their own frames: z = 0 is the floor, the front faces −y."""

from __future__ import annotations

import numpy as np

from .meshes import Mesh, box, join, lathe, puffed, sheet, tube

Parts = list[tuple[Mesh, str]]


def front(width: float, height: float, x: float, y: float, z: float, material: str) -> Parts:
    """Rectangle that faces −y. Its lower left corner is at (x − width/2, y, z)."""
    corner = np.array([x - width / 2, y, z])
    mesh = sheet(corner, np.array([width, 0, 0]), np.array([0, 0, height]), 0.04, fit=True)
    return [(mesh, material)]


def dining_table(length: float = 1.5, depth: float = 0.88, height: float = 0.74) -> Parts:
    """Table with four tapered legs. The grain of the top runs along its length."""
    top = box(length, depth, 0.035, 0.010, 0.02).moved(z=height - 0.035)
    top = top.mapped(
        lambda v, n: np.where(
            np.abs(n[:, 2:]) > 0.5, v[:, [1, 0]], np.stack([v[:, 2], v[:, 0] + v[:, 1]], 1)
        )
    )
    parts: Parts = [(top, "table_wood")]
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = box(0.065, 0.065, height - 0.035, 0.008, 0.04)
            leg = leg.deformed(
                lambda v: (
                    v
                    * np.c_[
                        0.65 + 0.35 * v[:, 2:] / height,
                        0.65 + 0.35 * v[:, 2:] / height,
                        np.ones(len(v)),
                    ]
                )
            )
            parts.append(
                (leg.moved(sx * (length / 2 - 0.08), sy * (depth / 2 - 0.08)), "table_wood")
            )
    for sy in (-1, 1):
        apron = box(length - 0.2, 0.022, 0.09, 0.004, 0.05)
        parts.append((apron.moved(0, sy * (depth / 2 - 0.08), height - 0.125), "table_wood"))
    for sx in (-1, 1):
        apron = box(0.022, depth - 0.2, 0.09, 0.004, 0.05)
        parts.append((apron.moved(sx * (length / 2 - 0.08), 0, height - 0.125), "table_wood"))
    return parts


def chair() -> Parts:
    """Wooden chair with a slatted, reclined back and an upholstered seat; faces −y."""
    wood: list[Mesh] = []
    for sx in (-1, 1):
        wood.append(tube(np.array([[sx * 0.19, -0.18, 0.0], [sx * 0.19, -0.18, 0.44]]), 0.019, 12))
        post = np.array(
            [
                [sx * 0.185, 0.22, 0.0],
                [sx * 0.185, 0.19, 0.44],
                [sx * 0.18, 0.205, 0.65],
                [sx * 0.175, 0.25, 0.92],
            ]
        )
        wood.append(tube(post, np.array([0.019, 0.021, 0.019, 0.016]), 12))
        wood.append(tube(np.array([[sx * 0.19, -0.18, 0.20], [sx * 0.186, 0.205, 0.20]]), 0.010, 8))
    wood.append(tube(np.array([[-0.19, 0.0, 0.20], [0.19, 0.0, 0.20]]), 0.010, 8))
    for y in (-0.18, 0.185):
        wood.append(box(0.38, 0.022, 0.06, 0.004, 0.04).moved(0, y, 0.385))
    for x in (-0.19, 0.19):
        wood.append(box(0.022, 0.36, 0.06, 0.004, 0.04).moved(x, 0, 0.385))
    for z, height in ((0.84, 0.075), (0.70, 0.05), (0.57, 0.05)):
        lean = 0.19 + 0.13 * max(z - 0.5, 0) ** 1.3
        slat = box(0.36, 0.018, height, 0.006, 0.03)
        slat = slat.deformed(
            lambda v: v + np.c_[np.zeros(len(v)), 0.03 - 0.9 * v[:, 0] ** 2, np.zeros(len(v))]
        )
        slat = slat.mapped(lambda v, n: v[:, [2, 0]])
        wood.append(slat.turned("x", -8).moved(0, lean, z))
    seat = puffed(box(0.43, 0.42, 0.055, 0.02, 0.03), 0.012).moved(0, -0.005, 0.435)
    return [(join(*wood), "chair_wood"), (seat, "seat_cloth")]


def couch(width: float = 2.0) -> Parts:
    """Three-seat couch with rounded cushions and arms; faces −y."""
    cloth = "couch_cloth"
    parts: Parts = [(box(width - 0.06, 0.82, 0.22, 0.03, 0.05).moved(0, 0, 0.10), cloth)]
    back = box(width - 0.10, 0.20, 0.60, 0.07, 0.05).turned("x", -6).moved(0, 0.31, 0.22)
    parts.append((back, cloth))
    for sx in (-1, 1):
        arm = puffed(box(0.20, 0.86, 0.50, 0.075, 0.04), 0.015)
        parts.append((arm.moved(sx * (width / 2 - 0.10), -0.005, 0.10), cloth))
    seat_width = (width - 0.40) / 3
    for i in (-1, 0, 1):
        seat = puffed(box(seat_width - 0.008, 0.66, 0.16, 0.05, 0.03), 0.03)
        parts.append((seat.moved(i * seat_width, -0.085, 0.29), cloth))
        cushion = puffed(box(seat_width - 0.012, 0.17, 0.43, 0.06, 0.03), 0.035)
        parts.append((cushion.turned("x", -12).moved(i * seat_width, 0.17, 0.43), cloth))
    for sx in (-1, 1):
        for sy in (-1, 1):
            foot = lathe([(1e-5, 0.0), (0.02, 0.0), (0.028, 0.10), (1e-5, 0.10)], 12)
            parts.append((foot.moved(sx * (width / 2 - 0.1), sy * 0.35), "stand_wood"))
    return parts


def pillow(material: str) -> Parts:
    """Square cushion that stands on an edge and leans back."""
    mesh = puffed(box(0.42, 0.10, 0.42, 0.045, 0.025), 0.05)
    return [(mesh.turned("x", -20), material)]


def coffee_table() -> Parts:
    """Low table with a rounded top and a lower board."""
    top = box(0.95, 0.52, 0.03, 0.012, 0.02).mapped(lambda v, n: v[:, [1, 0]]).moved(z=0.39)
    board = box(0.85, 0.42, 0.018, 0.006, 0.05).mapped(lambda v, n: v[:, [1, 0]]).moved(z=0.13)
    parts: Parts = [(top, "pale_wood"), (board, "pale_wood")]
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = tube(
                np.array([[sx * 0.43, sy * 0.22, 0.0], [sx * 0.40, sy * 0.19, 0.39]]), 0.018, 12
            )
            parts.append((leg, "pale_wood"))
    return parts


def tv(width: float = 1.15) -> Parts:
    """Flat screen on two feet."""
    height = width * 9 / 16 + 0.03
    parts: Parts = [(box(width, 0.045, height, 0.006, 0.05).moved(z=0.07), "black_plastic")]
    parts += front(width - 0.024, height - 0.034, 0, -0.0235, 0.088, "tv_screen")
    for sx in (-1, 1):
        foot = join(
            box(0.03, 0.22, 0.012, 0.004, 0.05).moved(sx * width * 0.3),
            box(0.03, 0.03, 0.075, 0.004, 0.05).moved(sx * width * 0.3),
        )
        parts.append((foot, "black_plastic"))
    return parts


def tv_stand(width: float = 1.6, depth: float = 0.42, height: float = 0.46) -> Parts:
    """Sideboard with three doors on short legs."""
    body = box(width, depth, height - 0.10, 0.006, 0.04).mapped(
        lambda v, n: np.where(np.abs(n[:, 2:]) > 0.5, v[:, [1, 0]], v[:, [2, 0]])
    )
    parts: Parts = [(body.moved(z=0.10), "stand_wood")]
    door_width = (width - 0.06) / 3
    for i in (-1, 0, 1):
        door = box(door_width - 0.012, 0.018, height - 0.15, 0.004, 0.04)
        parts.append((door.moved(i * door_width, -depth / 2 - 0.006, 0.125), "shelf_wood"))
        knob = lathe([(1e-5, 0), (0.012, 0.0), (0.014, 0.016), (1e-5, 0.022)], 12).turned("x", 90)
        parts.append((knob.moved(i * door_width + 0.16, -depth / 2 - 0.015, 0.33), "steel"))
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = tube(
                np.array(
                    [
                        [sx * (width / 2 - 0.10), sy * 0.14, 0],
                        [sx * (width / 2 - 0.14), sy * 0.13, 0.11],
                    ]
                ),
                0.016,
            )
            parts.append((leg, "stand_wood"))
    return parts


def bookshelf(
    width: float = 0.90,
    depth: float = 0.28,
    boards: tuple[float, ...] = (0.06, 0.42, 0.78, 1.14, 1.50),
    height: float = 1.62,
) -> Parts:
    """Open shelf. `boards` are the heights of the upper faces of the boards, metres."""
    wood: list[Mesh] = []
    for sx in (-1, 1):
        wood.append(box(0.022, depth, height, 0.003, 0.04).moved(sx * (width / 2 - 0.011)))
    for z in (*boards, height):
        board = box(width - 0.044, depth - 0.005, 0.022, 0.003, 0.03)
        wood.append(board.mapped(lambda v, n: v[:, [1, 0]]).moved(z=z - 0.022))
    wood.append(
        box(width - 0.044, 0.008, height - 0.05, 0.002, 0.04).moved(0, depth / 2 - 0.006, 0.04)
    )
    return [(join(*wood), "shelf_wood")]


def refrigerator() -> Parts:
    """Refrigerator with two doors and bar handles; the freezer is below."""
    parts: Parts = [(box(0.66, 0.60, 1.76, 0.012, 0.06).moved(0, 0.03), "white_enamel")]
    for z, height in ((0.05, 0.60), (0.66, 1.09)):
        parts.append((box(0.655, 0.06, height, 0.016, 0.05).moved(0, -0.30, z), "white_enamel"))
    for z0, z1 in ((0.36, 0.60), (0.71, 1.15)):
        path = np.array(
            [
                [-0.27, -0.33, z0],
                [-0.27, -0.365, z0 + 0.01],
                [-0.27, -0.365, z1 - 0.01],
                [-0.27, -0.33, z1],
            ]
        )
        parts.append((tube(path, 0.010, 10), "steel"))
    parts.append((box(0.11, 0.004, 0.03, 0.001, 0.05).moved(0.0, -0.331, 1.62), "steel"))
    return parts


def counter(length: float, sink_at: float, oven_at: float, depth: float = 0.60) -> Parts:
    """Base cabinets and worktop, open for a sink and an oven at x = `sink_at` and `oven_at`."""
    height, sink_w, sink_d, bay = 0.90, 0.56, 0.42, 0.62
    parts: Parts = []
    left, right = -length / 2, length / 2
    spans = [(left, oven_at - bay / 2), (oven_at + bay / 2, right)]
    for a, b in spans:
        if b - a < 0.03:
            continue
        parts.append(
            (
                box(b - a, depth - 0.06, 0.76, 0.003, 0.05).moved((a + b) / 2, 0.02, 0.10),
                "cabinet_blue",
            )
        )
        count = max(1, round((b - a) / 0.48))
        door = (b - a) / count
        for k in range(count):
            x = a + (k + 0.5) * door
            parts.append(
                (
                    box(door - 0.008, 0.02, 0.74, 0.004, 0.04).moved(x, -depth / 2 + 0.04, 0.11),
                    "cabinet_blue",
                )
            )
            parts.append(
                (
                    box(door - 0.12, 0.008, 0.60, 0.003, 0.04).moved(x, -depth / 2 + 0.027, 0.18),
                    "cabinet_blue",
                )
            )
            handle = np.array(
                [
                    [x - 0.07, -depth / 2 + 0.03, 0.80],
                    [x - 0.07, -depth / 2 + 0.005, 0.80],
                    [x + 0.07, -depth / 2 + 0.005, 0.80],
                    [x + 0.07, -depth / 2 + 0.03, 0.80],
                ]
            )
            parts.append((tube(handle, 0.005, 8), "steel"))
        parts.append(
            (box(b - a, depth - 0.14, 0.10, 0.002, 0.06).moved((a + b) / 2, 0.04), "black_plastic")
        )
    z, thick = height - 0.035, 0.035
    for x0, x1, y0, y1 in (
        (left, sink_at - sink_w / 2, -depth / 2, depth / 2),
        (sink_at + sink_w / 2, right, -depth / 2, depth / 2),
        (sink_at - sink_w / 2, sink_at + sink_w / 2, -depth / 2, -sink_d / 2),
        (sink_at - sink_w / 2, sink_at + sink_w / 2, sink_d / 2, depth / 2),
    ):
        slab = box(x1 - x0, y1 - y0, thick, 0.003, 0.025).moved((x0 + x1) / 2, (y0 + y1) / 2, z)
        parts.append((slab.mapped(lambda v, n: v[:, [0, 1]] + v[:, 2:]), "worktop"))
    return parts


def sink() -> Parts:
    """Steel basin in the worktop, with a tall tap. The rim is at z = 0.004."""
    width, deep = 0.58, 0.17
    steel: list[Mesh] = []
    for x, y, w, d in (
        (0, -0.205, width, 0.03),
        (0, 0.205, width, 0.03),
        (-0.275, 0, 0.03, 0.44),
        (0.275, 0, 0.03, 0.44),
    ):
        steel.append(box(w, d, 0.008, 0.003, 0.02).moved(x, y, -0.004))
    a, b = 0.262, 0.192
    x, y, z = np.eye(3)
    down = -deep
    steel.append(sheet(np.array([-a, -b, down]), 2 * a * x, 2 * b * y, 0.02))
    steel.append(sheet(np.array([-a, b, down]), 2 * a * x, deep * z, 0.02))
    steel.append(sheet(np.array([a, -b, down]), -2 * a * x, deep * z, 0.02))
    steel.append(sheet(np.array([-a, -b, down]), 2 * b * y, deep * z, 0.02))
    steel.append(sheet(np.array([a, b, down]), -2 * b * y, deep * z, 0.02))
    drain = lathe([(0.04, 0.0), (0.036, 0.006), (1e-5, 0.002)], 20).moved(z=down)
    angles = np.linspace(0, np.pi, 12)
    neck = [[0, 0.245, 0.0], [0, 0.245, 0.22]]
    neck += [[0, 0.245 - 0.07 * (1 - np.cos(t)), 0.22 + 0.08 * np.sin(t)] for t in angles[1:]]
    neck += [[0, 0.105, 0.19]]
    tap = join(
        tube(np.array(neck), 0.013, 14, 0.02),
        lathe([(0.03, 0.0), (0.03, 0.012), (0.03, 0.012), (0.02, 0.03), (0.014, 0.05)], 20).moved(
            0, 0.245
        ),
        tube(np.array([[0.0, 0.245, 0.06], [0.07, 0.235, 0.10]]), 0.008, 10),
    )
    return [(join(*steel), "steel"), (drain, "dark_metal"), (tap, "chrome")]


def oven() -> Parts:
    """Built-in oven below a glass cooktop."""
    parts: Parts = [(box(0.60, 0.55, 0.855, 0.004, 0.05).moved(0, 0.02, 0.0), "dark_metal")]
    parts += front(0.59, 0.72, 0, -0.2575, 0.13, "oven_front")
    bar = np.array(
        [[-0.23, -0.255, 0.70], [-0.23, -0.295, 0.70], [0.23, -0.295, 0.70], [0.23, -0.255, 0.70]]
    )
    parts.append((tube(bar, 0.011, 10), "steel"))
    return parts


def cooktop() -> Parts:
    """Glass plate with four rings."""
    parts: Parts = [(box(0.56, 0.50, 0.006, 0.002, 0.03), "cooktop")]
    for x, y, r in (
        (-0.14, -0.11, 0.09),
        (0.14, -0.11, 0.07),
        (-0.14, 0.12, 0.07),
        (0.14, 0.12, 0.09),
    ):
        ring = lathe([(r, 0.0065), (r - 0.006, 0.0065)], 36).moved(x, y)
        parts.append((ring, "grey_plastic"))
    return parts


def microwave() -> Parts:
    """Bench-top microwave."""
    parts: Parts = [(box(0.50, 0.36, 0.285, 0.01, 0.04).moved(z=0.01), "steel")]
    parts += front(0.49, 0.275, 0, -0.1815, 0.015, "microwave_front")
    bar = np.array(
        [[0.108, -0.18, 0.05], [0.108, -0.212, 0.06], [0.108, -0.212, 0.25], [0.108, -0.18, 0.26]]
    )
    parts.append((tube(bar, 0.008, 10), "steel"))
    return parts


def wall_cabinet(width: float, depth: float = 0.33, height: float = 0.66) -> Parts:
    """Wall cupboard with doors. Its lower edge is at z = 0."""
    parts: Parts = [(box(width, depth, height, 0.003, 0.05), "cabinet_white")]
    count = max(1, round(width / 0.45))
    door = width / count
    for k in range(count):
        x = -width / 2 + (k + 0.5) * door
        parts.append(
            (
                box(door - 0.006, 0.02, height - 0.006, 0.004, 0.04).moved(
                    x, -depth / 2 - 0.01, 0.003
                ),
                "cabinet_white",
            )
        )
        parts.append(
            (
                box(door - 0.11, 0.008, height - 0.13, 0.003, 0.04).moved(
                    x, -depth / 2 - 0.022, 0.065
                ),
                "cabinet_white",
            )
        )
        side = 1 if k % 2 == 0 else -1
        hx = x + side * (door / 2 - 0.035)
        parts.append(
            (
                tube(
                    np.array([[hx, -depth / 2 - 0.035, 0.05], [hx, -depth / 2 - 0.035, 0.17]]),
                    0.006,
                    8,
                ),
                "steel",
            )
        )
    return parts


def floor_lamp() -> Parts:
    """Stem with a glowing cloth shade."""
    stem = join(
        lathe([(0.15, 0.0), (0.15, 0.012), (0.14, 0.022), (0.015, 0.03)], 30),
        tube(np.array([[0, 0, 0.02], [0, 0, 1.45]]), 0.011, 12),
    )
    shade = lathe([(0.20, 1.32), (0.14, 1.60)], 40)
    inside = lathe([(0.139, 1.60), (0.199, 1.32)], 40)
    return [(stem, "dark_metal"), (shade, "shade_cloth"), (inside, "shade_cloth")]


def pendant_lamp() -> Parts:
    """Enamel ceiling lamp. Its lower rim is at z = 0; its cord is 0.75 m long."""
    profile = [(0.19, 0.0), (0.185, 0.03), (0.15, 0.09), (0.08, 0.15), (0.03, 0.18), (0.012, 0.22)]
    shade = lathe(profile, 40, 24)
    inside = lathe([(r - 0.003, z) for r, z in profile[::-1]], 40, 24)
    cord = tube(np.array([[0, 0, 0.2], [0, 0, 0.85]]), 0.004, 8, 0.1)
    bulb = lathe([(1e-5, 0.005), (0.05, 0.03), (0.055, 0.06), (0.03, 0.10), (1e-5, 0.12)], 20, 14)
    return [
        (shade, "ceramic_teal"),
        (inside, "ceramic_white"),
        (cord, "dark_metal"),
        (bulb, "lamp_glow"),
    ]


def wall_clock() -> Parts:
    """Round clock with its back in the plane y = 0 and its centre at z = 0."""
    rim = lathe([(0.165, 0.0), (0.165, 0.03), (0.150, 0.036), (0.145, 0.02)], 48).turned("x", 90)
    angles = np.linspace(0, 2 * np.pi, 49)
    points = np.c_[0.148 * np.cos(angles), np.full(49, -0.02), 0.148 * np.sin(angles)]
    points = np.vstack([[0, -0.02, 0], points])
    faces = np.array([[0, i, i + 1] for i in range(1, 49)])
    uv = points[:, [0, 2]] / (2 * 0.155) + 0.5
    dial = Mesh(points, np.tile([0.0, -1.0, 0.0], (50, 1)), uv, faces)
    return [(rim, "black_plastic"), (dial, "clock_face")]


def painting(width: float = 0.84, height: float = 0.60) -> Parts:
    """Framed picture with its back in the plane y = 0 and its lower edge at z = 0."""
    frame: list[Mesh] = []
    for z in (0.0, height - 0.035):
        frame.append(box(width, 0.03, 0.035, 0.006, 0.05).moved(0, -0.015, z))
    for sx in (-1, 1):
        frame.append(box(0.035, 0.03, height, 0.006, 0.05).moved(sx * (width / 2 - 0.0175), -0.015))
    return [
        (join(*frame), "stand_wood"),
        *front(width - 0.06, height - 0.06, 0, -0.012, 0.03, "painting"),
    ]


def window(width: float, height: float, wall: float = 0.16) -> Parts:
    """Window in a wall whose inner face is at y = 0: frame, bars, sill and a garden behind."""
    white: list[Mesh] = []
    for z in (0.0, height - 0.05):
        white.append(box(width, 0.06, 0.05, 0.006, 0.05).moved(0, wall - 0.05, z))
    for x in (-width / 2 + 0.025, 0.0, width / 2 - 0.025):
        white.append(box(0.05, 0.055, height, 0.006, 0.05).moved(x, wall - 0.05))
    white.append(box(width, 0.045, 0.035, 0.006, 0.05).moved(0, wall - 0.05, height * 0.62))
    white.append(box(width + 0.10, 0.20, 0.03, 0.008, 0.04).moved(0, 0.02, -0.03))
    return [
        (join(*white), "skirting"),
        *front(width * 3.2, height * 3.2, 0, 1.1, -1.1 * height, "garden"),
    ]
