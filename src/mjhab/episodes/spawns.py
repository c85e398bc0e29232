"""Sample robot spawns near a goal: on free floor, facing the goal, and free of collisions in simulation.

Numbers are those of mshab/utils/gen/gen_spawn_positions.py: base noise N(0, 0.1) clipped at 0.2 m, yaw noise
N(0, 0.25) clipped at 0.5 rad, arm noise N(0, 0.1) clipped at 0.2 rad; within 2 m of objects and goals, or within an
area in front of articulations. By default the robot must be within these also after the noise, with no wall between it
and the goal; the published rule of MS-HAB requires neither (`SpawnGoal.published`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.joints import BASE
from mjhab.core.rotations import mat_from_quat, pose_mul, wrap
from mjhab.scenes.freespace import FreeMap, shared_map
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch

XY_NOISE = (0.1, 0.2)
"""Noise of the base position: (standard deviation, clip) [m]."""
YAW_NOISE = (0.25, 0.5)
"""Noise of the base yaw: (standard deviation, clip) [rad]."""
ARM_NOISE = (0.1, 0.2)
"""Noise of the arm joints: (standard deviation, clip) [rad]."""
MAX_DISTANCE = 2.0
"""Largest distance [m] of the base from an object or goal, seen from above."""
TELEPORT_DISTANCE = 1.8
"""The same for the published teleports (mshab/evaluate.py)."""
TELEPORT_YAW_NOISE = (0.1, 0.5)
"""Yaw noise of the published teleports: (standard deviation, clip) [rad]."""
EYE_HEIGHT = 1.0
"""Height [m] at which the line from base to goal is tested for walls; doorways are open there."""
MAX_TRIES = 100
"""Most random tries of a spawn before the fallback."""


@dataclass(frozen=True, eq=False)
class SpawnGoal:
    """Constraints of a spawn, in the world frame [m, rad].

    The base is sampled in ``area`` if it is given, else within ``reach`` of `center`, else anywhere.

    Attributes:
        face: (2,) point that the robot faces; None: its heading is drawn from ``yaw``.
        area: (4,) floor box x_min, x_max, y_min, y_max.
        near: (2,) point to be near to; None for ``face``.
        reach: largest distance from `center`.
        yaw: range (low, high) of the heading if ``face`` is None.
        turn: largest angle between the heading and the direction to ``face``.
        yaw_noise: (standard deviation, clip) of the heading.
        slack: how far the position noise may move the base out of ``area`` or ``reach``.
        published: rule of MS-HAB: position noise is added after the robot was turned to ``face``, and a wall may be
            between robot and goal.
    """

    face: np.ndarray | None
    area: np.ndarray | None = None
    near: np.ndarray | None = None
    reach: float = MAX_DISTANCE
    yaw: tuple[float, float] = (-np.pi, np.pi)
    turn: float = np.pi
    yaw_noise: tuple[float, float] = YAW_NOISE
    slack: float = 0.0
    published: bool = False

    @property
    def center(self) -> np.ndarray | None:
        """(2,) point that the robot must be near to; None if it may be anywhere."""
        return self.face if self.near is None else self.near

    def allows(self, xy: np.ndarray, slack: float = 0.0) -> np.ndarray:
        """Return (...,) bool: bases at ``xy`` (..., 2) are in ``area`` or ``reach``, extended by ``slack`` [m]."""
        if self.area is not None:
            x_min, x_max, y_min, y_max = self.area
            inside = (xy[..., 0] >= x_min - slack) & (xy[..., 0] <= x_max + slack)
            return inside & (xy[..., 1] >= y_min - slack) & (xy[..., 1] <= y_max + slack)
        if self.center is None:
            return np.ones(xy.shape[:-1], bool)
        return (
            np.hypot(xy[..., 0] - self.center[0], xy[..., 1] - self.center[1])
            <= self.reach + slack
        )


@dataclass(frozen=True, eq=False)
class Held:
    """An object in the gripper.

    Attributes:
        slot: slot of the object.
        pose: (7,) its pose in the tcp frame [m, wxyz].
        grip: grasp test that a valid spawn must pass, see `Scratch.collision_free`; None for no test.
    """

    slot: int
    pose: np.ndarray
    grip: tuple[float, float] | None = None


class SpawnSampler:
    """Samples robot spawns. Several threads may use it.

    Args:
        sim: gives layout and compiled models; its worlds are not changed.
    """

    def __init__(self, sim: CpuSimulator) -> None:
        self.sim = sim
        self.scratch = Scratch(sim)
        self._robot = sim.layout.robot
        self._radius = self._robot.footprint.spawn
        self._arm = list(self._robot.arm_columns)
        self._homes = sim.layout.pack.homes_by_name
        self._walls: dict[str, Boxes] = {}

    def map(self, home: str) -> FreeMap:
        """Return the free-space map of a home."""
        return shared_map(self._homes[home], self.sim.layout.pack)

    def walkable(self, home: str, radius: float | None = None) -> np.ndarray:
        """Return (P, 2) centres [m] of the floor cells where a disc of ``radius`` [m] fits; None: `Footprint.spawn`."""
        return self.map(home).places(self._radius if radius is None else radius)

    def roomiest(self, home: str) -> np.ndarray:
        """Return the centre (2,) [m] of the floor cell with the largest clearance."""
        return self._roomiest(home, self.walkable(home))

    def try_once(
        self,
        home: str,
        qpos: np.ndarray,
        goal: SpawnGoal,
        rng: np.random.Generator,
        held: Held | None = None,
    ) -> np.ndarray | None:
        """Make one random try: return the new state (nq,) if it is valid, else None. Arguments as in `search`."""
        return self.search(home, qpos, goal, (rng,), held)[0]

    def search(
        self,
        home: str,
        qpos: np.ndarray,
        goal: SpawnGoal,
        rngs: Iterable[np.random.Generator],
        held: Held | None = None,
    ) -> tuple[np.ndarray | None, int]:
        """Sample spawns, one from each of ``rngs``, until one is valid.

        Args:
            home: name of the home.
            qpos: (nq,) state; only robot and held object are changed.
            goal: constraints of the spawn.
            rngs: one random generator per try.
            held: object in the gripper; the arm then starts from its posture in ``qpos``, else from rest.

        Returns:
            The new state (nq,), or None if no try was valid; and the number of tries.
        """
        candidates = self._candidates(home, goal)
        tries = 0
        for rng in rngs:
            tries += 1
            base = self._sample_base(home, goal, candidates, rng)
            arm_noise = np.clip(
                rng.normal(0, ARM_NOISE[0], len(self._arm)), -ARM_NOISE[1], ARM_NOISE[1]
            )
            found = (
                None if base is None else self._apply(home, qpos, base, arm_noise, held)
            )
            if found is not None:
                return found, tries
        return None, tries

    def at(
        self,
        home: str,
        qpos: np.ndarray,
        xy: np.ndarray,
        goal: SpawnGoal,
        held: Held | None = None,
    ) -> np.ndarray | None:
        """Return the state (nq,) with the robot at ``xy`` (2,) [m], facing the goal; None if it collides."""
        return self._apply(
            home,
            qpos,
            np.array([*xy, self._heading(xy, goal)]),
            np.zeros(len(self._arm)),
            held,
        )

    def fallback(
        self, home: str, qpos: np.ndarray, goal: SpawnGoal, held: Held | None = None
    ) -> np.ndarray:
        """Return a spawn (nq,) without noise for a goal whose random tries failed.

        It is the valid one nearest to the goal; if none is valid, the place with the largest clearance near the goal,
        where the robot may collide.
        """
        cells = self.walkable(home)
        close = goal.allows(cells, slack=1.0)
        cells = cells[close] if close.any() else cells
        center = cells.mean(axis=0) if goal.center is None else goal.center
        # Every n-th cell: a check of collisions for each one would take seconds.
        order = np.argsort(np.linalg.norm(cells - center, axis=1), kind="stable")[
            :: max(1, len(cells) // 200)
        ]
        for xy in cells[order]:
            found = self.at(home, qpos, xy, goal, held)
            if found is not None:
                return found
        # An episode must begin somehow: a fallback is told by its flag.
        best = self._roomiest(home, cells)
        return self._pose(
            home,
            qpos,
            np.array([*best, self._heading(best, goal)]),
            np.zeros(len(self._arm)),
            held,
        )

    # -- one try ---------------------------------------------------------------------------------------------------

    @staticmethod
    def _heading(xy: np.ndarray, goal: SpawnGoal) -> float:
        """Return the heading [rad] from ``xy`` to ``goal.face``; without it the middle of ``goal.yaw``."""
        if goal.face is None:
            return 0.5 * (goal.yaw[0] + goal.yaw[1])
        return math.atan2(goal.face[1] - xy[1], goal.face[0] - xy[0])

    def _roomiest(self, home: str, cells: np.ndarray) -> np.ndarray:
        return cells[int(np.argmax(self.map(home).clearance_at(cells)))]

    def _candidates(self, home: str, goal: SpawnGoal) -> np.ndarray:
        xy = self.walkable(home)
        return xy[goal.allows(xy)]

    def _sample_base(
        self, home: str, goal: SpawnGoal, candidates: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray | None:
        noise = np.clip(rng.normal(0, XY_NOISE[0], 2), -XY_NOISE[1], XY_NOISE[1])
        turn = float(
            np.clip(
                rng.normal(0, goal.yaw_noise[0]), -goal.yaw_noise[1], goal.yaw_noise[1]
            )
        )
        if not len(candidates):
            return None
        cell = candidates[int(rng.integers(len(candidates)))]
        xy = cell + noise
        # The map has cells: two centimetres of slack, as the simulator has the last word on collisions.
        if self.map(home).clearance_at(xy) < self._radius - 0.02 or not goal.allows(
            xy, goal.slack
        ):
            return None
        if goal.face is None:
            return np.array([*xy, rng.uniform(*goal.yaw)])
        if goal.published:
            # The original takes the heading before it adds the noise of the position.
            yaw = self._heading(cell, goal) + turn
            return (
                np.array([*xy, yaw])
                if abs(wrap(self._heading(xy, goal) - yaw)) <= goal.turn
                else None
            )
        if abs(turn) > goal.turn or self._behind_wall(home, xy, goal.face):
            return None
        return np.array([*xy, self._heading(xy, goal) + turn])

    def _behind_wall(self, home: str, xy: np.ndarray, face: np.ndarray) -> bool:
        """Return whether a wall intersects the line from base position to goal at EYE_HEIGHT."""
        if home not in self._walls:
            walls = [g for g in self._homes[home].walls if g.collide and g.shape == "box"]
            rot = mat_from_quat(np.array([g.quat for g in walls]).reshape(-1, 4))
            self._walls[home] = Boxes.of(
                [g.pos for g in walls], [g.size for g in walls], rot
            )
        share = np.linspace(0.0, 1.0, 60)[:, None]
        line = np.full((60, 3), EYE_HEIGHT)
        line[:, :2] = xy + share * (face - xy)
        return bool((sphere_box_distance(line, self._walls[home]) < 0.0).any())

    def _pose(
        self,
        home: str,
        qpos: np.ndarray,
        base: np.ndarray,
        arm_noise: np.ndarray,
        held: Held | None,
    ) -> np.ndarray:
        a = self.sim.addresses
        out = qpos.copy()
        # With a held object the arm has the posture of its grasp.
        robot = out[a.robot_q].copy() if held else self._robot.rest.copy()
        robot[BASE] = base
        robot[self._arm] += arm_noise
        out[a.robot_q] = robot
        if held is not None:
            start = a.object_q[held.slot]
            out[start : start + 7] = pose_mul(self.scratch.tcp_pose(home, out), held.pose)
        return out

    def _apply(
        self,
        home: str,
        qpos: np.ndarray,
        base: np.ndarray,
        arm_noise: np.ndarray,
        held: Held | None,
    ) -> np.ndarray | None:
        out = self._pose(home, qpos, base, arm_noise, held)
        carried, grip = (held.slot, held.grip) if held else (-1, None)
        return out if self.scratch.collision_free(home, out, carried, grip) else None
