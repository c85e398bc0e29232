"""Tables, seats and storage furniture without joints. Template frame: origin on the floor, +x to the front."""

from __future__ import annotations

from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.shapes import box, look, rounded_box, span
from mjhab.scenes.spec import Geom, Prop, Receptacle


def living_props() -> tuple[Prop, ...]:
    """Return all templates of this module."""
    return (
        _table_01(),
        _table_02(),
        _table_03(),
        _chair_01(),
        _sofa(),
        _tvstand(),
        _tv(),
        _bed(),
        _cabinet(),
        _chest_of_drawers(),
        _cupboard(),
        _sideboard(),
        _bookshelf(),
    )


def living_meshes() -> dict[str, Mesh]:
    """Return the meshes of the templates of this module by name: cushions, seats and the like."""
    return {
        "sofa_base": rounded_box((0.88, 1.90, 0.22), 0.03),
        "sofa_seat": rounded_box((0.64, 0.76, 0.16), 0.05),
        "sofa_back": rounded_box((0.20, 0.76, 0.42), 0.07),
        "sofa_arm": rounded_box((0.86, 0.18, 0.44), 0.05),
        "pillow": rounded_box((0.12, 0.40, 0.38), 0.06, 3),
        "bed_mattress": rounded_box((2.00, 1.44, 0.20), 0.05),
        "bed_blanket": rounded_box((1.36, 1.54, 0.14), 0.05),
        "bed_pillow": rounded_box((0.42, 0.62, 0.14), 0.07, 3),
        "chair_seat": rounded_box((0.44, 0.46, 0.045), 0.02),
        "chair_back": rounded_box((0.03, 0.44, 0.20), 0.015),
    }


def _legs(
    x: float, y: float, height: float, thick: float, material: str, collide: bool = True
) -> list[Geom]:
    return [
        box(
            (sx * x, sy * y, height / 2),
            (thick, thick, height),
            material,
            collide=collide,
        )
        for sx in (-1.0, 1.0)
        for sy in (-1.0, 1.0)
    ]


def _table_01() -> Prop:
    """The dining table, 0.85 x 1.40 m, top at 0.75 m; thin legs at the corners let a base come close."""
    geoms = [
        box((0.0, 0.0, 0.732), (0.85, 1.40, 0.036), "oak"),
        *_legs(0.375, 0.65, 0.714, 0.055, "oak"),
        box((0.0, 0.0, 0.68), (0.72, 1.27, 0.06), "oak", collide=False),
    ]
    return Prop(
        "table_01",
        tuple(geoms),
        (Receptacle("top", (0.0, 0.0, 0.75), (0.37, 0.64), 0.8),),
    )


def _table_02() -> Prop:
    """The coffee table, 0.70 x 1.20 m, top at 0.45 m, with a lower board."""
    geoms = [
        box((0.0, 0.0, 0.435), (0.70, 1.20, 0.03), "walnut"),
        box((0.0, 0.0, 0.15), (0.62, 1.10, 0.02), "walnut"),
        *_legs(0.31, 0.56, 0.42, 0.04, "black_metal"),
        box((0.05, 0.22, 0.172), (0.22, 0.16, 0.022), "book_blue", collide=False),
        box((0.05, 0.21, 0.193), (0.20, 0.15, 0.020), "book_yellow", collide=False),
    ]
    return Prop(
        "table_02",
        tuple(geoms),
        (Receptacle("top", (0.0, 0.0, 0.45), (0.30, 0.54), 0.8),),
    )


def _table_03() -> Prop:
    """A desk against a wall, 0.60 x 1.20 m, with a laptop-sized screen and a lamp as decoration."""
    geoms = [
        box((0.0, 0.0, 0.735), (0.60, 1.20, 0.03), "birch"),
        *_legs(0.27, 0.57, 0.72, 0.04, "white_lacquer"),
        box((0.0, 0.40, 0.60), (0.50, 0.36, 0.22), "white_lacquer"),
        box((0.254, 0.40, 0.60), (0.006, 0.10, 0.012), "black_metal", collide=False),
        box((-0.20, 0.0, 1.0), (0.025, 0.56, 0.34), "black_glass"),
        box((-0.20, 0.0, 0.80), (0.03, 0.08, 0.10), "black_metal", collide=False),
        box((-0.18, 0.0, 0.756), (0.16, 0.24, 0.012), "black_metal", collide=False),
        box((0.08, 0.0, 0.757), (0.13, 0.40, 0.014), "white_lacquer", collide=False),
    ]
    return Prop("table_03", tuple(geoms))


def _chair_01() -> Prop:
    """A chair: seat at 0.46 m, back at the rear (-x)."""
    geoms = [
        # Boxes collide, rounded meshes are seen: a mesh of rounded edges would cost far more contacts.
        box((0.0, 0.0, 0.4375), (0.44, 0.46, 0.045), "birch", visual=False),
        box((-0.205, 0.0, 0.78), (0.03, 0.44, 0.20), "birch", visual=False),
        look("chair_seat", "birch", (0.0, 0.0, 0.4375)),
        look("chair_back", "birch", (-0.205, 0.0, 0.78)),
        box((0.0, 0.0, 0.34), (0.36, 0.38, 0.03), "walnut", collide=False),
    ]
    for sy in (-1.0, 1.0):
        geoms.append(box((0.19, sy * 0.2, 0.2075), (0.034, 0.034, 0.415), "walnut"))
        geoms.append(box((-0.20, sy * 0.2, 0.43), (0.034, 0.034, 0.86), "walnut"))
    return Prop(
        "chair_01",
        tuple(geoms),
        (Receptacle("seat", (0.015, 0.0, 0.46), (0.175, 0.19), 0.6),),
    )


def _sofa() -> Prop:
    """A sofa for two, 0.95 x 1.95 m, seat at 0.44 m."""
    geoms = [
        box((0.0, 0.0, 0.23), (0.94, 1.94, 0.42), "sofa_fabric", visual=False),
        box((-0.36, 0.0, 0.60), (0.22, 1.94, 0.40), "sofa_fabric", visual=False),
        box((0.0, -0.875, 0.52), (0.90, 0.19, 0.22), "sofa_fabric", visual=False),
        box((0.0, 0.875, 0.52), (0.90, 0.19, 0.22), "sofa_fabric", visual=False),
        look("sofa_base", "sofa_fabric_dark", (0.0, 0.0, 0.17)),
        box((-0.42, 0.0, 0.45), (0.09, 1.58, 0.62), "sofa_fabric_dark", collide=False),
    ]
    for side in (-1.0, 1.0):
        geoms.append(look("sofa_seat", "sofa_fabric", (0.14, side * 0.39, 0.36)))
        geoms.append(look("sofa_back", "sofa_fabric", (-0.30, side * 0.39, 0.62)))
        geoms.append(look("sofa_arm", "sofa_fabric_dark", (0.0, side * 0.875, 0.41)))
    geoms += [
        look("pillow", "cushion_mustard", (-0.15, 0.58, 0.60), (0.966, 0.0, -0.17, 0.10)),
        look("pillow", "cushion_coral", (-0.15, -0.60, 0.60), (0.966, 0.0, -0.17, -0.10)),
        box((-0.13, 0.58, 0.60), (0.14, 0.36, 0.32), "cushion_mustard", visual=False),
        box((-0.13, -0.60, 0.60), (0.14, 0.36, 0.32), "cushion_coral", visual=False),
        *_legs(0.38, 0.85, 0.06, 0.05, "walnut", collide=False),
    ]
    return Prop(
        "sofa", tuple(geoms), (Receptacle("seat", (0.20, 0.0, 0.44), (0.22, 0.68), 0.6),)
    )


def _tvstand() -> Prop:
    """A low stand, 0.45 x 1.60 m, top at 0.50 m; the screen hangs on the wall above."""
    geoms = [
        box((0.0, 0.0, 0.28), (0.45, 1.60, 0.44), "oak"),
        *_legs(0.18, 0.74, 0.06, 0.04, "black_metal", False),
    ]
    for y in (-0.53, 0.53):
        geoms.append(
            box((0.227, y, 0.28), (0.008, 0.50, 0.38), "white_lacquer", collide=False)
        )
        geoms.append(
            box(
                (0.236, y - 0.18 * (1 if y > 0 else -1), 0.38),
                (0.012, 0.06, 0.012),
                "brass",
                collide=False,
            )
        )
    geoms.append(
        box((0.226, 0.0, 0.28), (0.006, 0.52, 0.38), "black_metal", collide=False)
    )
    geoms.append(
        box((0.231, 0.0, 0.26), (0.008, 0.42, 0.06), "black_glass", collide=False)
    )
    return Prop(
        "tvstand",
        tuple(geoms),
        (Receptacle("top", (0.01, 0.0, 0.50), (0.19, 0.74), 0.35),),
    )


def _tv() -> Prop:
    """A flat screen on the wall behind it, its lower edge at 0.95 m."""
    geoms = [
        box((0.0, 0.0, 1.30), (0.05, 1.24, 0.70), "black_metal"),
        box((0.026, 0.0, 1.305), (0.004, 1.20, 0.66), "black_glass", collide=False),
    ]
    return Prop("tv", tuple(geoms))


def _bed() -> Prop:
    """A bed, 2.05 x 1.60 m, head at the rear."""
    geoms = [
        box((0.0, 0.0, 0.27), (2.05, 1.56, 0.54), "bed_linen", visual=False),
        box((-1.02, 0.0, 0.52), (0.06, 1.60, 1.04), "oak"),
        box((0.0, 0.0, 0.20), (2.04, 1.54, 0.20), "oak", collide=False),
        look("bed_mattress", "bed_linen", (0.02, 0.0, 0.40)),
        look("bed_blanket", "bed_blanket", (0.36, 0.0, 0.46)),
        look("bed_pillow", "cushion_cream", (-0.70, 0.35, 0.55), (0.98, 0.0, -0.2, 0.0)),
        look("bed_pillow", "cushion_cream", (-0.70, -0.35, 0.55), (0.98, 0.0, -0.2, 0.0)),
        *_legs(0.95, 0.70, 0.10, 0.07, "oak", collide=False),
    ]
    return Prop("bed", tuple(geoms))


def _fronts(
    x: float,
    y: tuple[float, float],
    z: tuple[float, float],
    grid: tuple[int, int],
    material: str,
    knob: str,
) -> list[Geom]:
    """Door or drawer fronts drawn on a closed box, in a grid of rows and columns, with small knobs."""
    rows, columns = grid
    geoms = []
    dy = (y[1] - y[0]) / columns
    dz = (z[1] - z[0]) / rows
    gap = 0.008
    for r in range(rows):
        for c in range(columns):
            y0 = y[0] + c * dy
            z0 = z[0] + r * dz
            geoms.append(
                span(
                    (x, x + 0.012),
                    (y0 + gap / 2, y0 + dy - gap / 2),
                    (z0 + gap / 2, z0 + dz - gap / 2),
                    material,
                    collide=False,
                )
            )
            # Knobs of neighbours face each other, as on a cupboard with two doors.
            toward = 0.5 if columns == 1 else (0.88 if c < columns / 2 else 0.12)
            height = 0.5 if rows > 1 else 0.55
            geoms.append(
                box(
                    (x + 0.02, y0 + toward * dy, z0 + height * dz),
                    (0.018, 0.03, 0.03),
                    knob,
                    collide=False,
                )
            )
    return geoms


def _cabinet() -> Prop:
    """A wardrobe, 0.55 x 1.00 x 1.95 m."""
    geoms = [box((0.0, 0.0, 0.975), (0.55, 1.00, 1.95), "birch")]
    geoms += _fronts(0.275, (-0.49, 0.49), (0.06, 1.93), (1, 2), "white_lacquer", "brass")
    return Prop("cabinet", tuple(geoms))


def _chest_of_drawers() -> Prop:
    """A chest of drawers without joints, 0.45 x 0.90 x 0.85 m."""
    geoms = [box((0.0, 0.0, 0.425), (0.45, 0.90, 0.85), "walnut")]
    geoms += _fronts(0.225, (-0.43, 0.43), (0.05, 0.82), (3, 2), "oak", "brass")
    return Prop("chest_of_drawers", tuple(geoms))


def _cupboard() -> Prop:
    """A tall kitchen cupboard without joints, 0.40 x 0.80 x 2.00 m."""
    geoms = [box((0.0, 0.0, 1.0), (0.40, 0.80, 2.0), "cabinet_carcass")]
    geoms += _fronts(0.20, (-0.39, 0.39), (0.08, 1.98), (2, 2), "cabinet_front", "brass")
    return Prop("kitchen_cupboard_01", tuple(geoms))


def _sideboard() -> Prop:
    """A low cabinet, 0.40 x 1.20 x 0.70 m."""
    geoms = [box((0.0, 0.0, 0.36), (0.40, 1.20, 0.68), "white_lacquer")]
    geoms += _fronts(0.20, (-0.58, 0.58), (0.06, 0.66), (1, 3), "oak", "black_metal")
    geoms.append(box((0.0, 0.0, 0.705), (0.42, 1.22, 0.02), "oak", collide=False))
    return Prop("wall_cabinet_01", tuple(geoms))


def _bookshelf() -> Prop:
    """An open shelf full of books, 0.30 x 0.90 x 1.80 m; it collides as one box."""
    geoms = [
        box((0.0, 0.0, 0.90), (0.30, 0.90, 1.80), "oak", visual=False),
        box((-0.14, 0.0, 0.90), (0.02, 0.90, 1.80), "oak", collide=False),
    ]
    for y in (-0.44, 0.44):
        geoms.append(box((0.0, y, 0.90), (0.30, 0.02, 1.80), "oak", collide=False))
    colors = (
        "book_red",
        "book_blue",
        "book_green",
        "book_yellow",
        "picture_paper",
        "book_blue",
        "cushion_coral",
    )
    for level in range(6):
        z = 0.05 + level * 0.348
        geoms.append(box((0.0, 0.0, z), (0.30, 0.88, 0.02), "oak", collide=False))
        if level < 5:
            geoms += _books(level, z + 0.01, colors)
    return Prop("bookshelf", tuple(geoms))


def _books(level: int, z: float, colors: tuple[str, ...]) -> list[Geom]:
    geoms: list[Geom] = []
    y = -0.40 + 0.09 * (level % 3)
    k = level * 5
    while y < 0.36 - 0.14 * (level % 2):
        # Sums instead of random numbers, so that the pack is the same on every machine without a seed.
        thick = 0.028 + 0.011 * ((k * 7) % 4)
        height = 0.20 + 0.018 * ((k * 5) % 5)
        geoms.append(
            box(
                (0.0, y + thick / 2, z + height / 2),
                (0.20, thick - 0.003, height),
                colors[k % len(colors)],
                collide=False,
            )
        )
        y = y + thick
        k += 1
    return geoms
