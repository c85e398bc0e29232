"""Starts with an object in the gripper, found by physics and not by a policy.

Antipodal grasp candidates on the object's geometry are tried in an empty corner of the world: the gripper at rest, the
object between the fingers, closing; those that pass the grasp test for half a second, and keep the object while the
base turns, are kept. They are spread over the ways in which a gripper can come, and remembered on disk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import RLock

import numpy as np

from mjhab.core.cache import cache_dir, write_atomic
from mjhab.core.errors import MjhabError, UsageError, unknown_name
from mjhab.core.names import below
from mjhab.core.rotations import pose_inv
from mjhab.episodes.grasps.candidates import Grasps, ObjectShape, grasp_candidates
from mjhab.layout.compile import home_hash
from mjhab.scenes.spec import ObjectType
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch
from mjhab.sim.mujoco.settle import parked_robot_qpos
from mjhab.tasks.plan import TaskConfig

HOLD_SECONDS = 0.5
STEADY_SHARE = 0.8
"""Share of the grasp test's angle that a stored grasp may use: near the limit it flickers once the robot moves."""
MAX_GRASPS = 32
MAX_TRIES = 256
MAX_OFFSET = 0.15
"""An object whose origin is further [m] from the tool centre counts as badly held (MS-HAB's
mshab/utils/gen/gen_spawn_positions.py leaves such grasps out)."""
MAX_SLANT = np.radians(50.0)
"""Largest angle [rad] between the approach and straight down, where the object has grasps within. The hand points down
at rest: what it took from the side would lie on its side in it, as few picks leave it."""
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
_VERSION = 6
_POSITION_SCALE = 0.05
_CLOSING_WEIGHT = 0.5
"""What counts as far apart: 5 cm as much as a radian of approach or two of roll."""


class NoGraspError(MjhabError):
    """No grasp of an object type holds in the robot's hand."""


def shape_of(kind: ObjectType) -> ObjectShape:
    """What a gripper sees of an object type: a box, can, ball or bowl of its size."""
    if len(kind.collision) > 1:
        return ObjectShape("bowl", kind.half)
    shape = next(iter(kind.collision)).shape
    return ObjectShape(shape if shape in ("box", "cylinder") else "sphere", kind.half)


def spread(candidates: Grasps, count: int) -> Iterator[int]:
    """Rows of at most ``count`` candidates: the best, then always the one least like all those before it."""
    if not len(candidates):
        return
    closing = _CLOSING_WEIGHT * candidates.rot[:, :, 1]
    features = np.concatenate(
        [candidates.pos / _POSITION_SCALE, candidates.rot[:, :, 0], closing], axis=1
    )
    apart = np.full(len(candidates), np.inf)
    row = 0
    for _ in range(min(count, len(candidates))):
        yield row
        apart = np.minimum(apart, np.linalg.norm(features - features[row], axis=1))
        apart[row] = -1.0
        row = int(np.argmax(apart))


@dataclass(frozen=True, eq=False)
class HeldGrasp:
    """A stable grasp: object pose (7,) in the frame of the tool centre, finger position [m]."""

    pose: np.ndarray
    fingers: float


class HeldStarts:
    """Stable grasps per object type: found once per layout, kept in the cache.

    Args:
        sim: whose layout has the objects.
        config: the grasp test.
        scratch: world to try grasps in.
        harvested: `grasps` gives those that were added too, so that starts depend on what this machine has harvested.
    """

    def __init__(
        self, sim: CpuSimulator, config: TaskConfig, scratch: Scratch, harvested: bool = False
    ) -> None:
        self.layout = sim.layout
        self.robot = sim.layout.robot
        self.config = config
        self.scratch = scratch
        self.harvested = harvested
        self._found: dict[str, list[HeldGrasp]] = {}
        self._held: dict[str, bool] = {}
        self.lock = RLock()

    def grasps(self, kind: str) -> list[HeldGrasp]:
        """Stable grasps of an object type, the most sensible one first, then as different ones as possible.

        Raises:
            UsageError: the layout has no object of this type.
            NoGraspError: no candidate holds.
        """
        with self.lock:
            if kind not in self._found:
                self._found[kind] = self.found(kind) + (self.added(kind) if self.harvested else [])
            return self._found[kind]

    def holds(self, kind: str) -> bool:
        """Whether the hand can hold an object type at all.

        Raises:
            UsageError: the layout has no object of this type.
        """
        if kind not in self._held:
            try:
                self._held[kind] = bool(self.grasps(kind))
            except NoGraspError:
                self._held[kind] = False
        return self._held[kind]

    def add(self, kind: str, pose: np.ndarray, fingers: float) -> HeldGrasp | None:
        """Add a grasp, e.g. from a successful episode, if it passes the test that the found ones passed.

        Args:
            kind: object type.
            pose: (7,) object pose in the frame of the tool centre.
            fingers: finger position [m].

        Returns:
            The grasp as it settled and was written into the cache, where every process with the same layout finds it;
            None if it does not hold.

        Raises:
            UsageError: unknown type, or numbers that are no pose.
        """
        self._check(kind)
        pose = np.asarray(pose, dtype=np.float64)
        if (
            pose.shape != (7,)
            or not np.isfinite(pose).all()
            or abs(np.linalg.norm(pose[3:]) - 1.0) > 1e-3
        ):
            raise UsageError(
                f"a grasp needs the pose x, y, z, w, x, y, z of the object in the gripper, got {pose}"
            )
        most = self.robot.finger_max
        if not 0.0 <= fingers <= most:
            raise UsageError(f"fingers must be between 0 and {most} m, got {fingers}")
        grasp = self._try(kind, pose_inv(pose), 2 * fingers)
        if grasp is None:
            return None
        name = hashlib.sha256(
            grasp.pose.tobytes() + np.float64(grasp.fingers).tobytes()
        ).hexdigest()[:16]
        _save(below(self.folder, f"{kind}-added", f"{name}.npz"), [grasp])
        with self.lock:
            if self.harvested:
                self._found.pop(kind, None)
        return grasp

    def added(self, kind: str) -> list[HeldGrasp]:
        """The grasps that were added for an object type, in the order of their hashes."""
        return [
            g
            for file in sorted((self.folder / f"{kind}-added").glob("[!.]*.npz"))
            for g in _load(file)
        ]

    def digest(self, kind: str) -> str:
        """Hash of the grasps of an object type: equal when the same draws give the same starts."""
        rows = [np.append(grasp.pose, grasp.fingers) for grasp in self.grasps(kind)]
        return hashlib.sha256(np.array(rows).tobytes()).hexdigest()[:16]

    @cached_property
    def folder(self) -> Path:
        """Where the cache keeps the grasps of this layout."""
        test = (
            self.config.grasp_force,
            self.config.grasp_angle,
            HOLD_SECONDS,
            MAX_GRASPS,
            MAX_TRIES,
            MAX_SLANT,
            _VERSION,
        )
        name = repr((home_hash(self.layout, self.layout.pack.homes[0]), test))
        return cache_dir() / "grasps" / hashlib.sha256(name.encode()).hexdigest()[:16]

    def _check(self, kind: str) -> None:
        if kind not in self.layout.roster:
            raise unknown_name("object", kind, set(self.layout.roster))

    def found(self, kind: str) -> list[HeldGrasp]:
        """As `grasps`, without those that were added."""
        self._check(kind)
        path = below(self.folder, f"{kind}.npz")
        if path.exists():
            return _load(path)
        found = self._search(kind)
        _save(path, found)
        return found

    def _search(self, kind: str) -> list[HeldGrasp]:
        shape = shape_of(self.layout.pack.objects[kind])
        candidates = grasp_candidates(
            shape, np.zeros(3), _UPRIGHT, support_z=-shape.half[2], gripper=self.robot.gripper
        )
        steep = candidates.rot[:, 2, 0] <= -np.cos(MAX_SLANT)
        if steep.any():
            candidates = candidates.take(steep)
        found: list[HeldGrasp] = []
        for row in spread(candidates, MAX_TRIES):
            tcp = np.concatenate([candidates.pos[row], candidates.quat[row]])
            grasp = self._try(kind, tcp, float(candidates.width[row]))
            if grasp is not None:
                found.append(grasp)
            if len(found) == MAX_GRASPS:
                break
        if not found:
            raise NoGraspError(
                f"no grasp of {kind} by robot {self.robot.name!r} holds for {HOLD_SECONDS} s"
            )
        return found

    def hold_in(self, kind: str, grasp: HeldGrasp, robot: np.ndarray) -> HeldGrasp | None:
        """A stable grasp as it settles in another posture; None if it does not hold there or the robot touches itself.

        Args:
            robot: (J,) joint positions, those of the fingers aside; the base away from every home.
        """
        held = self._try(kind, pose_inv(grasp.pose), 2 * grasp.fingers, robot)
        if held is None:
            return None
        slot = self.layout.roster.index(kind)
        state = self.scratch.holding(
            slot, self._with_fingers(robot, held.fingers), pose_inv(held.pose)
        )
        grip = (self.config.grasp_force, self.config.grasp_angle)
        return (
            held
            if self.scratch.collision_free(self.layout.pack.homes[0].name, state, slot, grip)
            else None
        )

    def _with_fingers(self, robot: np.ndarray, fingers: float) -> np.ndarray:
        """Joint positions (J,) with both fingers at a position [m]."""
        out = robot.copy()
        out[self.robot.columns.fingers] = fingers
        return out

    def _try(
        self, kind: str, tcp: np.ndarray, width: float, robot: np.ndarray | None = None
    ) -> HeldGrasp | None:
        """Try a grasp: pose ``tcp`` (7,) of the tool centre in the object's frame, distance of the pads [m].

        ``robot``: (J,) joint positions, those of the fingers aside; at rest if None.
        """
        slot = self.layout.roster.index(kind)
        force = self.config.grasp_force
        angle = self.config.grasp_angle
        robot = parked_robot_qpos(self.robot) if robot is None else robot
        open_hand = self._with_fingers(robot, min(0.5 * width + 0.001, self.robot.finger_max))
        held = self.scratch.try_grasp(
            slot, tcp, open_hand, HOLD_SECONDS, force, STEADY_SHARE * angle
        )
        return (
            HeldGrasp(*held)
            if held is not None and np.linalg.norm(held[0][:3]) <= MAX_OFFSET
            else None
        )


def _save(path: Path, grasps: list[HeldGrasp]) -> None:
    arrays = {
        "pose": np.array([g.pose for g in grasps]),
        "fingers": np.array([g.fingers for g in grasps]),
    }
    write_atomic(path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays))


def _load(path: Path) -> list[HeldGrasp]:
    with np.load(path, allow_pickle=False) as data:
        return [
            HeldGrasp(pose, float(fingers))
            for pose, fingers in zip(data["pose"], data["fingers"], strict=True)
        ]
