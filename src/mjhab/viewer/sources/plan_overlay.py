"""Plans of the expert: in running worlds, and in the first state of each subtask of recorded episodes."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from mjhab.data.store.reading import RecordedEpisode
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts.policy import ExpertPolicy, Script
from mjhab.viewer.drawn.plan_marks import PlanMarks, plan_marks
from mjhab.viewer.sources.recorded_envs import RecordedEnvs
from mjhab.viewer.sources.track import Track

PLAN_STEPS = 20
"""Number of control steps after which an expert without a plan is taken to have none."""


class ExpertPlanOverlay:
    """The expert's plan in one of the worlds of a running environment.

    Attributes:
        marks: the plan; None until there is one.
    """

    def __init__(self, env: SequentialTaskEnv) -> None:
        self.marks: PlanMarks | None = None
        self._env = env
        self._token: tuple[int, int, int] | None = None
        self._tries = 0
        self._adviser: ExpertPolicy | None = None

    def forget(self) -> None:
        """Drop the plan, so that `note` computes it anew."""
        self.marks = None
        self._token = None

    def note(self, world: int, expert: ExpertPolicy | None) -> None:
        """Update ``marks`` in the present state of a world.

        Args:
            world: index of the world.
            expert: the expert if it acts in the world, whose present plan is taken; otherwise a second expert plans in
                the first control steps of each subtask.
        """
        script = expert.script(world) if expert is not None else self._advised(world)
        self.marks = plan_marks(script) if script is not None else None

    def _advised(self, world: int) -> Script | None:
        """The present script of the second expert."""
        if self._adviser is None:
            self._adviser = ExpertPolicy(self._env)
        here = np.arange(self._env.num_envs) == world
        token = self._env.view(world).token
        if token != self._token:
            self._adviser.reset(here)
            self.marks = None
            self._tries = 0
        self._token = token
        # Some scripts have a plan only after some control steps.
        if self.marks is None and self._tries < PLAN_STEPS:
            self._tries += 1
            # Its action is dropped: asking for one lets the script go on to its plan.
            self._adviser.act_in({}, {}, here)
        return self._adviser.script(world)


class RecordedPlans:
    """Compute plans of the expert in the first states of recorded subtasks, in its own thread and environments.

    Args:
        reading: lock that is held while an episode is read.

    Attributes:
        problem: why the last requested plan could not be computed; "" if there is no problem.
    """

    def __init__(self, reading: threading.Lock) -> None:
        self.problem = ""
        self._reading = reading
        # One thread, because an environment is of one at a time.
        self._pool = ThreadPoolExecutor(1, "plans")
        self._envs = RecordedEnvs()
        self._known: dict[tuple[str, str, int], Future[PlanMarks | None]] = {}

    def at(self, episode: RecordedEpisode, track: Track, step: int) -> PlanMarks | None:
        """Return the plan for the subtask that is active in a state, and start its computation at the first call.

        None until it is computed, if that failed (see ``problem``), and if the expert has no plan.
        """
        begin = track.begin_of(step)
        key = (str(episode.shard.path), episode.name, begin)
        if key not in self._known:
            self._known[key] = self._pool.submit(self._plan, episode, track, begin)
        made = self._known[key]
        if not made.done():
            self.problem = ""
            return None
        error = made.exception()
        self.problem = (
            f"the expert cannot plan here: {error}" if error is not None else ""
        )
        return None if error is not None else made.result()

    def close(self) -> None:
        """Close the environments after the current computation."""
        # Before the environments are closed that it works in.
        self._pool.shutdown(cancel_futures=True)
        self._envs.close()

    def _plan(
        self, episode: RecordedEpisode, track: Track, step: int
    ) -> PlanMarks | None:
        if track.moments[step].active >= len(track.plan):
            return None
        with self._reading:
            state = _state_at(episode, track, step)
        env = self._envs.of(episode)
        env.reset(seed=episode.record.seed, options={"episode": [episode.record.index]})
        env.set_state(0, state)
        expert = ExpertPolicy(env)
        expert.reset(np.ones(1, bool))
        marks = None
        for _ in range(PLAN_STEPS):
            # Some scripts have a plan only after some control steps.
            action = expert.act({}, {})
            script = expert.script(0)
            marks = plan_marks(script) if script is not None else None
            if marks is not None:
                break
            env.step(action)
        return marks


def _state_at(episode: RecordedEpisode, track: Track, step: int) -> dict[str, Any]:
    """The recorded first state (see `envs.parts.snapshots`), with qpos, qvel and active subtask of the state ``step``.

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
