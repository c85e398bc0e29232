"""THE rollout loop: what an episode is, is decided here and nowhere else.

Training-time evaluation, evaluation, data generation and viewers differ in their sinks only.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from mjhab.core.action_notes import ActionNotes
from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import UsageError, fault, wrong_type, wrong_value
from mjhab.core.files.interrupts import kernel_interrupts
from mjhab.core.typed.checks import check
from mjhab.rollout.indices import IndicesLeft
from mjhab.rollout.policy import Annotated, Fallible, Policy, RolloutEnv, Styled
from mjhab.rollout.records import EpisodeRecord, Event, PlanEntry, SubtaskRecord
from mjhab.rollout.sinks import EnvT, Sink, StepView


def rollout(
    env: EnvT,
    policy: Policy,
    episodes: Collection[int],
    seed: int,
    sinks: Sequence[Sink[EnvT]] = (),
    max_steps: int | None = None,
) -> list[EpisodeRecord]:
    """Run the named episodes and return their records, sorted by index.

    Worlds are filled with indices in the order given; a world that finishes takes the next one. What happens in an
    episode is a function of (seed, index), so the records do not depend on ``env.num_envs`` or on the order.

    Args:
        env: vector env with autoreset disabled whose ``reset`` takes ``options={"episode": (n,) indices,
            "reset_mask": (W,) bool}`` with n = number of worlds in the mask.
        policy: acts in all W worlds; actions of idle worlds are replaced by zeros.
        episodes: distinct episode indices, each >= 0. A range or `IndicesLeft` takes no memory per episode.
        seed: run seed, given to every reset.
        sinks: listeners, called in order; closed on every way out, also on Ctrl-C.
        max_steps: cut episodes after this many control steps; None leaves the end to the env.

    Raises:
        UsageError: an index is negative or named twice, ``max_steps`` < 1, or the environment resets its worlds by
            itself or is not a vector environment on the CPU; or the policy returns what are no actions: another shape
            than (W, A), no numbers, or numbers that are not finite in a world with an episode. What was finished before
            was told to the sinks.
    """
    _check(episodes, max_steps)
    _check_env(env)
    with ExitStack() as stack:
        # Closed in the order in which they are given, as a stack calls its last entry first.
        for sink in reversed(sinks):
            stack.callback(sink.close)
        for sink in sinks:
            sink.on_begin(env, episodes)
        # Ctrl-C inside of a compiled kernel would else come as another error.
        with kernel_interrupts():
            run = _Rollout(env, policy, episodes, seed, sinks, max_steps)
            while run.active.any():
                run.step()
        # Episodes finish in any order, which depends on the number of worlds.
        return sorted(run.records, key=lambda record: record.index)


def _check(episodes: Collection[int], max_steps: int | None) -> None:
    # Those of IndicesLeft are distinct and >= 0, and there may be too many for a set.
    if not isinstance(episodes, IndicesLeft):
        if any(index < 0 for index in episodes):
            raise wrong_value("episode indices", min(episodes), "at least 0")
        check(
            len(set(episodes)) == len(episodes), "episode indices", episodes, "distinct"
        )
    if max_steps is not None and max_steps < 1:
        raise wrong_value("max_steps", max_steps, "at least 1")


def _check_env(env: RolloutEnv) -> None:
    metadata = getattr(env, "metadata", {})
    # Environments of others may not say; then they must not reset.
    mode = metadata.get("autoreset_mode", AutoresetMode.DISABLED)
    if mode is not AutoresetMode.DISABLED:
        raise wrong_value(
            "autoreset",
            mode.name.lower(),
            "'disabled' for rollout, which would lose outcomes of episodes",
            'Make it with mjhab.make(..., autoreset="disabled"), or call mjhab.evaluate(policy, task=...), '
            "which makes its own.",
        )
    if not hasattr(env, "num_envs"):
        raise UsageError(
            "rollout needs a vector environment: mjhab.make(..., num_envs=1, autoreset='disabled')."
        )
    if metadata.get("tensors"):
        raise UsageError(
            "rollout runs on the CPU: make the environment with backend='cpu'."
        )


class _Rollout:
    """State of one call of ``rollout``."""

    def __init__(
        self,
        env: RolloutEnv,
        policy: Policy,
        episodes: Collection[int],
        seed: int,
        sinks: Sequence[Sink],
        max_steps: int | None,
    ) -> None:
        self.env = env
        self.policy = policy
        self.seed = seed
        self.sinks = sinks
        self.max_steps = np.inf if max_steps is None else max_steps
        # Not a list: there may be a hundred million.
        self.waiting = iter(episodes)
        self.left = len(episodes)
        self.active = np.zeros(env.num_envs, bool)
        self.steps = np.zeros(env.num_envs, np.int64)
        self.traces: list[_Trace | None] = [None] * env.num_envs
        self.records: list[EpisodeRecord] = []
        self.obs: Any = None
        self.info: Mapping[str, Any] = {}
        self._fill()

    def step(self) -> None:
        """Take one control step in all worlds, then give finished worlds their next episode."""
        actions = self._checked(self.policy.act(self.obs, self.info))
        faults = self._faults()
        notes = self._notes(actions)
        # Idle worlds stand still, whatever the policy returned for them.
        actions = np.where(self.active[:, None], actions, np.float32(0.0))
        self.obs, reward, terminated, truncated, self.info = self.env.step(actions)
        self.steps[self.active] += 1
        done = self.active & (
            np.asarray(terminated)
            | np.asarray(truncated)
            | (self.steps >= self.max_steps)
            | np.array([bool(fault) for fault in faults])
        )
        for w in np.flatnonzero(self.active):
            trace = self._trace(int(w))
            trace.actors[notes.actors[int(notes.actor[w])]] += 1
            trace.add(int(w), int(self.steps[w]), self.info)
        view = StepView(
            # Copies: a sink may keep the view beyond the step.
            self.active.copy(),
            self.steps.copy(),
            done,
            actions,
            self.obs,
            reward,
            self.info,
            notes,
        )
        for sink in self.sinks:
            sink.on_step(self.env, view)
        for w in np.flatnonzero(done):
            self._finish(int(w), faults[w])
        if done.any():
            self._fill()

    def _faults(self) -> list[str]:
        """Why the episode of each world cannot go on, "" where it can."""
        worlds = range(len(self.active))
        if not isinstance(self.policy, Fallible):
            return [""] * len(worlds)
        return [self.policy.fault(w) for w in worlds]

    def _notes(self, actions: np.ndarray) -> ActionNotes:
        if not isinstance(self.policy, Annotated):
            return ActionNotes.plain(actions, self.policy.name)
        notes = self.policy.notes()
        if notes.intended.shape != actions.shape:
            raise ValueError(
                f"policy {self.policy.name!r} gives actions {actions.shape} and intended ones {notes.intended.shape}"
            )
        return notes

    def _checked(self, given: Any) -> np.ndarray:
        """Actions of a policy as (W, A) float32; the env checks A and says what it is."""
        worlds = len(self.active)
        try:
            actions = np.asarray(given, np.float32)
        except (TypeError, ValueError) as error:
            raise wrong_type(
                "actions", given, "numbers (W, A)", where=f"policy {self.policy.name!r}"
            ) from error
        if actions.ndim != 2 or len(actions) != worlds:
            raise fault(
                f"policy {self.policy.name!r}",
                f"must return actions (W, A) for W = {worlds} worlds, got {actions.shape}.",
            )
        # Of idle worlds nothing is asked.
        bad = self.active[:, None] & ~np.isfinite(actions)
        if bad.any():
            world, column = (int(k) for k in np.argwhere(bad)[0])
            index = self._trace(world).index
            raise fault(
                f"policy {self.policy.name!r}",
                f"returned {actions[world, column]} in column {column} of its actions, in "
                f"episode {index} after control step {self.steps[world]} (world {world}). Actions must be finite.",
            )
        return actions

    def _trace(self, world: int) -> _Trace:
        trace = self.traces[world]
        assert trace is not None, f"world {world} is active without an episode"
        return trace

    def _finish(self, world: int, fault: str) -> None:
        style = self.policy.style(world) if isinstance(self.policy, Styled) else {}
        record = self._trace(world).record(
            int(self.steps[world]), world, self.info, self.env, style
        )
        record = dataclasses.replace(record, error=fault)
        self.active[world] = False
        self.traces[world] = None
        self.records.append(record)
        for sink in self.sinks:
            sink.on_episode_end(self.env, world, record)

    def _fill(self) -> None:
        mask = np.zeros(self.env.num_envs, bool)
        # The last episodes may be fewer than the free worlds.
        mask[np.flatnonzero(~self.active)[: self.left]] = True
        if not mask.any():
            return
        indices = np.array([next(self.waiting) for _ in range(int(mask.sum()))], np.int64)
        self.left -= len(indices)
        self.obs, self.info = self.env.reset(
            seed=self.seed, options={"episode": indices, "reset_mask": mask}
        )
        # After the environment, whose info tells which episodes begin.
        self.policy.reset(mask)
        self.active |= mask
        self.steps[mask] = 0
        for w, index in zip(np.flatnonzero(mask), indices, strict=True):
            self.traces[w] = _Trace(self.seed, int(index), self.info["episode_spec"][w])
        for sink in self.sinks:
            sink.on_reset(self.env, self.info, mask)


class _Trace:
    """What is gathered while one episode runs."""

    def __init__(self, seed: int, index: int, episode: Mapping[str, Any]) -> None:
        # An environment that ignores the option would record other episodes under these numbers.
        if episode["index"] != index:
            raise RuntimeError(
                f"env was asked for episode {index} but reset to episode {episode['index']}."
            )
        self.seed = seed
        self.index = index
        self.episode = episode
        self.started = time.perf_counter()
        self.actors: Counter[str] = Counter()
        self.force: list[float] = []
        self.finger_force: float | None = None
        self.events: list[Event] = []
        self.subtasks: list[SubtaskRecord] = []
        self.success_once = False
        self.taint = 0

    def add(self, world: int, step: int, info: Mapping[str, Any]) -> None:
        """Read one control step of ``world`` from ``info``."""
        self.force.append(float(info["robot_force"][world]))
        # Environments of others may have no such entry.
        if "finger_force" in info:
            now = float(info["finger_force"][world])
            self.finger_force = max(now, self.finger_force or 0.0)
        self.events.extend((step, str(name)) for name in info["events"][world])
        self.success_once |= bool(info["success"][world])
        # Collected, because a reset clears it.
        self.taint |= int(info["taint"][world])
        if info["ended"][world] is not None:
            self.subtasks.append(SubtaskRecord.from_dict(info["ended"][world]))

    def record(
        self,
        steps: int,
        world: int,
        info: Mapping[str, Any],
        env: RolloutEnv,
        style: Mapping[str, Any],
    ) -> EpisodeRecord:
        """Close the episode after ``steps`` control steps; ``info`` is that of its last step."""
        episode = self.episode
        return EpisodeRecord(
            seed=self.seed,
            index=self.index,
            home=str(episode["home"]),
            task=str(episode["task"]),
            split=str(episode["split"]),
            subtask=episode["subtask"],
            plan=tuple(
                PlanEntry(str(entry["kind"]), str(entry["target"]), plain(entry["goal"]))
                for entry in episode["plan"]
            ),
            subtasks=tuple(self.subtasks),
            success_once=self.success_once,
            success_at_end=bool(info["success"][world]),
            fail=bool(info["fail"][world]),
            steps=steps,
            completed=len(
                # A set, since a subtask that was undone may be done again.
                {subtask.index for subtask in self.subtasks if subtask.success_once}
            ),
            events=tuple(self.events),
            peak_force=round(max(self.force, default=0.0), 3),
            # Rounded, so that a record is the same text after a round trip through JSON.
            cumulative_force=round(ordered_sum(self.force), 3),
            force=tuple(round(value, 1) for value in self.force),
            taint=tuple(
                name for bit, name in enumerate(env.taint_names) if self.taint >> bit & 1
            ),
            spawn_fallback=bool(info["spawn_fallback"][world]),
            final_state=str(env.state_digest(world)),
            seconds=round(time.perf_counter() - self.started, 3),
            style=dict(style),
            instruction=str(episode.get("instruction", "")),
            instructions=tuple(episode.get("instructions", ())),
            peak_finger_force=(
                None if self.finger_force is None else round(self.finger_force, 3)
            ),
            skipped_homes=tuple(episode.get("skipped_homes", ())),
            perturbation=plain(episode.get("perturbation", {})),
            # One actor alone is the policy, whose name the run has.
            actors=dict(self.actors) if len(self.actors) > 1 else {},
        )


def plain(value: Any) -> Any:
    """Return ``value`` with numpy scalars and arrays turned into Python numbers and lists."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value
