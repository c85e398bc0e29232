"""Carry postures: arm postures with a held object, from which Place starts under the published spawn rule.

MS-HAB takes them from the final states of Picks by a trained policy (mshab/utils/gen/gen_spawn_positions.py). Here, arm
postures that pass the posture test of Pick are sampled, and those in which a stable grasp also holds in simulation are
kept. They are cached on disk per layout.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.errors import MjhabError
from mjhab.core.files.cache import read_cached, write_cached
from mjhab.core.seeding import stream
from mjhab.episodes.grasps.stable import HOLD_TIME_S, StableGrasp, StableGrasps
from mjhab.robots.damped_steps import damped_step
from mjhab.robots.robot import Robot
from mjhab.sim.mujoco.settle import parked_robot_qpos
from mjhab.tasks.thresholds import TaskConfig

MAX_ARMS = 32
"""Most carry postures per object type."""
MAX_TRIES = 256
"""Most arm postures sampled per object type."""
SOLVER_STEPS = 20
"""Damped least-squares steps that bring the tcp of a sampled posture to its goal."""
REST_SHARE = 0.9
"""Fraction of Pick's tolerance of the tcp's rest position that postures use, because they settle a little."""
_VERSION = 1


@dataclass(frozen=True, eq=False)
class CarryPosture:
    """``arm``: (A,) joint positions [rad] in the order of the robot's group "arm"; ``grasp``: of the held object."""

    arm: np.ndarray
    grasp: StableGrasp


class CarryPostures:
    """Carry postures per object type: made once per layout and cached on disk.

    Args:
        held: stable grasps; those of `StableGrasps.add` are not used.
    """

    def __init__(self, held: StableGrasps) -> None:
        self._held = held
        self._arms: dict[str, list[CarryPosture]] = {}

    def arms(self, kind: str) -> list[CarryPosture]:
        """Return the carry postures of an object type.

        Raises:
            UsageError: the layout has no object of this type.
            MjhabError: no grasp is stable in any sampled posture.
        """
        # One lock for both, since making postures searches grasps.
        with self._held.lock:
            if kind not in self._arms:
                path = self._path(kind)
                found = read_cached(path, _load)
                if found is None:
                    # Read back from the file, so that the first run has the same bits as later ones.
                    found = _load(_save(path, self._make(kind)))
                self._arms[kind] = found
            return self._arms[kind]

    def digest(self, kind: str) -> str:
        """Return the hash of the carry postures of an object type."""
        rows = [
            np.concatenate([one.arm, one.grasp.pose, [one.grasp.fingers]])
            for one in self.arms(kind)
        ]
        return hashlib.sha256(np.array(rows).tobytes()).hexdigest()[:16]

    def _path(self, kind: str) -> Path:
        config = self._held.config
        test = (
            config.ee_rest_pos,
            config.ee_rest_tol,
            config.arm_tol_grasped,
            MAX_ARMS,
            MAX_TRIES,
        )
        made = hashlib.sha256(
            repr((test, SOLVER_STEPS, REST_SHARE, _VERSION)).encode()
        ).hexdigest()[:8]
        return self._held.folder / f"{kind}-arms-{made}.npz"

    def _make(self, kind: str) -> list[CarryPosture]:
        grasps = self._held.found(kind)
        robot = self._held.robot
        random = stream(0, "held arms", kind)
        postures = rest_postures(robot, random, self._held.config, MAX_TRIES)
        made: list[CarryPosture] = []
        for number, arm in enumerate(postures):
            grasp = self._held.hold_in(
                # In turn, so that a good grasp does not take all postures.
                kind,
                grasps[number % len(grasps)],
                _parked(robot, arm),
            )
            if grasp is not None:
                made.append(CarryPosture(arm, grasp))
            if len(made) == MAX_ARMS:
                break
        if not made:
            raise MjhabError(
                f"no grasp of {kind} holds for {HOLD_TIME_S} s in a posture in which a Pick succeeds"
            )
        return made


def rest_postures(
    robot: Robot, rng: np.random.Generator, config: TaskConfig, count: int
) -> np.ndarray:
    """Sample arm postures that pass the posture test of Pick, with torso and head at rest.

    Postures are drawn uniformly within the joint tolerance around rest; inverse kinematics then moves the tcp to a
    random point near its rest position.

    Args:
        robot: the robot.
        rng: draws postures and points.
        config: tolerances of the posture test.
        count: number of postures drawn.

    Returns:
        (N, A) joint positions [rad], N <= ``count``: those whose tcp is within the tolerance.
    """
    chain = robot.chain
    columns = np.array(robot.arm_columns)
    rest = robot.rest[columns]
    low = np.maximum(chain.lower[columns], rest - config.arm_tol_grasped)
    high = np.minimum(chain.upper[columns], rest + config.arm_tol_grasped)
    q = np.repeat(robot.rest[None], count, axis=0)
    q[:, columns] = rng.uniform(low, high, (count, len(rest)))
    allowed = REST_SHARE * config.ee_rest_tol
    offset = rng.normal(size=(count, 3))
    offset *= (
        allowed
        # The cube root makes points uniform in a ball: most of its volume is far from the centre.
        * rng.uniform(size=(count, 1)) ** (1 / 3)
        / np.linalg.norm(offset, axis=1, keepdims=True)
    )
    # The rest position is relative to the base link, whose origin lies higher than the floor.
    center = np.add(config.ee_rest_pos, (0.0, 0.0, config.base_height))
    nothing = np.zeros((count, len(rest)))
    for _ in range(SOLVER_STEPS):
        error = center + offset - chain.tip_pose(q)[0]
        step = damped_step(error, chain.jacobian(q)[:, :3, columns], nothing)
        # The tolerance of the joints is a limit as hard as those of the joints themselves.
        q[:, columns] = np.clip(q[:, columns] + step, low, high)
    # With clipped joints the solver need not arrive.
    there = np.linalg.norm(chain.tip_pose(q)[0] - center, axis=1) <= allowed
    return q[there][:, columns]


def _parked(robot: Robot, arm: np.ndarray) -> np.ndarray:
    """Return (J,) joint positions of the parked robot with an arm posture (A,)."""
    q = parked_robot_qpos(robot)
    q[list(robot.arm_columns)] = arm
    return q


def _save(path: Path, arms: list[CarryPosture]) -> Path:
    arrays = {
        "arm": np.array([one.arm for one in arms]),
        "pose": np.array([one.grasp.pose for one in arms]),
        "fingers": np.array([one.grasp.fingers for one in arms]),
    }
    return write_cached(
        # Without pickles a file from elsewhere cannot run code.
        path,
        lambda temporary: np.savez(temporary, allow_pickle=False, **arrays),
    )


def _load(path: Path) -> list[CarryPosture]:
    with np.load(path, allow_pickle=False) as data:
        rows = zip(data["arm"], data["pose"], data["fingers"], strict=True)
        return [
            CarryPosture(arm, StableGrasp(pose, float(fingers)))
            for arm, pose, fingers in rows
        ]
