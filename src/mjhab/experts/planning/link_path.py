"""Motions of base and arm that lead a drawer or door by its handle: a configuration for every value of its joint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjhab.core.joints import BASE_YAW
from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning import approach
from mjhab.experts.planning.approach import Route
from mjhab.robots.robot import Robot

Array = np.ndarray
LEAD_M = 0.08
"""Largest distance between the hand and where it should be that one control step makes up for."""


@dataclass(frozen=True, eq=False)
class LinkPath:
    """Configurations ``q`` (K, J) of a robot for the joint values ``values`` (K,) [m or rad] of a link, which rise or
    fall, and the way to the first one.

    The hand's pose comes from the configurations, relative to where the base should be: no frames to keep."""

    robot: Robot
    q: Array
    values: Array
    route: Route

    def at(self, value: float) -> Array:
        """Configuration (J,) at a joint value of the link."""
        values, q = self._rising
        if value <= values[0]:
            return q[0].copy()
        if value >= values[-1]:
            return q[-1].copy()
        k = int(np.searchsorted(values, value, side="right")) - 1
        return (q[k + 1] - q[k]) / (values[k + 1] - values[k]) * (value - values[k]) + q[k]

    @cached_property
    def _rising(self) -> tuple[Array, Array]:
        """Joint values (K,) and configurations (K, J) in rising order of the values."""
        order = np.argsort(self.values)
        return self.values[order], self.q[order]

    def hand_at(self, value: float) -> tuple[Array, Array]:
        """Hand position (3,) and rotation (3, 3) in the world at a joint value of the link."""
        pos, rot = self.robot.chain.tip_pose(self.at(value))
        return pos[0], rot[0]

    @property
    def height(self) -> float:
        """Height of the hand [m]."""
        return float(self.hand_at(self.values[-1])[0][2])


def action(view: WorldView, path: LinkPath, aim: float, step: float, gripper: float) -> Array:
    """One action that moves hand and base to where the path has them at a joint value.

    Args:
        aim: joint value of the link [m or rad]. step: how far it moves on per control step, with its sign.
        gripper: action of the gripper.

    Returns:
        (A,) action.
    """
    wish = path.at(aim)
    pos, rot = path.hand_at(aim)
    q = view.q
    ahead = (path.at(aim + step)[:2] - wish[:2]) @ np.array(
        [np.cos(q[BASE_YAW]), np.sin(q[BASE_YAW])]
    )
    v, w = approach.base_towards(view, wish, float(ahead) / STEP_SECONDS)
    base_next = approach.next_base(view, v, w)
    robot = view.robot.chain
    here, _ = motion.tcp(view)
    lead = pos - here
    pos = here + lead * min(1.0, LEAD_M / max(float(np.linalg.norm(lead)), 1e-9))
    delta = ik.servo(
        robot,
        q,
        pos[None],
        rot[None],
        ik.columns(robot),
        rest=wish,
        base_next=base_next,
        options=ik.ServoOptions(rest_gain=0.1),
    )[0]
    return motion.action(view, q + delta / motion.ARM_STEP_SHARE, gripper=gripper, drive=(v, w))
