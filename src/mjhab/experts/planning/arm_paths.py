"""Collision-free paths of arm and torso while the base stands, found by RRT-Connect of OMPL.

Lengths [m], angles [rad], world frame. Letters: N configurations, V ends, P configurations of a path, J joints, D
joints of arm and torso.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from mjhab.experts.arm import ik
from mjhab.experts.arm.clearance import Boxes, RobotSpheres
from mjhab.experts.base.route import DRIVE_ERROR_M, MARGIN_M, SELF_CLEARANCE_M
from mjhab.robots.robot import Robot

EDGE_STEPS = 1.5
"""Distance between the checked configurations of an edge, in control steps of the slowest joint. A joint of the arm
moves 0.057 rad in it."""
MAX_EDGE_STEPS = 12.0
"""Longest edge of the trees, in control steps of the slowest joint."""
MAX_ROUNDS = 300
"""Iterations after which RRT-Connect gives up; one takes about a millisecond."""
PLANNING_SEED = 1
_PIECES = 10
"""Number of configurations that `Free.likely` checks per motion."""


@dataclass(frozen=True, eq=False)
class Free:
    """Definition of collision-free configurations.

    Attributes:
        body: the robot, for its joints.
        robot: spheres of the robot, with those of the held object.
        boxes: obstacles.
        clearance: least clearance to the boxes [m].
        own: least clearance of arm and trunk [m].
        drive: least clearance to the boxes while the base drives [m].
    """

    body: Robot
    robot: RobotSpheres
    boxes: Boxes
    clearance: float
    own: float
    drive: float

    @classmethod
    def near(cls, body: Robot, q: np.ndarray, robot: RobotSpheres, boxes: Boxes) -> Free:
        """The definition with the clearances of `plan_route`, or nearly those of configuration ``q`` (J,) if less."""
        clearance = float(robot.clearance(q, boxes)[0]) - 0.004
        own = float(robot.self_clearance(q[None])[0]) - 0.004
        return cls(
            body,
            robot,
            boxes,
            # From a start that is closer than the margin there would be no path at all.
            min(MARGIN_M, clearance),
            min(SELF_CLEARANCE_M, own),
            min(MARGIN_M + DRIVE_ERROR_M, clearance),
        )

    def spare(self, q: np.ndarray) -> np.ndarray:
        """Clearance (N,) [m] of configurations ``q`` (N, J) beyond the least one, while the base stands."""
        return np.minimum(
            self.robot.clearance(q, self.boxes) - self.clearance,
            self.robot.self_clearance(q) - self.own,
        )

    def likely(self, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Whether straight motions from ``start`` (J,) to ``ends`` (V, J) are free at `_PIECES` points: (V,) bool."""
        share = np.linspace(0.0, 1.0, _PIECES + 1)[1:, None, None]
        gap = self.spare((start + share * (ends - start)).reshape(-1, len(start)))
        return gap.reshape(_PIECES, -1).min(axis=0) >= 0.0

    def edge(self, start: np.ndarray, end: np.ndarray) -> bool:
        """Whether the straight motion between two configurations (J,) is collision-free, checked every `EDGE_STEPS`."""
        pieces = 1 + int(path_length(self.body, np.stack([start, end])) / EDGE_STEPS)
        share = np.linspace(0.0, 1.0, pieces + 1)[1:, None]
        return bool((self.spare(start + share * (end - start)) >= 0.0).all())


def arm_path(
    start: np.ndarray, end: np.ndarray, free: Free, rounds: int = MAX_ROUNDS
) -> np.ndarray | None:
    """Plan a path of arm and torso between two configurations.

    Args:
        start: (J,) first configuration.
        end: (J,) last configuration; it differs from ``start`` in arm and torso only.
        free: definition of collision-free configurations.
        rounds: iterations after which RRT-Connect gives up.

    Returns:
        (P, J) configurations with collision-free straight motions between them; None when no path is found.
    """
    # Here: it takes long to load, and most grasps need no search.
    from ompl import base, geometric, util

    # OMPL seeds every generator that it makes after this call from the seed: the same path every time. It logs an
    # error when a generator was made before, as in the second call, though the seed takes effect: hence no log.
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(PLANNING_SEED)
    info: Any = _space(start, end, free)
    problem: Any = base.ProblemDefinition(info)
    problem.setStartAndGoalStates(
        _state(free.body, info, start), _state(free.body, info, end)
    )
    planner = geometric.RRTConnect(info)
    planner.setRange(MAX_EDGE_STEPS)
    planner.setProblemDefinition(problem)
    planner.setup()
    # Rounds and not seconds: the result must not depend on how fast the machine is.
    left = iter(range(rounds))
    planner.solve(base.PlannerTerminationCondition(lambda: next(left, None) is None))
    if not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    between = [
        _joints(free.body, path.getState(i), start)
        for i in range(1, path.getStateCount() - 1)
    ]
    return _shortened(np.array([start, *between, end]), free)


def _space(start: np.ndarray, end: np.ndarray, free: Free) -> Any:
    """OMPL's ``SpaceInformation`` of arm and torso, in control steps, within half a turn of both ends (J,)."""
    from ompl import base

    class Edges(base.MotionValidator):
        """Checks all configurations of an edge in one batch."""

        def checkMotion(self, s1: Any, s2: Any, *_: Any) -> bool:
            return free.edge(_joints(free.body, s1, start), _joints(free.body, s2, start))

    robot = free.body.chain
    dofs = ik.columns(robot)
    scale = joint_scale(free.body)
    low = np.maximum(np.minimum(start, end) - np.pi, robot.lower)[dofs] / scale
    high = np.minimum(np.maximum(start, end) + np.pi, robot.upper)[dofs] / scale
    space = base.RealVectorStateSpace(len(dofs))
    bounds = base.RealVectorBounds(len(dofs))
    for i in range(len(dofs)):
        bounds.setLow(i, float(low[i]))
        bounds.setHigh(i, float(high[i]))
    space.setBounds(bounds)
    info = base.SpaceInformation(space)
    info.setStateValidityChecker(
        lambda state: bool(free.spare(_joints(free.body, state, start)[None])[0] >= 0.0)
    )
    info.setMotionValidator(Edges(info))
    info.setup()
    return info


def _joints(robot: Robot, state: Any, like: np.ndarray) -> np.ndarray:
    """Configuration (J,) of an OMPL state; all joints but arm and torso as in ``like`` (J,)."""
    q = like.copy()
    dofs = ik.columns(robot.chain)
    q[dofs] = joint_scale(robot) * [state[i] for i in range(len(dofs))]
    return q


def _state(robot: Robot, info: Any, q: np.ndarray) -> Any:
    """OMPL state of configuration ``q`` (J,), clipped to the bounds of the space."""
    state = info.allocState()
    for i, value in enumerate(q[ik.columns(robot.chain)] / joint_scale(robot)):
        state[i] = float(value)
    # Rounding in the scale may leave an end just outside.
    info.enforceBounds(state)
    return state


def _shortened(path: np.ndarray, free: Free) -> np.ndarray:
    """Path (P, J) without the configurations that a collision-free straight motion can skip."""
    kept = [path[0]]
    at = 0
    while at < len(path) - 1:
        at = next(
            # From the far end: the first that is free skips most.
            (i for i in range(len(path) - 1, at + 1, -1) if free.edge(path[at], path[i])),
            at + 1,
        )
        kept.append(path[at])
    return np.array(kept)


def path_length(robot: Robot, path: np.ndarray) -> float:
    """Control steps that arm and torso need along the configurations ``path`` (P, J)."""
    return float(
        np.max(
            np.abs(np.diff(path, axis=0))[:, ik.columns(robot.chain)]
            / joint_scale(robot),
            axis=1,
        ).sum()
    )


@lru_cache(maxsize=8)
def joint_scale(robot: Robot) -> np.ndarray:
    """Largest motion (D,) [m or rad] of the joints of arm and torso in one control step."""
    return ik.step_limits(robot.chain)[ik.columns(robot.chain)]
