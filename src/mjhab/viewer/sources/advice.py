"""What the expert plans in recorded episodes: where each subtask of them began."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from mjhab.data.store.reading import Episode
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.recorded import recorded_env
from mjhab.experts.policy import ExpertPolicy
from mjhab.viewer.drawn.plan_marks import PlanMarks, plan_marks
from mjhab.viewer.sources.track import Track

PLAN_STEPS = 20
"""Control steps within which the expert has a plan, if it makes one."""


class RecordedPlans:
    """Plans of the expert in the states in which recorded subtasks began.

    They are made one after the other in a thread of their own, in environments of their own.

    Args:
        reading: held while an episode is read.

    Attributes:
        problem: why the last plan that was asked for cannot be made; empty while all is well.
    """

    def __init__(self, reading: threading.Lock) -> None:
        self.problem = ""
        self._reading = reading
        self._pool = ThreadPoolExecutor(1, "plans")
        self._envs: dict[str, SequentialTaskEnv] = {}
        self._known: dict[tuple[str, str, int], Future[PlanMarks | None]] = {}

    def at(self, episode: Episode, track: Track, step: int) -> PlanMarks | None:
        """The plan for the subtask that is active in a state; None until it is made, and where there is none."""
        begin = track.begin_of(step)
        key = (str(episode.shard.path), episode.name, begin)
        if key not in self._known:
            self._known[key] = self._pool.submit(self._plan, episode, track, begin)
        made = self._known[key]
        if not made.done():
            return None
        error = made.exception()
        self.problem = f"the expert cannot plan here: {error}" if error is not None else ""
        return None if error is not None else made.result()

    def close(self) -> None:
        """Free the environments, once the plan in work is made."""
        self._pool.shutdown(cancel_futures=True)
        for env in self._envs.values():
            env.close()

    def _plan(self, episode: Episode, track: Track, step: int) -> PlanMarks | None:
        if track.moments[step].active >= len(track.plan):
            return None
        with self._reading:
            state = _state_at(episode, track, step)
        env = self._env(episode)
        env.reset(seed=episode.record.seed, options={"episode": [episode.record.index]})
        env.set_state(0, state)
        expert = ExpertPolicy(env)
        expert.reset(np.ones(1, bool))
        marks = None
        for _ in range(PLAN_STEPS):
            # Some scripts plan only after their first steps.
            action = expert.act({}, {})
            script = expert.script(0)
            marks = plan_marks(script) if script is not None else None
            if marks is not None:
                break
            env.step(action)
        return marks

    def _env(self, episode: Episode) -> SequentialTaskEnv:
        run = episode.run
        if run.config_id not in self._envs:
            self._envs[run.config_id] = recorded_env(run, num_envs=1, threads=1)
        return self._envs[run.config_id]


def _state_at(episode: Episode, track: Track, step: int) -> dict[str, Any]:
    """The recorded first state of an episode (see `envs.parts.snapshots`), with positions and subtask of a later one.

    Raises:
        UsageError: the episode was recorded without states.
    """
    state = episode.initial()
    if step:
        moment = track.moments[step]
        state["sim"]["qpos"] = moment.qpos
        state["sim"]["qvel"] = episode.array("states/qvel")[step]
        state["progress"]["pointer"] = moment.active
    return state
