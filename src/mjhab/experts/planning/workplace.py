"""Requests and results of the search for base placements: hand poses, obstacles around them, base poses and routes.

Lengths [m], angles [rad], world frame. Letters: G hand poses, A avoided base poses, N configurations, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.arm.clearance import RobotSpheres
from mjhab.experts.base.limits import UNLIMITED, CommandLimits
from mjhab.experts.base.route import Route
from mjhab.robots.robot import Robot

NEARBY_M = 2.6
"""Furniture within this distance of the work is checked for collisions."""
CLEARANCES_M = (0.012, 0.006, 0.0)
"""Least clearance of the arm at the work, and of the whole robot just before it, in the first, second and later
attempts."""


@dataclass(frozen=True, eq=False)
class HandGoals:
    """Alternative hand poses, of which one is to be reached.

    Attributes:
        pos, rot: (G, 3) and (G, 3, 3) poses of the tool centre.
        pre: (G, 3) where the straight approach begins; the rotation is the same.
        opening: (G,) distance between the pads during the approach [m].
        score: (G,) preference, higher is better; 1 is worth about half a second (10 control steps).
    """

    pos: np.ndarray
    rot: np.ndarray
    pre: np.ndarray
    opening: np.ndarray
    score: np.ndarray

    def __len__(self) -> int:
        return len(self.pos)

    def take(self, rows: np.ndarray) -> HandGoals:
        """The hand poses with the indices ``rows``."""
        return HandGoals(
            *(getattr(self, name)[rows] for name in self.__dataclass_fields__)
        )


@dataclass(frozen=True, eq=False)
class ReachScene:
    """Obstacles and robot around a work place.

    near: boxes of everything but the object. target: boxes of the object, empty while it is held. support_z: height of
    the surface that the object lies on or goes to [m]. body: the robot. held: centres and radii [m] of spheres that
    cover the held object, in the frame of the hand. limits: of the motion of the base for a held object.
    """

    near: Boxes
    target: Boxes
    support_z: float
    body: Robot
    held: tuple[np.ndarray, np.ndarray] | None = None
    limits: CommandLimits = UNLIMITED

    @property
    def all(self) -> Boxes:
        """The boxes of ``near`` and of ``target``."""
        return Boxes.join([self.near, self.target])

    @property
    def beside(self) -> Boxes:
        """Boxes of ``near`` that rise above the supporting surface."""
        top = self.near.center[:, 2] + np.einsum(
            "kj,kj->k", np.abs(self.near.rot[:, 2]), self.near.half
        )
        # Some millimetres of tolerance: the support itself, and what lies flush with it, is no neighbour.
        return self.near.take(top > self.support_z + 0.004)

    def robot(self) -> RobotSpheres:
        """Spheres of the arm and of the held object."""
        arm = motion.arm_spheres(self.body)
        return arm if self.held is None else arm.with_held(*self.held)


@dataclass(frozen=True, eq=False)
class BasePlacement:
    """A way to reach one of several hand poses.

    Attributes:
        goal: index of the hand pose in its `HandGoals`.
        pre, at: (J,) configurations at the start of the straight approach and at the hand pose.
        route: of base and arm to ``pre``, before the straight drive if there is one.
    """

    goal: int
    pre: np.ndarray
    at: np.ndarray
    route: Route


@dataclass(frozen=True, eq=False)
class Blocked:
    """Hand poses that the arm can reach, but without a collision-free straight motion from ``pre`` to ``at``.

    goals: all hand poses. goal: (N,) indices into ``goals``, best first. pre, at: (N, J) joint configurations before
    and at each hand pose. scene: obstacles. drive_in: distance of the straight drive at the end [m].
    """

    goals: HandGoals
    goal: np.ndarray
    pre: np.ndarray
    at: np.ndarray
    scene: ReachScene
    drive_in: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ReachQuery:
    """A request for a base pose, an arm motion and a route.

    Attributes:
        point: (3,) point near which the base stands [m].
        goals: hand poses, of which one is reached.
        scene: obstacles and robot.
        drive_in: distance [m] that the base drives straight forward at the end, with the arm already stretched out, for
            instance into a fridge. The route ends at this distance before the work place.
        avoid: (A, 3) base poses from which an earlier attempt failed.
        clearance: least clearance [m] at the work, see `CLEARANCES_M`.
        nearer: how much nearer [m] than that the hand may come just before its work.
        home: weight of the control steps from the work back to rest.
        far: stand far off even where one may stand nearer: that can save a long way.
        bases: (B, 3) the base poses to choose from; None: they are searched.
        start: (3,) base pose from which drives are counted, so that the choice does not depend on where the robot is;
            None: they are counted from there.
    """

    point: np.ndarray
    goals: HandGoals
    scene: ReachScene
    drive_in: float = 0.0
    avoid: np.ndarray | None = None
    clearance: float = CLEARANCES_M[0]
    nearer: float = 0.0
    home: float = 0.0
    far: bool = False
    bases: np.ndarray | None = None
    start: np.ndarray | None = None


def surroundings(view: WorldView, obj: str, point: np.ndarray) -> tuple[Boxes, Boxes]:
    """Everything solid near ``point`` (3,) but the object, and the object's bounding box."""
    parts = (view.home.boxes, view.link_boxes(), view.object_boxes((obj,)))
    others = Boxes.join(parts)
    everything = view.object_boxes()
    mine = np.array([view.object_names.index(obj)])
    return others.near(np.array([*point[:2], 0.9]), NEARBY_M), everything.take(mine)
