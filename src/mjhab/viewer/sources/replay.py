"""Recorded episodes as a source of the viewer: their list, their tracks, and the environments they were recorded in."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjhab.core.errors import MjhabError, UsageError, fault
from mjhab.data.select.query import Filter
from mjhab.data.store.places import has_shards, shard_paths
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.rollout.store import EPISODES_FILE
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.plan_marks import PlanMarks
from mjhab.viewer.sources.pace import RealTimeClock
from mjhab.viewer.sources.plan_overlay import RecordedPlans
from mjhab.viewer.sources.recorded_envs import RecordedEnvs
from mjhab.viewer.sources.track import Track, recorded_track

# A menu of more cannot be used, and reading their heads takes seconds.
MAX_LISTED = 2000
"""Largest number of episodes listed."""


class Replay:
    """Recorded episodes of shards and folders; a `source.Source` without a policy.

    Args:
        places: shards or folders. Of a shard that is still being written, the episodes present now are listed.
        where: filter of the episodes; None takes all.
        first: position of the episode that `start` shows, from 0.

    Attributes:
        choices: titles of the episodes, at most `MAX_LISTED`.
        choice: title of the episode that was chosen last, which may be unreadable; "" before `start`.

    Raises:
        UsageError: there is no episode with states, or not more than ``first``.
        DamagedError: a file is no shard, or cannot be read.
    """

    def __init__(
        self, places: Path | Sequence[Path], where: Filter | None = None, first: int = 0
    ) -> None:
        self.is_live = False
        self.pace = RealTimeClock()
        self.policies: tuple[str, ...] = ()
        self.hand_drives = False
        self.recording = ""
        self.choice = ""
        # One tuple, assigned at once: the thread of a page sets it while the thread of the frames reads it.
        self._shown: tuple[RecordedEpisode, Track] | None = None
        self._episodes: dict[str, RecordedEpisode] = {}
        self._envs = RecordedEnvs()
        self._plan_wanted = False
        self._problem = ""
        # Held to read a shard: a page loads episodes while the expert's thread reads others.
        self._reading = threading.Lock()
        # Held to load an episode: pages call from several threads, and environments are of one at a time.
        self._loading = threading.Lock()
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
        """Return the title, of ``choices``, of the episode at a position from 0.

        Raises:
            UsageError: there is no episode at this position.
        """
        count = len(self.choices)
        if position < count:
            return self.choices[position]
        some = f"are {count} episodes" if count > 1 else "is 1 episode"
        more = " (more are not listed: choose among them with --where)" * (
            count == MAX_LISTED
        )
        raise UsageError(
            f"--episode {position}: there {some}{more}, counted from 0; the last is --episode {count - 1}."
        )

    @property
    def problem(self) -> str:
        """Why the episode, or the expert's plan in it, cannot be shown; "" if there is no problem."""
        return self._problem or (self._plans.problem if self._plan_wanted else "")

    def _title(self, episode: RecordedEpisode) -> str:
        label = str(episode.attributes.get("label", ""))
        index = int(episode.attributes["index"])
        name = f"{index} (seed {int(episode.attributes['seed'])}) {label}"
        if name in self._episodes:
            name = f"{name}, {episode.name}"
        # Copies of an episode, as of `mjhab replay`, have the same name in other shards.
        number = 2
        title = name
        while title in self._episodes:
            title = f"{name} ({number})"
            number += 1
        return title

    def place_of(self, title: str) -> tuple[Path, int]:
        """The shard of the episode with a title of ``choices``, and its index there."""
        episode = self._episodes[title]
        return Path(episode.shard.path), episode.record.index

    def load(self, title: str) -> Track:
        """Read the track of the episode with a title of ``choices``.

        Raises:
            UsageError: a file or an asset pack that it was recorded with is not installed.
            DamagedError: it cannot be read.
        """
        config = self.env(title).task_config
        with self._reading:
            return recorded_track(self._episodes[title], config)

    def env(self, title: str) -> SequentialTaskEnv:
        """Return an environment of one world with the configuration of an episode, made once per configuration.

        Raises:
            UsageError: see `load`.
        """
        return self._envs.of(self._episodes[title])

    @property
    def sim(self) -> CpuSimulator:
        """Simulator whose layout has the home of the episode that is shown."""
        assert self._shown is not None, "there are no homes before there is a track"
        return self._envs.of(self._shown[0]).sim

    @property
    def track(self) -> Track | None:
        """The episode that is shown; None until one was read."""
        return None if self._shown is None else self._shown[1]

    def prepare(self) -> None:
        """Do nothing: the shards were read when this was made."""

    def start(self) -> None:
        """Show the episode at the position ``first``."""
        self.choose(self._first)

    def choose(self, choice: str) -> None:
        """Show the episode with a title; if it cannot be read, set ``problem`` and keep the one that is shown."""
        self.choice = choice
        with self._loading:
            if self.choice != choice:
                # Another one was chosen in the meantime.
                return
            try:
                track = self.load(choice)
            except MjhabError as error:
                self._problem = str(error)
                return
            self._problem = ""
            self._shown = (self._episodes[choice], track)

    def next_episode(self) -> None:
        """Show the episode after ``choice`` in ``choices``; after the last, the first."""
        at = self.choices.index(self.choice) + 1
        self.choose(self.choices[at % len(self.choices)])

    def restart(self) -> None:
        """Show the same episode from its first state."""
        self.choose(self.choice)

    def close(self) -> None:
        """Close the environments."""
        self._plans.close()
        self._envs.close()

    def set_policy(self, spec: str) -> None:
        """Do nothing: recorded episodes have no policy to replace."""

    def show_expert_plan(self, shown: bool) -> None:
        """Switch `plan_at` on or off."""
        self._plan_wanted = shown

    def plan_at(self, step: int) -> PlanMarks | None:
        """Return the expert's plan for the subtask that is active in a state, planned in that subtask's first state.

        None until it is computed, where the expert has no plan, and while switched off.
        """
        shown = self._shown
        if not self._plan_wanted or shown is None:
            return None
        return self._plans.at(*shown, step)

    def set_hand(self, driving: bool) -> None:
        """Do nothing: recorded episodes cannot be teleoperated."""

    def hear_hand(self, message: str) -> None:
        """Do nothing: recorded episodes cannot be teleoperated."""

    @property
    def hand_pose(self) -> np.ndarray | None:
        """None: recorded episodes cannot be teleoperated."""
        return None

    def aim_hand(self, pose: np.ndarray) -> None:
        """Do nothing: recorded episodes cannot be teleoperated."""

    def grip(self) -> None:
        """Do nothing: recorded episodes cannot be teleoperated."""

    def hand_gone(self) -> None:
        """Do nothing: recorded episodes cannot be teleoperated."""

    def finish_episode(self) -> None:
        """Do nothing: recorded episodes have ended."""


def _refuse_evaluations(places: Path | Sequence[Path]) -> None:
    """Refuse folders of evaluations, which have records of episodes but no states.

    Raises:
        UsageError: a place is such a folder, without shards; the message tells how to record its episodes.
    """
    for place in [places] if isinstance(places, Path) else places:
        if (place / EPISODES_FILE).is_file() and not has_shards(place):
            raise fault(
                place,
                "is the folder of an evaluation, which keeps no states. Record its episodes with `mjhab "
                "generate --out FOLDER` and the policy, task, subtask, split and seed of its config.json, and view "
                "that folder.",
            )
