"""What pinches are made of: the shape of an object, options of the search, and the pinch itself.

A pinch is a line on which the two pads of a parallel gripper close on an object, with directions of approach. Gripper
frame as in `candidates`. Lengths [m], world frame. Letters: A directions of approach, P points of contact.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mjhab.scenes.builtin.objects import BOWL_FACETS

MAX_APPROACH_RISE = 0.05
"""Largest z component of a unit direction of approach, which excludes approaches from below."""


@dataclass(frozen=True, eq=False)
class SurfaceGrasps:
    """M grasps in the frame of the object.

    Attributes:
        pos: (M, 3) position of the tcp.
        approach: (M, 3) unit direction along the fingers.
        closing: (M, 3) unit direction of the line on which the pads close.
        contact: (M, 3) midpoint of the two contacts.
        width: (M,) distance between the contacts.
        most_open: (M,) widest opening for a collision-free approach.
        slant: (M,) larger angle [rad] between the closing line and the surface normal at a contact.
        patch: (M,) square root of the contact area of the pad that has less.
    """

    pos: np.ndarray
    approach: np.ndarray
    closing: np.ndarray
    contact: np.ndarray
    width: np.ndarray
    most_open: np.ndarray
    slant: np.ndarray
    patch: np.ndarray

    def __len__(self) -> int:
        return len(self.pos)

    def take(self, rows: np.ndarray) -> SurfaceGrasps:
        """Return the grasps of row indices or a mask."""
        return SurfaceGrasps(
            *(getattr(self, name)[rows] for name in self.__dataclass_fields__)
        )


@dataclass(frozen=True)
class ObjectShape:
    """Shape of an object to grasp. The axis of cylinders and bowls is z.

    Attributes:
        kind: type of the shape.
        half: half-extents of its bounding box.
        wall: bowls: thickness of the wall.
        lean: bowls: angle [rad] between the wall at the rim and the axis.
        facets: bowls: number of flat pieces of the collision wall, the first centred on +x; 0 for a round wall.
        grasps: meshes: grasps from `antipodal.surface_grasps`.
    """

    kind: Literal["box", "cylinder", "sphere", "bowl", "mesh"]
    half: tuple[float, float, float]
    wall: float = 0.0045
    lean: float = 0.197
    facets: int = BOWL_FACETS
    grasps: SurfaceGrasps | None = field(default=None, compare=False)


@dataclass(frozen=True)
class PinchOptions:
    """Options of the search and scoring of grasp candidates. Lengths [m], angles [rad]."""

    floor_gap: float = 0.006
    """Least gap between the gripper and the surface that the object rests on."""
    palm_gap: float = 0.005
    """Least gap between palm and object."""
    retreat: float = 0.10
    """Distance from the grasp at which the straight approach begins."""
    spread: float = 0.036
    """Opening of the fingers on the approach minus the width of the grasp."""
    fan: int = 24
    """Number of directions of approach around each closing line."""
    shallower: tuple[float, ...] = (0.0,)
    """Distances from the deepest possible position of the hand, along the approach, at which grasps are made."""
    leans: tuple[float, ...] = (0.0, 0.2, -0.2, 0.4)
    """Angles of the approach to a bowl from the direction along its wall, positive outwards."""
    inward: tuple[float, float] | None = None
    """Horizontal unit direction into a shelf; approaches against it are left out."""
    cells: int = 15
    """Points sampled along each side of a box face."""
    slants: tuple[float, ...] = ()
    """Angles between the level direction of the hand and an upright side of a box, at which one finger meets that side
    and the other one the opposite edge; none: grasps of boxes are parallel to their sides."""
    scant: float = 0.0
    """Score lost per metre by which the square root of the contact area on flat sides is below 2 cm."""
    least_clear_m: float = 0.0
    """Least clearance of the approach from neighbours; grasps with less are left out."""
    preference: dict[str, float] = field(
        default_factory=lambda: {"top": 1.0, "tilted": 0.8, "side": 0.5}
    )
    """Score by kind of approach, see `candidates.KINDS`."""


@dataclass(frozen=True, eq=False)
class Pinch:
    """A line on which the pads close on an object, with A directions of approach."""

    closing: np.ndarray
    """(3,) unit direction in which the pads close."""
    approach: np.ndarray
    """(A, 3) unit directions along the fingers."""
    locus: np.ndarray
    """(P, 3) midpoints of the pairs of points at which the two pads can touch the object."""
    width: float
    """Distance [m] between the pads in contact."""
    at: np.ndarray | None = None
    """(A, 3) position of the tcp for each approach; None: as deep as palm and support allow."""
    bonus: float = 0.0
    """Added to the score."""
    least: float = 0.010
    """Least length of the locus (or square root of its area) [m] within the pads."""
    measure: float = 0.0
    """Length (or square root of the area) of the whole locus [m]; 0 for a point."""
    planar: bool = False
    """The locus samples an area, not a line."""
    most_open: float = np.inf
    """Widest opening [m] of the approach; with a wider one a finger touches another part of the object."""

    @property
    def point(self) -> bool:
        """Whether each pad touches the object in a single point."""
        return len(self.locus) == 1


def fan_of(closing: np.ndarray, start: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` unit directions of approach (A, 3) around a closing line, without those from below."""
    u = start - closing * (start @ closing)
    # Only the part of the start across the closing line gives a direction of approach.
    u = u / np.linalg.norm(u, axis=-1)
    angle = np.arange(count) * 2 * np.pi / count
    fan = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(closing, u)
    return fan[fan[:, 2] <= MAX_APPROACH_RISE]
