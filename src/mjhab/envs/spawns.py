"""Robot starts near a target: navigable, facing it, collision-free by simulation.

Numbers are those of mshab/utils/gen/gen_spawn_positions.py: base noise N(0, 0.1) clipped at 0.2 m, yaw noise
N(0, 0.25) clipped at 0.5 rad, arm noise N(0, 0.1) clipped at 0.2 rad, within 2 m of objects and goals, and for
articulations within an area in front of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.rotations import mat_from_quat, pose_mul
from mjhab.envs.actions import ARM_JOINTS
from mjhab.scenes.fetch import REST_QPOS
from mjhab.scenes.freespace import BASE_RADIUS, FreeMap, free_map
from mjhab.scenes.spec import Home
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.scratch import Scratch

XY_NOISE, YAW_NOISE, ARM_NOISE = (0.1, 0.2), (0.25, 0.5), (0.1, 0.2)
"""(standard deviation, clip) in m, rad, rad."""
MAX_DISTANCE = 2.0
EYE_HEIGHT = 1.0
"""Height [m] at which a wall between robot and goal counts; doorways are open there."""
MAX_TRIES = 100


@dataclass(frozen=True, eq=False)
class SpawnGoal:
    """Where to spawn: within 2 m of ``face`` (2,) or, with ``area``, in that world box (x_min, x_max, y_min, y_max)."""

    face: np.ndarray
    area: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Held:
    """An object in the gripper: its slot and its pose (7,) in the frame of gripper_link."""

    slot: int
    pose: np.ndarray


class SpawnSampler:
    """Draws starts one try at a time, so that a hard one never holds up the other worlds."""

    def __init__(self, sim: CpuSimulator) -> None:
        self.sim = sim
        self.scratch = Scratch(sim)
        self._maps: dict[str, FreeMap] = {}
        self._standing: dict[str, np.ndarray] = {}
        self._walls: dict[str, Boxes] = {}

    def map(self, home: str) -> FreeMap:
        """Free-space map of a home."""
        if home not in self._maps:
            self._maps[home] = free_map(self._home(home), self.sim.layout.pack)
        return self._maps[home]

    def _walkable(self, home: str) -> np.ndarray:
        """(P, 2) centres of the cells where the robot can stand."""
        if home not in self._standing:
            fmap = self.map(home)
            self._standing[home] = fmap.to_xy(np.argwhere(fmap.navigable(BASE_RADIUS)))
        return self._standing[home]

    def try_once(
        self, home: str, qpos: np.ndarray, goal: SpawnGoal, rng: np.random.Generator, held: Held | None = None
    ) -> np.ndarray | None:
        """One random try.

        Args:
            home: home of the world.
            qpos: (nq,) its present state; objects and joints stay, robot and held object move.
            goal: where to stand.
            rng: stream of this try.
            held: what the gripper carries.

        Returns:
            The new state (nq,) when it is valid, else None.
        """
        base = self._sample_base(home, goal, rng)
        arm_noise = np.clip(rng.normal(0, ARM_NOISE[0], 7), -ARM_NOISE[1], ARM_NOISE[1])
        if base is None:
            return None
        return self._apply(home, qpos, base, arm_noise, held)

    def at(self, home: str, qpos: np.ndarray, xy: np.ndarray, goal: SpawnGoal) -> np.ndarray | None:
        """The state with the robot at ``xy`` (2,) in its rest pose, facing the goal; None when it touches something."""
        return self._apply(home, qpos, np.array([*xy, self._bearing(xy, goal)]), np.zeros(7), None)

    def fallback(self, home: str, qpos: np.ndarray, goal: SpawnGoal, held: Held | None = None) -> np.ndarray:
        """Without noise: the nearest valid start, else the roomiest place near the goal (the caller flags it)."""
        cells = self._candidates(home, goal, MAX_DISTANCE + 1.0)
        order = np.argsort(np.linalg.norm(cells - goal.face, axis=1), kind="stable")[:: max(1, len(cells) // 200)]
        for xy in cells[order]:
            base = np.array([*xy, self._bearing(xy, goal)])
            found = self._apply(home, qpos, base, np.zeros(7), held)
            if found is not None:
                return found
        fmap = self.map(home)
        best = max(cells, key=lambda xy: float(fmap.clearance[tuple(fmap.to_cell(xy))]))
        return self._pose(home, qpos, np.array([*best, self._bearing(best, goal)]), np.zeros(7), held)

    # -- one try ---------------------------------------------------------------------------------------------------

    @staticmethod
    def _bearing(xy: np.ndarray, goal: SpawnGoal) -> float:
        return float(np.arctan2(goal.face[1] - xy[1], goal.face[0] - xy[0]))

    def _candidates(self, home: str, goal: SpawnGoal, reach: float = MAX_DISTANCE) -> np.ndarray:
        xy = self._walkable(home)
        near = np.linalg.norm(xy - goal.face, axis=1) <= reach
        if goal.area is not None:
            inside = self._inside(xy, goal.area)
            near = inside if inside.any() else near
        return xy[near]

    @staticmethod
    def _inside(xy: np.ndarray, area: np.ndarray) -> np.ndarray:
        x_min, x_max, y_min, y_max = area
        return (xy[..., 0] >= x_min) & (xy[..., 0] <= x_max) & (xy[..., 1] >= y_min) & (xy[..., 1] <= y_max)

    def _sample_base(self, home: str, goal: SpawnGoal, rng: np.random.Generator) -> np.ndarray | None:
        candidates = self._candidates(home, goal)
        noise = np.clip(rng.normal(0, XY_NOISE[0], 2), -XY_NOISE[1], XY_NOISE[1])
        turn = float(np.clip(rng.normal(0, YAW_NOISE[0]), -YAW_NOISE[1], YAW_NOISE[1]))
        if not len(candidates):
            return None
        xy = candidates[int(rng.integers(len(candidates)))] + noise
        fmap = self.map(home)
        cell = fmap.to_cell(xy)
        inside = np.all(cell >= 0) and np.all(cell < fmap.clearance.shape)
        if not inside or fmap.clearance[tuple(cell)] < BASE_RADIUS - 0.02:
            return None
        if np.linalg.norm(xy - goal.face) > MAX_DISTANCE or (goal.area is not None and not self._inside(xy, goal.area)):
            return None
        if self._behind_wall(home, xy, goal):
            return None
        return np.array([*xy, self._bearing(xy, goal) + turn])

    def _behind_wall(self, home: str, xy: np.ndarray, goal: SpawnGoal) -> bool:
        """Whether a wall stands between a base and its goal: two metres through a wall are a long way round."""
        if home not in self._walls:
            walls = [g for g in self._home(home).walls if g.collide and g.shape == "box"]
            rot = mat_from_quat(np.array([g.quat for g in walls]).reshape(-1, 4))
            self._walls[home] = Boxes.of([g.pos for g in walls], [g.size for g in walls], rot)
        share = np.linspace(0.0, 1.0, 60)[:, None]
        line = np.full((60, 3), EYE_HEIGHT)
        line[:, :2] = xy + share * (goal.face - xy)
        return bool((sphere_box_distance(line, self._walls[home]) < 0.0).any())

    def _home(self, name: str) -> Home:
        return next(h for h in self.sim.layout.pack.homes if h.name == name)

    def _pose(
        self, home: str, qpos: np.ndarray, base: np.ndarray, arm_noise: np.ndarray, held: Held | None
    ) -> np.ndarray:
        a = self.sim.addresses
        out = qpos.copy()
        robot = out[a.robot_q].copy() if held else np.array(REST_QPOS, dtype=np.float64)
        robot[:3] = base
        robot[list(ARM_JOINTS)] += arm_noise
        out[a.robot_q] = robot
        if held is not None:
            start = a.object_q[held.slot]
            out[start : start + 7] = pose_mul(self.scratch.tcp_pose(home, out), held.pose)
        return out

    def _apply(
        self, home: str, qpos: np.ndarray, base: np.ndarray, arm_noise: np.ndarray, held: Held | None
    ) -> np.ndarray | None:
        out = self._pose(home, qpos, base, arm_noise, held)
        carried = held.slot if held else -1
        return out if self.scratch.collision_free(home, out, carried) else None
