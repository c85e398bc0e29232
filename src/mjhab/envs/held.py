"""Starts with an object in the gripper, found by physics and not by a policy.

Grasp candidates from the object's geometry are tried in an empty corner of the world: the gripper at rest, the object
between the fingers, closing; those that still pass the grasp test after half a second are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import MjhabError
from mjhab.envs.grasps import ObjectShape, grasp_candidates
from mjhab.scenes.spec import ObjectType
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.scratch import Scratch
from mjhab.tasks.plan import TaskConfig

HOLD_SECONDS = 0.5
MAX_GRASPS = 6
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def shape_of(kind: ObjectType) -> ObjectShape:
    """What a gripper sees of an object type: a box, can, ball or bowl of its size."""
    if len(kind.collision) > 1:
        return ObjectShape("bowl", kind.half)
    shape = next(iter(kind.collision)).shape
    return ObjectShape(shape if shape in ("box", "cylinder") else "sphere", kind.half)


@dataclass(frozen=True, eq=False)
class HeldGrasp:
    """A stable grasp: object pose (7,) in the frame of gripper_link, finger position [m]."""

    pose: np.ndarray
    fingers: float


class HeldStarts:
    """Stable grasps per object type, found once and remembered."""

    def __init__(self, sim: CpuSimulator, config: TaskConfig, scratch: Scratch) -> None:
        self.layout, self.config, self.scratch = sim.layout, config, scratch
        self._found: dict[str, list[HeldGrasp]] = {}

    def grasps(self, kind: str) -> list[HeldGrasp]:
        """Stable grasps of an object type, best first.

        Raises:
            MjhabError: no candidate holds.
        """
        if kind not in self._found:
            self._found[kind] = self._search(kind)
        return self._found[kind]

    def _search(self, kind: str) -> list[HeldGrasp]:
        slot, shape = self.layout.roster.index(kind), shape_of(self.layout.pack.objects[kind])
        candidates = grasp_candidates(shape, np.zeros(3), _UPRIGHT, support_z=-shape.half[2])
        found: list[HeldGrasp] = []
        for pos, quat, width in zip(candidates.pos, candidates.quat, candidates.width, strict=True):
            held = self.scratch.try_grasp(
                slot, np.concatenate([pos, quat]), float(width), HOLD_SECONDS,
                self.config.grasp_force, self.config.grasp_angle,
            )  # fmt: skip
            if held is not None:
                found.append(HeldGrasp(*held))
            if len(found) == MAX_GRASPS:
                break
        if not found:
            raise MjhabError(f"no grasp of {kind} holds for {HOLD_SECONDS} s")
        return found
