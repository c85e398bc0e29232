"""Thresholds of success and failure that are common to all kinds of subtasks.

Thresholds come from the MS-HAB paper (Sec. 4 and App. A.2) and from its code (mshab/envs/planner.py,
mshab/envs/sequential_task.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from mjhab.core.errors import unknown_name
from mjhab.core.joints import JointColumns
from mjhab.core.typed.checks import check

Vec3 = tuple[float, float, float]
STILLNESS: tuple[str, ...] = ("absolute", "published")
"""Definitions of standing still: by absolute or by signed joint speeds; see `TaskConfig.stillness`."""


@dataclass(frozen=True)
class SubtaskConfig:
    """Limits of one kind of subtask: ``horizon`` in control steps, ``force_limit`` in N x control steps."""

    horizon: int
    force_limit: float


@dataclass(frozen=True)
class TaskConfig:
    """Thresholds of success and failure. Lengths [m], angles [rad], speeds [rad/s or m/s], forces [N]."""

    rest_qpos: tuple[float, ...]
    """(J,) joint positions of the robot at rest."""
    joints: JointColumns
    """Columns of base, posture and fingers among the joints."""
    ee_rest_pos: Vec3
    """Rest position of the tcp in the frame of the base link."""
    base_height: float
    """Height of the frame of the base link above the floor (mshab/envs/sequential_task.py: the base floats)."""
    endless: tuple[bool, ...] = ()
    """(J,) which joints turn without limits and are as far from rest as the shortest turn leads there. Empty: none, as
    in the original, where a joint at rest after a whole turn is not at rest."""
    limits: Mapping[str, SubtaskConfig] = field(default_factory=dict)
    """Limits of kinds of subtasks, by name, in place of those of their `SubtaskSpec`; see `registry.limits_of`."""
    continuous: bool = False
    """Evaluate a single subtask to its horizon: success does not end it, force is never reset."""
    hold_steps: int = -1
    """With ``continuous``: control steps for which an episode goes on after its first success, or after its force
    exceeds the limit; -1 for all steps to the horizon. Demonstrations need only a few."""

    goes_on: bool = False
    """In a chain: too much force, or a finished Place that is undone, mark the episode as failed and do not end it, as
    published evaluations of the original count. What was failed cannot be finished: force is not taken back."""

    ee_rest_tol: float = 0.05
    arm_tol: float = 0.2
    arm_tol_grasped: float = 0.6
    torso_tol: float = 0.01
    static_speed: float = 0.2
    static_base_speed: float = 0.05
    stillness: str = "absolute"
    """"absolute": the absolute speed of every joint is below these limits; "published": the signed speed is, so that
    joints that move in the negative direction count as still at any speed (the paper's App. A.2 and
    mani_skill/agents/robots/fetch/fetch.py take no absolute value)."""
    grasp_force: float = 0.5
    grasp_angle: float = math.radians(30.0)

    goal_type: Literal["sphere", "cylinder", "zone"] = "sphere"
    goal_tol: float = 0.15
    open_fraction_door: float = 0.75
    open_fraction_drawer: float = 0.9
    close_fraction: float = 0.01
    slightly_open_fraction: float = 0.1
    slightly_close_fraction: float = 0.05
    nav_distance: float = 2.0
    nav_bearing: float = 0.5
    ignore_arm: bool = True
    """Success of Navigate does not depend on arm and grasp; the default, because a teleport does not move them."""

    def __post_init__(self) -> None:
        check(
            len(self.rest_qpos) == self.joints.count,
            "rest_qpos",
            self.rest_qpos,
            f"the {self.joints.count} joint values of the robot",
        )
        check(
            len(self.endless) in (0, self.joints.count),
            "endless",
            self.endless,
            f"truth values, one for each of the {self.joints.count} joints",
        )
        if self.goal_type not in ("sphere", "cylinder", "zone"):
            raise unknown_name(
                "goal_type", self.goal_type, ("sphere", "cylinder", "zone")
            )
        if self.stillness not in STILLNESS:
            raise unknown_name("stillness", self.stillness, STILLNESS)

    @property
    def rest_tolerances(self) -> tuple[float, ...]:
        """Largest distance of every joint of the posture from rest [m or rad]."""
        posture = self.joints.posture
        return tuple(
            self.torso_tol if column == self.joints.torso else self.arm_tol
            for column in range(posture.start, posture.stop)
        )

    def open_fraction(self, hinged: bool) -> float:
        """Share of its range at which a link counts as open: a door if it is ``hinged``, else a drawer."""
        return self.open_fraction_door if hinged else self.open_fraction_drawer
