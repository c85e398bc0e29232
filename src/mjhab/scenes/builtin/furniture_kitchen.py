"""The furniture with joints: a kitchen counter with seven drawers and a sink, and a fridge with two doors.

Template frame: origin on the floor under the centre, +x to the front. Sizes follow ReplicaCAD's
kitchen_counter and fridge (worktop at 0.86 m, drawer travel 0.5 m, doors of 0.69 m that turn 2.3 and 2.5 rad),
with bar handles that collide; the original handles have no collision geometry.
"""

from __future__ import annotations

from mjhab.scenes.shapes.shapes import box, rod, span
from mjhab.scenes.spec import (
    Articulation,
    FrontArea,
    Geom,
    Handle,
    Link,
    Receptacle,
    Vec3,
)

FRONT_BACK_X_M = 0.303
"""x of the back face of the counter's drawer fronts [m]; a front is 20 mm thick."""
FRONT_THICKNESS_M = 0.02
BAR_THICKNESS_M = 0.02
"""Thickness of a handle bar [m]."""
BAR_GAP_M = 0.05
"""Gap between bar and front [m]: fingers are 14 mm thick and extend 31 mm beyond the grasp point."""
WORKTOP_HEIGHT_M = 0.88
DRAWER_TRAVEL_M = 0.5
FRIDGE_FRONT_AREA = FrontArea(near_m=0.933, far_m=1.833, half_width_m=0.6)
"""Area where robots stand to open a fridge, as in MS-HAB (mshab/utils/gen/gen_spawn_positions.py)."""

# name, y extent, z extent of the front, surface height of the drawer floor, mass [kg]
_DRAWERS: tuple[
    tuple[str, tuple[float, float], tuple[float, float], float, float], ...
] = (
    ("drawer1_top", (-1.40, -0.60), (0.645, 0.835), 0.705, 5.0),
    ("drawer1_bottom", (-1.40, -0.60), (0.115, 0.635), 0.16, 5.0),
    ("drawer2_top", (-0.05, 0.60), (0.645, 0.835), 0.705, 4.0),
    ("drawer2_middle", (-0.05, 0.60), (0.385, 0.635), 0.43, 4.0),
    ("drawer2_bottom", (-0.05, 0.60), (0.115, 0.375), 0.16, 4.0),
    ("drawer3", (0.60, 1.40), (0.645, 0.835), 0.705, 4.0),
    ("drawer4", (0.60, 1.40), (0.115, 0.635), 0.16, 6.0),
)


def kitchen_counter() -> Articulation:
    """Make the counter: worktop at 0.88 m, 2.8 m wide, 0.65 m deep; drawers slide along +x."""
    links = tuple(_drawer(*row) for row in _DRAWERS)
    surfaces = (
        Receptacle("counter_left", (0.08, -0.99, WORKTOP_HEIGHT_M), (0.20, 0.37), 0.6),
        Receptacle("counter_right", (0.08, 0.68, WORKTOP_HEIGHT_M), (0.20, 0.68), 0.6),
        Receptacle("sink", (0.0, -0.325, 0.78), (0.16, 0.19), 0.6),
    )
    inside = tuple(
        Receptacle(
            name,
            (0.14, 0.0, floor - _link_z(z)),
            (0.145, (y[1] - y[0]) / 2 - 0.05),
            z[1] - floor,
            "drawer",
            name,
        )
        for name, y, z, floor, _ in _DRAWERS
    )
    return Articulation(
        "kitchen_counter", (*_counter_body(), *_sink()), links, surfaces + inside
    )


def _link_z(z: tuple[float, float]) -> float:
    return (z[0] + z[1]) / 2


def _counter_body() -> list[Geom]:
    top = (0.84, WORKTOP_HEIGHT_M)
    back = (-0.325, -0.305)
    x = (-0.325, 0.335)
    geoms = [
        # Four pieces around the hole of the sink, as a box cannot have one.
        span(x, (-1.42, -0.55), top, "worktop"),
        span(x, (-0.10, 1.42), top, "worktop"),
        span((0.20, 0.335), (-0.55, -0.10), top, "worktop"),
        span((-0.325, -0.20), (-0.55, -0.10), top, "worktop"),
        span(back, (-1.40, 1.40), (0.0, 0.84), "cabinet_carcass"),
        span((-0.305, 0.24), (-1.39, 1.39), (0.0, 0.10), "cabinet_plinth"),
        span(
            (0.283, FRONT_BACK_X_M + FRONT_THICKNESS_M),
            (-0.595, -0.055),
            (0.115, 0.835),
            "cabinet_front",
        ),
        span(
            (-0.325, -0.315),
            (-1.42, 1.42),
            (WORKTOP_HEIGHT_M, 1.36),
            "backsplash",
            collide=False,
        ),
        box(
            (FRONT_BACK_X_M + FRONT_THICKNESS_M + 0.012, -0.12, 0.60),
            (0.012, 0.012, 0.18),
            "brass",
            collide=False,
        ),
    ]
    for y in (-1.40, -0.60, -0.05, 0.60, 1.40):
        geoms.append(
            span(
                (-0.305, FRONT_BACK_X_M),
                (y - 0.009, y + 0.009),
                (0.10, 0.84),
                "cabinet_carcass",
            )
        )
    return geoms


def _sink() -> list[Geom]:
    floor = 0.78
    rim = 0.882
    inner_x = (-0.19, 0.19)
    inner_y = (-0.54, -0.11)
    wall = 0.01
    x = (inner_x[0] - wall, inner_x[1] + wall)
    y = (inner_y[0] - wall, inner_y[1] + wall)
    return [
        span(x, y, (floor - 0.015, floor), "steel"),
        span(x, (y[0], inner_y[0]), (floor, rim), "steel"),
        span(x, (inner_y[1], y[1]), (floor, rim), "steel"),
        span((x[0], inner_x[0]), y, (floor, rim), "steel"),
        span((inner_x[1], x[1]), y, (floor, rim), "steel"),
        rod((0.0, -0.325, floor + 0.001), (0.022, 0.004), "black_metal", collide=False),
        rod((-0.25, -0.325, WORKTOP_HEIGHT_M + 0.12), (0.016, 0.24), "steel"),
        rod(
            (-0.175, -0.325, WORKTOP_HEIGHT_M + 0.235),
            (0.011, 0.17),
            "steel",
            axis="x",
            collide=False,
        ),
        rod(
            (-0.095, -0.325, WORKTOP_HEIGHT_M + 0.21),
            (0.011, 0.05),
            "steel",
            collide=False,
        ),
        rod(
            (-0.25, -0.29, WORKTOP_HEIGHT_M + 0.10),
            (0.007, 0.07),
            "steel",
            axis="y",
            collide=False,
        ),
    ]


def _drawer(
    name: str, y: tuple[float, float], z: tuple[float, float], floor: float, mass: float
) -> Link:
    """One drawer, open on top. The link's origin is above the template's origin, at the height of the front."""
    width = y[1] - y[0]
    height = z[1] - z[0]
    mid = _link_z(z)
    surface = floor - mid
    side = min(0.10, height / 2 - 0.02)
    inner = width / 2 - 0.012
    back = -0.29
    low = surface - 0.015
    handle_z = 0.0 if height < 0.3 else height / 2 - 0.10
    out = FRONT_BACK_X_M + FRONT_THICKNESS_M
    geoms = [
        span((back, FRONT_BACK_X_M), (-inner, inner), (low, surface), "drawer_inside"),
        span(
            (FRONT_BACK_X_M, out),
            (-width / 2 + 0.004, width / 2 - 0.004),
            (-height / 2, height / 2),
            "cabinet_front",
        ),
        span((back, back + 0.012), (-inner, inner), (surface, side), "drawer_inside"),
        span(
            (back, FRONT_BACK_X_M),
            (inner - 0.012, inner),
            (surface, side),
            "drawer_inside",
        ),
        span(
            (back, FRONT_BACK_X_M),
            (-inner, -inner + 0.012),
            (surface, side),
            "drawer_inside",
        ),
    ]
    bar_x = out + BAR_GAP_M + BAR_THICKNESS_M / 2
    half = 0.085
    geoms += _bar((bar_x, 0.0, handle_z), (0.0, 1.0, 0.0), half, out, "brass")
    handle = Handle(
        (bar_x, 0.0, handle_z), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), half, BAR_THICKNESS_M
    )
    pos = (0.0, (y[0] + y[1]) / 2, mid)
    return Link(
        name,
        "slide",
        (1.0, 0.0, 0.0),
        (0.0, DRAWER_TRAVEL_M),
        pos,
        mass,
        tuple(geoms),
        handle,
    )


def _bar(
    center: Vec3,
    along: Vec3,
    half: float,
    front: float,
    material: str,
    thick: float = BAR_THICKNESS_M,
) -> list[Geom]:
    """A bar handle in front of a plate at x = ``front`` [m], on two thin posts at its ends."""
    reach = 2 * half + 0.02
    size = (thick, reach if along[1] else thick, reach if along[2] else thick)
    geoms = [box(center, size, material)]
    for end in (-half, half):
        post = (
            (front + center[0]) / 2,
            center[1] + end * along[1],
            center[2] + end * along[2],
        )
        geoms.append(box(post, (center[0] - front, 0.012, 0.012), material))
    return geoms


# fridge: closed door's inner face, outer face, hinge line
_DOOR_INNER_X_M = 0.290
_DOOR_OUTER_X_M = 0.345
_HINGE_Y_M = 0.345
_FRIDGE_WIDTH_M = 0.69
_TOP_DOOR_Z_M = (0.84, 1.93)
_BOTTOM_DOOR_Z_M = (0.07, 0.83)
_SHELF_HEIGHTS_M = {"middle_bottom": 0.48, "middle_top": 1.16, "top": 1.53}
_DECK_HEIGHT_M = 0.86
"""Surface of the deck between the two compartments [m]."""


def fridge() -> Articulation:
    """Make the fridge: 0.69 x 0.69 x 1.95 m; both doors hinge at y = +0.345 m and open at positive angles."""
    heights = {
        "bottom": 0.12,
        "middle_bottom": 0.48,
        "middle": _DECK_HEIGHT_M,
        "middle_top": 1.16,
        "top": 1.53,
    }
    free = {
        "bottom": 0.34,
        "middle_bottom": 0.32,
        "middle": 0.28,
        "middle_top": 0.35,
        "top": 0.34,
    }
    shelves = tuple(
        Receptacle(name, (-0.01, -0.03, z), (0.165, 0.23), free[name], "shelf")
        for name, z in heights.items()
    )
    links = (
        _door("top_door", _TOP_DOOR_Z_M, (0.0, 2.3), 8.0, 1.17, (0.95, 1.20, 1.56)),
        _door("bottom_door", _BOTTOM_DOOR_Z_M, (0.0, 2.5), 6.0, 0.62, (0.16, 0.50)),
    )
    return Articulation("fridge", tuple(_carcass()), links, shelves, FRIDGE_FRONT_AREA)


def _carcass() -> list[Geom]:
    x = (-0.345, _DOOR_INNER_X_M)
    y = (-0.345, 0.345)
    geoms = [
        span((-0.345, -0.305), y, (0.0, 1.95), "fridge_body"),
        span(x, (-0.345, -0.315), (0.0, 1.95), "fridge_body"),
        span(x, (0.315, 0.345), (0.0, 1.95), "fridge_body"),
        span(x, (-0.315, 0.315), (1.90, 1.95), "fridge_body"),
        span((-0.305, 0.27), (-0.315, 0.315), (0.03, 0.12), "fridge_inside"),
        span(
            (-0.305, _DOOR_INNER_X_M),
            (-0.315, 0.315),
            (0.81, _DECK_HEIGHT_M),
            "fridge_inside",
        ),
        span(
            (-0.305, -0.300),
            (-0.315, 0.315),
            (0.12, 1.90),
            "fridge_inside",
            collide=False,
        ),
        box((0.10, 0.0, 1.893), (0.10, 0.16, 0.012), "lamp_shade", collide=False),
    ]
    for side in (-1.0, 1.0):
        geoms.append(
            box(
                (-0.01, side * 0.3125, 1.01),
                (0.58, 0.005, 1.78),
                "fridge_inside",
                collide=False,
            )
        )
    for z in _SHELF_HEIGHTS_M.values():
        geoms.append(
            span((-0.305, 0.165), (-0.315, 0.315), (z - 0.018, z), "fridge_shelf")
        )
        geoms.append(
            span(
                (0.165, 0.171),
                (-0.315, 0.315),
                (z - 0.018, z + 0.004),
                "steel",
                collide=False,
            )
        )
    return geoms


def _door(
    name: str,
    z: tuple[float, float],
    limits: tuple[float, float],
    mass: float,
    grip: float,
    bins: tuple[float, ...],
) -> Link:
    """A door. The origin of its link is on the hinge axis at floor height, +x outward; the door extends along -y."""
    inner = _DOOR_INNER_X_M - _DOOR_OUTER_X_M
    outer = 0.0
    geoms = [
        span((inner, outer), (-_FRIDGE_WIDTH_M, 0.0), z, "fridge_door"),
        span(
            (inner - 0.006, inner),
            (-_FRIDGE_WIDTH_M + 0.035, -0.035),
            (z[0] + 0.03, z[1] - 0.03),
            "fridge_inside",
            collide=False,
        ),
    ]
    for height in bins:
        geoms += _bin(inner, height)
    half = 0.22 if z[1] - z[0] > 1.0 else 0.14
    thick = 0.022
    center = (outer + BAR_GAP_M + thick / 2, -_FRIDGE_WIDTH_M + 0.06, grip)
    geoms += _bar(center, (0.0, 0.0, 1.0), half, outer, "steel", thick)
    handle = Handle(center, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), half, thick)
    return Link(
        name,
        "hinge",
        (0.0, 0.0, 1.0),
        limits,
        (_DOOR_OUTER_X_M, _HINGE_Y_M, 0.0),
        mass,
        tuple(geoms),
        handle,
    )


def _bin(inner: float, height: float) -> list[Geom]:
    """A door shelf of floor and lip, 75 mm deep, and narrower than the door so that it clears the side walls."""
    y = (-_FRIDGE_WIDTH_M + 0.07, -0.08)
    return [
        span((inner - 0.075, inner), y, (height, height + 0.012), "fridge_bin"),
        span(
            (inner - 0.075, inner - 0.067),
            y,
            (height + 0.012, height + 0.07),
            "fridge_bin",
        ),
    ]
