"""Teleports: a Navigate of a chain puts the robot near its goal, as the evaluation of the MS-HAB paper does.

A few spawn tries per world and control step, each checked by simulation on a scratch world, until one is valid: a
world with a hard spawn waits, alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.core.seeding import stream
from mjhab.envs.parts.plan_tables import PlanTables
from mjhab.envs.parts.sensing import Sensing
from mjhab.episodes.generator import Episode
from mjhab.episodes.spawns import MAX_TRIES, Held
from mjhab.episodes.starts import StartMaker
from mjhab.sim.protocol import SimState

TRIES_PER_STEP = 3
"""Number of poses that are sampled for one world in one control step."""


@dataclass(frozen=True, eq=False)
class Landing:
    """Result of a teleport: state ``qpos`` (nq,), and whether no sampled pose was valid and the nearest one is used."""

    world: int
    qpos: np.ndarray
    fallback: bool


class Teleports:
    """Pending teleports: the worlds that wait, and the number of poses sampled for each.

    Args:
        starts: tries places.
        sensing, tables: of the worlds.

    ``pending`` (W,): tries done for the active Navigate, -1 when none is due.
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
        """Tries done for the teleport of a world, -1 when none is due."""
        return int(self.pending[world])

    def set_state(self, world: int, state: int) -> None:
        """Restore a world from `get_state`."""
        self.pending[world] = state

    def begin(self, mask: np.ndarray, navigates: np.ndarray) -> None:
        """Note for the worlds in ``mask`` (W,) whether their new subtask ``navigates`` (W,): then a teleport is due."""
        self.pending = np.where(mask, np.where(navigates, 0, -1), self.pending)

    def run(
        self,
        qpos: np.ndarray,
        state: SimState,
        pointer: np.ndarray,
        episodes: Sequence[Episode | None],
    ) -> Iterator[Landing]:
        """Try to find places for the worlds that wait; yields those that have one, which wait no longer.

        Args:
            qpos: (W, nq) positions of the worlds.
            state: of the worlds, at ``qpos``.
            pointer: (W,) positions of the active subtasks in their plans.
            episodes: (W,) those the worlds are in.
        """
        for world in np.flatnonzero(self.waiting).tolist():
            episode = episodes[world]
            assert episode is not None, f"world {world} has not been reset"
            held = self._held(state, world, int(pointer[world]))
            landing = self._try(world, int(pointer[world]), episode, qpos[world], held)
            if landing is not None:
                self.pending[world] = -1
                yield landing

    def _try(
        self, world: int, position: int, episode: Episode, qpos: np.ndarray, held: Held | None
    ) -> Landing | None:
        boxes = self._starts.boxes(self._starts.home(episode.home))
        goal = self._starts.spawn_goal(self._tables.plans[world], position, boxes)
        sampler = self._starts.sampler
        for _ in range(TRIES_PER_STEP):
            key = ("navigate", episode.task, episode.index, position, int(self.pending[world]))
            rng = stream(episode.seed, *key)
            found = sampler.try_once(episode.home, qpos, goal, rng, held)
            self.pending[world] += 1
            if found is not None:
                return Landing(world, found, fallback=False)
        if self.pending[world] < MAX_TRIES:
            return None
        return Landing(world, sampler.fallback(episode.home, qpos, goal, held), fallback=True)

    def _held(self, state: SimState, world: int, position: int) -> Held | None:
        """What the robot carries to the Navigate at ``position``, if it has it between both fingers."""
        slot = int(self._tables.held[world, position])
        if slot < 0:
            return None
        force = np.linalg.norm(state.finger_force[world, :, slot], axis=-1)
        if not (force > 0).all():
            return None
        tcp = self._sensing.tcp_pose(state)[world]
        return Held(slot, pose_mul(pose_inv(tcp), state.object_pose[world, slot]))
