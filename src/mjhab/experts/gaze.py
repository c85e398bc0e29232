"""Where the head looks while a script works: at what the subtask is about, and ahead again when the work is done.

Success asks for a robot at rest, head included, so the head turns back as soon as only that is missing.
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
"""Conditions of success that the head has a part in."""
NEAREST_M = 0.2
"""What is nearer to the axis of the neck has no direction to look in."""


@dataclass(frozen=True)
class Neck:
    """A head that pans about z, then tilts about y, on a torso that only lifts it. Lengths [m].

    ``pan_at`` (3,): the axis of pan in the frame of the base link, with the torso down; ``tilt_at`` (3,): the axis of
    tilt in the frame that pans.
    """

    pan_at: tuple[float, float, float]
    tilt_at: tuple[float, float, float]

    def angles(self, point: np.ndarray, lift: float) -> tuple[float, float] | None:
        """Pan and tilt [rad] that look at ``point`` (3,) in the frame of the base link; None if it is too near."""
        x, y, z = point - np.array(self.pan_at) - (0.0, 0.0, lift)
        out = math.hypot(x, y)
        if out < NEAREST_M:
            return None
        tilt = -math.atan2(z - self.tilt_at[2], max(out - self.tilt_at[0], NEAREST_M))
        return math.atan2(y, x), tilt


def neck_of(robot: Robot) -> Neck | None:
    """The neck of a robot; None if it has no head that pans and tilts."""
    head = robot.group("head")
    links = {row.joint: row for row in robot.body.tree if row.joint}
    if len(head) != 2:
        return None
    pan = links[head[0]]
    tilt = links[head[1]]
    if pan.axis != (0.0, 0.0, 1.0) or tilt.axis != (0.0, 1.0, 0.0) or tilt.parent != pan.link:
        return None
    return Neck(_origin(robot, pan), tilt.origin)


def _origin(robot: Robot, link: TreeLink) -> tuple[float, float, float]:
    """Origin of a link in the frame of the base link with all joints at 0; its ancestors are not turned."""
    rows = {row.link: row for row in robot.body.tree}
    total = np.zeros(3)
    at: TreeLink | None = link
    while at is not None:
        total += at.origin
        at = rows.get(at.parent)
    return float(total[0]), float(total[1]), float(total[2])


def focus(view: WorldView) -> np.ndarray | None:
    """The point (3,) in the world that the active subtask is about; None when its work is done, or there is none."""
    subtask = view.subtask
    if subtask is None:
        return None
    spec = spec_of(subtask.kind)
    known = Signals.__dataclass_fields__
    work = [name for name in spec.conditions if name in known and name not in RESTING]
    if work and all(view.signal(name) for name in work):
        return None
    if spec.jointed and subtask.link in view.home.links:
        return view.home.links[subtask.link].handle_pose(view.link_q(subtask.link))[0]
    if "object" in spec.shows and subtask.obj and not (spec.brings_to_goal or spec.navigates):
        return view.object_pose(subtask.obj)[:3]
    return np.array(subtask.goal_pos, float)


class Gaze:
    """Turns the head of one robot to what its script works on.

    Args:
        robot: whose head.
        stationary: parts that do not follow their actions, see `EnvConfig.stationary`.
    """

    def __init__(self, robot: Robot, stationary: tuple[str, ...]) -> None:
        self._robot = robot
        self._neck = None if "head" in stationary else neck_of(robot)
        self._rest = np.array([robot.rest_qpos[column] for column in robot.head_columns])
        limits = [robot.joint_limits[column] for column in robot.head_columns]
        self._low = np.array([low for low, _ in limits])
        self._high = np.array([high for _, high in limits])

    def turn(self, view: WorldView, action: np.ndarray) -> np.ndarray:
        """The action (A,) with the head turned to the `focus`; as it is for a robot whose head cannot."""
        if self._neck is None:
            return action
        goal = self._wanted(self._neck, view)
        wish = (goal - view.q[list(self._robot.head_columns)]) / self._robot.limits.joint_delta
        turned = action.copy()
        turned[list(self._robot.action.head)] = np.clip(wish, -1.0, 1.0)
        return turned

    def _wanted(self, neck: Neck, view: WorldView) -> np.ndarray:
        """Pan and tilt (2,) [rad]."""
        point = focus(view)
        if point is None:
            return self._rest
        base = view.base
        c = math.cos(base[BASE_YAW])
        s = math.sin(base[BASE_YAW])
        x, y = point[:2] - base[BASE_XY]
        here = np.array([c * x + s * y, c * y - s * x, point[2] - self._robot.base_height])
        torso = self._robot.torso_columns
        lift = float(view.q[list(torso)].sum())
        angles = neck.angles(here, lift)
        return self._rest if angles is None else np.clip(angles, self._low, self._high)
