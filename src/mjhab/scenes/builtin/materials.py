"""Materials of surfaces by name, with procedural patterns instead of texture files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Pattern = Literal["plain", "wood", "planks", "tiles", "fabric", "stripes"]


@dataclass(frozen=True)
class Material:
    """A material.

    ``color``: sRGB 0..1; ``pattern``: a key of `render.patterns.PERIODS`, or "plain"; ``color2``: second colour of the
    pattern, None for a darker shade of the first; ``scale``: unit of length of the pattern [m]; ``gloss``: 0..1.
    """

    color: tuple[float, float, float]
    pattern: Pattern = "plain"
    color2: tuple[float, float, float] | None = None
    scale: float = 0.1
    gloss: float = 0.1


def _m(
    r: float,
    g: float,
    b: float,
    pattern: Pattern = "plain",
    color2: tuple[float, float, float] | None = None,
    scale: float = 0.1,
    gloss: float = 0.1,
) -> Material:
    return Material((r, g, b), pattern, color2, scale, gloss)


MATERIALS: dict[str, Material] = {
    # walls, floors, building parts
    "plain_white": _m(0.93, 0.93, 0.91),
    "wall_white": _m(0.87, 0.85, 0.81, gloss=0.02),
    "wall_sage": _m(0.72, 0.77, 0.69, gloss=0.02),
    "wall_blue": _m(0.66, 0.74, 0.80, gloss=0.02),
    "wall_sand": _m(0.82, 0.75, 0.64, gloss=0.02),
    "wall_rose": _m(0.85, 0.73, 0.69, gloss=0.02),
    "floor_oak": _m(0.72, 0.54, 0.36, "planks", (0.64, 0.46, 0.30), 0.14, 0.2),
    "floor_walnut": _m(0.47, 0.33, 0.23, "planks", (0.40, 0.27, 0.18), 0.14, 0.2),
    "floor_ash": _m(0.70, 0.61, 0.48, "planks", (0.63, 0.54, 0.41), 0.16, 0.2),
    "floor_tile": _m(0.69, 0.67, 0.62, "tiles", (0.56, 0.54, 0.50), 0.4, 0.3),
    "floor_slate": _m(0.42, 0.44, 0.46, "tiles", (0.33, 0.35, 0.37), 0.45, 0.3),
    "floor_carpet": _m(0.62, 0.60, 0.57, "fabric", (0.56, 0.54, 0.51), 0.02, 0.0),
    "trim_white": _m(0.96, 0.96, 0.95, gloss=0.2),
    "window_glass": _m(0.62, 0.80, 0.93, gloss=0.8),
    "curtain": _m(0.90, 0.87, 0.80, "stripes", (0.84, 0.80, 0.72), 0.08, 0.0),
    # kitchen
    "worktop": _m(0.60, 0.44, 0.29, "wood", (0.52, 0.37, 0.23), 0.12, 0.3),
    "cabinet_front": _m(0.30, 0.42, 0.43, gloss=0.25),
    "cabinet_carcass": _m(0.88, 0.87, 0.84, gloss=0.1),
    "cabinet_plinth": _m(0.16, 0.17, 0.18),
    "drawer_inside": _m(0.86, 0.80, 0.70, "wood", (0.81, 0.74, 0.63), 0.1),
    "steel": _m(0.74, 0.75, 0.77, gloss=0.7),
    "brass": _m(0.78, 0.62, 0.33, gloss=0.6),
    "backsplash": _m(0.93, 0.93, 0.90, "tiles", (0.78, 0.79, 0.78), 0.1, 0.5),
    "fridge_body": _m(0.60, 0.62, 0.64, gloss=0.4),
    "fridge_door": _m(0.76, 0.78, 0.80, gloss=0.5),
    "fridge_inside": _m(0.95, 0.97, 0.98, gloss=0.3),
    "fridge_shelf": _m(0.80, 0.90, 0.94, gloss=0.5),
    "fridge_bin": _m(0.86, 0.93, 0.96, gloss=0.4),
    # furniture
    "oak": _m(0.76, 0.60, 0.42, "wood", (0.69, 0.52, 0.35), 0.1, 0.2),
    "walnut": _m(0.44, 0.30, 0.20, "wood", (0.37, 0.24, 0.15), 0.1, 0.25),
    "birch": _m(0.88, 0.78, 0.62, "wood", (0.83, 0.72, 0.55), 0.1, 0.2),
    "white_lacquer": _m(0.92, 0.92, 0.91, gloss=0.4),
    "black_metal": _m(0.12, 0.12, 0.13, gloss=0.3),
    "black_glass": _m(0.04, 0.05, 0.06, gloss=0.8),
    "sofa_fabric": _m(0.35, 0.44, 0.53, "fabric", (0.30, 0.39, 0.48), 0.015, 0.0),
    "sofa_fabric_dark": _m(0.27, 0.35, 0.43, "fabric", (0.24, 0.31, 0.39), 0.015, 0.0),
    "cushion_mustard": _m(0.83, 0.63, 0.24, "fabric", (0.77, 0.57, 0.20), 0.015, 0.0),
    "cushion_coral": _m(0.80, 0.45, 0.36, "fabric", (0.74, 0.40, 0.32), 0.015, 0.0),
    "cushion_cream": _m(0.90, 0.86, 0.77, "fabric", (0.84, 0.80, 0.70), 0.015, 0.0),
    "beanbag_fabric": _m(0.71, 0.36, 0.27, "fabric", (0.65, 0.32, 0.24), 0.02, 0.0),
    "bed_linen": _m(0.88, 0.89, 0.92, "stripes", (0.80, 0.83, 0.88), 0.12, 0.0),
    "bed_blanket": _m(0.42, 0.53, 0.50, "fabric", (0.37, 0.48, 0.45), 0.02, 0.0),
    "rug_red": _m(0.62, 0.29, 0.25, "stripes", (0.82, 0.73, 0.60), 0.18, 0.0),
    "rug_blue": _m(0.35, 0.45, 0.56, "stripes", (0.78, 0.79, 0.76), 0.24, 0.0),
    "rug_border": _m(0.83, 0.77, 0.66, "fabric", (0.77, 0.71, 0.60), 0.02, 0.0),
    "mat_grey": _m(0.36, 0.36, 0.37, "fabric", (0.30, 0.30, 0.31), 0.02, 0.0),
    "leaf_green": _m(0.25, 0.47, 0.22, gloss=0.2),
    "leaf_light": _m(0.42, 0.60, 0.28, gloss=0.2),
    "terracotta": _m(0.73, 0.42, 0.29),
    "pot_white": _m(0.90, 0.89, 0.86, gloss=0.3),
    "soil": _m(0.24, 0.17, 0.12),
    "lamp_shade": _m(0.98, 0.93, 0.78, "fabric", (0.95, 0.89, 0.72), 0.02, 0.0),
    "picture_sky": _m(0.55, 0.72, 0.83),
    "picture_sun": _m(0.93, 0.70, 0.32),
    "picture_hill": _m(0.33, 0.49, 0.42),
    "picture_paper": _m(0.95, 0.93, 0.88),
    "book_red": _m(0.67, 0.20, 0.18),
    "book_blue": _m(0.20, 0.34, 0.55),
    "book_green": _m(0.25, 0.45, 0.34),
    "book_yellow": _m(0.87, 0.71, 0.30),
    # objects
    "label_white": _m(0.95, 0.94, 0.90, gloss=0.3),
    "coffee_blue": _m(0.13, 0.27, 0.56, gloss=0.4),
    "coffee_lid": _m(0.16, 0.20, 0.36, gloss=0.3),
    "cracker_red": _m(0.80, 0.12, 0.12, gloss=0.3),
    "cracker_orange": _m(0.93, 0.62, 0.25, gloss=0.3),
    "sugar_yellow": _m(0.96, 0.79, 0.16, gloss=0.3),
    "sugar_blue": _m(0.15, 0.30, 0.62, gloss=0.3),
    "soup_red": _m(0.78, 0.11, 0.13, gloss=0.4),
    "soup_gold": _m(0.83, 0.68, 0.28, gloss=0.5),
    "tuna_blue": _m(0.18, 0.42, 0.66, gloss=0.4),
    "pudding_brown": _m(0.40, 0.23, 0.14, gloss=0.3),
    "gelatin_red": _m(0.74, 0.16, 0.22, gloss=0.3),
    "meat_blue": _m(0.10, 0.20, 0.47, gloss=0.4),
    "meat_yellow": _m(0.95, 0.80, 0.25, gloss=0.3),
    "tin": _m(0.78, 0.78, 0.76, gloss=0.7),
    "apple_red": _m(0.73, 0.13, 0.12, gloss=0.4),
    "apple_stem": _m(0.33, 0.22, 0.12),
    "bowl_red": _m(0.76, 0.20, 0.17, gloss=0.5),
    "bowl_inside": _m(0.83, 0.28, 0.23, gloss=0.5),
}
"""Materials of the built-in pack by name."""
