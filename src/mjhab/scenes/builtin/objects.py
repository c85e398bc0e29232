"""The ten movable objects of the Home Assistant Benchmark, built by code with the sizes and masses of YCB.

Sizes: extents of the google_16k scans of the YCB Object and Model Set along the object's own axes (the scans
of the pudding, gelatin and meat boxes are turned about z, so their axis-aligned bounds are larger). Masses:
Calli et al., "Benchmarking in Manipulation Research: The YCB Object and Model Set", table of objects.
"""

from __future__ import annotations

import math

import numpy as np

from mjhab.scenes.shapes.hulls import hull_mesh
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.shapes import about_z, box, lathe, look, rod
from mjhab.scenes.spec import Geom, ObjectType, Vec3

SIZES: dict[str, Vec3] = {
    "002_master_chef_can": (0.1024, 0.1024, 0.1402),
    "003_cracker_box": (0.0718, 0.1640, 0.2134),
    "004_sugar_box": (0.0479, 0.0933, 0.1760),
    "005_tomato_soup_can": (0.0678, 0.0678, 0.1019),
    "007_tuna_fish_can": (0.0855, 0.0855, 0.0335),
    "008_pudding_box": (0.0898, 0.1127, 0.0389),
    "009_gelatin_box": (0.0729, 0.0893, 0.0301),
    "010_potted_meat_can": (0.0573, 0.1016, 0.0835),
    "013_apple": (0.0754, 0.0749, 0.0719),
    "024_bowl": (0.1610, 0.1610, 0.0550),
}
"""Full extents (x, y, z) [m] of each object in its usual standing pose."""

MASSES: dict[str, float] = {
    "002_master_chef_can": 0.414,
    "003_cracker_box": 0.411,
    "004_sugar_box": 0.514,
    "005_tomato_soup_can": 0.349,
    "007_tuna_fish_can": 0.171,
    "008_pudding_box": 0.187,
    "009_gelatin_box": 0.097,
    "010_potted_meat_can": 0.370,
    "013_apple": 0.068,
    "024_bowl": 0.147,
}
"""Masses [kg]."""

SCAN_YAW: dict[str, float] = {
    "004_sugar_box": 0.031,
    "008_pudding_box": 1.089,
    "009_gelatin_box": -0.229,
    "010_potted_meat_can": 1.524,
}
"""Heading [rad] of the google_16k scan's x axis in our frame, for objects that are rotated in their scan."""

CLUTTER_TYPES: tuple[str, ...] = tuple(name for name in SIZES if name != "013_apple")
"""The nine object types of TidyHouse, of PrepareGroceries, and of the clutter of SetTable."""

BOWL_WALL_M = 0.0045
"""Thickness of the collision wall of a bowl [m]; a scanned wall is thinner, too thin for a stable grasp."""
_BOWL_PROFILE_M = ((0.046, -0.0275), (0.0735, -0.0075), (0.0805, 0.0275))
"""Outer (radius, z) [m] of the bowl at foot, knee and rim; steep above the knee, so that the rim can be grasped."""
BOWL_FACETS = 12
"""Number of flat pieces of the bowl's wall. A finger pad (26 mm wide) may be up to 7 mm off the middle of a piece
before it touches the next piece."""
_BOWL_BASE_PIECES = 8


def builtin_objects() -> dict[str, ObjectType]:
    """Return the ten object types by name."""
    makers = {
        "002_master_chef_can": lambda h: _can(
            h, "coffee_blue", "label_white", "coffee_lid"
        ),
        "003_cracker_box": lambda h: _carton(
            h, "cracker_red", "cracker_orange", "label_white"
        ),
        "004_sugar_box": lambda h: _carton(
            h, "sugar_yellow", "label_white", "sugar_blue"
        ),
        "005_tomato_soup_can": lambda h: _can(
            h, "soup_red", "label_white", "tin", "soup_gold"
        ),
        "007_tuna_fish_can": lambda h: _can(h, "tuna_blue", "label_white", "tin"),
        "008_pudding_box": lambda h: _flat_carton(
            h, "pudding_brown", "label_white", "cracker_orange"
        ),
        "009_gelatin_box": lambda h: _flat_carton(
            h, "gelatin_red", "label_white", "cracker_orange"
        ),
        "010_potted_meat_can": lambda h: _meat_can(h),
        "013_apple": lambda h: _apple(),
        "024_bowl": lambda h: _bowl(),
    }
    types = {}
    for name, size in SIZES.items():
        half = (size[0] / 2, size[1] / 2, size[2] / 2)
        collision, visuals = makers[name](half)
        types[name] = ObjectType(
            name,
            MASSES[name],
            half,
            tuple(collision),
            tuple(visuals),
            SCAN_YAW.get(name, 0.0),
        )
    return types


def object_meshes() -> dict[str, Mesh]:
    """Return the meshes of the objects by name: collision pieces of apple and bowl, and their render meshes."""
    (foot_r, foot_z), (knee_r, knee_z), (rim_r, rim_z) = _BOWL_PROFILE_M
    w = BOWL_WALL_M
    return {
        "apple_hull": hull_mesh(_icosphere() * (np.array(SIZES["013_apple"]) / 2)),
        "apple_look": _apple_look(),
        "bowl_rim_piece": _wall_piece(knee_r, knee_z, rim_r, rim_z, BOWL_FACETS),
        "bowl_base_piece": _wall_piece(foot_r, foot_z, knee_r, knee_z, _BOWL_BASE_PIECES),
        "bowl_outside": lathe(
            [
                (0.0, foot_z),
                (foot_r, foot_z),
                (0.062, -0.020),
                (knee_r - 0.001, knee_z),
                (0.0785, 0.010),
                (rim_r, rim_z),
            ],
            40,
        ),
        "bowl_inside": lathe(
            [
                (rim_r, rim_z),
                (rim_r - w, rim_z),
                (0.0785 - w, 0.010),
                (knee_r - w, knee_z),
                (0.060, -0.015),
                (0.040, foot_z + w),
                (0.0, foot_z + w),
            ],
            40,
        ),
    }


def _carton(half: Vec3, main: str, band: str, mark: str) -> tuple[list[Geom], list[Geom]]:
    """Collision and visual geoms of a standing box, with labels on the two wide faces and a band at the lower part."""
    hx, hy, hz = half
    # Labels stand out by half a millimetre: in one plane with the box they would flicker.
    skin = 0.0005
    visuals = [
        box(
            (0.0, 0.0, 0.0),
            (2 * (hx - skin), 2 * (hy - skin), 2 * hz),
            main,
            collide=False,
        ),
        box(
            (0.0, 0.0, -0.45 * hz),
            (2 * (hx - skin / 2), 2 * (hy - skin / 2), 0.45 * hz),
            band,
            collide=False,
        ),
    ]
    for s in (-1.0, 1.0):
        visuals.append(
            box(
                (s * (hx - skin / 2), 0.0, 0.40 * hz),
                (skin, 1.5 * hy, 0.5 * hz),
                mark,
                collide=False,
            )
        )
        visuals.append(
            box(
                (0.0, s * (hy - skin / 2), 0.40 * hz),
                (1.3 * hx, skin, 0.3 * hz),
                mark,
                collide=False,
            )
        )
        visuals.append(
            rod(
                (s * (hx - skin), 0.0, -0.45 * hz),
                (min(0.35 * hy, 0.2 * hz), 2 * skin),
                main,
                axis="x",
                collide=False,
            )
        )
    return [Geom("box", half, visual=False)], visuals


def _flat_carton(
    half: Vec3, main: str, mark: str, spot: str
) -> tuple[list[Geom], list[Geom]]:
    """Collision and visual geoms of a lying box, with labels on top and bottom."""
    hx, hy, hz = half
    skin = 0.0005
    visuals = [
        box((0.0, 0.0, 0.0), (2 * hx, 2 * hy, 2 * (hz - skin)), main, collide=False)
    ]
    for s in (-1.0, 1.0):
        visuals.append(
            box(
                (0.25 * hx, 0.0, s * (hz - skin)),
                (0.9 * hx, 1.6 * hy, skin),
                mark,
                collide=False,
            )
        )
        visuals.append(
            rod(
                (-0.45 * hx, 0.3 * hy, s * (hz - skin)),
                (0.3 * hx, skin),
                spot,
                collide=False,
            )
        )
        visuals.append(
            box(
                (-0.45 * hx, -0.45 * hy, s * (hz - skin)),
                (0.5 * hx, 0.5 * hy, skin),
                spot,
                collide=False,
            )
        )
    return [Geom("box", half, visual=False)], visuals


def _meat_can(half: Vec3) -> tuple[list[Geom], list[Geom]]:
    """Collision and visual geoms of a rectangular tin with metal rims and a printed sleeve."""
    hx, hy, hz = half
    visuals = [
        box(
            (0.0, 0.0, 0.0),
            (2 * hx - 0.003, 2 * hy - 0.003, 2 * hz),
            "tin",
            collide=False,
        ),
        box((0.0, 0.0, 0.0), (2 * hx, 2 * hy, 1.75 * hz), "meat_blue", collide=False),
    ]
    for s in (-1.0, 1.0):
        visuals.append(
            box(
                (s * hx, 0.0, 0.1 * hz),
                (0.001, 1.4 * hy, 0.7 * hz),
                "meat_yellow",
                collide=False,
            )
        )
        visuals.append(
            box(
                (0.0, s * hy, 0.1 * hz),
                (1.2 * hx, 0.001, 0.5 * hz),
                "label_white",
                collide=False,
            )
        )
    return [Geom("box", half, visual=False)], visuals


def _can(
    half: Vec3, main: str, band: str, lid: str, dot: str = ""
) -> tuple[list[Geom], list[Geom]]:
    """Collision and visual geoms of a round can with a two-coloured sleeve, rims and a lid."""
    r = half[0]
    h = half[2]
    visuals = [
        rod((0.0, 0.0, 0.0), (r - 0.0015, 2 * h), lid, collide=False),
        rod((0.0, 0.0, 0.0), (r - 0.0003, 1.84 * h), main, collide=False),
        rod((0.0, 0.0, -0.38 * h), (r, 0.85 * h), band, collide=False),
        rod((0.0, 0.0, h - 0.0005), (0.8 * r, 0.001), "tin", collide=False),
    ]
    if dot:
        for s in (-1.0, 1.0):
            visuals.append(
                rod(
                    (s * (r - 0.004), 0.0, 0.04 * h),
                    (0.35 * r, 0.0082),
                    dot,
                    axis="x",
                    collide=False,
                )
            )
    return [Geom("cylinder", (r, h, 0.0), visual=False)], visuals


def _apple() -> tuple[list[Geom], list[Geom]]:
    hull = Geom("mesh", (1.0, 1.0, 1.0), mesh="apple_hull", visual=False)
    stem = rod((0.0, 0.0, 0.031), (0.0015, 0.012), "apple_stem", collide=False)
    return [hull], [look("apple_look", "apple_red"), stem]


def _bowl() -> tuple[list[Geom], list[Geom]]:
    """Collision and visual geoms of an open bowl: rings of steep rim pieces and flat base pieces, and a round floor."""
    foot_r, foot_z = _BOWL_PROFILE_M[0]
    pieces = [
        Geom(
            "cylinder",
            (foot_r, BOWL_WALL_M / 2, 0.0),
            (0.0, 0.0, foot_z + BOWL_WALL_M / 2),
            visual=False,
        )
    ]
    for count, mesh in (
        (BOWL_FACETS, "bowl_rim_piece"),
        (_BOWL_BASE_PIECES, "bowl_base_piece"),
    ):
        for i in range(count):
            turn = about_z(2 * math.pi * i / count)
            pieces.append(
                Geom("mesh", (1.0, 1.0, 1.0), quat=turn, mesh=mesh, visual=False)
            )
    return pieces, [look("bowl_outside", "bowl_red"), look("bowl_inside", "bowl_inside")]


def _wall_piece(r0: float, z0: float, r1: float, z1: float, count: int) -> Mesh:
    """One of ``count`` equal wedges of a conical wall, centred about +x; its outer corners lie on the cone.

    ``r0``, ``z0``, ``r1``, ``z1``: outer radius and height [m] at the two ends of the cone.
    """
    a = math.pi / count
    slope = math.atan2(r1 - r0, z1 - z0)
    inward = BOWL_WALL_M / math.cos(slope)
    points = []
    for r, z in ((r0, z0), (r1, z1)):
        # The base pieces end at the axis, where the radius cannot shrink further.
        for rr in (r, max(r - inward, 0.0)):
            points += [(rr * math.cos(t), rr * math.sin(t), z) for t in (-a, a)]
    return hull_mesh(np.array(points))


def _icosphere() -> np.ndarray:
    """(42, 3) points on the unit sphere whose largest coordinates along the axes are exactly 1."""
    g = (1 + math.sqrt(5)) / 2
    base = [(0.0, s, t * g) for s in (-1.0, 1.0) for t in (-1.0, 1.0)]
    corners = np.array([p[i:] + p[:i] for p in base for i in range(3)])
    edges = [
        (corners[i] + corners[j]) / 2
        for i in range(12)
        for j in range(i)
        if abs(np.linalg.norm(corners[i] - corners[j], axis=-1) - 2.0) < 1e-6
    ]
    points = np.concatenate([corners, np.array(edges)])
    # Midpoints of edges lie inside of the sphere.
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def _apple_look() -> Mesh:
    """Render mesh of an apple with dimples at stem and flower, inside the bounds of the collision hull."""
    rx, _, rz = (s / 2 for s in SIZES["013_apple"])
    profile = [
        (0.0, -0.86),
        (0.16, -0.96),
        (0.34, -1.0),
        (0.66, -0.82),
        (0.90, -0.42),
        (1.0, 0.10),
        (0.95, 0.52),
        (0.74, 0.88),
        (0.44, 1.0),
        (0.20, 0.93),
        (0.06, 0.80),
        (0.0, 0.74),
    ]
    return lathe([(rx * r, rz * z) for r, z in profile], 28)
