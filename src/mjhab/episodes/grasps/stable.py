"""Stable grasps: grasps that hold in simulation, for starts with an object in the gripper.

Grasp candidates on the object's geometry are simulated away from the home: the gripper closes on the object. Those that
pass the grasp test for half a second, and keep the object while the base turns, are kept. They are spread over grasp
positions and directions of approach, and cached on disk.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import RLock

import numpy as np

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.errors import MjhabError, unknown_name
from mjhab.core.files.cache import cache_dir, read_cached, write_cached
from mjhab.core.names import below
from mjhab.core.rotations import pose_inv
from mjhab.core.typed.checks import check
from mjhab.episodes.grasps.candidates import (
    Grasps,
    LyingObject,
    ObjectShape,
    grasp_candidates,
)
from mjhab.episodes.grasps.spread import farthest_points
from mjhab.layout.compile import home_hash
from mjhab.robots.parts import Gripper
from mjhab.robots.registry import robot_named
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.spec import ObjectType
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch
from mjhab.sim.mujoco.settle import parked_robot_qpos
from mjhab.tasks.thresholds import TaskConfig

HOLD_TIME_S = 0.5
"""Time [s] for which a grasp must pass the grasp test."""
STEADY_SHARE = 0.8
"""Fraction of the grasp test's angle that stable grasps may have; closer to the limit a moving robot fails the test."""
MAX_GRASPS = 32
"""Most stable grasps per object type."""
MAX_TRIES = 256
"""Most candidates simulated per object type."""
MAX_OFFSET_M = 0.15
"""Largest distance [m] of an object's origin from the tcp in a grasp (mshab/utils/gen/gen_spawn_positions.py)."""
MAX_APPROACH_SLANT_RAD = np.radians(50.0)
"""Largest angle [rad] between approach and straight down; ignored for objects without such grasps. The hand points down
at rest, so that an object grasped from the side would be tilted in a way that few Picks result in."""
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
_VERSION = 6
_POSITION_SCALE_M = 0.05
"""Distance [m] of grasps that counts as much as 1 rad between their approaches, when grasps are spread."""
_CLOSING_WEIGHT = 0.5
"""Weight of the angle between closing lines against that between approaches, when grasps are spread."""


class NoGraspError(MjhabError):
    """No grasp of an object type is stable in the robot's gripper."""


def shape_of(
    kind: ObjectType, meshes: Mapping[str, object], gripper: Gripper | None = None
) -> ObjectShape:
    """Return the shape on which grasps of an object type are searched: a primitive of its size, or surface grasps.

    Args:
        kind: the object type.
        meshes: meshes by name (`Pack.meshes`).
        gripper: sizes of the gripper; None for the default robot's.
    """
    if kind.grasp_shape == "mesh":
        return _mesh_shape(kind, meshes, gripper or robot_named().gripper)
    # A bowl is the one object of the pack whose collision shape is a ring of pieces.
    if len(kind.collision) > 1:
        return ObjectShape("bowl", kind.half)
    shape = next(iter(kind.collision)).shape
    return ObjectShape(shape if shape in ("box", "cylinder") else "sphere", kind.half)


_mesh_shapes: dict[str, ObjectShape] = {}
"""Cache of mesh shapes by a hash of object and gripper: searching the grasps of one takes about a second."""


def _mesh_shape(
    kind: ObjectType, meshes: Mapping[str, object], gripper: Gripper
) -> ObjectShape:
    pieces = np.concatenate([outline(geom, meshes) for geom in kind.collision])
    key = hashlib.sha256(repr((kind, gripper)).encode() + pieces.tobytes()).hexdigest()
    if key not in _mesh_shapes:
        # Imported on use: trimesh takes long to import, and few packs have meshes.
        from mjhab.episodes.grasps.antipodal import surface_grasps

        grasps = surface_grasps(kind, meshes, gripper)
        _mesh_shapes[key] = ObjectShape("mesh", kind.half, grasps=grasps)
    return _mesh_shapes[key]


def spread(candidates: Grasps, count: int) -> Iterator[int]:
    """Yield rows of at most ``count`` candidates: the best, then always the one most different from those before."""
    if not len(candidates):
        return
    closing = _CLOSING_WEIGHT * candidates.rot[:, :, 1]
    features = np.concatenate(
        [candidates.pos / _POSITION_SCALE_M, candidates.rot[:, :, 0], closing], axis=1
    )
    yield from farthest_points(features, count).tolist()


@dataclass(frozen=True, eq=False)
class StableGrasp:
    """A stable grasp: object pose (7,) in the tcp frame [m, wxyz], and finger position [m]."""

    pose: np.ndarray
    fingers: float


class StableGrasps:
    """Stable grasps per object type: searched once per layout and cached on disk. Several threads may use it.

    Args:
        sim: CPU simulator of the layout.
        config: thresholds of the grasp test.
        scratch: simulates grasps.
        harvested: `grasps` also returns those of `add`, so that starts depend on the grasps added on this machine.
    """

    def __init__(
        self,
        sim: CpuSimulator,
        config: TaskConfig,
        scratch: Scratch,
        harvested: bool = False,
    ) -> None:
        self.layout = sim.layout
        self.robot = sim.layout.robot
        self.config = config
        self.scratch = scratch
        self.harvested = harvested
        self._found: dict[str, list[StableGrasp]] = {}
        self._held: dict[str, bool] = {}
        # Reentrant, since a search may be started while the lock is held.
        self.lock = RLock()

    def grasps(self, kind: str) -> list[StableGrasp]:
        """Return the stable grasps of an object type, the best score first, then as different ones as possible.

        Raises:
            UsageError: the layout has no object of this type.
            NoGraspError: no candidate is stable.
        """
        with self.lock:
            if kind not in self._found:
                self._found[kind] = self.found(kind) + (
                    self.added(kind) if self.harvested else []
                )
            return self._found[kind]

    def holds(self, kind: str) -> bool:
        """Return whether there is a stable grasp of an object type.

        Raises:
            UsageError: the layout has no object of this type.
        """
        if kind not in self._held:
            try:
                self._held[kind] = bool(self.grasps(kind))
            except NoGraspError:
                self._held[kind] = False
        return self._held[kind]

    def add(self, kind: str, pose: np.ndarray, fingers: float) -> StableGrasp | None:
        """Add a grasp, e.g. from a successful episode, to the cache of this layout if it is stable.

        Args:
            kind: object type.
            pose: (7,) object pose in the tcp frame [m, wxyz].
            fingers: finger position [m].

        Returns:
            The grasp as it settled and was written to the cache; None if it is not stable.

        Raises:
            UsageError: the object type is unknown, ``pose`` is not a pose, or ``fingers`` is out of range.
        """
        self._check(kind)
        pose = np.asarray(pose, dtype=np.float64)
        good = (
            pose.shape == (7,)
            and np.isfinite(pose).all()
            and abs(np.linalg.norm(pose[3:], axis=-1) - 1.0) <= 1e-3
        )
        check(
            bool(good),
            "pose of a grasp",
            pose,
            "x, y, z, w, x, y, z of the object in the gripper",
        )
        most = self.robot.finger_max
        check(0.0 <= fingers <= most, "fingers", fingers, f"between 0 and {most} m")
        grasp = self._try(kind, pose_inv(pose), 2 * fingers)
        if grasp is None:
            return None
        name = hashlib.sha256(
            grasp.pose.tobytes() + np.float64(grasp.fingers).tobytes()
        ).hexdigest()[:16]
        # A file of its own for each, so that processes that add at the same time do not overwrite each other.
        _save(below(self.folder, f"{kind}-added", f"{name}.npz"), [grasp])
        with self.lock:
            if self.harvested:
                # Read again on next use, in the order of the hashes, which does not depend on who added when.
                self._found.pop(kind, None)
        return grasp

    def added(self, kind: str) -> list[StableGrasp]:
        """Return the grasps of an object type that `add` has cached, in the order of their hashes."""
        return [
            g
            # Without files that are being written, whose names begin with a dot.
            for file in sorted((self.folder / f"{kind}-added").glob("[!.]*.npz"))
            for g in _load(file)
        ]

    def digest(self, kind: str) -> str:
        """Return the hash of the grasps of an object type."""
        rows = [np.append(grasp.pose, grasp.fingers) for grasp in self.grasps(kind)]
        return hashlib.sha256(np.array(rows).tobytes()).hexdigest()[:16]

    @cached_property
    def folder(self) -> Path:
        """Folder in the cache with the grasps of this layout."""
        test = (
            self.config.grasp_force,
            self.config.grasp_angle,
            HOLD_TIME_S,
            MAX_GRASPS,
            MAX_TRIES,
            MAX_APPROACH_SLANT_RAD,
            _VERSION,
        )
        # The hash of a home covers what its model is made of, not the sizes that the search goes by.
        hand = (self.robot.gripper, self.robot.limits.gripper)
        name = repr((home_hash(self.layout, self.layout.pack.homes[0]), hand, test))
        # Whether a grasp holds can depend on the last bits, which differ between machines.
        key = hashlib.sha256(name.encode() + arithmetic_digest()).hexdigest()[:16]
        return cache_dir() / "grasps" / key

    def _check(self, kind: str) -> None:
        if kind not in self.layout.roster:
            raise unknown_name("object", kind, set(self.layout.roster))

    def found(self, kind: str) -> list[StableGrasp]:
        """Return the grasps of an object type without those of `add`; raises as `grasps`."""
        self._check(kind)
        path = below(self.folder, f"{kind}.npz")
        found = read_cached(path, _load)
        if found is None:
            found = self._search(kind)
            _save(path, found)
        return found

    def _search(self, kind: str) -> list[StableGrasp]:
        pack = self.layout.pack
        shape = shape_of(pack.objects[kind], pack.meshes, self.robot.gripper)
        candidates = grasp_candidates(
            # As if it stood on a table: grasps from below would never be made there.
            LyingObject(shape, np.zeros(3), np.eye(3), -shape.half[2]),
            gripper=self.robot.gripper,
        )
        steep = candidates.rot[:, 2, 0] <= -np.cos(MAX_APPROACH_SLANT_RAD)
        if steep.any():
            candidates = candidates.take(steep)
        found: list[StableGrasp] = []
        for row in spread(candidates, MAX_TRIES):
            tcp = np.concatenate([candidates.pos[row], candidates.quat[row]])
            grasp = self._try(kind, tcp, float(candidates.width[row]))
            if grasp is not None:
                found.append(grasp)
            if len(found) == MAX_GRASPS:
                break
        if not found:
            raise NoGraspError(
                f"no grasp of {kind} by robot {self.robot.name!r} holds for {HOLD_TIME_S} s"
            )
        return found

    def hold_in(
        self, kind: str, grasp: StableGrasp, robot: np.ndarray
    ) -> StableGrasp | None:
        """Simulate a stable grasp in another posture of the robot.

        Args:
            kind: object type.
            grasp: the grasp.
            robot: (J,) joint positions [m, rad] with the base outside of the home; the fingers are ignored.

        Returns:
            The grasp as it settles; None if it is not stable there or the robot collides with itself.
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
            if self.scratch.collision_free(
                self.layout.pack.homes[0].name, state, slot, grip
            )
            else None
        )

    def _with_fingers(self, robot: np.ndarray, fingers: float) -> np.ndarray:
        """Return joint positions (J,) with both fingers set to a position [m]."""
        out = robot.copy()
        out[self.robot.columns.fingers] = fingers
        return out

    def _try(
        self, kind: str, tcp: np.ndarray, width: float, robot: np.ndarray | None = None
    ) -> StableGrasp | None:
        """Simulate a grasp; return it as it settles, or None if it is not stable.

        Args:
            kind: object type.
            tcp: (7,) pose of the tcp in the object's frame [m, wxyz].
            width: distance of the pads in contact [m].
            robot: (J,) joint positions [m, rad], fingers ignored; None for the parked rest posture.
        """
        slot = self.layout.roster.index(kind)
        force = self.config.grasp_force
        angle = self.config.grasp_angle
        robot = parked_robot_qpos(self.robot) if robot is None else robot
        open_hand = self._with_fingers(
            # A millimetre open, so that closing is part of what is tested.
            robot,
            min(0.5 * width + 0.001, self.robot.finger_max),
        )
        held = self.scratch.try_grasp(
            slot, tcp, open_hand, HOLD_TIME_S, force, STEADY_SHARE * angle
        )
        return (
            StableGrasp(*held)
            if held is not None and np.linalg.norm(held[0][:3], axis=-1) <= MAX_OFFSET_M
            else None
        )


def _save(path: Path, grasps: list[StableGrasp]) -> Path:
    arrays = {
        "pose": np.array([g.pose for g in grasps]),
        "fingers": np.array([g.fingers for g in grasps]),
    }
    return write_cached(
        path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays)
    )


def _load(path: Path) -> list[StableGrasp]:
    with np.load(path, allow_pickle=False) as data:
        return [
            StableGrasp(pose, float(fingers))
            for pose, fingers in zip(data["pose"], data["fingers"], strict=True)
        ]
