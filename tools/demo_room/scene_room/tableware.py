"""Small objects in their own frames: they stand on z = 0, the front faces −y."""

from __future__ import annotations

import numpy as np

from .furniture import Parts, front
from .meshes import Mesh, ball, box, join, lathe, leaf, sheet, tube


def cup(material: str) -> Parts:
    """Mug of coffee with a handle towards +x."""
    r, h = 0.046, 0.104
    body = lathe(
        [
            (1e-5, 0.0),
            (r - 0.006, 0.0),
            (r - 0.006, 0.0),
            (r, 0.006),
            (r, h - 0.003),
            (r - 0.002, h),
            (r - 0.004, h - 0.003),
            (r - 0.004, 0.012),
            (r - 0.008, 0.008),
            (1e-5, 0.008),
        ],
        36,
    )
    angles = np.linspace(-1.75, 1.75, 14)
    ring = np.c_[r - 0.008 + 0.036 * np.cos(angles), np.zeros(14), 0.053 + 0.033 * np.sin(angles)]
    handle = tube(ring, 0.0058, 10, 0.008)
    coffee = lathe([(r - 0.004, h - 0.022), (1e-5, h - 0.022)], 30)
    return [(join(body, handle), material), (coffee, "coffee")]


def bowl(material: str, radius: float = 0.14, height: float = 0.078) -> Parts:
    """Wide open bowl on a foot ring."""
    outside = [
        (0.05, 0.0),
        (0.055, 0.012),
        (0.10, 0.03),
        (radius - 0.01, height - 0.022),
        (radius, height),
    ]
    inside = [
        (radius - 0.006, height),
        (radius - 0.016, height - 0.02),
        (0.09, 0.036),
        (0.04, 0.02),
        (1e-5, 0.017),
    ]
    scale = radius / 0.14
    mesh = join(
        lathe([(r * (scale if r < radius - 0.02 else 1), z) for r, z in outside], 48, 24),
        lathe([(radius, height), (radius - 0.003, height + 0.002), (radius - 0.006, height)], 48),
        lathe([(r * (scale if r < radius - 0.02 else 1), z) for r, z in inside], 48, 24),
    )
    return [(mesh, material)]


def wine_bottle() -> Parts:
    """Green wine bottle with a label and foil."""
    glass = lathe(
        [
            (1e-5, 0.0),
            (0.030, 0.0),
            (0.0365, 0.006),
            (0.0375, 0.03),
            (0.0375, 0.17),
            (0.0365, 0.195),
            (0.026, 0.222),
            (0.0165, 0.245),
            (0.0145, 0.29),
        ],
        36,
        48,
    )
    foil = lathe(
        [(0.0150, 0.245), (0.0152, 0.298), (0.0152, 0.298), (0.014, 0.302), (1e-5, 0.302)], 24
    )
    ring = lathe([(0.0378, 0.06), (0.0380, 0.062), (0.0380, 0.148), (0.0378, 0.15)], 48)
    ring = ring.mapped(
        lambda v, n: np.c_[
            np.arctan2(v[:, 1], v[:, 0]) / (2 * np.pi) + 0.5, (v[:, 2] - 0.06) / 0.09
        ]
    )
    return [(glass, "bottle_green"), (foil, "bottle_foil"), (ring, "label")]


def soap_bottle() -> Parts:
    """Washing-up bottle with a pump cap."""
    body = lathe(
        [
            (1e-5, 0),
            (0.032, 0),
            (0.036, 0.01),
            (0.036, 0.12),
            (0.030, 0.16),
            (0.014, 0.18),
            (0.013, 0.20),
        ],
        30,
        40,
    )
    cap = lathe(
        [
            (0.016, 0.195),
            (0.016, 0.22),
            (0.016, 0.22),
            (0.006, 0.225),
            (0.005, 0.25),
            (1e-5, 0.252),
        ],
        20,
    )
    return [(body, "soap_blue"), (cap, "ceramic_white")]


def vase(material: str, height: float = 0.26) -> Parts:
    """Bellied vase with an open neck."""
    k = height / 0.26
    outside = [
        (1e-5, 0.0),
        (0.045, 0.0),
        (0.06, 0.02),
        (0.08, 0.09),
        (0.065, 0.16),
        (0.034, 0.205),
        (0.036, 0.235),
        (0.05, 0.26),
    ]
    inside = [(0.047, 0.26), (0.031, 0.23), (0.030, 0.20), (1e-5, 0.19)]
    mesh = join(
        lathe([(r * k, z * k) for r, z in outside], 44, 48),
        lathe([(r * k, z * k) for r, z in inside], 44, 20),
    )
    return [(mesh, material)]


def flowers(rng: np.random.Generator, neck: float, count: int = 9, spread: float = 0.15) -> Parts:
    """Bunch of tulips. The stems meet at z = 0 and end about 0.2 m above `neck`."""
    greens: list[Mesh] = []
    leaves: list[Mesh] = []
    petals: dict[str, list[Mesh]] = {"petal_red": [], "petal_yellow": [], "petal_white": []}
    for k in range(count):
        angle = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count
        reach = spread * (0.35 + 0.65 * (k % 3) / 2) * rng.uniform(0.8, 1.1)
        top = neck + rng.uniform(0.15, 0.25) - 0.25 * reach
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        s = np.linspace(0, 1, 9)[:, None]
        path = direction * reach * s**2.2 + np.array([0, 0, 1.0]) * top * s
        greens.append(tube(path, 0.0035, 6))
        head = lathe(
            [(1e-5, 0.0), (0.014, 0.006), (0.022, 0.025), (0.019, 0.045), (0.011, 0.055)], 12, 14
        )
        inner = lathe([(0.010, 0.055), (0.016, 0.04), (1e-5, 0.012)], 12, 8)
        tilt = np.rad2deg(reach / spread) * 0.5
        bud = join(head, inner).turned("y", tilt).turned("z", np.rad2deg(angle))
        name = ("petal_red", "petal_yellow", "petal_white")[k % 3]
        petals[name].append(bud.moved(*(path[-1] - [0, 0, 0.004])))
        blade = leaf(0.20 * rng.uniform(0.8, 1.1), 0.035, 0.25, 0.3).turned("y", -48)
        turn = np.rad2deg(angle) + 20
        leaves.append(blade.turned("z", turn).moved(0, 0, neck - 0.04))
    parts: Parts = [(join(*greens), "stem"), (join(*leaves), "leaf_young")]
    parts += [(join(*meshes), name) for name, meshes in petals.items()]
    return parts


def potted_plant(
    rng: np.random.Generator, size: float, pot: str, leaves: int, stem: float = 0.35
) -> Parts:
    """Pot with a leafy plant. `size` is about the total height, metres."""
    r, h = 0.17 * size, 0.30 * size
    shell = lathe(
        [
            (1e-5, 0),
            (0.72 * r, 0),
            (0.72 * r, 0),
            (0.97 * r, 0.86 * h),
            (0.97 * r, 0.86 * h),
            (1.06 * r, 0.86 * h),
            (1.06 * r, 0.86 * h),
            (1.08 * r, h),
            (1.08 * r, h),
            (0.96 * r, h),
            (0.96 * r, h),
            (0.92 * r, 0.86 * h),
        ],
        40,
    )
    earth = lathe([(0.95 * r, 0.88 * h), (0.5 * r, 0.91 * h), (1e-5, 0.92 * h)], 30)
    blades: dict[str, list[Mesh]] = {"leaf": [], "leaf_young": []}
    stalks: list[Mesh] = []
    for k in range(leaves):
        level = (k + 0.5) / leaves
        angle = 137.5 * k + rng.uniform(-12, 12)
        height = 0.9 * h + stem * size * level**0.8
        lift = 20 + 55 * level + rng.uniform(-6, 6)
        length = size * (0.40 - 0.12 * level) * rng.uniform(0.85, 1.1)
        out = size * 0.10 * (1 - 0.6 * level)
        blade = leaf(length, length * 0.44, 0.50, 0.18).turned("y", -lift + 15)
        blade = blade.moved(out, 0, height).turned("z", angle)
        blades["leaf_young" if level > 0.75 else "leaf"].append(blade)
        a = np.deg2rad(angle)
        path = np.array(
            [
                [0, 0, 0.85 * h],
                [0, 0, 0.4 * (height + h)],
                [out * np.cos(a), out * np.sin(a), height],
            ]
        )
        stalks.append(tube(path, 0.006 * size + 0.001, 6, 0.05))
    parts: Parts = [(shell, pot), (earth, "soil"), (join(*stalks), "stem")]
    parts += [(join(*meshes), name) for name, meshes in blades.items() if meshes]
    return parts


def laptop(opening: float = 112.0) -> Parts:
    """Open notebook; the user sits at −y."""
    width, depth = 0.335, 0.232
    deck = box(width, depth, 0.016, 0.005, 0.03)
    keys_corner = np.array([-width / 2 + 0.006, -depth / 2 + 0.006, 0.0165])
    keys = sheet(
        keys_corner, np.array([width - 0.012, 0, 0]), np.array([0, depth - 0.012, 0]), 0.03, True
    )
    lid = box(width, 0.008, depth - 0.006, 0.003, 0.03)
    screen = front(width - 0.018, depth - 0.032, 0, -0.0045, 0.017, "laptop_screen")[0][0]
    bezel = front(width - 0.004, depth - 0.012, 0, -0.0042, 0.004, "black_plastic")[0][0]
    hinge = (0, depth / 2 - 0.004, 0.014)
    tilt = 90.0 - opening
    parts: Parts = [(deck, "aluminium"), (keys, "keyboard")]
    for mesh, material in ((lid, "aluminium"), (bezel, "black_plastic"), (screen, "laptop_screen")):
        parts.append((mesh.turned("x", tilt).moved(*hinge), material))
    return parts


def book(index: int, thickness: float, height: float, depth: float) -> Parts:
    """Upright book. The spine faces −y; the thickness is along x."""
    cover, spine = f"cover_{index}", f"spine_{index}"
    t = 0.003
    pages = box(thickness - 2 * t, depth - 0.010, height - 0.008, 0.001, 0.05).moved(
        0, -0.001, 0.004
    )
    parts: Parts = [(pages, "paper")]
    for sx in (-1, 1):
        board = box(t, depth, height, 0.001, 0.05).moved(sx * (thickness / 2 - t / 2))
        parts.append((board, f"cloth_{index}"))
    back = box(thickness, t, height, 0.0012, 0.05).moved(0, -depth / 2 + t / 2)
    parts.append((back, f"cloth_{index}"))
    parts += front(thickness - 0.001, height - 0.001, 0, -depth / 2 - 0.0006, 0.0005, spine)
    face = sheet(
        np.array([thickness / 2 + 0.0006, -depth / 2, 0]),
        np.array([0, depth, 0]),
        np.array([0, 0, height]),
        0.04,
        True,
    )
    parts.append((face, cover))
    return parts


def lying_book(index: int, thickness: float, height: float, depth: float) -> Parts:
    """Lying book: cover up, spine towards −x, head towards +y."""
    parts = []
    for mesh, material in book(index, thickness, height, depth):
        turned = mesh.turned("z", -90).turned("x", -90).moved(0, -height / 2, thickness / 2)
        parts.append((turned.turned("z", 0), material))
    low = min(float(m.vertices[:, 2].min()) for m, _ in parts)
    return [(m.moved(z=-low), name) for m, name in parts]


def fruit(material: str, radius: float) -> Parts:
    """Orange or apple: a ball with a dent at the top and a stalk."""

    def dent(v: np.ndarray) -> np.ndarray:
        q = np.hypot(v[:, 0], v[:, 1]) / radius
        top = v[:, 2] > radius
        sink_in = 0.28 * radius * np.exp(-((q / 0.32) ** 2)) * top
        return v - np.c_[np.zeros(len(v)), np.zeros(len(v)), sink_in]

    body = ball(radius, 28)
    parts: Parts = []
    if material == "apple":
        body = body.deformed(dent)
        stalk = tube(np.array([[0, 0, 1.6 * radius], [0.004, 0, 2.1 * radius]]), 0.002, 6)
        parts.append((stalk, "banana_tip"))
    return [(body, material), *parts]


def bananas() -> Parts:
    """Three bananas, joined at one end."""
    parts: Parts = []
    for k in range(3):
        t = np.linspace(-0.95, 1.05, 15)
        arc = np.c_[0.105 * np.sin(t), np.zeros(15), 0.105 * (1 - np.cos(t)) + 0.018]
        radius = 0.0175 * np.clip(1.25 - np.abs(np.linspace(-1, 1, 15)) ** 3, 0.25, 1)
        fruit_mesh = tube(arc, radius, 10, 0.012)
        tip = tube(np.array([arc[-1], arc[-1] + [0.006, 0, 0.016]]), 0.005, 8, 0.01)
        move = (0.0, 0.034 * (k - 1), 0.0)
        parts.append((fruit_mesh.turned("z", 9.0 * (k - 1)).moved(*move), "banana"))
        parts.append((tip.turned("z", 9.0 * (k - 1)).moved(*move), "banana_tip"))
    return parts


def remote() -> Parts:
    """Remote control with two rows of buttons."""
    parts: Parts = [(box(0.045, 0.17, 0.018, 0.006, 0.03), "black_plastic")]
    for row in range(6):
        for column in (-1, 0, 1):
            key = box(0.008, 0.012, 0.002, 0.0008, 0.02).moved(
                0.012 * column, -0.055 + 0.021 * row, 0.018
            )
            parts.append((key, "grey_plastic" if row else "ceramic_red"))
    return parts


def teddy_bear() -> Parts:
    """Sitting bear made of balls; faces −y."""

    def lump(x: float, y: float, z: float, rx: float, ry: float, rz: float) -> Mesh:
        return ball(1.0, 22).moved(z=-1.0).scaled(rx, ry, rz).moved(x, y, z)

    fur = [lump(0, 0, 0.13, 0.10, 0.09, 0.13), lump(0, -0.015, 0.315, 0.092, 0.085, 0.085)]
    pale = [lump(0, -0.085, 0.295, 0.042, 0.036, 0.034), lump(0, -0.045, 0.12, 0.065, 0.055, 0.085)]
    for sx in (-1, 1):
        fur.append(lump(sx * 0.075, -0.005, 0.385, 0.036, 0.022, 0.036))
        pale.append(lump(sx * 0.075, -0.018, 0.383, 0.022, 0.015, 0.022))
        fur.append(lump(sx * 0.115, -0.045, 0.19, 0.038, 0.075, 0.045))
        fur.append(lump(sx * 0.085, -0.13, 0.048, 0.048, 0.10, 0.048))
        pale.append(lump(sx * 0.085, -0.222, 0.05, 0.034, 0.014, 0.036))
    dark = [lump(sx * 0.034, -0.092, 0.335, 0.010, 0.008, 0.010) for sx in (-1, 1)]
    dark.append(lump(0, -0.120, 0.306, 0.015, 0.010, 0.011))
    return [(join(*fur), "teddy_fur"), (join(*pale), "teddy_pale"), (join(*dark), "black_plastic")]
