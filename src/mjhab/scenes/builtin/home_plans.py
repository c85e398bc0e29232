"""Floor plans of the five macro layouts: walls, doorways, rooms, and poses of the furniture.

Coordinates: x to the right, y up, origin at the inner lower left corner of the flat [m]. A wall is a line with
doorways; a piece is (template, x, y, yaw in degrees). The front of a piece (+x of its template) looks along yaw.
"""

from __future__ import annotations

from dataclasses import dataclass

Piece = tuple[str, float, float, float]
Spot = tuple[float, float, float]


@dataclass(frozen=True)
class Wall:
    """An inner wall along ``axis`` ("x" or "y") from ``start`` to ``end``, at ``at`` on the other axis [m].

    ``gaps``: doorways (from, to) along the axis [m].
    """

    axis: str
    at: float
    start: float
    end: float
    gaps: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Room:
    """A rectangle of floor with its own material; ``extent``: x_min, y_min, x_max, y_max [m]."""

    name: str
    extent: tuple[float, float, float, float]
    floor: str


@dataclass(frozen=True)
class Plan:
    """One macro layout.

    ``size``: of the floor [m]; ``kitchen``: counter and fridge; ``fixed``: pieces with the same pose in all micro
    layouts; ``loose``: pieces that micro layouts shift; ``spots``: positions that micro layouts assign to `SMALL`.
    """

    size: tuple[float, float]
    outer_wall: str
    inner_wall: str
    walls: tuple[Wall, ...]
    rooms: tuple[Room, ...]
    kitchen: tuple[Piece, Piece]
    fixed: tuple[Piece, ...]
    loose: tuple[Piece, ...]
    spots: tuple[Spot, ...]


@dataclass(frozen=True)
class HardCase:
    """A home whose fridge is in a corner, so that its doors open toward a wall.

    ``fridge``: its pose; ``side``: gap between the hinge side of the fridge and the wall [m]; ``note``: see `Home`;
    ``limits``: (link id, angle [rad]) at which a door touches the wall, for doors that do.
    """

    fridge: Piece
    side: float
    note: str
    limits: tuple[tuple[str, float], ...] = ()


SMALL = ("indoor_plant_01", "indoor_plant_02", "beanbag", "lamp_01", "bin_01")
"""Small pieces that micro layouts assign randomly to a plan's spots; in order in micro layout 0."""

PLANS: tuple[Plan, ...] = (
    # The order of the plans is part of the names of homes, and decides their splits.
    Plan(  # kitchen and fridge on the west wall, living room north east, bedroom south east
        (9.4, 7.0),
        "wall_white",
        "wall_sage",
        (
            Wall("y", 5.0, 0.0, 7.0, ((0.9, 1.9), (3.7, 5.5))),
            Wall("x", 2.7, 5.06, 9.4, ((5.2, 6.2),)),
        ),
        (
            Room("kitchen", (0.0, 0.0, 5.0, 7.0), "floor_tile"),
            Room("living", (5.0, 2.7, 9.4, 7.0), "floor_oak"),
            Room("bedroom", (5.0, 0.0, 9.4, 2.7), "floor_carpet"),
        ),
        (("kitchen_counter", 0.345, 1.75, 0), ("fridge", 0.365, 4.05, 0)),
        (
            ("kitchen_cupboard_01", 0.22, 6.1, 0),
            ("tv", 7.35, 6.97, -90),
            ("wall_shelf", 0.10, 1.75, 0),
            ("window_01", 2.6, 7.0, -90),
            ("window_01", 9.4, 4.8, 180),
            ("window_01", 6.9, 0.0, 90),
            ("front_door", 4.3, 0.0, 90),
            ("picture_01", 7.3, 2.76, 90),
            ("picture_02", 4.94, 2.8, 180),
            ("rug_01", 7.35, 4.95, 90),
            ("rug_02", 6.75, 1.35, 90),
            ("mat", 4.3, 0.45, 90),
            ("door_frame", 5.0, 1.4, 0),
            ("door_frame", 5.7, 2.7, 90),
        ),
        (
            ("table_01", 3.75, 4.55, 0),
            ("chair_01", 3.75, 5.66, -90),
            ("chair_01", 3.75, 3.44, 90),
            ("chair_01", 4.68, 2.85, 180),
            ("sofa", 7.35, 3.26, 90),
            ("table_02", 7.35, 4.95, 90),
            ("tvstand", 7.35, 6.74, -90),
            ("bookshelf", 9.22, 6.2, 180),
            ("bed", 8.33, 0.92, 180),
            ("cabinet", 6.2, 0.31, 90),
            ("chest_of_drawers", 7.3, 2.38, -90),
            ("chair_01", 6.5, 1.5, 200),
            ("wall_cabinet_01", 3.05, 0.23, 90),
        ),
        (
            (4.6, 6.6, 0),
            (9.0, 3.2, 0),
            (5.55, 6.5, 0),
            (5.5, 3.1, 0),
            (0.4, 5.35, 0),
            (1.1, 6.6, 0),
        ),
    ),
    Plan(  # kitchen on the north wall of the east side, fridge on the east wall, living room west
        (10.0, 6.4),
        "wall_white",
        "wall_blue",
        (
            Wall("y", 5.6, 0.0, 6.4, ((2.5, 4.2),)),
            Wall("x", 2.4, 0.0, 5.54, ((4.3, 5.3),)),
        ),
        (
            Room("kitchen", (5.6, 0.0, 10.0, 6.4), "floor_slate"),
            Room("living", (0.0, 2.4, 5.6, 6.4), "floor_walnut"),
            Room("bedroom", (0.0, 0.0, 5.6, 2.4), "floor_carpet"),
        ),
        (("kitchen_counter", 7.5, 6.055, -90), ("fridge", 9.635, 3.7, 180)),
        (
            ("kitchen_cupboard_01", 9.78, 5.35, 180),
            ("tv", 5.51, 5.25, 180),
            ("wall_shelf", 7.5, 6.30, -90),
            ("window_01", 10.0, 1.4, 180),
            ("window_01", 0.0, 4.5, 0),
            ("window_01", 0.0, 1.0, 0),
            ("front_door", 9.2, 0.0, 90),
            ("picture_01", 7.3, 0.0, 90),
            ("picture_02", 2.2, 6.4, -90),
            ("rug_01", 2.3, 4.5, 0),
            ("rug_02", 3.4, 1.25, 90),
            ("mat", 9.2, 0.45, 90),
            ("door_frame", 4.8, 2.4, 90),
        ),
        (
            ("table_01", 7.3, 1.75, 90),
            ("chair_01", 8.39, 1.75, 180),
            ("chair_01", 6.21, 1.75, 0),
            ("chair_01", 9.6, 1.9, 180),
            ("sofa", 0.52, 4.5, 0),
            ("table_02", 2.4, 4.5, 0),
            ("tvstand", 5.30, 5.25, 180),
            ("bookshelf", 3.3, 6.22, -90),
            ("bed", 1.12, 1.0, 0),
            ("cabinet", 2.9, 0.31, 90),
            ("table_03", 4.6, 0.34, 90),
            ("chair_01", 4.6, 1.08, -90),
            ("chest_of_drawers", 3.3, 2.09, -90),
        ),
        (
            (0.45, 6.0, 0),
            (0.4, 2.85, 0),
            (1.5, 2.95, 0),
            (4.3, 6.0, 0),
            (9.75, 4.65, 0),
            (6.0, 0.4, 0),
        ),
    ),
    Plan(  # counter and fridge along the south wall of an open plan, bedroom and study on the east side
        (8.8, 7.6),
        "wall_sand",
        "wall_white",
        (Wall("y", 5.7, 0.0, 7.6, ((2.3, 3.3), (4.2, 5.2))), Wall("x", 3.5, 5.76, 8.8)),
        (
            Room("kitchen", (0.0, 0.0, 5.7, 2.5), "floor_tile"),
            Room("living", (0.0, 2.5, 5.7, 7.6), "floor_ash"),
            Room("bedroom", (5.7, 3.5, 8.8, 7.6), "floor_carpet"),
            Room("study", (5.7, 0.0, 8.8, 3.5), "floor_ash"),
        ),
        (("kitchen_counter", 1.85, 0.345, 90), ("fridge", 4.5, 0.365, 90)),
        (
            ("kitchen_cupboard_01", 0.22, 2.9, 0),
            ("tv", 5.61, 6.4, 180),
            ("wall_shelf", 1.85, 0.10, 90),
            ("window_01", 0.0, 6.1, 0),
            ("window_01", 2.6, 7.6, -90),
            ("window_01", 8.8, 1.4, 180),
            ("window_01", 7.3, 7.6, -90),
            ("front_door", 0.0, 4.3, 0),
            ("picture_01", 0.0, 1.6, 0),
            ("picture_02", 5.64, 3.75, 180),
            ("rug_02", 2.5, 6.1, 0),
            ("rug_01", 2.6, 3.45, 90),
            ("mat", 0.45, 4.3, 0),
            ("door_frame", 5.7, 2.8, 0),
            ("door_frame", 5.7, 4.7, 0),
        ),
        (
            ("table_01", 2.6, 3.45, 90),
            ("chair_01", 1.50, 3.45, 0),
            ("chair_01", 3.70, 3.45, 180),
            ("chair_01", 5.35, 3.75, 180),
            ("sofa", 0.52, 6.1, 0),
            ("table_02", 2.5, 6.1, 0),
            ("tvstand", 5.39, 6.4, 180),
            ("bed", 7.73, 6.3, 180),
            ("cabinet", 7.4, 3.85, 90),
            ("chest_of_drawers", 8.54, 4.9, 180),
            ("table_03", 8.46, 1.4, 180),
            ("chair_01", 7.72, 1.4, 0),
            ("bookshelf", 6.7, 0.18, 90),
            ("wall_cabinet_01", 7.6, 3.22, -90),
        ),
        (
            (0.4, 7.25, 0),
            (5.35, 5.45, 0),
            (3.6, 7.1, 0),
            (0.35, 4.88, 0),
            (5.45, 0.25, 0),
            (8.5, 0.3, 0),
        ),
    ),
    Plan(  # three strips: bedroom west, living room with a sofa in its middle, kitchen east
        (11.2, 6.2),
        "wall_white",
        "wall_rose",
        (
            Wall("y", 3.2, 0.0, 6.2, ((2.5, 3.5),)),
            Wall("y", 7.1, 0.0, 6.2, ((2.5, 4.2),)),
        ),
        (
            Room("bedroom", (0.0, 0.0, 3.2, 6.2), "floor_carpet"),
            Room("living", (3.2, 0.0, 7.1, 6.2), "floor_oak"),
            Room("kitchen", (7.1, 0.0, 11.2, 6.2), "floor_tile"),
        ),
        (("kitchen_counter", 10.855, 1.8, 180), ("fridge", 9.2, 5.835, -90)),
        (
            ("kitchen_cupboard_01", 7.6, 5.98, -90),
            ("tv", 4.7, 0.03, 90),
            ("wall_shelf", 11.10, 1.8, 180),
            ("window_01", 11.2, 4.6, 180),
            ("window_01", 5.6, 6.2, -90),
            ("window_01", 1.4, 6.2, -90),
            ("front_door", 6.5, 0.0, 90),
            ("picture_01", 7.16, 1.2, 0),
            ("picture_02", 3.26, 4.6, 0),
            ("rug_01", 4.9, 2.3, 90),
            ("rug_02", 1.5, 2.6, 0),
            ("mat", 6.5, 0.45, 90),
            ("door_frame", 3.2, 3.0, 0),
        ),
        (
            ("table_01", 8.4, 1.5, 0),
            ("chair_01", 8.4, 2.60, -90),
            ("chair_01", 8.4, 0.40, 90),
            ("chair_01", 6.8, 5.2, 180),
            ("sofa", 4.9, 4.2, -90),
            ("table_02", 4.9, 2.2, 90),
            ("tvstand", 4.7, 0.26, 90),
            ("bookshelf", 4.4, 6.02, -90),
            ("bed", 1.12, 4.7, 0),
            ("cabinet", 0.32, 1.3, 0),
            ("chest_of_drawers", 2.9, 0.8, 180),
            ("chair_01", 1.7, 0.5, 90),
            ("wall_cabinet_01", 0.24, 2.7, 0),
        ),
        (
            (7.45, 0.4, 0),
            (3.5, 5.75, 0),
            (5.7, 5.65, 0),
            (6.65, 4.55, 0),
            (10.9, 3.55, 0),
            (2.85, 5.8, 0),
        ),
    ),
    Plan(  # kitchen in the north, living room and bedroom in the south, study north east
        (9.2, 8.0),
        "wall_white",
        "wall_sand",
        (
            Wall("x", 3.4, 0.0, 9.2, ((3.5, 5.0), (7.0, 8.0))),
            Wall("y", 6.6, 3.46, 8.0, ((3.8, 4.8),)),
            Wall("y", 5.5, 0.0, 3.34, ((2.1, 3.1),)),
        ),
        (
            Room("kitchen", (0.0, 3.4, 6.6, 8.0), "floor_slate"),
            Room("living", (0.0, 0.0, 5.5, 3.4), "floor_oak"),
            Room("bedroom", (5.5, 0.0, 9.2, 3.4), "floor_carpet"),
            Room("study", (6.6, 3.4, 9.2, 8.0), "floor_oak"),
        ),
        (("kitchen_counter", 2.4, 7.655, -90), ("fridge", 4.9, 7.635, -90)),
        (
            ("kitchen_cupboard_01", 0.22, 5.6, 0),
            ("tv", 5.41, 1.05, 180),
            ("wall_shelf", 2.4, 7.90, -90),
            ("window_01", 0.0, 1.6, 0),
            ("window_01", 2.7, 0.0, 90),
            ("window_01", 9.2, 6.4, 180),
            ("window_01", 9.2, 1.1, 180),
            ("front_door", 0.0, 4.2, 0),
            ("picture_01", 1.6, 3.34, -90),
            ("picture_02", 6.54, 5.7, 180),
            ("rug_02", 2.4, 1.6, 0),
            ("rug_01", 2.3, 4.75, 90),
            ("mat", 0.45, 4.2, 0),
            ("door_frame", 7.5, 3.4, 90),
            ("door_frame", 6.6, 4.3, 0),
            ("door_frame", 5.5, 2.6, 0),
        ),
        (
            ("table_01", 2.3, 4.75, 90),
            ("chair_01", 1.20, 4.75, 0),
            ("chair_01", 3.40, 4.75, 180),
            ("chair_01", 6.25, 5.25, 180),
            ("sofa", 0.52, 1.65, 0),
            ("table_02", 2.4, 1.6, 0),
            ("tvstand", 5.19, 1.05, 180),
            ("bed", 8.13, 1.1, 180),
            ("cabinet", 8.6, 3.04, -90),
            ("chest_of_drawers", 6.1, 0.25, 90),
            ("table_03", 8.86, 6.4, 180),
            ("chair_01", 8.12, 6.4, 0),
            ("bookshelf", 7.6, 7.82, -90),
            ("wall_cabinet_01", 8.97, 4.7, 180),
        ),
        (
            (5.1, 3.0, 0),
            (0.4, 3.0, 0),
            (3.9, 0.5, 0),
            (0.4, 0.35, 0),
            (0.35, 6.5, 0),
            (7.0, 5.4, 0),
        ),
    ),
)

_NARROW = (
    "hard case, solvable: the fridge opens toward a wall 0.9 m away; its doors open fully"
)
HARD: dict[tuple[int, int], HardCase] = {
    (3, 19): HardCase(("fridge", 9.955, 5.835, -90), 0.90, _NARROW),
    (3, 20): HardCase(
        ("fridge", 10.605, 5.835, -90),
        0.25,
        "hard case, not solvable: the fridge opens against a wall 0.25 m away; a hand cannot follow its handle",
        (("fridge/top_door", 1.85), ("fridge/bottom_door", 1.85)),
    ),
    (4, 20): HardCase(("fridge", 5.295, 7.635, -90), 0.90, _NARROW),
}
"""Homes in which the fridge opens toward a wall, by (macro, micro). In MS-HAB's val homes, a fridge door that is open
against a wall cannot be closed, because its handle is out of reach."""
