"""The episodes of a configuration: where they take place, which one a name means, and how a world begins it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from mjhab.config.env import EnvConfig
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.seeding import stream
from mjhab.episodes.generator import Episode, EpisodeMaker
from mjhab.episodes.hab.format import HabFile, read_hab
from mjhab.episodes.hab.reader import FileEpisodes, file_roster
from mjhab.episodes.rosters import object_roster
from mjhab.episodes.starts import Start, StartMaker, check_target
from mjhab.episodes.zones import with_zones
from mjhab.layout.layout import Layout
from mjhab.robots.registry import robot_named
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True, eq=False)
class Setting:
    """Where the episodes of a configuration take place.

    ``layout``: homes and objects; ``file``: the episode file that `EnvConfig.episodes_file` names, None without one.
    """

    layout: Layout
    file: HabFile | None


def open_setting(config: EnvConfig) -> Setting:
    """Open the pack and the episode file of a configuration.

    Raises:
        UsageError: no such pack, file or target, or they do not fit each other.
    """
    pack = open_pack(config.assets)
    file = read_hab(Path(config.episodes_file)) if config.episodes_file else None
    objects = file_roster(file, pack) if file else object_roster(config, pack)
    layout = Layout(pack, objects, robot_named(config.robot))
    check_target(config, layout)
    return Setting(layout, file)


class EpisodeSource:
    """Makes the episodes of a configuration and the states in which worlds begin them. Threads may share it.

    Args:
        sim: on the CPU, of the setting's layout; its compiled homes are used, its worlds are left alone.
        config, task_config: what is to be done.
        file: the setting's episode file.

    Attributes:
        layout: of ``sim``.
        starts: places the robot.
        plan_length: number of subtasks of an episode.

    Raises:
        UsageError: a home, file or spawn set that does not fit the configuration.
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
        wanted = config.target if config.target in self.layout.roster else ""
        self._arrangements = (
            FileEpisodes(sim, file, config.task, config.home, wanted)
            if file
            else EpisodeMaker(sim, config.task, config.split, config.home, wanted)
        )
        self.starts = StartMaker(sim, config, task_config)
        self.plan_length = 1 if config.subtask else TASKS[config.task].length
        # Settling an arrangement takes longer than a whole episode of control steps: training draws from a few.
        given = file is not None or self.starts.spawn_set is not None
        self._pool_size = config.episode_pool if config.trains and not given else 0
        self._pool = MemoryCache("episodes")

    def episode(self, seed: int, index: int) -> Episode:
        """The episode named by (seed, index).

        In training only the arrangement of objects comes from a pool of `EnvConfig.episode_pool`. Where the robot
        starts, which target is meant and how far links stand open is drawn anew for every name.
        """
        if not self._pool_size:
            return (self.starts.spawn_set or self._arrangements).episode(seed, index)
        key = (self.config.seed, int(stream(seed, "pool", index).integers(self._pool_size)))
        found = self._pool.get(key, lambda: self._arrangements.episode(*key))
        return dataclasses.replace(found, seed=seed, index=index)

    def start(self, episode: Episode) -> Start:
        """How a world begins an episode, with place zones where the goal type asks for them."""
        start = self.starts.start(episode)
        if self.task_config.goal_type != "zone":
            return start
        home = self.starts.home(start.home)
        plan = with_zones(start.plan, self.layout, home, self.task_config.goal_tol)
        return dataclasses.replace(start, plan=plan)
