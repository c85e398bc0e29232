"""Materials of surfaces by name, with procedural patterns instead of texture files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Pattern = Literal["plain", "wood", "planks", "tiles", "fabric", "stripes"]
MaterialKind = Literal["", "metal", "glass"]


@dataclass(frozen=True)
class Material:
    """A material.

    ``color``: sRGB 0..1; ``pattern``: a key of `render.patterns.PERIODS`, or "plain"; ``color2``: second colour of the
    pattern, None for a darker shade of the first; ``scale``: unit of length of the pattern [m]; ``gloss``: 0..1;
    ``kind``: what light does with it where it is traced (`render.path_tracer`), "" for paint, wood, stone and fabric.
    """

    color: tuple[float, float, float]
    pattern: Pattern = "plain"
    color2: tuple[float, float, float] | None = None
    scale: float = 0.1
    gloss: float = 0.1
    kind: MaterialKind = ""


MATERIALS: dict[str, Material] = {
    # walls, floors, building parts
    "plain_white": Material((0.93, 0.93, 0.91)),
    "wall_white": Material((0.87, 0.85, 0.81), gloss=0.02),
    "wall_sage": Material((0.72, 0.77, 0.69), gloss=0.02),
    "wall_blue": Material((0.66, 0.74, 0.80), gloss=0.02),
    "wall_sand": Material((0.82, 0.75, 0.64), gloss=0.02),
    "wall_rose": Material((0.85, 0.73, 0.69), gloss=0.02),
    "floor_oak": Material((0.72, 0.54, 0.36), "planks", (0.64, 0.46, 0.30), 0.14, 0.2),
    "floor_walnut": Material((0.47, 0.33, 0.23), "planks", (0.40, 0.27, 0.18), 0.14, 0.2),
    "floor_ash": Material((0.70, 0.61, 0.48), "planks", (0.63, 0.54, 0.41), 0.16, 0.2),
    "floor_tile": Material((0.69, 0.67, 0.62), "tiles", (0.56, 0.54, 0.50), 0.4, 0.3),
    "floor_slate": Material((0.42, 0.44, 0.46), "tiles", (0.33, 0.35, 0.37), 0.45, 0.3),
    "floor_carpet": Material((0.62, 0.60, 0.57), "fabric", (0.56, 0.54, 0.51), 0.02, 0.0),
    "trim_white": Material((0.96, 0.96, 0.95), gloss=0.2),
    "window_glass": Material((0.62, 0.80, 0.93), gloss=0.8, kind="glass"),
    "curtain": Material((0.90, 0.87, 0.80), "stripes", (0.84, 0.80, 0.72), 0.08, 0.0),
    # kitchen
    "worktop": Material((0.60, 0.44, 0.29), "wood", (0.52, 0.37, 0.23), 0.12, 0.3),
    "cabinet_front": Material((0.30, 0.42, 0.43), gloss=0.25),
    "cabinet_carcass": Material((0.88, 0.87, 0.84), gloss=0.1),
    "cabinet_plinth": Material((0.16, 0.17, 0.18)),
    "drawer_inside": Material((0.86, 0.80, 0.70), "wood", (0.81, 0.74, 0.63), 0.1),
    "steel": Material((0.74, 0.75, 0.77), gloss=0.7, kind="metal"),
    "brass": Material((0.78, 0.62, 0.33), gloss=0.6, kind="metal"),
    "backsplash": Material((0.93, 0.93, 0.90), "tiles", (0.78, 0.79, 0.78), 0.1, 0.5),
    "fridge_body": Material((0.60, 0.62, 0.64), gloss=0.4),
    "fridge_door": Material((0.76, 0.78, 0.80), gloss=0.5, kind="metal"),
    "fridge_inside": Material((0.95, 0.97, 0.98), gloss=0.3),
    "fridge_shelf": Material((0.80, 0.90, 0.94), gloss=0.5),
    "fridge_bin": Material((0.86, 0.93, 0.96), gloss=0.4),
    # furniture
    "oak": Material((0.76, 0.60, 0.42), "wood", (0.69, 0.52, 0.35), 0.1, 0.2),
    "walnut": Material((0.44, 0.30, 0.20), "wood", (0.37, 0.24, 0.15), 0.1, 0.25),
    "birch": Material((0.88, 0.78, 0.62), "wood", (0.83, 0.72, 0.55), 0.1, 0.2),
    "white_lacquer": Material((0.92, 0.92, 0.91), gloss=0.4),
    "black_metal": Material((0.12, 0.12, 0.13), gloss=0.3, kind="metal"),
    "black_glass": Material((0.04, 0.05, 0.06), gloss=0.8),
    "sofa_fabric": Material((0.35, 0.44, 0.53), "fabric", (0.30, 0.39, 0.48), 0.015, 0.0),
    "sofa_fabric_dark": Material(
        (0.27, 0.35, 0.43), "fabric", (0.24, 0.31, 0.39), 0.015, 0.0
    ),
    "cushion_mustard": Material(
        (0.83, 0.63, 0.24), "fabric", (0.77, 0.57, 0.20), 0.015, 0.0
    ),
    "cushion_coral": Material(
        (0.80, 0.45, 0.36), "fabric", (0.74, 0.40, 0.32), 0.015, 0.0
    ),
    "cushion_cream": Material(
        (0.90, 0.86, 0.77), "fabric", (0.84, 0.80, 0.70), 0.015, 0.0
    ),
    "beanbag_fabric": Material(
        (0.71, 0.36, 0.27), "fabric", (0.65, 0.32, 0.24), 0.02, 0.0
    ),
    "bed_linen": Material((0.88, 0.89, 0.92), "stripes", (0.80, 0.83, 0.88), 0.12, 0.0),
    "bed_blanket": Material((0.42, 0.53, 0.50), "fabric", (0.37, 0.48, 0.45), 0.02, 0.0),
    "rug_red": Material((0.62, 0.29, 0.25), "stripes", (0.82, 0.73, 0.60), 0.18, 0.0),
    "rug_blue": Material((0.35, 0.45, 0.56), "stripes", (0.78, 0.79, 0.76), 0.24, 0.0),
    "rug_border": Material((0.83, 0.77, 0.66), "fabric", (0.77, 0.71, 0.60), 0.02, 0.0),
    "mat_grey": Material((0.36, 0.36, 0.37), "fabric", (0.30, 0.30, 0.31), 0.02, 0.0),
    "leaf_green": Material((0.25, 0.47, 0.22), gloss=0.2),
    "leaf_light": Material((0.42, 0.60, 0.28), gloss=0.2),
    "terracotta": Material((0.73, 0.42, 0.29)),
    "pot_white": Material((0.90, 0.89, 0.86), gloss=0.3),
    "soil": Material((0.24, 0.17, 0.12)),
    "lamp_shade": Material((0.98, 0.93, 0.78), "fabric", (0.95, 0.89, 0.72), 0.02, 0.0),
    "picture_sky": Material((0.55, 0.72, 0.83)),
    "picture_sun": Material((0.93, 0.70, 0.32)),
    "picture_hill": Material((0.33, 0.49, 0.42)),
    "picture_paper": Material((0.95, 0.93, 0.88)),
    "book_red": Material((0.67, 0.20, 0.18)),
    "book_blue": Material((0.20, 0.34, 0.55)),
    "book_green": Material((0.25, 0.45, 0.34)),
    "book_yellow": Material((0.87, 0.71, 0.30)),
    # objects
    "label_white": Material((0.95, 0.94, 0.90), gloss=0.3),
    "coffee_blue": Material((0.13, 0.27, 0.56), gloss=0.4),
    "coffee_lid": Material((0.16, 0.20, 0.36), gloss=0.3),
    "cracker_red": Material((0.80, 0.12, 0.12), gloss=0.3),
    "cracker_orange": Material((0.93, 0.62, 0.25), gloss=0.3),
    "sugar_yellow": Material((0.96, 0.79, 0.16), gloss=0.3),
    "sugar_blue": Material((0.15, 0.30, 0.62), gloss=0.3),
    "soup_red": Material((0.78, 0.11, 0.13), gloss=0.4),
    "soup_gold": Material((0.83, 0.68, 0.28), gloss=0.5),
    "tuna_blue": Material((0.18, 0.42, 0.66), gloss=0.4),
    "pudding_brown": Material((0.40, 0.23, 0.14), gloss=0.3),
    "gelatin_red": Material((0.74, 0.16, 0.22), gloss=0.3),
    "meat_blue": Material((0.10, 0.20, 0.47), gloss=0.4),
    "meat_yellow": Material((0.95, 0.80, 0.25), gloss=0.3),
    "tin": Material((0.78, 0.78, 0.76), gloss=0.7, kind="metal"),
    "apple_red": Material((0.73, 0.13, 0.12), gloss=0.4),
    "apple_stem": Material((0.33, 0.22, 0.12)),
    "bowl_red": Material((0.76, 0.20, 0.17), gloss=0.5),
    "bowl_inside": Material((0.83, 0.28, 0.23), gloss=0.5),
}
"""Materials of the built-in pack by name."""
