"""The recorder: a sink that writes every finished episode of a rollout to a shard."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from mjhab.core.action_notes import NOTHING, Doing
from mjhab.core.errors import MjhabError, UsageError
from mjhab.data.record.provenance import describe_run, model_hash
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.store.annotations import ANNOTATIONS, Annotations
from mjhab.data.store.episode_data import EpisodeData, RunInfo, last_label, to_bytes
from mjhab.data.store.images import ImageFormat, encode, stored_frames
from mjhab.data.store.schema import FORCES, STORED_CHECKS
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView

STATE = "state"
_IMAGE = "sensor_data/"


class Appends(Protocol):
    """A destination of episodes, such as a `ShardWriter`."""

    def append(self, data: EpisodeData) -> int:
        """Store an episode; returns the number of bytes used."""
        ...


class Recorder(Sink[RecordedEnv]):
    """Records the episodes of an environment with autoreset "disabled" into an open shard.

    ``seen`` and ``kept`` count finished and stored episodes, ``labels`` the labels of the finished ones; ``bytes`` is
    the growth of the shard.

    Args:
        writer: destination; it stays open.
        env: the environment of the rollout.
        policy: name and options of the policy, see `provenance.describe_run`.
        keep: decides from the record whether to store an episode; None stores all, failures included.
        states: store positions and velocities of every state; without them images cannot be rendered later.
        images: format of the camera images among the observations; None leaves them out.
        licence: of the assets, if they are not the built-in ones.

    Raises:
        UsageError: the observations of the environment have nested keys.
    """

    def __init__(
        self,
        writer: Appends,
        env: RecordedEnv,
        policy: Mapping[str, Any],
        *,
        keep: Callable[[EpisodeRecord, RunInfo], bool] | None = None,
        states: bool = True,
        images: ImageFormat | None = None,
        licence: str = "",
    ) -> None:
        # Stacked or joined observations cannot be taken apart into the columns of the schema.
        if not env.config.has_flat_keys:
            raise UsageError(
                "recording needs flat observation keys and the parts of the state: leave out obs_keys, or give 'flat'."
            )
        self.run = describe_run(env, policy, licence)
        self.seen = self.kept = self.bytes = 0
        self.labels: Counter[str] = Counter()
        self._writer = writer
        self._keep = keep
        self._states = states
        self._images = images
        self._open: dict[int, _Buffer] = {}
        self._models: dict[str, str] = {}

    def on_reset(
        self, env: RecordedEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """Start buffers with the first states of the worlds in ``mask``."""
        # A sink is told of a reset without its observations.
        obs = env.observer.observe(env.state, env.focus, env.signals, env.homes)
        checks, forces = signal_rows(env.signals)
        for w in np.flatnonzero(mask).tolist():
            buffer = _Buffer(env.get_state(w), len(info["episode_spec"][w]["plan"]))
            buffer.wordings = env.wordings(w)
            # Labels compare each state with the one before, so that row 0 must be the start.
            buffer.enter(0, int(info["pointer"][w]), checks[w])
            buffer.add_state(self._physics(env, w), checks[w], forces[w], info, w)
            buffer.add_obs(obs, w, self._images)
            self._open[w] = buffer

    def on_step(self, env: RecordedEnv, step: StepView) -> None:
        """Add one action and one state to the buffer of every running episode."""
        # Those of the subtask that was active in the step; the pointer may have moved on since.
        checks, forces = signal_rows(env.outcome_signals)
        # The next subtask begins with signals of its own target.
        begun, _ = signal_rows(env.signals)
        terms = dict(step.info.get("reward_terms", {}))
        for w in np.flatnonzero(step.active).tolist():
            buffer = self._open[w]
            buffer.add_action(
                step, w, {name: float(values[w]) for name, values in terms.items()}
            )
            before = buffer.active[-1]
            now = int(step.info["pointer"][w])
            buffer.add_state(self._physics(env, w), checks[w], forces[w], step.info, w)
            buffer.add_obs(step.obs, w, self._images)
            # At the plan's end the pointer is one past the last subtask, and none begins.
            if now != before and now < buffer.length:
                buffer.enter(int(step.steps[w]), now, begun[w])

    def on_episode_end(self, env: RecordedEnv, world: int, record: EpisodeRecord) -> None:
        """Write the episode if it is to be kept.

        Raises:
            MjhabError: it does not fit the schema: numbers are not finite, or sizes differ from those of the env.
        """
        buffer = self._open.pop(world)
        self.seen += 1
        self.labels[last_label(record)] += 1
        # Before arrays are stacked: dropped episodes should cost nothing.
        if self._keep is not None and not self._keep(record, self.run):
            return
        # Hashing a model reads some MB of arrays, and a home's model does not change within a run.
        if record.home not in self._models:
            self._models[record.home] = model_hash(env.sim.model(record.home))
        columns = {
            "signals/checks": STORED_CHECKS,
            "signals/forces": FORCES,
            **buffer.columns(),
        }
        model = self._models[record.home]
        arrays = buffer.arrays()
        try:
            data = EpisodeData(
                record,
                self.run,
                model,
                _ending(env, world),
                arrays,
                columns,
                buffer.actors,
            )
        except ValueError as error:
            raise MjhabError(
                f"{error}. The episode was not recorded; those before it are safe."
            ) from error
        self.bytes += self._writer.append(data)
        self.kept += 1

    def close(self) -> None:
        """Drop the unfinished episodes."""
        self._open.clear()

    def _physics(
        self, env: RecordedEnv, world: int
    ) -> tuple[np.ndarray, np.ndarray] | None:
        if not self._states:
            return None
        state = env.sim.get_world(world)
        return state["qpos"], state["qvel"]


class _Buffer:
    """The rows of one running episode."""

    def __init__(self, initial: dict[str, Any], length: int) -> None:
        self.initial = initial
        self.length = length
        self.active: list[int] = []
        self.actors: tuple[str, ...] = ()
        self.wordings: Sequence[Sequence[str]] = ()
        self._doing: list[Doing] = []
        self._rows: dict[str, list[Any]] = {}
        self._terms: list[dict[str, float]] = []
        self._files: dict[str, list[bytes]] = {}
        self._parts: dict[str, int] = {}

    def _put(self, path: str, value: Any) -> None:
        self._rows.setdefault(path, []).append(value)

    def enter(self, step: int, index: int, checks: np.ndarray) -> None:
        """Record that a subtask starts after control step ``step``."""
        self._put("subtasks/step", np.int32(step))
        self._put("subtasks/index", np.int16(index))
        self._put("subtasks/checks", checks)

    def add_state(
        self,
        physics: tuple[np.ndarray, np.ndarray] | None,
        checks: np.ndarray,
        forces: np.ndarray,
        info: Mapping[str, Any],
        world: int,
    ) -> None:
        """Add physics, checks, forces and active subtask of a state of ``world``."""
        if physics is not None:
            self._put("states/qpos", physics[0])
            self._put("states/qvel", physics[1])
        self._put("signals/checks", checks)
        self._put("signals/forces", forces)
        self._put("signals/taint", np.uint8(info["taint"][world]))
        self.active.append(int(info["pointer"][world]))
        self._put("subtasks/active", np.int16(self.active[-1]))

    def add_obs(
        self, obs: Mapping[str, np.ndarray], world: int, images: ImageFormat | None
    ) -> None:
        """Add the observation of a state of ``world``; parts that ``state`` already contains are not stored twice."""
        if not self._parts:
            self._parts = joined_parts(obs)
        # Copied, because environments reuse their arrays.
        self._put(f"obs/{STATE}", obs[STATE][world].copy())
        for key, values in obs.items():
            if key.startswith(_IMAGE):
                if images is not None:
                    output = key.rsplit("/", 1)[1]
                    self._files.setdefault(key.removeprefix(_IMAGE), []).append(
                        # Encoded at once, because raw frames of many worlds would not fit in memory.
                        encode(values[world], output, images)
                    )
            elif key != STATE and key not in self._parts:
                self._put(f"obs/{key}", values[world].copy())

    def add_action(self, step: StepView, world: int, terms: dict[str, float]) -> None:
        """Add an action and its reward and outcome."""
        self._put("actions", np.array(step.actions[world], np.float32))
        self._put("actions_intended", np.array(step.notes.intended[world], np.float32))
        self._put("actor", np.uint8(step.notes.actor[world]))
        self.actors = step.notes.actors
        self._doing.append(step.notes.doing[world] if step.notes.doing else NOTHING)
        self._put("reward/total", np.float64(step.reward[world]))
        self._put("reward/success", np.uint8(step.info["success"][world]))
        self._put("reward/fail", np.uint8(step.info["fail"][world]))
        self._terms.append(terms)

    def _term_names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for terms in self._terms for name in terms))

    def columns(self) -> dict[str, tuple[str, ...]]:
        """Column names of the state observation and of the reward terms."""
        parts = tuple(f"{key}:{size}" for key, size in self._parts.items())
        return {f"obs/{STATE}": parts, "reward/terms": self._term_names()}

    def arrays(self) -> dict[str, np.ndarray]:
        """All datasets of the episode except its record."""
        arrays = {path: np.stack(rows) for path, rows in self._rows.items()}
        arrays["states/initial"] = to_bytes(self.initial)
        told = Annotations.of(self._doing, self.wordings)
        if told:
            arrays[ANNOTATIONS] = told.array
        # A chain's subtasks have different terms, and those that were not active count as 0.
        names = self._term_names()
        if names:
            arrays["reward/terms"] = np.array(
                [[terms.get(name, 0.0) for name in names] for terms in self._terms]
            )
        return arrays | stored_frames(self._files)


def signal_rows(signals: Any) -> tuple[np.ndarray, np.ndarray]:
    """`tasks.measure.Signals` of W worlds as (W, len(STORED_CHECKS)) uint8 and (W, len(FORCES)) float64."""
    checks = np.stack(
        [np.asarray(getattr(signals, name)) for name in STORED_CHECKS], axis=1
    ).astype(np.uint8)
    forces = np.stack(
        [np.asarray(getattr(signals, name), np.float64) for name in FORCES], axis=1
    )
    return checks, forces


def joined_parts(obs: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Observations that ``state`` concatenates, in order, with their widths; empty if it is not a concatenation."""
    parts = {
        # float32 of two axes is what observers join; images and truths have other types.
        key: v.shape[1]
        for key, v in obs.items()
        if key != STATE and v.ndim == 2 and v.dtype == np.float32
    }
    if not parts or sum(parts.values()) != obs[STATE].shape[1]:
        return {}
    joined = np.concatenate([obs[key] for key in parts], axis=1)
    # Equal sizes prove nothing: the order may differ.
    return parts if np.array_equal(joined, obs[STATE], equal_nan=True) else {}


def _ending(env: RecordedEnv, world: int) -> str:
    if not env.progress.done[world]:
        return "cut"
    # Such episodes go on after success and failure, so that neither ended them.
    if env.config.runs_to_horizon:
        return "timeout"
    if env.success[world]:
        return "success"
    outcome_signals = env.outcome_signals
    assert outcome_signals is not None, "an episode has ended, so there was a step"
    if not outcome_signals.placed_ok[world]:
        return "place_broken"
    return "timeout" if outcome_signals.force_ok[world] else "force_exceeded"
