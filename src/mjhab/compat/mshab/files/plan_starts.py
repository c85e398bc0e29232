"""Starts of task plans in mjhab's environments: plans, spawn data and episode files become a spawn set.

A spawn set is what ``EnvConfig.spawns`` takes, so environments of both backends begin as the files say. Episode i of
such an environment is row i of the set.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.compat.mshab.files.init_configs import InitConfigs
from mjhab.compat.mshab.files.matching import (
    home_of,
    is_whole,
    position_in,
    with_goals,
)
from mjhab.compat.mshab.files.plan_requests import (
    PlanRequest,
    check_homes,
    check_plans,
    complete,
    digest_of,
    episodes_of,
    root_of,
    spawns_of,
)
from mjhab.compat.mshab.files.plans import MsHabTaskPlan, task_of_dataset
from mjhab.compat.mshab.files.spawn_data import ROBOT_POS, Spawns
from mjhab.compat.mshab.files.spawned_states import SpawnedStates
from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.errors import UsageError, about, wrong_value
from mjhab.core.files.cache import cache_dir, read_cached, write_cached
from mjhab.core.machine import cores
from mjhab.episodes.episode import Episode
from mjhab.episodes.hab.format import HabFile
from mjhab.episodes.hab.reader import file_roster
from mjhab.episodes.rosters import roster
from mjhab.episodes.source import open_setting
from mjhab.episodes.spawn_sets import (
    SpawnRecipe,
    SpawnRow,
    check_size,
    header_of,
    layout_digest,
    pack_rows,
    write,
)
from mjhab.episodes.spawns import SpawnGoal
from mjhab.episodes.starts import StartMaker
from mjhab.layout.layout import Layout
from mjhab.scenes.pack_source import pack_request
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import chain

_START_XY = np.array([-1.0, 0.0])
"""Where the robot begins a whole task in the original [m], facing +x (ManiSkill, scene builder of the episodes)."""


@dataclass(frozen=True)
class PlanRow:
    """A start: number of its plan, and of the spawn among those of the plan; name of its home."""

    plan: int
    spawn: int
    home: str


@dataclass(frozen=True)
class PlanStarts:
    """Starts of task plans.

    Attributes:
        options: options of an environment that begins with them, see `EnvConfig`.
        rows: what every row of the set is; episode i begins with row i.
        plans: the task plans.
        root: folder of rearrangement data that they belong to.
    """

    options: Mapping[str, Any]
    rows: tuple[PlanRow, ...]
    plans: tuple[MsHabTaskPlan, ...]
    root: Path

    @cached_property
    def _numbers(self) -> dict[tuple[int, int], int]:
        return {(row.plan, row.spawn): i for i, row in enumerate(self.rows)}

    def of(self, plan: int, spawn: int = 0) -> int:
        """Row of a plan and one of its spawns.

        Raises:
            UsageError: there is none.
        """
        if (plan, spawn) not in self._numbers:
            raise wrong_value(
                "plan and spawn", (plan, spawn), f"one of the {len(self.rows)} starts"
            )
        return self._numbers[plan, spawn]

    @cached_property
    def _counts(self) -> Counter[int]:
        return Counter(row.plan for row in self.rows)

    def spawns(self, plan: int) -> int:
        """Number of spawns of a plan."""
        return self._counts[plan]

    def home_of(self, plan: int) -> str:
        """Home of a plan."""
        return home_of(self.plans[plan].build_config_name)


def plan_starts(request: PlanRequest, threads: int = 0) -> PlanStarts:
    """Make the starts of task plans, or find them in the cache.

    Args:
        request: plans and files.
        threads: that settle episodes; 0 for all cores. Does not change the starts.

    Raises:
        UsageError: plans of another subtask; homes, objects, episodes or spawns that are missing; a file of another
            layout, or one that needs more than tensors. The message names file, plan and what is missing.
    """
    check_plans(request.plans, request.subtask)
    request = complete(request)
    task, split = task_of_dataset(request.dataset)
    spawns = spawns_of(request)
    key = digest_of(request)
    pack = open_pack(request.assets)
    check_homes(request, pack.homes_by_name, pack.name)
    noted = read_cached(_note(key), lambda path: json.loads(path.read_text()))
    # What the episodes need is kept, because reading all of their files takes long.
    if noted is None:
        files = episodes_of(request)
        needed = file_roster(HabFile(tuple(files.values()), path=root_of(request)), pack)
        extra = Counter(needed) - Counter(roster(task))
        # Sorted, as the order of objects is part of the layout and so of the file's name.
        noted = {"extra": sorted(extra.elements())}
        text = json.dumps(noted)
        write_cached(_note(key), lambda path: path.write_text(text))
    options = {
        "profile": request.profile,
        "task": task,
        "subtask": request.subtask,
        "split": split,
        "assets": request.assets,
        "extra_objects": tuple(noted["extra"]),
    }
    config = EnvConfig(**options)
    layout = open_setting(config).layout
    out = cache_dir() / "task_plans" / f"{key}-{layout_digest(layout)}.npz"
    rows = tuple(
        PlanRow(number, spawn, home_of(plan.build_config_name))
        for number, plan in enumerate(request.plans)
        for spawn in range(len(spawns[number][ROBOT_POS]) if spawns else 1)
    )
    if not out.is_file():
        _write(out, _Maker(request, config, layout, spawns), rows, threads or cores())
    options["spawns"] = str(out)
    return PlanStarts(options, rows, tuple(request.plans), root_of(request))


def _note(key: str) -> Path:
    return cache_dir() / "task_plans" / f"{key}.json"


class _Maker:
    """Makes the rows of a spawn set. Several threads may use it."""

    def __init__(
        self,
        request: PlanRequest,
        config: EnvConfig,
        layout: Layout,
        spawns: Sequence[Spawns],
    ) -> None:
        self.request = request
        self.config = config
        self.layout = layout
        self.spawns = spawns
        sim = CpuSimulator(layout, 1, 1)
        starts = StartMaker(sim, config, task_config(config, layout.robot))
        self.states = SpawnedStates(starts)
        self.episodes = InitConfigs(
            sim, config.task, config.split, episodes_of(request), root_of(request)
        )

    def row(self, row: PlanRow) -> SpawnRow:
        """One start of a plan.

        Raises:
            UsageError: plan and episode do not fit each other; names the plan.
        """
        plan = self.request.plans[row.plan]
        with about(f"task_plans[{row.plan}] ({plan.init_config_name})", UsageError):
            episode = self.episodes.episode(str(plan.init_config_name))
            if episode.home != row.home:
                raise wrong_value("build_config_name", row.home, episode.home)
            if self.request.subtask:
                return self._single(plan, episode, row)
            return self._whole(plan, episode)

    def _single(self, plan: MsHabTaskPlan, episode: Episode, row: PlanRow) -> SpawnRow:
        (subtask,) = plan.subtasks
        full = chain(episode.task, episode.targets, episode.home)
        position = position_in(full, self.layout, subtask)
        targets = with_goals(episode.targets, full, [(position, subtask)])
        own = dataclasses.replace(episode, targets=targets)
        qpos = self.states.state(own, subtask, self.spawns[row.plan], row.spawn)
        return SpawnRow(own, qpos, position, False, 1)

    def _whole(self, plan: MsHabTaskPlan, episode: Episode) -> SpawnRow:
        full = chain(episode.task, episode.targets, episode.home)
        if not is_whole(full, plan):
            kinds = [subtask.type for subtask in plan.subtasks]
            wanted = f"those of {episode.task}: {[own.name for own in full.subtasks]}"
            raise wrong_value("subtasks", kinds, wanted)
        found = list(enumerate(plan.subtasks))
        targets = with_goals(episode.targets, full, found)
        own = dataclasses.replace(episode, targets=targets)
        starts = self.states.starts
        qpos = starts.episode_qpos(own)
        # Episodes of the original begin at its fixed place, if that is free in this home.
        if not self.episodes.is_own(str(plan.init_config_name)):
            ahead = SpawnGoal(_START_XY + np.array([1.0, 0.0]))
            placed = starts.sampler.at(own.home, qpos, _START_XY, ahead)
            if placed is not None:
                return SpawnRow(own, placed, 0, False, 1)
        qpos, fallback, tries = starts.roam(own, qpos)
        return SpawnRow(own, qpos, 0, fallback, tries)


def _write(out: Path, maker: _Maker, rows: Sequence[PlanRow], threads: int) -> None:
    # Before the others are made: the first row tells how large the file will be.
    check_size(pack_rows([maker.row(rows[0])]), len(rows))
    with ThreadPoolExecutor(threads) as pool:
        made = list(pool.map(maker.row, rows))
    config = maker.config
    recipe = SpawnRecipe(
        config.task,
        config.subtask,
        "",
        config.split,
        config.seed,
        len(rows),
        pack_request(config.assets).as_json(),
        spawn_rule=config.spawn_rule,
        robot=config.robot,
        joint_dynamics=config.joint_dynamics,
    )
    header = header_of(recipe, maker.layout, {})
    write(out, header, pack_rows(made))
