"""Collision shapes of the handles of the ReplicaCAD kitchen counter and fridge, which the URDFs lack.

The collision boxes of the URDFs end at flat fronts. A drawer front is replaced by a frame around its recess and the
handle block inside, and a fridge door gets its handle and shelves. All dimensions are measured on the render meshes of
the data set (``urdf/kitchen_counter/drawer*.glb``, ``urdf/fridge/*_door.glb``), in the frame of the URDF link [m].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.scenes.formats.urdf import UrdfBox

Range = tuple[float, float]
FINGERTIP_REACH_M = 0.031
"""Distance of the fingertips of the benchmark's robot beyond its tool centre point [m]."""


@dataclass(frozen=True)
class Front:
    """A drawer front with a recess and a handle block in it, in the frame of the URDF link [m].

    x: floor of the recess, which is open at the outer face of the front. y, z: extents of the recess. block_x: outer
    face of the block, which begins at the floor of the recess. block_y, block_z: extents of the block.
    """

    x: float
    y: Range
    z: Range
    block_x: float
    block_y: Range
    block_z: Range


_LEFT = Front(
    0.2707,
    (-0.1403, 0.1415),
    (-0.3890, 0.3900),
    0.2961,
    (-0.0073, 0.0171),
    (-0.0393, 0.0584),
)
_MIDDLE = Front(
    0.2763,
    (-0.0883, 0.0774),
    (-0.2464, 0.2451),
    0.3013,
    (-0.0135, 0.0109),
    (-0.0470, 0.0508),
)
_RIGHT = Front(
    0.2742,
    (-0.0651, 0.0703),
    (-0.3986, 0.3819),
    0.2936,
    (-0.0085, 0.0159),
    (-0.0451, 0.0526),
)
_LOW_RIGHT = Front(
    0.2709,
    (-0.1462, 0.1335),
    (-0.3900, 0.3872),
    0.2906,
    (-0.0206, 0.0039),
    (-0.0404, 0.0573),
)
FRONTS = {
    "drawer1_top": _LEFT,
    "drawer1_bottom": _LEFT,
    "drawer2_top": _MIDDLE,
    "drawer2_middle": _MIDDLE,
    "drawer2_bottom": _MIDDLE,
    "drawer3": _RIGHT,
    "drawer4": _LOW_RIGHT,
}


@dataclass(frozen=True)
class Rib:
    """A handle of a fridge door: a solid rib along z, in the frame of the URDF link [m].

    door_x: outer face of the door beside it. front: x of its outer face at the two ends of ``straight``. y, z: extents.
    """

    door_x: float
    front: tuple[float, float]
    y: Range
    z: Range
    straight: Range
    """z extent of the rib without its rounded ends."""


RIBS = {
    "top_door": Rib(
        0.0627, (0.1082, 0.1007), (-0.6890, -0.6391), (-0.0660, 0.5120), (-0.0348, 0.4906)
    ),
    "bottom_door": Rib(
        0.0623,
        (0.1066, 0.0994),
        (-0.6900, -0.6396),
        (-0.3440, 0.0040),
        (-0.3127, -0.0170),
    ),
}
_BIN_WALL_M = 0.008
"""Thickness of the walls of a door shelf [m]."""
# Extents x, y, z of the door shelves; z points down, so the floor of a shelf is at its largest z.
_BINS: dict[str, tuple[tuple[Range, Range, Range], ...]] = {
    "top_door": (
        ((-0.1302, 0.0065), (-0.6438, -0.3723), (-0.1434, -0.0603)),
        ((-0.1290, 0.0065), (-0.3179, -0.0444), (-0.0633, 0.0198)),
        ((-0.1301, 0.0065), (-0.6466, -0.0474), (0.3983, 0.5071)),
    )
}
_LIDDED: dict[str, tuple[tuple[Range, Range, Range], ...]] = {
    "top_door": (
        ((-0.1558, -0.0082), (-0.6392, -0.3848), (-0.4934, -0.3580)),
        ((-0.1545, -0.0069), (-0.3124, -0.0580), (-0.4934, -0.3580)),
    )
}
"""Extents x, y, z of door compartments with a lid, which collide as solid boxes."""


PUBLISHED: dict[str, tuple[float, float, float]] = {
    **dict.fromkeys(FRONTS, (0.26, 0.0, 0.0)),
    "top_door": (0.09, -0.66, 0.2),
}
"""Handle points in the plans of MS-HAB (articulation_relative_handle_pos), in the frame of the URDF link [m]. They are
not multiplied by the scale of the furniture, because MS-HAB applies them to the pose of the link without its scale."""


@dataclass(frozen=True, eq=False)
class Grip:
    """Geometry of a handle for grasping, in the frame of the URDF link.

    pos: (3,) position of the tool centre point in a grasp [m]. bar: (3,) unit direction along the handle. out: (3,)
    unit direction away from the front. half_length, thickness: of the handle along and across ``bar`` [m].
    """

    pos: np.ndarray
    bar: np.ndarray
    out: np.ndarray
    half_length: float
    thickness: float


def span(x: Range, y: Range, z: Range) -> UrdfBox:
    """Make a box from its extents along the axes [m]."""
    low, high = np.array([x, y, z], float).T
    pose = np.eye(4)
    pose[:3, 3] = (low + high) / 2
    return UrdfBox((high - low) / 2, pose)


def drawer(name: str, boxes: tuple[UrdfBox, ...]) -> tuple[tuple[UrdfBox, ...], Grip]:
    """Return the collision boxes and the grip of a drawer.

    Args:
        name: link of the kitchen counter.
        boxes: boxes of the URDF; returned unchanged unless they are the five of the original data set.

    Raises:
        KeyError: the link is not in `FRONTS`.
    """
    cut = FRONTS[name]
    (y0, y1) = cut.block_y
    (z0, z1) = cut.block_z
    pos = np.array([cut.x + FINGERTIP_REACH_M, (y0 + y1) / 2, (z0 + z1) / 2])
    # The long side of the block is along z, horizontal in the drawer.
    grip = Grip(
        pos, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), (z1 - z0) / 2, y1 - y0
    )
    # Another version of the file may have a handle of its own: only the known boxes are replaced.
    if len(boxes) != 5:
        return boxes, grip
    # The boxes have no names; the front is the one farthest out.
    front = max(boxes, key=lambda b: float(b.pose[0, 3]))
    low = front.pose[:3, 3] - front.half
    high = front.pose[:3, 3] + front.half
    rim = (cut.x, float(high[0]))
    y = (float(low[1]), float(high[1]))
    z = (float(low[2]), float(high[2]))
    new = (
        span((float(low[0]), cut.x), y, z),
        span(rim, (y[0], cut.y[0]), z),
        span(rim, (cut.y[1], y[1]), z),
        span(rim, cut.y, (z[0], cut.z[0])),
        span(rim, cut.y, (cut.z[1], z[1])),
        span((cut.x, cut.block_x), cut.block_y, cut.block_z),
    )
    return (*(b for b in boxes if b is not front), *new), grip


def door(name: str, boxes: tuple[UrdfBox, ...]) -> tuple[tuple[UrdfBox, ...], Grip]:
    """Return the collision boxes and the grip of a fridge door.

    Args:
        name: link of the fridge.
        boxes: boxes of the URDF; returned unchanged unless it is the one box of the original data set.

    Raises:
        KeyError: the link is not in `RIBS`.
    """
    rib = RIBS[name]
    (y0, y1) = rib.y
    (z0, z1) = rib.straight
    pos = np.array([rib.door_x + 0.002 + FINGERTIP_REACH_M, (y0 + y1) / 2, (z0 + z1) / 2])
    # The link's z axis points down; the bar's direction is upwards.
    grip = Grip(
        pos, np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), (z1 - z0) / 2, y1 - y0
    )
    # As for drawers: only the one plain box that is known gets a handle.
    if len(boxes) != 1:
        return boxes, grip
    more = [_rib(rib, float(boxes[0].pose[0, 3]))]
    for x, y, z in _BINS.get(name, ()):
        more += [
            span(x, y, (z[1] - _BIN_WALL_M, z[1])),
            span((x[0], x[0] + _BIN_WALL_M), y, (z[0], z[1] - _BIN_WALL_M)),
            span(
                (x[0] + _BIN_WALL_M, x[1]),
                (y[0], y[0] + _BIN_WALL_M),
                (z[0], z[1] - _BIN_WALL_M),
            ),
            span(
                (x[0] + _BIN_WALL_M, x[1]),
                (y[1] - _BIN_WALL_M, y[1]),
                (z[0], z[1] - _BIN_WALL_M),
            ),
        ]
    more += [span(x, y, z) for x, y, z in _LIDDED.get(name, ())]
    return (*boxes, *more), grip


def _rib(rib: Rib, inner: float) -> UrdfBox:
    """The box of a rib: its outer face is tilted by about 1 deg, and its inner face is at x = ``inner`` in the door."""
    run = rib.straight[1] - rib.straight[0]
    lean = math.atan2(rib.front[1] - rib.front[0], run)
    middle = ordered_sum(rib.z) / 2
    front = rib.front[0] + math.tan(lean) * (middle - rib.straight[0])
    c = np.cos(lean)
    s = np.sin(lean)
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    pose[:3, 3] = ((front + inner) / 2, ordered_sum(rib.y) / 2, middle)
    return UrdfBox(
        np.array(
            [(front - inner) / 2, (rib.y[1] - rib.y[0]) / 2, (rib.z[1] - rib.z[0]) / 2]
        ),
        pose,
    )


def plain(boxes: tuple[UrdfBox, ...], out: np.ndarray, scale: float) -> Grip:
    """Return the grip of a door or drawer whose URDF has collision boxes for its handle.

    The handle is the box that protrudes farthest. A link of a single box has no handle: its grip is the middle of its
    face, which is too wide to be grasped.

    Args:
        boxes: boxes of the URDF.
        out: (3,) unit axis of the link that points out of the front.
        scale: uniform scale of the furniture, by which lengths of the gripper are divided.
    """
    reach = [
        float(out @ box.pose[:3, 3] + np.abs(out @ box.pose[:3, :3]) @ box.half)
        for box in boxes
    ]
    knob = boxes[int(np.argmax(reach))]
    face = max(
        (r for r, box in zip(reach, boxes, strict=True) if box is not knob),
        default=max(reach),
    )
    # A bar runs along the front, never out of it.
    half = np.where(np.abs(out) > 0.5, 0.0, np.abs(knob.pose[:3, :3]) @ knob.half)
    bar = np.eye(3)[int(half.argmax())]
    across = np.abs(np.cross(bar, out))
    pos = knob.pose[:3, 3]
    pos = pos + out * (face + (FINGERTIP_REACH_M + 0.002) / scale - float(out @ pos))
    return Grip(pos, bar, out, float(half @ bar), float(2 * half @ across))
