"""Pool of episode starts on the device: computed on the host and uploaded once."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from mjhab.config.env import DENSE_MODES, EnvConfig
from mjhab.core.arrays import map_record
from mjhab.core.machine import cores
from mjhab.envs.device.fields import GoalFields
from mjhab.envs.device.teleport_poses import find_teleport_poses
from mjhab.envs.parts.plan_tables import PlanTables, Rows
from mjhab.episodes.episode import Episode
from mjhab.episodes.perturbing import as_perturbed
from mjhab.episodes.source import EpisodeSource
from mjhab.episodes.starts import Start
from mjhab.sim.warp.simulator import WarpSimulator
from mjhab.tasks.plan import TaskPlan
from mjhab.tasks.subtasks.registry import spec_of

LEAST = 256
MOST = 8192
PER_WORLD = 4
"""Default size of a pool: PER_WORLD starts per world, at least LEAST and at most MOST."""


def pool_size(config: EnvConfig) -> int:
    """Number of starts for a configuration."""
    # Bounded above because making a start takes time, and below so that few worlds see many of them.
    return config.starts or max(LEAST, min(PER_WORLD * config.num_envs, MOST))


@dataclass(frozen=True, eq=False)
class _Made:
    """One start on the host.

    qpos: (nq,) state. teleport_poses: (S, J) joints of the robot after the teleport of each subtask. fallback: (S,)
    bool, no sampled pose was valid and the nearest one is used.
    """

    episode: Episode
    start: Start
    qpos: np.ndarray
    teleport_poses: np.ndarray
    fallback: np.ndarray


class StartPool:
    """P starts as tensors; number i is the cpu backend's episode (seed, i). S subtasks.

    Attributes:
        episodes: (P,) list on the host.
        plans: (P,) list on the host.
        qpos: (P, nq) start positions; for plans that begin with a teleport, those after it.
        home_rows: (P,) homes, see `WarpSimulator.start_rows`.
        ctrl: (P, nu) actuator commands.
        rings: (P, ...) sleep states, see `WarpSimulator.reset_masked`.
        fallback: (P,) bool, no valid start pose was found and the nearest one is used.
        teleport_poses: (P, S, J) of `find_teleport_poses`.
        landing_fallback: (P, S) bool of `find_teleport_poses`.
        field_index: (P, S) int64, index in ``fields`` of the goal of each subtask, -1 for none.
        fields: path lengths to the goals of Navigate; None if the reward does not need them.

    Args:
        source: makes the episodes on the host; its configuration gives navigation mode and reward.
        sim: simulator whose device holds the tensors; the homes of the starts are uploaded to it.
        count: P.
        seed: seed of the episodes.
    """

    def __init__(
        self, source: EpisodeSource, sim: WarpSimulator, count: int, seed: int
    ) -> None:
        self.seed = seed
        self.count = count
        self._source = source
        self._config = source.config
        made = self._make()
        self.episodes: list[Episode] = [m.episode for m in made]
        self.plans: list[TaskPlan] = [m.start.plan for m in made]
        device = sim.qpos.device
        states = np.stack([m.qpos for m in made])

        def upload(values: Sequence[Any] | np.ndarray) -> torch.Tensor:
            array = np.asarray(values)
            return torch.as_tensor(
                array.astype(np.float32) if array.dtype.kind == "f" else array,
                device=device,
            )

        self.qpos = upload(states)
        self.home_rows, self.ctrl, self.rings = sim.start_rows(
            [m.start.home for m in made], states
        )
        self.fallback = upload([m.start.fallback or bool(m.fallback[0]) for m in made])
        self.teleport_poses = upload(np.stack([m.teleport_poses for m in made]))
        self.landing_fallback = upload(np.stack([m.fallback for m in made]))
        tables = PlanTables(source.layout, source.task_config, count, source.plan_length)
        for row, m in enumerate(made):
            tables.set_row(row, m.start.plan, m.start.boxes)
        arrays = map_record(upload, tables.arrays)
        self._tables = Rows(
            arrays, *map(upload, (tables.obj, tables.link, tables.target, tables.held))
        )
        self.fields, self.field_index = self._find_fields(made, device)

    def rows(self, index: torch.Tensor) -> Rows:
        """Plan tables of the starts ``index`` (W,) int64."""
        t = self._tables
        arrays = map_record(lambda x: x[index], t.arrays)
        return Rows(arrays, t.obj[index], t.link[index], t.target[index], t.held[index])

    def _make(self) -> list[_Made]:
        console = Console(stderr=True)
        # Settling takes most of the time, and is done by MuJoCo outside of Python.
        with ThreadPoolExecutor(self._config.threads or cores()) as crew:
            starts = crew.map(self._make_one, range(self.count))
            return list(
                track(
                    starts,
                    "starts of episodes",
                    self.count,
                    console=console,
                    transient=True,
                    disable=not console.is_terminal,
                )
            )

    def _make_one(self, index: int) -> _Made:
        source = self._source
        length = source.plan_length
        episode = source.episode(self.seed, index)
        start = source.start(episode)
        qpos = start.qpos
        teleport_poses = np.zeros((length, len(source.layout.robot.joints)))
        fallback = np.zeros(length, bool)
        if self._config.teleports:
            teleport_poses, fallback = find_teleport_poses(
                source.starts, episode, start, length
            )
            # A chain begins with a drive, whose teleport is part of the start.
            if spec_of(start.plan.subtasks[0].kind).navigates:
                # The start may be in the cache of the source.
                qpos = qpos.copy()
                qpos[source.starts.sim.addresses.robot_q] = teleport_poses[0]
        episode = as_perturbed(episode, start)
        return _Made(episode, start, qpos, teleport_poses, fallback)

    def _find_fields(
        self, made: list[_Made], device: torch.device
    ) -> tuple[GoalFields | None, torch.Tensor]:
        # -1 is the mark of no goal, whose length is 0.
        index = torch.full(
            (self.count, self._source.plan_length), -1, dtype=torch.int64, device=device
        )
        where = [
            (p, s)
            for p, m in enumerate(made)
            for s, subtask in enumerate(m.start.plan.subtasks)
            if spec_of(subtask.kind).navigates
        ]
        # Only dense rewards read path lengths.
        if not where or self._config.reward not in DENSE_MODES:
            return None, index
        goals = [
            (made[p].start.home, made[p].start.plan.subtasks[s].goal_pos[:2])
            for p, s in where
        ]
        fields = GoalFields(goals, self._source.starts.sampler.map, device)
        p, s = torch.as_tensor(where, device=device).unbind(1)
        index[p, s] = fields.index
        return fields, index
