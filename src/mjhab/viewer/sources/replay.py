"""Recorded episodes for a viewer: which there are, their tracks, and the environment they were recorded in."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

from mjhab.core.errors import MjhabError, UsageError
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.reading import Episode, open_shard, shard_paths
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.recorded import recorded_env
from mjhab.rollout.store import EPISODES
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.plan_marks import PlanMarks
from mjhab.viewer.sources.advice import RecordedPlans
from mjhab.viewer.sources.pace import Pace
from mjhab.viewer.sources.track import Track, recorded_track

MAX_LISTED = 2000


class Replay:
    """The episodes of shards and folders that can be shown; a `sources.Source` in which nothing acts.

    Args:
        places: shards or folders. A shard that is being written shows what was in it when this was made.
        where: only these episodes.
        first: position of the episode that `start` shows, from 0.

    Attributes:
        choices: names of the episodes, by which `load` finds them.
        choice: the one that is shown; "" before there is one.

    Raises:
        UsageError: there is no episode with states, or fewer than ``first`` asks for.
        DamagedError: a file is no shard, or cannot be read.
    """

    def __init__(
        self, places: Path | Sequence[Path], where: Filter | None = None, first: int = 0
    ) -> None:
        self.is_live = False
        self.pace = Pace()
        self.policies: tuple[str, ...] = ()
        self.hand_drives = False
        self.recording = ""
        self.choice = ""
        self.track: Track | None = None
        self._episodes: dict[str, Episode] = {}
        self._envs: dict[str, SequentialTaskEnv] = {}
        self._plan_wanted = False
        self._problem = ""
        # A page chooses episodes while the expert plans in another thread: one of them reads.
        self._reading = threading.Lock()
        self._plans = RecordedPlans(self._reading)
        skipped = 0
        _refuse_evaluations(places)
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
        self._first = self.choice_at(first)

    def choice_at(self, position: int) -> str:
        """The name, of ``choices``, of the episode at a position from 0.

        Raises:
            UsageError: there are fewer episodes.
        """
        count = len(self.choices)
        if position < count:
            return self.choices[position]
        some = f"are {count} episodes" if count > 1 else "is 1 episode"
        more = " (more are not listed: choose among them with --where)" * (count == MAX_LISTED)
        raise UsageError(
            f"--episode {position}: there {some}{more}, counted from 0; the last is --episode {count - 1}."
        )

    @property
    def problem(self) -> str:
        """Why the episode, or the plan of the expert in it, cannot be shown; empty while all is well."""
        return self._problem or (self._plans.problem if self._plan_wanted else "")

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
        config = self.env(title).task_config
        with self._reading:
            return recorded_track(self._episodes[title], config)

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
        return self.env(self.choice).sim

    def start(self) -> None:
        """Show the episode at the position ``first``."""
        self.choose(self._first)

    def choose(self, choice: str) -> None:
        """Show another episode; one that cannot be read is told in ``problem``."""
        try:
            track = self.load(choice)
        except MjhabError as error:
            self._problem = str(error)
            return
        self._problem = ""
        self.choice = choice
        self.track = track

    def next_episode(self) -> None:
        """Show the episode after this one."""
        at = self.choices.index(self.choice) + 1
        self.choose(self.choices[at % len(self.choices)])

    def restart(self) -> None:
        """Show the same episode from its beginning."""
        self.choose(self.choice)

    def close(self) -> None:
        """Free the environments."""
        self._plans.close()
        for env in self._envs.values():
            env.close()

    def set_policy(self, spec: str) -> None:
        """Nothing acts here."""

    def show_expert_plan(self, shown: bool) -> None:
        """Ask for `plan_at`, or not any more."""
        self._plan_wanted = shown

    def plan_at(self, step: int) -> PlanMarks | None:
        """What the expert plans where the subtask of a state began; None until it is known, or if nobody asked."""
        track = self.track
        if not self._plan_wanted or track is None:
            return None
        return self._plans.at(self._episodes[self.choice], track, step)

    def set_hand(self, driving: bool) -> None:
        """Nothing can be driven here."""

    def hear_hand(self, message: str) -> None:
        """Nothing can be driven here."""

    def hand_gone(self) -> None:
        """Nothing can be driven here."""

    def finish_episode(self) -> None:
        """Recorded episodes are over."""


def _refuse_evaluations(places: Path | Sequence[Path]) -> None:
    """Tell how to record what an evaluation did: its folder has records of the episodes, but no states.

    Raises:
        UsageError: a place is such a folder, without shards.
    """
    for place in [places] if isinstance(places, Path) else places:
        if (place / EPISODES).is_file() and not any(place.rglob("*.h5")):
            raise UsageError(
                f"{place} is the folder of an evaluation, which keeps no states. Record its episodes with `mjhab "
                "generate --out FOLDER` and the policy, task, subtask, split and seed of its config.json, and view "
                "that folder."
            )
