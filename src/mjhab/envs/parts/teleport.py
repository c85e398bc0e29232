"""Teleports: the environment moves the robot to the goal of a Navigate, as in the evaluation of the MS-HAB paper.

In every control step a few poses are sampled per waiting world, and each is checked by simulation on a scratch world.
A world waits until a pose is valid; the others step on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.arrays import may_hold
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.core.seeding import stream
from mjhab.envs.parts.plan_tables import PlanTables
from mjhab.envs.parts.sensing import Sensing
from mjhab.episodes.episode import Episode
from mjhab.episodes.spawns import MAX_TRIES, Held
from mjhab.episodes.starts import StartMaker
from mjhab.sim.protocol import SimState

TRIES_PER_STEP = 3
"""Number of poses that are sampled for one world in one control step."""


@dataclass(frozen=True, eq=False)
class TeleportPose:
    """Result of a teleport.

    Attributes:
        world: index of the world.
        qpos: (nq,) positions after the teleport.
        fallback: no sampled pose was valid, and the nearest one is used.
    """

    world: int
    qpos: np.ndarray
    fallback: bool


class Teleports:
    """Pending teleports: the worlds that wait, and the number of poses sampled for each.

    Args:
        starts: samples and checks poses.
        sensing: sensing of the worlds.
        tables: plans of the worlds.

    Attributes:
        pending: (W,) number of poses sampled for the active Navigate, -1 if no teleport is due.
    """

    def __init__(self, starts: StartMaker, sensing: Sensing, tables: PlanTables) -> None:
        self._starts = starts
        self._sensing = sensing
        self._tables = tables
        self.pending = np.full(len(tables.plans), -1)

    @property
    def waiting(self) -> np.ndarray:
        """(W,) bool: a teleport is due."""
        return self.pending >= 0

    def get_state(self, world: int) -> int:
        """Number of poses sampled for the teleport of a world, -1 if none is due."""
        # The number of the try is a key, so that the result does not depend on how many are made per step.
        return int(self.pending[world])

    def set_state(self, world: int, state: int) -> None:
        """Restore a world from `get_state`."""
        self.pending[world] = state

    def begin(self, mask: np.ndarray, navigates: np.ndarray) -> None:
        """Begin new subtasks in the worlds of ``mask`` (W,) bool; a teleport is due where ``navigates`` (W,) bool."""
        if may_hold(mask):
            self.pending = np.where(mask, np.where(navigates, 0, -1), self.pending)

    def run(
        self,
        qpos: np.ndarray,
        state: SimState,
        pointer: np.ndarray,
        episodes: Sequence[Episode | None],
    ) -> Iterator[TeleportPose]:
        """Sample poses for the waiting worlds and yield the teleports that are found; their worlds wait no longer.

        Args:
            qpos: (W, nq) positions.
            state: state of the worlds at ``qpos``.
            pointer: (W,) int64 index of the active subtask in each plan.
            episodes: (W,) episodes of the worlds.
        """
        for world in np.flatnonzero(self.waiting).tolist():
            episode = episodes[world]
            assert episode is not None, f"world {world} has not been reset"
            held = self._held(state, world, int(pointer[world]))
            teleport_pose = self._try(
                world, int(pointer[world]), episode, qpos[world], held
            )
            if teleport_pose is not None:
                self.pending[world] = -1
                yield teleport_pose

    def _try(
        self,
        world: int,
        position: int,
        episode: Episode,
        qpos: np.ndarray,
        held: Held | None,
    ) -> TeleportPose | None:
        boxes = self._starts.boxes(self._starts.home(episode.home))
        goal = self._starts.spawn_goal(self._tables.plans[world], position, boxes)
        sampler = self._starts.sampler
        for _ in range(TRIES_PER_STEP):
            key = (
                "navigate",
                episode.task,
                episode.index,
                position,
                int(self.pending[world]),
            )
            rng = stream(episode.seed, *key)
            found = sampler.try_once(episode.home, qpos, goal, rng, held)
            self.pending[world] += 1
            if found is not None:
                return TeleportPose(world, found, fallback=False)
        # The others go on in the next step, so that one crowded world does not hold up the batch.
        if self.pending[world] < MAX_TRIES:
            return None
        return TeleportPose(
            world, sampler.fallback(episode.home, qpos, goal, held), fallback=True
        )

    def _held(self, state: SimState, world: int, position: int) -> Held | None:
        """The object to carry in the Navigate at ``position``, if both fingers press it; else None."""
        slot = int(self._tables.held[world, position])
        if slot < 0:
            return None
        force = np.linalg.norm(state.finger_force[world, :, slot], axis=-1)
        # One finger alone holds nothing: the object stays where it is.
        if not (force > 0).all():
            return None
        tcp = self._sensing.tcp_pose(state)[world]
        # Relative to the hand, with which it moves.
        return Held(slot, pose_mul(pose_inv(tcp), state.object_pose[world, slot]))
