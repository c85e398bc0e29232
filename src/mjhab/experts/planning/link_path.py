"""Motions of base and arm that move a drawer or door by its handle, parameterised by the link's joint value.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjhab.core.timing import STEP_SECONDS
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning import approach
from mjhab.experts.planning.approach import Route
from mjhab.robots.robot import Robot

LEAD_M = 0.08
"""Largest position error of the tcp that one control step is asked to correct."""


@dataclass(frozen=True, eq=False)
class LinkPath:
    """Robot configurations along the motion of a link, interpolated linearly between way points.

    Attributes:
        robot: the robot.
        q: (K, J) configurations, base columns in the world.
        values: (K,) joint values of the link at these configurations [m or rad], monotonic.
        route: motion to the first configuration.
    """

    robot: Robot
    q: np.ndarray
    values: np.ndarray
    route: Route

    def at(self, value: float) -> np.ndarray:
        """Configuration (J,) at a joint value of the link [m or rad], clipped to the ends of the path."""
        values, q = self._rising
        if value <= values[0]:
            return q[0].copy()
        if value >= values[-1]:
            return q[-1].copy()
        k = int(np.searchsorted(values, value, side="right")) - 1
        return (q[k + 1] - q[k]) / (values[k + 1] - values[k]) * (value - values[k]) + q[
            k
        ]

    @cached_property
    def _rising(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint values (K,) and configurations (K, J) in rising order of the values."""
        # A closing path falls, and the search wants rising values.
        order = np.argsort(self.values)
        return self.values[order], self.q[order]

    def hand_at(self, value: float) -> tuple[np.ndarray, np.ndarray]:
        """Tcp position (3,) [m] and rotation (3, 3) in the world at a joint value of the link [m or rad]."""
        pos, rot = self.robot.chain.tip_pose(self.at(value))
        return pos[0], rot[0]

    @property
    def height(self) -> float:
        """Height of the tcp at the end of the path [m]."""
        return float(self.hand_at(self.values[-1])[0][2])


def action(
    view: WorldView, path: LinkPath, aim: float, step: float, gripper: float
) -> np.ndarray:
    """Compute the action (A,) that moves tcp and base towards their poses on the path at a joint value.

    Args:
        view: the world.
        path: the path.
        aim: joint value of the link [m or rad].
        step: change of ``aim`` per control step, with its sign; feed-forward for the base.
        gripper: gripper command.
    """
    wish = path.at(aim)
    pos, rot = path.hand_at(aim)
    # The speed that the path itself has here, so that the base does not lag behind.
    moved = path.at(aim + step)[:2] - wish[:2]
    speed = float(moved @ motion.ahead(view.base[2])) / STEP_SECONDS
    drive = approach.base_towards(view, wish, speed)
    here, _ = motion.tcp(view)
    lead = pos - here
    pos = here + lead * min(1.0, LEAD_M / max(float(np.linalg.norm(lead)), 1e-9))
    goals = ik.TipGoals(pos[None], rot[None], ik.columns(view.robot.chain), wish)
    return motion.hand_action(view, goals, gripper=gripper, drive=drive, rest_gain=0.1)
