"""Actions of scored episodes: storing them during the run, and replaying them."""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.data.record.worlds import RecordedEnv
from mjhab.evaluation.score.manifest import start_digest
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.tasks.success import succeeds_whatever_force

MAX_ACTIONS_BYTES = 64 << 20
"""Largest size of the decompressed actions of one episode [bytes]."""
NO_MORE = "the recorded actions end here"
"""Fault of a world in which a replayed episode outlasts its recorded actions."""


class StartKeeper(Sink[RecordedEnv]):
    """Remembers what no record tells of every finished episode, by its index.

    starts: digest of the start. continuing: whether the subtask succeeded in some step, whatever force the robot had
    exerted until then.
    """

    def __init__(self) -> None:
        self.starts: dict[int, str] = {}
        self.continuing: dict[int, bool] = {}
        self._now: dict[int, str] = {}
        self._achieved: dict[int, bool] = {}

    def on_reset(
        self, env: RecordedEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """Compute the digests of the worlds in ``mask`` (W,)."""
        for w in np.flatnonzero(mask).tolist():
            self._now[w] = start_digest(env, w)
            self._achieved[w] = False

    def on_step(self, env: RecordedEnv, step: StepView) -> None:
        """Look whether the subtasks succeed but for the force."""
        assert env.outcome_signals is not None
        good = step.active & succeeds_whatever_force(env.outcome_signals)
        for w in np.flatnonzero(good).tolist():
            self._achieved[w] = True

    def on_episode_end(self, env: RecordedEnv, world: int, record: EpisodeRecord) -> None:
        """Give what was found to the episode."""
        self.starts[record.index] = self._now[world]
        self.continuing[record.index] = self._achieved[world]


class ActionKeeper(StartKeeper):
    """Writes start digest, actions and ``continuing`` of every finished episode to a file of its own in ``folder``."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._actions: dict[int, list[np.ndarray]] = {}

    def on_reset(
        self, env: RecordedEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """Start recording the worlds in ``mask`` (W,)."""
        super().on_reset(env, info, mask)
        for w in np.flatnonzero(mask).tolist():
            self._actions[w] = []

    def on_step(self, env: RecordedEnv, step: StepView) -> None:
        """Remember the applied actions."""
        super().on_step(env, step)
        for w in np.flatnonzero(step.active).tolist():
            self._actions[w].append(np.array(step.actions[w], np.float32))

    def on_episode_end(self, env: RecordedEnv, world: int, record: EpisodeRecord) -> None:
        """Write the actions of the episode."""
        super().on_episode_end(env, world, record)
        index = record.index
        packed = packed_actions(np.stack(self._actions[world]))
        text = f"{self.starts[index]} {packed} {int(self.continuing[index])}"
        path = kept_path(self._folder, index)
        # One file per episode: a kill loses none that is finished.
        write_atomic(path, lambda temporary: temporary.write_text(text, encoding="ascii"))


def kept_path(folder: Path, index: int) -> Path:
    """File with the actions of the episode ``index``."""
    return folder / f"{index:06d}.actions"


def packed_actions(actions: np.ndarray) -> str:
    """Encode actions (N, A) as text: "A:", then zlib-compressed float32 in base64."""
    # Little-endian on every machine; the highest level, since files are written once and shared.
    packed = zlib.compress(np.asarray(actions, "<f4").tobytes(), 9)
    return f"{actions.shape[1]}:{base64.b64encode(packed).decode('ascii')}"


def unpacked_actions(text: str) -> np.ndarray:
    """Decode actions (N, A) float32 from the text of `packed_actions`.

    Raises:
        UsageError: the text is malformed, too long, or holds numbers that are not finite.
    """
    width, _, packed = text.partition(":")
    try:
        inflater = zlib.decompressobj()
        data = inflater.decompress(
            # A few kB could unpack to TB.
            base64.b64decode(packed, validate=True),
            MAX_ACTIONS_BYTES,
        )
        # `decompress` with a limit returns what fits and says nothing.
        if not inflater.eof:
            raise ValueError("they end too early, or are too long")
        actions = np.frombuffer(data, "<f4").reshape(-1, int(width))
    except (ValueError, zlib.error, binascii.Error) as error:
        raise UsageError(f"the actions of an episode cannot be read: {error}.") from error
    # A file from elsewhere must not bring the simulation to diverge.
    if not np.isfinite(actions).all():
        raise UsageError("the actions of an episode hold numbers that are not finite.")
    return actions.astype(np.float32)


class Replayed:
    """A policy that replays recorded actions.

    Args:
        worlds: number of worlds W.
        width: of an action (A).
        actions: (N, A) by index of the episode.
        errors: error that ended an episode with its last action, by index of the episode.
    """

    name = "replayed"

    def __init__(
        self,
        worlds: int,
        width: int,
        actions: Mapping[int, np.ndarray],
        errors: Mapping[int, str],
    ) -> None:
        self._width = width
        self._actions = actions
        self._errors = errors
        self._step = np.zeros(worlds, np.int64)
        self._faults = [""] * worlds

    def reset(self, mask: np.ndarray) -> None:
        """Start from the first action in the worlds of ``mask`` (W,)."""
        self._step[mask] = 0

    def fault(self, world: int) -> str:
        """Error of a world: the recorded one at the last action, NO_MORE after it, else ""."""
        return self._faults[world]

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """The next actions (W, A)."""
        acted = np.zeros((len(self._step), self._width), np.float32)
        none = np.zeros((0, self._width), np.float32)
        for w, spec in enumerate(info["episode_spec"]):
            index = -1 if spec is None else int(spec["index"])
            actions = self._actions.get(index, none)
            step = int(self._step[w])
            # The replay must not go on: what the policy would have done is not known.
            self._faults[w] = NO_MORE if step >= len(actions) else ""
            if step < len(actions):
                acted[w] = actions[step]
            if step == len(actions) - 1:
                self._faults[w] = self._errors.get(index, "")
        self._step += 1
        return acted
