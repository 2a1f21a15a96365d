"""Random materials: an albedo and a pattern per part."""

from __future__ import annotations

import colorsys

import numpy as np

from .shapes import Material

PLAIN, WOOD, STRIPES, CHECKS, SPECKLES, GRADIENT, PRINT = range(7)


def paint(
    rng: np.random.Generator,
    *,
    saturation: tuple[float, float] = (0.15, 0.9),
    value: tuple[float, float] = (0.12, 0.85),
    patterns: tuple[int, ...] = (PLAIN, PLAIN, GRADIENT, SPECKLES, STRIPES, PRINT),
    scale_m: tuple[float, float] = (0.01, 0.06),
) -> Material:
    """A colour of any hue."""
    hue = rng.random()
    first = colorsys.hsv_to_rgb(hue, rng.uniform(*saturation), rng.uniform(*value))
    shift = hue + rng.choice([0.0, 0.08, 0.5])
    second = colorsys.hsv_to_rgb(shift % 1, rng.uniform(*saturation), rng.uniform(*value))
    return Material(first, second, int(rng.choice(patterns)), float(rng.uniform(*scale_m)))


def wood(rng: np.random.Generator) -> Material:
    """Light to dark wood, sometimes painted white, grey or black."""
    if rng.random() < 0.25:
        grey = float(rng.choice([0.05, 0.3, 0.75]))
        return Material((grey, grey, grey), (grey * 0.9,) * 3, SPECKLES, 0.02)
    value = rng.uniform(0.12, 0.65)
    first = colorsys.hsv_to_rgb(rng.uniform(0.05, 0.11), rng.uniform(0.4, 0.75), value)
    second = tuple(c * rng.uniform(0.55, 0.8) for c in first)
    return Material(first, second, WOOD, float(rng.uniform(0.02, 0.08)))


def metal(rng: np.random.Generator) -> Material:
    """Grey, white or black, nearly plain."""
    grey = float(rng.choice([0.04, 0.25, 0.5, 0.8])) * rng.uniform(0.85, 1.1)
    return Material((grey, grey, grey * rng.uniform(0.95, 1.05)), (grey * 0.9,) * 3, SPECKLES, 0.01)


def fabric(rng: np.random.Generator) -> Material:
    """Cloth: often with a pattern."""
    return paint(
        rng,
        saturation=(0.05, 0.7),
        value=(0.1, 0.7),
        patterns=(SPECKLES, SPECKLES, STRIPES, CHECKS, PRINT),
        scale_m=(0.015, 0.1),
    )


def dark() -> Material:
    """Nearly black: screens and keys."""
    return Material((0.025, 0.027, 0.03), (0.05, 0.05, 0.06), GRADIENT, 0.3)


def ceramic(rng: np.random.Generator) -> Material:
    """White or strongly coloured glaze."""
    if rng.random() < 0.4:
        grey = rng.uniform(0.55, 0.85)
        return Material((grey, grey, grey * 0.95), (0.2, 0.3, 0.6), int(rng.choice([0, 2])), 0.03)
    return paint(rng, patterns=(PLAIN, GRADIENT, STRIPES))
