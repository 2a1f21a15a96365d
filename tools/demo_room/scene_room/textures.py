"""Procedural textures: images of linear albedo (H, W, 3) float32. Repeated textures tile."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]


def rgb(hex_colour: str) -> Image:
    """Linear RGB (3,) of '#rrggbb' in sRGB."""
    values = np.array([int(hex_colour[i : i + 2], 16) for i in (1, 3, 5)], np.float32) / 255
    return (values**2.2).astype(np.float32)


def plain(colour: str) -> Image:
    """Texture of one colour."""
    return np.tile(rgb(colour), (4, 4, 1)).astype(np.float32)


def write(
    image: Image,
    text: str,
    origin: tuple[int, int],
    font: int,
    scale: float,
    colour: list[float] | tuple[float, float, float],
    thickness: int,
) -> None:
    """Write text into a float image. OpenCV itself writes only into 8-bit images."""
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.putText(mask, text, origin, font, scale, 255, thickness, cv2.LINE_AA)
    weight = mask[..., None].astype(np.float32) / 255
    image[:] = image * (1 - weight) + np.array(colour, np.float32) * weight


def noise(rng: np.random.Generator, cells_y: int, cells_x: int, size: int = 512) -> Image:
    """Smooth periodic noise (size, size), zero mean, about unit deviation."""
    grid = rng.normal(size=(cells_y, cells_x)).astype(np.float32)
    padded = np.pad(grid, 3, mode="wrap")
    scale_y, scale_x = size / cells_y, size / cells_x
    y, x = np.mgrid[0:size, 0:size].astype(np.float32)
    return cv2.remap(padded, x / scale_x + 3, y / scale_y + 3, cv2.INTER_CUBIC)


def fractal(rng: np.random.Generator, cells: int, octaves: int = 4, size: int = 512) -> Image:
    """Sum of octaves of periodic noise, normalised to unit deviation."""
    total = sum(noise(rng, cells * 2**k, cells * 2**k, size) / 1.7**k for k in range(octaves))
    return (total / np.std(total)).astype(np.float32)


def mix(a: str, b: str, weight: Image) -> Image:
    """Blend of two colours by a weight image, clipped to [0, 1]."""
    w = np.clip(weight, 0, 1)[..., None]
    return (rgb(a) * (1 - w) + rgb(b) * w).astype(np.float32)


def wood(rng: np.random.Generator, light: str, dark: str, rings: float = 7.0) -> Image:
    """Grain along v: warped rings and fine pores."""
    size = 512
    x = np.linspace(0, 1, size, endpoint=False, dtype=np.float32)[None, :]
    warp = 0.10 * noise(rng, 2, 3, size) + 0.03 * noise(rng, 4, 12, size)
    grain = 0.5 + 0.5 * np.sin(2 * np.pi * (round(rings) * x + 2.2 * warp))
    fibres = noise(rng, 4, 128, size) * 0.5 + noise(rng, 8, 256, size) * 0.5
    weight = 0.25 + 0.38 * grain**2 + 0.16 * fibres + 0.08 * noise(rng, 3, 3, size)
    return mix(light, dark, weight)


def planks(rng: np.random.Generator, light: str, dark: str, rows: int = 8) -> Image:
    """Staggered floor boards along v, each with its own tone and grain."""
    size = 1024
    image = np.zeros((size, size, 3), np.float32)
    width = size // rows
    for i in range(rows):
        base = cv2.resize(wood(rng, light, dark, 5), (size, size))
        start = int(rng.integers(size))
        column = base[:, (i * 97) % (size - width) :][:, :width].copy()
        tone = rng.uniform(0.82, 1.12, 2)
        half = size // 2
        column[:half] *= tone[0]
        column[half:] *= tone[1]
        column[half - 1 : half + 1] *= 0.45
        column[:2] *= 0.45
        column[:, :2] *= 0.5
        image[:, i * width : (i + 1) * width] = np.roll(column, start, axis=0)
    return image


def plaster(rng: np.random.Generator, colour: str, strength: float = 0.02) -> Image:
    """Painted wall with faint roller marks."""
    tone = 1 + strength * fractal(rng, 8, 5) + 0.5 * strength * noise(rng, 2, 2)
    return (rgb(colour) * tone[..., None]).astype(np.float32)


def fabric(rng: np.random.Generator, colour: str, contrast: float = 0.25) -> Image:
    """Woven cloth: two thread directions with uneven yarn."""
    size, threads = 512, 64
    y, x = np.mgrid[0:size, 0:size] * (2 * np.pi * threads / size)
    weave = 0.5 * np.sin(x) * np.sin(y) + 0.5 * np.sign(np.sin(x / 2)) * np.sin(y)
    yarn = noise(rng, 256, 32, size) + noise(rng, 32, 256, size)
    tone = 1 + contrast * (0.35 * weave + 0.30 * yarn) + 0.05 * fractal(rng, 3, 3)
    return np.clip(rgb(colour) * tone[..., None], 0.003, 0.95).astype(np.float32)


def fur(rng: np.random.Generator, colour: str) -> Image:
    """Short curly pile."""
    tone = 1 + 0.22 * fractal(rng, 48, 3) + 0.1 * fractal(rng, 8, 3)
    return np.clip(rgb(colour) * tone[..., None], 0.003, 0.95).astype(np.float32)


def rug(rng: np.random.Generator) -> Image:
    """Carpet with a border and diamonds. One texture covers the whole carpet."""
    height, width = 512, 768
    image = np.tile(rgb("#8c2f2b"), (height, width, 1))
    cv2.rectangle(image, (24, 24), (width - 25, height - 25), rgb("#e2d3b4").tolist(), 16)
    cv2.rectangle(image, (52, 52), (width - 53, height - 53), rgb("#27405f").tolist(), 26)
    for i, cx in enumerate(np.linspace(150, width - 150, 5)):
        for j, cy in enumerate(np.linspace(140, height - 140, 3)):
            r = 58
            diamond = np.array([[cx, cy - r], [cx + r, cy], [cx, cy + r], [cx - r, cy]], np.int32)
            colour = ("#d8b26a", "#27405f", "#e2d3b4")[(i + j) % 3]
            cv2.fillPoly(image, [diamond], rgb(colour).tolist(), cv2.LINE_AA)
            inner = ((diamond - [cx, cy]) * 0.5 + [cx, cy]).astype(np.int32)
            cv2.fillPoly(image, [inner], rgb("#8c2f2b").tolist(), cv2.LINE_AA)
    tone = 1 + 0.16 * cv2.resize(fractal(rng, 96, 2), (width, height))
    return np.clip(image * tone[..., None], 0.01, 0.9).astype(np.float32)


def tiles(rng: np.random.Generator, colour: str, grout: str, rows: int = 4, cols: int = 2) -> Image:
    """Brick-laid glazed wall tiles."""
    size = 512
    image = np.tile(rgb(grout), (size, size, 1))
    h, w = size // rows, size // cols
    for r in range(rows):
        for c in range(cols):
            x0 = c * w + (w // 2 if r % 2 else 0)
            tone = rng.uniform(0.93, 1.04)
            columns = np.arange(x0 + 4, x0 + w - 4) % size
            image[r * h + 4 : (r + 1) * h - 4, columns] = rgb(colour) * tone
    return (image * (1 + 0.015 * fractal(rng, 6, 3))[..., None]).astype(np.float32)


def marble(rng: np.random.Generator) -> Image:
    """Speckled light worktop."""
    weight = 0.25 + 0.12 * fractal(rng, 4, 5) + 0.1 * fractal(rng, 64, 2)
    return mix("#d8d4cc", "#7d7871", weight)


def brushed_metal(rng: np.random.Generator, colour: str) -> Image:
    """Steel with streaks along u."""
    tone = 1 + 0.05 * noise(rng, 256, 4) + 0.02 * noise(rng, 64, 2)
    return (rgb(colour) * tone[..., None]).astype(np.float32)


def leaf_green(rng: np.random.Generator, light: str = "#6fae3c", dark: str = "#234f1b") -> Image:
    """Leaf blade: midrib along v at u = 0.5, side veins."""
    size = 256
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) / size
    rib = np.exp(-(((x - 0.5) / 0.025) ** 2))
    veins = 0.5 + 0.5 * np.cos(2 * np.pi * (14 * y - 9 * np.abs(x - 0.5)))
    weight = 0.62 + 0.10 * fractal(rng, 4, 3, size) - 0.5 * rib - 0.16 * veins**6
    return mix(light, dark, weight)


def soil(rng: np.random.Generator) -> Image:
    """Potting earth."""
    return mix("#2a1d14", "#6a4b33", 0.35 + 0.25 * fractal(rng, 48, 3))


def orange_peel(rng: np.random.Generator, colour: str, other: str) -> Image:
    """Fruit skin with pores and a blush."""
    weight = 0.3 + 0.2 * fractal(rng, 3, 3) + 0.08 * fractal(rng, 64, 1)
    return mix(colour, other, weight)


def book_cover(rng: np.random.Generator, base: str, ink: str, title: str) -> Image:
    """Cover (u across, v up): coloured cloth, title lines, an ornament."""
    height, width = 384, 256
    image = np.tile(rgb(base), (height, width, 1))
    colour = rgb(ink).tolist()
    cv2.rectangle(image, (12, 12), (width - 13, height - 13), colour, 3)
    write(image, title, (26, 80), cv2.FONT_HERSHEY_DUPLEX, 1.1, colour, 2)
    cv2.line(image, (26, 100), (width - 40, 100), colour, 3)
    centre = (width // 2, 230)
    for r in range(20, 80, 16):
        cv2.circle(image, centre, r, colour, 4, cv2.LINE_AA)
    write(image, "VOL. I", (80, 350), cv2.FONT_HERSHEY_SIMPLEX, 0.8, colour, 2)
    tone = 1 + 0.04 * cv2.resize(fractal(rng, 64, 2), (width, height))
    return np.flipud(np.clip(image * tone[..., None], 0.01, 0.9)).astype(np.float32)


def book_spine(base: str, ink: str, title: str) -> Image:
    """Spine (u across, v up) with bands and a title that reads downwards."""
    height, width = 384, 64
    lying = np.tile(rgb(base), (width, height, 1))
    colour = rgb(ink).tolist()
    for x in (18, 26, height - 40, height - 32):
        cv2.line(lying, (x, 0), (x, width), colour, 3)
    write(lying, title, (50, 42), cv2.FONT_HERSHEY_DUPLEX, 1.0, colour, 2)
    image = np.rot90(lying, -1)
    x = np.linspace(-1, 1, width, dtype=np.float32)
    return np.flipud(image * (1 - 0.35 * x**4)[None, :, None]).astype(np.float32)


def paper_edge(rng: np.random.Generator) -> Image:
    """Page block: fine lines along u."""
    return mix("#f1ead8", "#b9ad92", 0.35 + 0.3 * noise(rng, 256, 2))


def landscape(rng: np.random.Generator, height: int = 384, width: int = 640) -> Image:
    """Sunset over hills and water: for the screen and the painting (row 0 = bottom)."""
    y = np.linspace(1, 0, height, dtype=np.float32)[:, None]
    x = np.linspace(0, 1, width, dtype=np.float32)[None, :]
    sky = mix("#ffb45c", "#2f6fc4", np.broadcast_to((y - 0.35) / 0.6, (height, width)))
    cloud = cv2.resize(fractal(rng, 3, 5), (width, height))
    sky += np.clip(cloud - 0.4, 0, 1)[..., None] * 0.22
    sun = np.exp(-(((x - 0.68) / 0.05) ** 2 + ((y - 0.52) / 0.08) ** 2))
    image = sky + sun[..., None] * rgb("#ffe9b0") * 0.8
    profiles = cv2.resize(fractal(rng, 4, 4), (width, height))
    for k, (level, colour) in enumerate(((0.50, "#5c6f9a"), (0.42, "#3f5a52"), (0.34, "#26401f"))):
        ridge = level + 0.05 * profiles[40 + 60 * k][None, :]
        image = np.where((y < ridge)[..., None], rgb(colour) * (0.8 + 0.4 * y[..., None]), image)
    glitter = 0.5 + 0.5 * cv2.resize(noise(rng, 128, 12), (width, height))
    water = mix("#1d4f7c", "#f2b470", 0.25 + 0.3 * glitter * np.exp(-(((x - 0.68) / 0.12) ** 2)))
    image = np.where((y < 0.24)[..., None], water, image)
    return np.flipud(np.clip(image, 0.005, 1)).astype(np.float32)


def abstract_painting(rng: np.random.Generator) -> Image:
    """Overlapping colour fields."""
    height, width = 320, 448
    image = np.tile(rgb("#efe6d2"), (height, width, 1))
    colours = ("#c8553d", "#f28f3b", "#588b8b", "#2d3047", "#e0a458", "#93b7be")
    for k in range(16):
        overlay = image.copy()
        centre = (int(rng.integers(40, width - 40)), int(rng.integers(40, height - 40)))
        axes = (int(rng.integers(25, 85)), int(rng.integers(25, 85)))
        angle = float(rng.uniform(0, 180))
        colour = rgb(colours[k % len(colours)]).tolist()
        cv2.ellipse(overlay, centre, axes, angle, 0, 360, colour, -1, cv2.LINE_AA)
        image = 0.25 * image + 0.75 * overlay
    tone = 1 + 0.05 * cv2.resize(fractal(rng, 32, 3), (width, height))
    return np.clip(image * tone[..., None], 0.01, 0.95).astype(np.float32)


def desktop(rng: np.random.Generator) -> Image:
    """Laptop screen: wallpaper, a window with lines of text, a bar."""
    image = np.flipud(landscape(rng, 300, 480)).copy() * 0.8
    cv2.rectangle(image, (70, 30), (350, 235), rgb("#f4f4f2").tolist(), -1)
    cv2.rectangle(image, (70, 30), (350, 50), rgb("#3b4252").tolist(), -1)
    for i in range(11):
        end = 90 + int(rng.integers(90, 240))
        colour = rgb(("#4c566a", "#b04a4a", "#3d7a4a")[i % 3]).tolist()
        cv2.line(image, (86, 66 + 15 * i), (end, 66 + 15 * i), colour, 3)
    cv2.rectangle(image, (0, 282), (480, 300), rgb("#20242c").tolist(), -1)
    return np.flipud(image).astype(np.float32)


def keyboard() -> Image:
    """Laptop deck: rows of dark keys and a touch pad (v = 0 at the user's side)."""
    height, width = 300, 448
    image = np.tile(rgb("#a9acb0"), (height, width, 1))
    dark = rgb("#1c1d20").tolist()
    for row in range(5):
        for column in range(14):
            x, y = 22 + column * 29, 24 + row * 30
            cv2.rectangle(image, (x, y), (x + 25, y + 25), dark, -1)
    cv2.rectangle(image, (138, 174), (308, 198), dark, -1)
    cv2.rectangle(image, (150, 208), (298, 290), rgb("#8f9297").tolist(), -1)
    return np.flipud(image).astype(np.float32)


def clock_face() -> Image:
    """White dial, black marks, hands at ten past ten."""
    size = 256
    image = np.tile(rgb("#f5f3ec"), (size, size, 1))
    c = size // 2
    black = rgb("#111111").tolist()
    for hour in range(12):
        a = np.deg2rad(30 * hour)
        d = np.array([np.sin(a), -np.cos(a)])
        p, q = c + d * 100, c + d * (78 if hour % 3 == 0 else 88)
        cv2.line(image, tuple(p.astype(int)), tuple(q.astype(int)), black, 8, cv2.LINE_AA)
    for degrees, length, width in ((305, 58, 10), (60, 84, 6)):
        a = np.deg2rad(degrees)
        tip = c + np.array([np.sin(a), -np.cos(a)]) * length
        cv2.line(image, (c, c), tuple(tip.astype(int)), black, width, cv2.LINE_AA)
    return np.flipud(image).astype(np.float32)


def garden(rng: np.random.Generator) -> Image:
    """Out-of-focus view through the window: bright sky over trees."""
    size = 512
    y = np.linspace(0, 1, size, dtype=np.float32)[:, None]
    edge = 0.38 + 0.06 * noise(rng, 2, 6, size)
    trees = 1 / (1 + np.exp((y - edge) * 40))
    sky = mix("#ffffff", "#a9cdf5", np.broadcast_to(y, (size, size)))
    green = mix("#4c7a35", "#a7c46c", 0.5 + 0.3 * fractal(rng, 8, 3)) * 0.5
    image = sky * (1 - trees[..., None]) + green * trees[..., None]
    return cv2.GaussianBlur(image, (0, 0), 6).astype(np.float32)


def oven_front() -> Image:
    """Oven door (row 0 = bottom): dark glass in steel, panel with knobs on top."""
    height, width = 384, 320
    image = np.tile(rgb("#b9bbbd"), (height, width, 1))
    cv2.rectangle(image, (8, 96), (width - 9, height - 20), rgb("#0c0c0e").tolist(), -1)
    cv2.rectangle(image, (34, 150), (width - 35, height - 60), rgb("#24211d").tolist(), -1)
    for k in range(3):
        y = 190 + 40 * k
        cv2.line(image, (40, y), (width - 41, y), rgb("#4a443c").tolist(), 2)
    cv2.rectangle(image, (110, 22), (210, 60), rgb("#081018").tolist(), -1)
    write(image, "10:10", (126, 50), cv2.FONT_HERSHEY_DUPLEX, 0.75, (0.1, 0.9, 0.5), 2)
    for x in (36, 78, 242, 284):
        cv2.circle(image, (x, 42), 17, rgb("#1a1a1c").tolist(), -1, cv2.LINE_AA)
        cv2.line(image, (x, 42), (x, 28), rgb("#e8e8e8").tolist(), 3)
    return np.flipud(image).astype(np.float32)


def microwave_front() -> Image:
    """Microwave (row 0 = bottom): window on the left, buttons and display on the right."""
    height, width = 240, 400
    image = np.tile(rgb("#c9cbcc"), (height, width, 1))
    cv2.rectangle(image, (10, 12), (290, height - 13), rgb("#141416").tolist(), -1)
    cv2.rectangle(image, (40, 40), (262, height - 41), rgb("#2b2a28").tolist(), -1)
    cv2.rectangle(image, (304, 12), (width - 11, height - 13), rgb("#1b1c1e").tolist(), -1)
    cv2.rectangle(image, (312, 22), (width - 19, 58), rgb("#061a12").tolist(), -1)
    write(image, "10:10", (318, 50), cv2.FONT_HERSHEY_DUPLEX, 0.65, (0.1, 0.9, 0.4), 2)
    for row in range(4):
        for column in range(3):
            x, y = 314 + 24 * column, 74 + 30 * row
            cv2.rectangle(image, (x, y), (x + 18, y + 18), rgb("#8d9094").tolist(), -1)
    cv2.rectangle(image, (314, 200), (width - 21, 220), rgb("#b8bbbe").tolist(), -1)
    return np.flipud(image).astype(np.float32)


def label(rng: np.random.Generator) -> Image:
    """Paper label that goes round a bottle."""
    height, width = 160, 512
    image = np.tile(rgb("#efe4c8"), (height, width, 1))
    ink = rgb("#5a1220").tolist()
    for x in (40, 296):
        cv2.rectangle(image, (x - 20, 10), (x + 190, height - 11), ink, 3)
        write(image, "RIVA", (x, 75), cv2.FONT_HERSHEY_TRIPLEX, 2.0, ink, 3)
        cv2.line(image, (x, 95), (x + 160, 95), ink, 3)
        write(image, "2019", (x + 30, 135), cv2.FONT_HERSHEY_DUPLEX, 1.1, ink, 2)
    return np.flipud(
        image * (1 + 0.02 * cv2.resize(fractal(rng, 8, 3), (512, 160)))[..., None]
    ).astype(np.float32)
