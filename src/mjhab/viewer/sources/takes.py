"""Episodes that people drove, wholly or in part, on their way into a shard."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np

from mjhab.data.record.provenance import describe_run
from mjhab.data.record.recorder import Appends, Recorder
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.store.episode_data import RunInfo
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import StepView
from mjhab.viewer.sources.hand import HUMAN

Known = Callable[[RunInfo, int, int], bool]
"""Whether an episode of a run, by seed and index, is in a shard."""


class Cuttable:
    """An environment whose episodes can be ended by hand: they are then truncated by the next control step.

    cut: (W,) bool, the worlds to end. inner: the environment.
    """

    def __init__(self, inner: SequentialTaskEnv) -> None:
        self.inner = inner
        self.cut = np.zeros(inner.num_envs, bool)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def as_env(self) -> SequentialTaskEnv:
        """This object, which has all that the environment has."""
        return cast(SequentialTaskEnv, self)

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step, see the environment."""
        obs, reward, terminated, truncated, info = self.inner.step(actions)
        truncated = truncated | self.cut
        self.cut = np.zeros_like(self.cut)
        return obs, reward, terminated, truncated, info


class TakeRecorder(Recorder):
    """Records episodes under the name of who acted in them.

    An episode in which a person acted is the policy's ``human``, and a take of its own: the same episode can be driven
    again. Without a person, an episode that is in the shard already is left out, since it would be the same. Who acted
    in which step is in its dataset ``actor``.

    Args:
        writer: where to.
        env: what is rolled out.
        policy: name and identity of the policy that acts where nobody drives.
        known: whether the writer has an episode already.
    """

    def __init__(
        self, writer: Appends, env: RecordedEnv, policy: Mapping[str, Any], known: Known
    ) -> None:
        super().__init__(writer, env, policy, keep=lambda record, run: not self._is_known(record))
        self._env = env
        self._policy = dict(policy)
        self._known = known
        self._alone = self.run
        self._acted: dict[int, set[str]] = {}

    def on_reset(self, env: RecordedEnv, info: Mapping[str, Any], mask: np.ndarray) -> None:
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
        self.run = self._run_of(self._acted.pop(world))
        super().on_episode_end(env, world, record)

    def _run_of(self, acted: set[str]) -> RunInfo:
        if acted == {self._policy["name"]}:
            return self._alone
        name = HUMAN if HUMAN in acted else "+".join(sorted(acted))
        take = f"{time.strftime('%Y%m%dT%H%M%S')}-{secrets.token_hex(3)}"
        about = {"name": name, "actors": sorted(acted), "take": take}
        return describe_run(self._env, about, self.run.licence)

    def _is_known(self, record: EpisodeRecord) -> bool:
        return self._known(self.run, record.seed, record.index)
