"""Recording of the viewer's episodes, including teleoperated ones, to a shard."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np

from mjhab.core.action_notes import HUMAN
from mjhab.data.record.provenance import describe_run
from mjhab.data.record.recorder import Appends, Recorder
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.store.episode_data import RunInfo
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import StepView

Known = Callable[[RunInfo, int, int], bool]
"""Tells whether the episode of a run with a seed and an index is in a shard."""


class Cuttable:
    """Wrapper of an environment that can truncate episodes at the next control step.

    Attributes:
        cut: (W,) bool, worlds whose episode the next step truncates; cleared by it.
        inner: the environment, which all other attributes are forwarded to.
    """

    def __init__(self, inner: SequentialTaskEnv) -> None:
        self.inner = inner
        self.cut = np.zeros(inner.num_envs, bool)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def as_env(self) -> SequentialTaskEnv:
        """Return this object, typed as the environment whose attributes it forwards."""
        return cast(SequentialTaskEnv, self)

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one control step as `SequentialTaskEnv.step`, with ``truncated`` set in the worlds of ``cut``."""
        obs, reward, terminated, truncated, info = self.inner.step(actions)
        truncated = truncated | self.cut
        # A cut is for one step.
        self.cut = np.zeros_like(self.cut)
        return obs, reward, terminated, truncated, info


class TakeRecorder(Recorder):
    """Record episodes, with a run description that names who acted in them.

    An episode in which a person acted is recorded as one of the policy "human", with a unique take id, so that the same
    episode can be recorded several times; so has one that did not reach its end. Another episode that is in the shard
    already is left out, because it would be identical. The dataset ``actor`` of an episode has the actor of every step;
    "corrected" of the run's policy is the policy that the person corrected.

    Args:
        writer: the shard.
        env: the environment that is rolled out.
        policy: name and identity of the policy that acts in worlds that are not teleoperated.
        known: tells whether the shard has an episode already.
    """

    def __init__(
        self, writer: Appends, env: RecordedEnv, policy: Mapping[str, Any], known: Known
    ) -> None:
        super().__init__(
            writer, env, policy, keep=lambda record, run: not self._is_known(record)
        )
        self._env = env
        self._policy = dict(policy)
        self._known = known
        self._alone = self.run
        self._acted: dict[int, set[str]] = {}

    def on_reset(
        self, env: RecordedEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """See `Recorder`."""
        super().on_reset(env, info, mask)
        for w in np.flatnonzero(mask).tolist():
            self._acted[w] = set()

    def on_step(self, env: RecordedEnv, step: StepView) -> None:
        """See `Recorder`."""
        super().on_step(env, step)
        for w in np.flatnonzero(step.active).tolist():
            self._acted[w].add(step.notes.actors[int(step.notes.actor[w])])

    def on_episode_end(self, env: RecordedEnv, world: int, record: EpisodeRecord) -> None:
        """See `Recorder`."""
        # Set before the recorder looks: the run's name is part of the episode's.
        self.run = self._run_of(self._acted.pop(world), bool(env.progress.done[world]))
        super().on_episode_end(env, world, record)

    def _run_of(self, acted: set[str], is_whole: bool) -> RunInfo:
        if is_whole and acted == {self._policy["name"]}:
            return self._alone
        name = HUMAN if HUMAN in acted else "+".join(sorted(acted))
        # A person never does the same twice, so that seed and index do not identify it.
        take = f"{time.strftime('%Y%m%dT%H%M%S')}-{secrets.token_hex(3)}"
        about: dict[str, Any] = {"name": name, "actors": sorted(acted), "take": take}
        if name == HUMAN and self._policy["name"] in acted:
            about["corrected"] = self._policy
        return describe_run(self._env, about, self.run.licence)

    def _is_known(self, record: EpisodeRecord) -> bool:
        return self._known(self.run, record.seed, record.index)
