"""Decoration: plants, rugs, lamps, pictures, windows, doors and their frames, bins."""

from __future__ import annotations

from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.shapes import ball, box, foliage, lathe, look, rod, span
from mjhab.scenes.spec import Geom, Prop


def decor_props() -> tuple[Prop, ...]:
    """Return all templates of this module."""
    return (
        _plant("indoor_plant_01", "plant_tall", 0.16, 0.34, "terracotta"),
        _plant("indoor_plant_02", "plant_bush", 0.14, 0.30, "pot_white"),
        _beanbag(),
        _lamp(),
        _rug("rug_01", 2.0, 2.8, "rug_red"),
        _rug("rug_02", 1.4, 2.0, "rug_blue"),
        _rug("mat", 0.5, 0.9, "mat_grey"),
        _wall_shelf(),
        _picture("picture_01"),
        _picture("picture_02"),
        _window(),
        _front_door(),
        _inner_frame(),
        _bin(),
    )


def decor_meshes() -> dict[str, Mesh]:
    """Return the meshes of the templates of this module by name."""
    return {
        "plant_tall": foliage(1, 26, 0.34, 1.05, 0.10),
        "plant_bush": foliage(2, 34, 0.30, 0.50, 0.08),
        "plant_small": foliage(3, 18, 0.11, 0.17, 0.03),
        "pot_tall": lathe(
            [
                (0.0, 0.0),
                (0.12, 0.0),
                (0.16, 0.34),
                (0.14, 0.34),
                (0.14, 0.30),
                (0.0, 0.30),
            ]
        ),
        "pot_bush": lathe(
            [
                (0.0, 0.0),
                (0.10, 0.0),
                (0.14, 0.12),
                (0.14, 0.30),
                (0.12, 0.30),
                (0.12, 0.27),
                (0.0, 0.27),
            ]
        ),
        "beanbag": lathe(
            [
                (0.0, 0.0),
                (0.34, 0.02),
                (0.40, 0.12),
                (0.39, 0.24),
                (0.33, 0.38),
                (0.22, 0.52),
                (0.10, 0.62),
                (0.04, 0.66),
                (0.0, 0.66),
            ],
            28,
        ),
        "lamp_shade": lathe([(0.19, 1.32), (0.12, 1.62), (0.11, 1.62), (0.18, 1.32)]),
        "vase": lathe(
            [
                (0.0, 0.0),
                (0.05, 0.0),
                (0.075, 0.08),
                (0.06, 0.16),
                (0.03, 0.21),
                (0.04, 0.25),
                (0.03, 0.25),
                (0.02, 0.21),
                (0.0, 0.20),
            ]
        ),
    }


def _plant(name: str, leaves: str, radius: float, height: float, pot: str) -> Prop:
    """A plant: pot and stem collide, leaves are visual only."""
    tall = leaves == "plant_tall"
    top = 1.35 if tall else 0.75
    geoms = [
        # Collision shapes are plain: leaves would make hundreds of contacts, and a base must not drive through a stem.
        rod((0.0, 0.0, height / 2), (radius, height), pot, visual=False),
        rod(
            (0.0, 0.0, (height + top) / 2),
            (0.10, top - height),
            "leaf_green",
            visual=False,
        ),
        look("pot_tall" if tall else "pot_bush", pot),
        look(leaves, "leaf_green" if tall else "leaf_light", (0.0, 0.0, height - 0.05)),
        rod((0.0, 0.0, height - 0.03), (radius - 0.025, 0.01), "soil", collide=False),
    ]
    return Prop(name, tuple(geoms))


def _beanbag() -> Prop:
    """A beanbag, 0.8 m wide."""
    geoms = (
        rod((0.0, 0.0, 0.17), (0.39, 0.34), "beanbag_fabric", visual=False),
        rod((0.0, 0.0, 0.47), (0.24, 0.26), "beanbag_fabric", visual=False),
        look("beanbag", "beanbag_fabric"),
    )
    return Prop("beanbag", geoms)


def _lamp() -> Prop:
    """A floor lamp."""
    geoms = (
        rod((0.0, 0.0, 0.015), (0.15, 0.03), "black_metal"),
        rod((0.0, 0.0, 0.70), (0.015, 1.36), "black_metal"),
        rod((0.0, 0.0, 1.47), (0.18, 0.30), "lamp_shade", visual=False),
        look("lamp_shade", "lamp_shade"),
        ball((0.0, 0.0, 1.45), 0.06, "lamp_shade", collide=False),
    )
    return Prop("lamp_01", geoms)


def _rug(name: str, depth: float, width: float, material: str) -> Prop:
    """A rug 8 mm thick, without collision geoms; robots drive over it."""
    geoms = [box((0.0, 0.0, 0.004), (depth, width, 0.008), material, collide=False)]
    # A doormat has no border.
    if depth > 1.0:
        rim = 0.07
        for sx in (-1.0, 1.0):
            geoms.append(
                box(
                    (sx * (depth - rim) / 2, 0.0, 0.005),
                    (rim, width, 0.010),
                    "rug_border",
                    collide=False,
                )
            )
            geoms.append(
                box(
                    (0.0, sx * (width - rim) / 2, 0.005),
                    (depth, rim, 0.010),
                    "rug_border",
                    collide=False,
                )
            )
    # A rug lies under the base wherever the robot stands on it.
    return Prop(name, tuple(geoms), blocks_base=False)


def _wall_shelf() -> Prop:
    """A narrow visual-only shelf on the wall, above the reach of arms, with cups, a plant and a vase."""
    geoms: list[Geom] = [box((0.0, 0.0, 1.62), (0.20, 1.40, 0.03), "oak", collide=False)]
    for y, material in (
        (-0.55, "pot_white"),
        (-0.44, "cushion_mustard"),
        (-0.33, "sofa_fabric"),
        (-0.22, "pot_white"),
    ):
        geoms.append(rod((0.0, y, 1.68), (0.035, 0.09), material, collide=False))
    geoms += [
        look("vase", "terracotta", (0.0, 0.05, 1.635)),
        rod((0.0, 0.40, 1.68), (0.05, 0.09), "terracotta", collide=False),
        look("plant_small", "leaf_light", (0.0, 0.40, 1.72)),
        box((0.0, 0.60, 1.76), (0.14, 0.03, 0.24), "book_red", collide=False),
        box((0.0, 0.635, 1.75), (0.14, 0.035, 0.22), "book_yellow", collide=False),
    ]
    return Prop("wall_shelf", tuple(geoms), blocks_base=False)


def _picture(name: str) -> Prop:
    """A framed picture at eye height; its back is at x = 0, on the wall."""
    big = name == "picture_01"
    w, h, z = (0.9, 0.6, 1.6) if big else (0.5, 0.7, 1.6)
    geoms = [
        box(
            (0.012, 0.0, z),
            (0.024, w, h),
            "walnut" if big else "black_metal",
            collide=False,
        ),
        box(
            (0.026, 0.0, z),
            (0.004, w - 0.06, h - 0.06),
            "picture_sky" if big else "picture_paper",
            collide=False,
        ),
    ]
    if big:
        geoms.append(
            box(
                (0.029, 0.0, z - 0.16),
                (0.003, w - 0.06, h - 0.38),
                "picture_hill",
                collide=False,
            )
        )
        geoms.append(
            rod(
                (0.029, 0.22, z + 0.12),
                (0.08, 0.004),
                "picture_sun",
                axis="x",
                collide=False,
            )
        )
    else:
        geoms.append(
            rod(
                (0.029, 0.0, z + 0.08),
                (0.13, 0.004),
                "cushion_coral",
                axis="x",
                collide=False,
            )
        )
        geoms.append(
            box((0.029, 0.0, z - 0.16), (0.003, 0.30, 0.05), "book_blue", collide=False)
        )
    return Prop(name, tuple(geoms), blocks_base=False)


def _window() -> Prop:
    """A window with curtains; its back is at x = 0, on the wall."""
    w = 1.4
    h = 1.15
    z = 1.62
    t = 0.06
    geoms = [box((0.01, 0.0, z), (0.02, w, h), "window_glass", collide=False)]
    for s in (-1.0, 1.0):
        geoms.append(
            box((0.02, s * w / 2, z), (0.05, t, h + t), "trim_white", collide=False)
        )
        geoms.append(
            box((0.02, 0.0, z + s * h / 2), (0.05, w, t), "trim_white", collide=False)
        )
        geoms.append(
            box(
                (0.035, s * (w / 2 + 0.10), z - 0.05),
                (0.05, 0.26, h + 0.35),
                "curtain",
                collide=False,
            )
        )
    geoms.append(box((0.02, 0.0, z), (0.04, 0.04, h), "trim_white", collide=False))
    geoms.append(
        box(
            (0.04, 0.0, z - h / 2 - 0.04),
            (0.10, w + 0.1, 0.03),
            "trim_white",
            collide=False,
        )
    )
    geoms.append(
        rod(
            (0.05, 0.0, z + h / 2 + 0.13),
            (0.012, w + 0.6),
            "brass",
            axis="y",
            collide=False,
        )
    )
    return Prop("window_01", tuple(geoms), blocks_base=False)


def _front_door() -> Prop:
    """The closed outer door in its frame; its back is at x = 0, on the wall."""
    geoms = (
        span((0.0, 0.03), (-0.45, 0.45), (0.0, 2.05), "walnut", collide=False),
        span((0.0, 0.05), (-0.52, -0.45), (0.0, 2.12), "trim_white", collide=False),
        span((0.0, 0.05), (0.45, 0.52), (0.0, 2.12), "trim_white", collide=False),
        span((0.0, 0.05), (-0.45, 0.45), (2.05, 2.12), "trim_white", collide=False),
        rod((0.055, 0.36, 1.0), (0.012, 0.12), "brass", axis="y", collide=False),
    )
    return Prop("front_door", geoms, blocks_base=False)


def _bin() -> Prop:
    """A waste bin."""
    geoms = (
        rod((0.0, 0.0, 0.20), (0.14, 0.40), "steel"),
        rod((0.0, 0.0, 0.41), (0.145, 0.02), "black_metal", collide=False),
    )
    return Prop("bin_01", geoms)


def _inner_frame() -> Prop:
    """Trim of a doorway 1.0 m wide in an inner wall 0.12 m thick; the origin is at the centre of the opening."""
    geoms = [
        box((0.0, s * 0.49, 1.06), (0.16, 0.02, 2.12), "trim_white", collide=False)
        for s in (-1.0, 1.0)
    ]
    geoms.append(box((0.0, 0.0, 2.13), (0.16, 1.06, 0.06), "trim_white", collide=False))
    geoms.append(box((0.0, 0.0, 0.003), (0.13, 0.98, 0.006), "oak", collide=False))
    return Prop("door_frame", tuple(geoms), blocks_base=False)
