"""Head motion of the experts: the head camera follows the object, handle or goal of the active subtask.

Success requires the robot to be at rest, head included. The head therefore returns to its rest position as soon as
all other conditions of success hold.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.envs.parts.world_view import WorldView
from mjhab.robots.parts import TreeLink
from mjhab.robots.robot import Robot
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import spec_of

RESTING = frozenset({"ee_rest", "robot_rest", "is_static"})
"""Conditions of success that concern the robot's posture or motion, and with it the head."""
NEAREST_M = 0.2
"""Points at a smaller horizontal distance from the pan axis are not looked at: the pan angle is ill-defined there."""


@dataclass(frozen=True)
class Neck:
    """Kinematics of a head with a pan joint about z and a tilt joint about y, on a torso that moves along z.

    Attributes:
        pan_at: (3,) position of the pan joint in the frame of the base link, with the torso at 0 [m].
        tilt_at: (3,) position of the tilt joint in the frame of the pan link [m].
    """

    pan_at: tuple[float, float, float]
    tilt_at: tuple[float, float, float]

    def angles(self, point: np.ndarray, lift: float) -> tuple[float, float] | None:
        """Compute pan and tilt [rad] that point the head at a position.

        Args:
            point: (3,) position in the frame of the base link [m].
            lift: height of the torso above its zero position [m].

        Returns:
            Pan and tilt, not limited to the joints' ranges; None if the point is nearer than `NEAREST_M` to the axis.
        """
        x, y, z = point - np.array(self.pan_at) - (0.0, 0.0, lift)
        out = math.hypot(x, y)
        if out < NEAREST_M:
            return None
        # Tilting down is positive in a turn about y.
        tilt = -math.atan2(z - self.tilt_at[2], max(out - self.tilt_at[0], NEAREST_M))
        return math.atan2(y, x), tilt


def neck_of(robot: Robot) -> Neck | None:
    """Pan and tilt joints of a robot's head; None if its head is not a pan joint about z followed by a tilt about y."""
    head = robot.group("head")
    links = {row.joint: row for row in robot.body.tree if row.joint}
    # Other heads cannot be pointed by two angles.
    if len(head) != 2:
        return None
    pan = links[head[0]]
    tilt = links[head[1]]
    if (
        pan.axis != (0.0, 0.0, 1.0)
        or tilt.axis != (0.0, 1.0, 0.0)
        or tilt.parent != pan.link
    ):
        return None
    return Neck(_origin(robot, pan), tilt.origin)


def _origin(robot: Robot, link: TreeLink) -> tuple[float, float, float]:
    """Origin of a link in the frame of the base link [m] with all joints at 0, for ancestors without fixed rotation."""
    rows = {row.link: row for row in robot.body.tree}
    total = np.zeros(3)
    at: TreeLink | None = link
    while at is not None:
        total += at.origin
        at = rows.get(at.parent)
    return float(total[0]), float(total[1]), float(total[2])


def focus(view: WorldView) -> np.ndarray | None:
    """Point (3,) in the world [m] that the head looks at: handle, object or goal position of the active subtask.

    Returns:
        None when no subtask is active, or when all its conditions hold except those in `RESTING`.
    """
    subtask = view.subtask
    if subtask is None:
        return None
    spec = spec_of(subtask.kind)
    known = Signals.__dataclass_fields__
    work = [name for name in spec.conditions if name in known and name not in RESTING]
    # The head has to rest for success, and it takes some steps to get there.
    if work and all(view.signal(name) for name in work):
        return None
    return worked_on(view)


def worked_on(view: WorldView) -> np.ndarray | None:
    """Handle, object or goal position (3,) of the active subtask in the world [m]; None when no subtask is active."""
    subtask = view.subtask
    if subtask is None:
        return None
    spec = spec_of(subtask.kind)
    if spec.jointed and subtask.link in view.home.links:
        return view.home.links[subtask.link].handle_pose(view.link_q(subtask.link))[0]
    if (
        "object" in spec.shows
        and subtask.obj
        and not (spec.brings_to_goal or spec.navigates)
    ):
        return view.object_pose(subtask.obj)[:3]
    return np.array(subtask.goal_pos, float)


class Gaze:
    """Adds commands of the head joints to actions, so that the head follows `focus`.

    Args:
        robot: the robot that acts.
        stationary: parts that do not follow their actions, see `EnvConfig.stationary`.
    """

    def __init__(self, robot: Robot, stationary: tuple[str, ...]) -> None:
        self._robot = robot
        # A stationary head ignores its entries of the action.
        self._neck = None if "head" in stationary else neck_of(robot)
        self._rest = np.array([robot.rest_qpos[column] for column in robot.head_columns])
        limits = [robot.joint_limits[column] for column in robot.head_columns]
        self._low = np.array([low for low, _ in limits])
        self._high = np.array([high for _, high in limits])

    def turn(self, view: WorldView, action: np.ndarray) -> np.ndarray:
        """``action`` (A,) with head commands towards the `focus`; unchanged if the head has no movable `Neck`."""
        if self._neck is None:
            return action
        goal = self._wanted(self._neck, view)
        wish = (
            goal - view.q[list(self._robot.head_columns)]
        ) / self._robot.limits.joint_delta
        # The expert's own action may be recorded as well.
        turned = action.copy()
        turned[list(self._robot.action.head)] = np.clip(wish, -1.0, 1.0)
        return turned

    def _wanted(self, neck: Neck, view: WorldView) -> np.ndarray:
        """Wanted pan and tilt (2,) [rad]: towards the `focus`, else the rest position."""
        point = focus(view)
        if point is None:
            return self._rest
        base = view.base
        c = math.cos(base[BASE_YAW])
        s = math.sin(base[BASE_YAW])
        x, y = point[:2] - base[BASE_XY]
        here = np.array(
            [c * x + s * y, c * y - s * x, point[2] - self._robot.base_height]
        )
        torso = self._robot.torso_columns
        lift = float(view.q[list(torso)].sum())
        angles = neck.angles(here, lift)
        return self._rest if angles is None else np.clip(angles, self._low, self._high)
