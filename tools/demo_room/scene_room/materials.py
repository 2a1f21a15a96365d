"""Materials by name: texture, tile size and reflection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import textures as tex


@dataclass(frozen=True)
class Material:
    """Appearance of a surface.

    Attributes:
        texture: (H, W, 3) linear albedo or radiance.
        tile_m: size of one repetition of the texture along u and v, metres.
        f0: reflectance at normal incidence; 0 = matt.
        roughness: spread of reflected rays.
        emission: emitted radiance = emission × texture.
        two_sided: lit from both sides, like leaves.
        sensed: False if a depth camera measures no depth, like the view through the window.
    """

    texture: NDArray[np.float32]
    tile_m: tuple[float, float] = (1.0, 1.0)
    f0: float = 0.0
    roughness: float = 0.3
    emission: float = 0.0
    two_sided: bool = False
    sensed: bool = True


BOOK_COLOURS = (
    ("#7a1f2b", "#e8c872", "ATLAS"),
    ("#1f3d6e", "#f0e6c8", "OCEANS"),
    ("#2e5e3e", "#f3e2a0", "FOREST"),
    ("#c99a2e", "#3a2410", "DESERT"),
    ("#3b2b52", "#e6d7f5", "NIGHT"),
    ("#b5482a", "#fbe9d0", "RIVERS"),
    ("#e4dccb", "#7a1f2b", "POEMS"),
    ("#20242c", "#d9d9d9", "MAPS"),
    ("#4f8a8b", "#ffffff", "ISLES"),
    ("#8a5a8f", "#f7e9ff", "MUSIC"),
)


def build_materials(seed: int) -> dict[str, Material]:
    """All materials of the room by name. The same seed gives the same textures."""
    rng = np.random.default_rng(seed)
    unit = (1.0, 1.0)
    materials = {
        "floor": Material(tex.planks(rng, "#c39a6b", "#8a5f38"), (1.3, 1.9), 0.035, 0.12),
        "wall": Material(tex.plaster(rng, "#ddd6c6", 0.008), (2.0, 2.0)),
        "wall_accent": Material(tex.plaster(rng, "#93aaa3", 0.008), (2.0, 2.0)),
        "ceiling": Material(tex.plaster(rng, "#f0efea", 0.01), (2.0, 2.0)),
        "skirting": Material(tex.plain("#ecebe6"), unit, 0.03, 0.3),
        "wall_tiles": Material(tex.tiles(rng, "#e9ece9", "#b5b6b0"), (0.6, 0.6), 0.04, 0.05),
        "table_wood": Material(tex.wood(rng, "#91623c", "#5e371b"), (0.30, 1.6), 0.04, 0.12),
        "chair_wood": Material(tex.wood(rng, "#b98450", "#7c4c22"), (0.25, 0.9), 0.04, 0.2),
        "shelf_wood": Material(tex.wood(rng, "#a97a4a", "#6b4524"), (0.4, 1.2), 0.03, 0.2),
        "stand_wood": Material(tex.wood(rng, "#6e4a30", "#3c2616"), (0.4, 1.2), 0.04, 0.15),
        "pale_wood": Material(tex.wood(rng, "#d8b888", "#ad8656"), (0.4, 1.2), 0.03, 0.2),
        "seat_cloth": Material(tex.fabric(rng, "#b3402f"), (0.22, 0.22)),
        "couch_cloth": Material(tex.fabric(rng, "#53708f"), (0.30, 0.30)),
        "pillow_yellow": Material(tex.fabric(rng, "#d9a32b"), (0.20, 0.20)),
        "pillow_cream": Material(tex.fabric(rng, "#e6dcc8"), (0.20, 0.20)),
        "box_cloth": Material(tex.fabric(rng, "#7d8b6a"), (0.20, 0.20)),
        "shade_cloth": Material(tex.fabric(rng, "#fff0d2", 0.1), (0.2, 0.2), emission=1.2),
        "teddy_fur": Material(tex.fur(rng, "#9a6334"), (0.25, 0.25)),
        "teddy_pale": Material(tex.fur(rng, "#d3aa78"), (0.25, 0.25)),
        "rug": Material(tex.rug(rng), unit),
        "black_plastic": Material(tex.plain("#141415"), unit, 0.04, 0.15),
        "grey_plastic": Material(tex.plain("#6d7074"), unit, 0.04, 0.2),
        "dark_metal": Material(tex.plain("#2c2d30"), unit, 0.04, 0.2),
        "steel": Material(tex.brushed_metal(rng, "#b4b7ba"), (0.6, 0.6), 0.22, 0.12),
        "chrome": Material(tex.plain("#9da1a5"), unit, 0.45, 0.03),
        "aluminium": Material(tex.plain("#aeb1b5"), unit, 0.15, 0.2),
        "white_enamel": Material(tex.plain("#e4e5e3"), unit, 0.045, 0.08),
        "cabinet_white": Material(tex.plain("#d9d7cf"), unit, 0.03, 0.2),
        "cabinet_blue": Material(tex.plain("#4e6a7a"), unit, 0.03, 0.2),
        "worktop": Material(tex.marble(rng), (0.8, 0.8), 0.04, 0.06),
        "cooktop": Material(tex.plain("#0d0d0f"), unit, 0.05, 0.04),
        "oven_front": Material(tex.oven_front(), unit, 0.05, 0.06),
        "microwave_front": Material(tex.microwave_front(), unit, 0.05, 0.06),
        "tv_screen": Material(tex.landscape(rng), unit, 0.03, 0.03, emission=0.75),
        "laptop_screen": Material(tex.desktop(rng), unit, 0.02, 0.1, emission=0.85),
        "keyboard": Material(tex.keyboard(), unit, 0.02, 0.3),
        "painting": Material(tex.abstract_painting(rng), unit),
        "clock_face": Material(tex.clock_face(), unit, 0.02, 0.05),
        "ceramic_white": Material(tex.plain("#e9e6df"), unit, 0.05, 0.06),
        "ceramic_red": Material(tex.plain("#b52a22"), unit, 0.05, 0.06),
        "ceramic_blue": Material(tex.plain("#2f5fa8"), unit, 0.05, 0.06),
        "ceramic_teal": Material(tex.plain("#2f7f7c"), unit, 0.05, 0.06),
        "terracotta": Material(tex.orange_peel(rng, "#b5613c", "#8a4226"), (0.4, 0.4)),
        "coffee": Material(tex.plain("#2a150a"), unit, 0.03, 0.02),
        "bottle_green": Material(tex.plain("#0f2d16"), unit, 0.08, 0.03),
        "bottle_foil": Material(tex.plain("#7d1526"), unit, 0.15, 0.2),
        "label": Material(tex.label(rng), unit),
        "soap_blue": Material(tex.plain("#3f86c4"), unit, 0.05, 0.08),
        "orange": Material(tex.orange_peel(rng, "#f08a1c", "#d8670e"), (0.15, 0.15), 0.03, 0.25),
        "apple": Material(tex.orange_peel(rng, "#b3161c", "#d8a534"), (0.25, 0.25), 0.045, 0.1),
        "banana": Material(tex.orange_peel(rng, "#efc62e", "#d2a51f"), (0.2, 0.2), 0.02, 0.3),
        "banana_tip": Material(tex.plain("#4a3a16"), unit),
        "soil": Material(tex.soil(rng), (0.2, 0.2)),
        "leaf": Material(tex.leaf_green(rng), unit, 0.03, 0.3, two_sided=True),
        "leaf_young": Material(
            tex.leaf_green(rng, "#93c653", "#3f7a2a"), unit, 0.03, 0.3, two_sided=True
        ),
        "stem": Material(tex.plain("#4f6b2a"), unit),
        "petal_red": Material(tex.plain("#d8344a"), unit, two_sided=True),
        "petal_yellow": Material(tex.plain("#f2c230"), unit, two_sided=True),
        "petal_white": Material(tex.plain("#f3ece4"), unit, two_sided=True),
        "paper": Material(tex.paper_edge(rng), (0.1, 0.1)),
        "garden": Material(tex.garden(rng), unit, emission=2.05, sensed=False),
        "lamp_glow": Material(tex.plain("#fff3dd"), unit, emission=9.0),
    }
    for i, (base, ink, title) in enumerate(BOOK_COLOURS):
        materials[f"cover_{i}"] = Material(tex.book_cover(rng, base, ink, title), unit, 0.02, 0.3)
        materials[f"spine_{i}"] = Material(tex.book_spine(base, ink, title), unit, 0.02, 0.3)
        materials[f"cloth_{i}"] = Material(tex.plain(base), unit, 0.02, 0.3)
    return materials
