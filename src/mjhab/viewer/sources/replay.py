"""Recorded episodes for a viewer: which there are, their tracks, and the environment they were recorded in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mjhab.core.errors import MjhabError, UsageError
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.reading import Episode, open_shard, shard_paths
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.recorded import recorded_env
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.sources.pace import Pace
from mjhab.viewer.sources.track import Track, recorded_track

MAX_LISTED = 2000


class Replay:
    """The episodes of shards and folders that can be shown; a `sources.Source` in which nothing acts.

    Args:
        places: shards or folders. A shard that is being written shows what was in it when this was made.
        where: only these episodes.

    Attributes:
        choices: names of the episodes, by which `load` finds them.

    Raises:
        UsageError: there is no episode with states.
        DamagedError: a file is no shard, or cannot be read.
    """

    def __init__(self, places: Path | Sequence[Path], where: Filter | None = None) -> None:
        self.is_live = False
        self.pace = Pace()
        self.policies: tuple[str, ...] = ()
        self.problem = ""
        self.hand_drives = False
        self.recording = ""
        self.expert_plan = None
        self.track: Track | None = None
        self._episodes: dict[str, Episode] = {}
        self._envs: dict[str, SequentialTaskEnv] = {}
        self._chosen = ""
        skipped = 0
        for path in shard_paths(places):
            with open_shard(path) as shard:
                for episode in shard:
                    if len(self._episodes) >= MAX_LISTED:
                        break
                    if where is not None and not where(episode.record, episode.run):
                        continue
                    if "states/qpos" not in episode.paths:
                        skipped += 1
                        continue
                    self._episodes[self._title(episode)] = episode
        if not self._episodes:
            why = f" ({skipped} have no states)" if skipped else ""
            raise UsageError(
                f"there is no episode to show{why}: give shards that `mjhab generate` made with states, or a --where "
                "that holds for some."
            )

        self.choices = tuple(self._episodes)

    def _title(self, episode: Episode) -> str:
        label = str(episode.attributes.get("label", ""))
        index = int(episode.attributes["index"])
        name = f"{index} (seed {int(episode.attributes['seed'])}) {label}"
        return name if name not in self._episodes else f"{name}, {episode.name}"

    def load(self, title: str) -> Track:
        """The track of an episode.

        Raises:
            UsageError: what it was recorded with is not here: a file, an asset pack.
            DamagedError: it cannot be read.
        """
        return recorded_track(self._episodes[title], self.env(title).task_config)

    def env(self, title: str) -> SequentialTaskEnv:
        """An environment of one world like the one an episode was recorded in, made once per configuration.

        Raises:
            UsageError: see `load`.
        """
        run: RunInfo = self._episodes[title].run
        if run.config_id not in self._envs:
            self._envs[run.config_id] = recorded_env(run, num_envs=1, threads=1)
        return self._envs[run.config_id]

    @property
    def sim(self) -> CpuSimulator:
        """Has the homes of the episode that is shown."""
        return self.env(self._chosen).sim

    def start(self) -> None:
        """Show the first episode."""
        self.choose(self.choices[0])

    def choose(self, choice: str) -> None:
        """Show another episode; one that cannot be read is told in ``problem``."""
        try:
            track = self.load(choice)
        except MjhabError as error:
            self.problem = str(error)
            return
        self.problem = ""
        self._chosen = choice
        self.track = track

    def next_episode(self) -> None:
        """Show the episode after this one."""
        at = self.choices.index(self._chosen) + 1
        self.choose(self.choices[at % len(self.choices)])

    def restart(self) -> None:
        """Show the same episode from its beginning."""
        self.choose(self._chosen)

    def close(self) -> None:
        """Free the environments."""
        for env in self._envs.values():
            env.close()

    def set_policy(self, spec: str) -> None:
        """Nothing acts here."""

    def show_expert_plan(self, shown: bool) -> None:
        """Nothing is planned here."""

    def set_hand(self, driving: bool) -> None:
        """Nothing can be driven here."""

    def hear_hand(self, message: str) -> None:
        """Nothing can be driven here."""

    def hand_gone(self) -> None:
        """Nothing can be driven here."""

    def finish_episode(self) -> None:
        """Recorded episodes are over."""
