"""Episodes of an `EnvConfig`: its layout, the episode of a (seed, index), and the state in which a world starts it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mjhab.config.env import EnvConfig
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.seeding import stream
from mjhab.episodes.episode import Episode
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.hab.format import HabFile, read_hab
from mjhab.episodes.hab.reader import FileEpisodes, file_roster
from mjhab.episodes.homes import homes_named, homes_of
from mjhab.episodes.moved_furniture import with_moved_furniture
from mjhab.episodes.perturbing import EpisodePerturber
from mjhab.episodes.rosters import object_roster
from mjhab.episodes.starts import Start, StartMaker, check_target
from mjhab.episodes.zones import with_zones
from mjhab.layout.layout import Layout
from mjhab.robots.registry import robot_named
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True, eq=False)
class Setting:
    """Layout and episode file of a configuration.

    Attributes:
        layout: homes, robot and object slots.
        file: content of `EnvConfig.episodes_file`; None if it names none.
    """

    layout: Layout
    file: HabFile | None


def open_setting(config: EnvConfig) -> Setting:
    """Open the asset pack and the episode file of a configuration.

    Raises:
        UsageError: there is no such pack, file or target, or they do not fit each other.
    """
    pack = _with_versions(open_pack(config.assets), config)
    file = read_hab(Path(config.episodes_file)) if config.episodes_file else None
    # A file needs its own objects, of each type the most in any episode.
    objects = file_roster(file, pack) if file else object_roster(config, pack)
    robot = robot_named(config.robot)
    layout = Layout(pack, objects, robot, config.joint_dynamics)
    check_target(config, layout)
    return Setting(layout, file)


def _with_versions(pack: Pack, config: EnvConfig) -> Pack:
    """The pack, with further versions of the homes of the configuration if it perturbs furniture.

    Files of episodes and of start states name the homes that they were made in, which stay as they are.
    """
    shifts = config.perturbations.shifts()
    if not shifts or config.episodes_file or config.spawns:
        return pack
    find = homes_named if config.home else homes_of
    homes = find(pack, config.home or config.split)
    return with_moved_furniture(pack, [home.name for home in homes], shifts)


class EpisodeSource:
    """Makes the episodes of a configuration and their start states. Several threads may use it.

    Args:
        sim: CPU simulator of the layout; its compiled models are used, its worlds are not changed.
        config: configuration of the environment.
        task_config: thresholds of success.
        file: episode file, see `Setting`; None to generate episodes.

    Attributes:
        layout: layout of ``sim``.
        starts: makes start states.
        plan_length: number of subtasks of an episode.

    Raises:
        UsageError: a home, episode file or spawn set does not fit the configuration.
    """

    def __init__(
        self,
        sim: CpuSimulator,
        config: EnvConfig,
        task_config: TaskConfig,
        file: HabFile | None = None,
    ) -> None:
        self.config = config
        self.task_config = task_config
        self.layout = sim.layout
        # A link as target does not change which objects are drawn.
        wanted = config.target if config.target in self.layout.roster else ""
        self._arrangements = (
            FileEpisodes(sim, file, config.task, config.home, wanted)
            if file
            else EpisodeMaker(sim, config.task, config.split, config.home, wanted)
        )
        self.starts = StartMaker(sim, config, task_config)
        self._perturber = EpisodePerturber(self.starts)
        self.plan_length = 1 if config.subtask else TASKS[config.task].length
        # Settling the objects takes longer than all control steps of an episode: training draws from a pool of them.
        given = file is not None or self.starts.spawn_set is not None
        self._pool_size = 0 if given else config.episode_pool
        self._pool = MemoryCache("episodes")

    def episode(self, seed: int, index: int) -> Episode:
        """Return the episode of (seed, index).

        With `EnvConfig.episode_pool` its home and object poses come from a pool of so many episodes. Spawn, target and
        opening of links are still drawn for each (seed, index).
        """
        return self._perturber.objects(self._clean(seed, index))

    def episodes(
        self, wanted: Sequence[tuple[int, int]], threads: int = 1
    ) -> list[Episode]:
        """Return the episodes of several (seed, index); they do not depend on ``threads``."""
        # Threads cost more than they save where the pool already has everything.
        new = [names for names in wanted if self._pool_key(*names) not in self._pool]
        if min(threads, len(new)) <= 1:
            return [self.episode(*names) for names in wanted]
        # Most of the time of a new episode is the settling of its objects, for which MuJoCo gives up Python's lock.
        with ThreadPoolExecutor(min(threads, len(new))) as pool:
            return list(pool.map(lambda names: self.episode(*names), wanted))

    def _pool_key(self, seed: int, index: int) -> tuple[int, int] | None:
        """(seed, index) of the episode of the pool that lends its arrangement; None without a pool."""
        if not self._pool_size:
            return None
        drawn = stream(seed, "pool", index).integers(self._pool_size)
        # The seed of the configuration: otherwise every seed would have a pool of its own.
        return self.config.seed, int(drawn)

    def _clean(self, seed: int, index: int) -> Episode:
        """The episode before its objects are perturbed."""
        key = self._pool_key(seed, index)
        if key is None:
            return (self.starts.spawn_set or self._arrangements).episode(seed, index)
        found = self._pool.get(key, lambda: self._arrangements.episode(*key))
        # The names of the episode that was asked for, as they seed the spawn.
        return dataclasses.replace(found, seed=seed, index=index)

    def start(self, episode: Episode) -> Start:
        """Return plan and start state of an episode; with goal type "zone", the plan has place zones."""
        start = self._perturber.start(self.starts.start(episode), episode)
        if self.task_config.goal_type != "zone":
            return start
        home = self.starts.home(start.home)
        plan = with_zones(start.plan, self.layout, home, self.task_config.goal_tol)
        return dataclasses.replace(start, plan=plan)
