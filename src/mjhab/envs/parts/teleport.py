"""Teleports: a Navigate of a chain puts the robot near its goal, as the evaluation of the MS-HAB paper does.

A few spawn tries per world and control step, each checked by simulation on a scratch world, until one is valid: a
world with a hard spawn waits, alone.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.core.seeding import stream
from mjhab.envs.parts.worlds import Worlds
from mjhab.episodes.spawns import MAX_TRIES, Held

TRIES_PER_STEP = 3
"""Tries of one world in one control step."""


class Teleports:
    """Which worlds wait for a teleport, and how often each has tried.

    ``pending`` (W,): tries done for the active Navigate, -1 when none is due.
    """

    def __init__(self, env: Worlds) -> None:
        self._env = env
        self.pending = np.full(env.num_envs, -1)

    @property
    def waiting(self) -> np.ndarray:
        """(W,) bool: a teleport is due."""
        return self.pending >= 0

    def begin(self, mask: np.ndarray, navigates: np.ndarray) -> None:
        """Note for the worlds in ``mask`` (W,) whether their new subtask ``navigates`` (W,): then a teleport is due."""
        self.pending = np.where(mask, np.where(navigates, 0, -1), self.pending)

    def run(self) -> np.ndarray:
        """Try to move the worlds that wait; returns (W,) bool, those that have been moved."""
        before = self.waiting
        for world in np.flatnonzero(before):
            self._move(int(world))
        return before & ~self.waiting

    def _move(self, world: int) -> None:
        env = self._env
        plan = env.tables.plans[world]
        position = int(env.progress.pointer[world])
        goal = env.starts.spawn_goal(plan, position, env.boxes[world])
        slot = int(env.tables.held[world, position])
        qpos = env.sim.qpos[world]
        held = (
            Held(slot, self._held_pose(world, slot))
            if slot >= 0 and self._is_held(world, slot)
            else None
        )
        episode = env.episode_of(world)
        found = None
        for _ in range(TRIES_PER_STEP):
            key = ("navigate", episode.task, episode.index, position, int(self.pending[world]))
            rng = stream(episode.seed, *key)
            found = env.starts.sampler.try_once(episode.home, qpos, goal, rng, held)
            self.pending[world] += 1
            if found is not None:
                break
        if found is None and self.pending[world] >= MAX_TRIES:
            found = env.starts.sampler.fallback(episode.home, qpos, goal, held)
            env.fallback[world] = True
        if found is not None:
            env.sim.write_qpos(world, found)
            self.pending[world] = -1

    def _held_pose(self, world: int, slot: int) -> np.ndarray:
        tcp = self._env.sensing.tcp_pose(self._env.state)[world]
        return pose_mul(pose_inv(tcp), self._env.state.object_pose[world, slot])

    def _is_held(self, world: int, slot: int) -> bool:
        return bool(
            (np.linalg.norm(self._env.state.finger_force[world, :, slot], axis=-1) > 0).all()
        )
