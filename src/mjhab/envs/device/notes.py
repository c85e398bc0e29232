"""Labels and events of every world's subtask on the device. Records are decoded on the host, only on request."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from mjhab.core.arrays import Array, map_record, to_numpy
from mjhab.envs.parts.tracking import Tracker
from mjhab.tasks import label_state as lb
from mjhab.tasks.labelling import events as ev
from mjhab.tasks.labelling.labels import label
from mjhab.tasks.plan import TaskPlan
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import PADDING


@dataclass(frozen=True)
class _Row(lb.History):
    """One step of the subtasks of n worlds, as the tracker reads it."""

    kind: Array


@dataclass(frozen=True)
class _Ended:
    """Data of the last step from which records are made, (W, ...): references to tensors that are never modified."""

    signals: Signals
    outcome: StepOutcome
    progress: Progress
    first: torch.Tensor
    must_hold: torch.Tensor
    start_step: torch.Tensor


@dataclass(frozen=True)
class DeviceStepNotes:
    """Events and ended subtasks of a control step, as tensors that later steps do not modify.

    ``event_flags`` (W, E) bool, columns `event_columns`; ``ended`` (W,) bool, whose subtask ended; ``label`` (W,) int64
    of that subtask, -1 for none.
    """

    event_flags: torch.Tensor
    ended: torch.Tensor
    label: torch.Tensor

    def entries(self) -> dict[str, torch.Tensor]:
        """Entries of `info`."""
        return {"event_flags": self.event_flags, "ended": self.ended, "label": self.label}


class DeviceNotes:
    """Collects labels and events of the active subtask of W worlds.

    `begin`, `update` and `end` do not wait for the device. The checks of every step are stored as bits of one
    integer until the next subtask of the world overwrites them.

    Args:
        num_worlds: W.
        longest: largest number of control steps of a subtask.
        device: device of the tensors.
        teleports: as in `Tracker`.
    """

    def __init__(
        self,
        num_worlds: int,
        longest: int,
        device: torch.device,
        teleports: bool = False,
    ) -> None:
        self._teleports = teleports
        self._history = torch.zeros(
            (num_worlds, longest + 2),
            dtype=torch.int16,
            device=device,
        )
        self._weights = (
            # 12 checks fit into 16 bits: a bool tensor would take six times as much.
            2 ** torch.arange(len(lb.WATCHED), dtype=torch.int16, device=device)
        )[:, None]
        self._start_step = torch.zeros(num_worlds, dtype=torch.int64, device=device)
        self._labels: lb.LabelState | None = None
        self._ended: _Ended | None = None

    def begin(self, mask: torch.Tensor, signals: Signals, progress: Progress) -> None:
        """Start new notes in the worlds of ``mask`` (W,) from the signals at the start of their subtask."""
        new = lb.start(signals)
        self._labels = new if self._labels is None else lb.choose(mask, new, self._labels)
        self._history[:, 0] = torch.where(
            mask, self._pack(self._labels.now), self._history[:, 0]
        )
        self._start_step = torch.where(mask, progress.episode_step, self._start_step)

    def update(self, signals: Signals, progress: Progress) -> torch.Tensor:
        """Add one control step, before the pointer moves; returns its events (W, E) bool, columns `event_columns`."""
        assert self._labels is not None
        before = self._labels
        live = ~progress.done
        self._labels = lb.choose(live, lb.add(before, lb.watch(signals)), before)
        # Beyond its horizon a world is done; clamped, since an index out of range crashes the device.
        column = torch.clamp(progress.subtask_step, max=self._history.shape[1] - 1)[
            :, None
        ]
        bits = torch.where(
            # What is there stays, as a scatter writes into all worlds.
            live,
            self._pack(self._labels.now),
            self._history.gather(1, column)[:, 0],
        )
        self._history.scatter_(1, column, bits[:, None])
        kind = torch.where(live, signals.kind, PADDING)
        return ev.edge_events(kind, before.now, self._labels.now)

    def end(
        self, signals: Signals, outcome: StepOutcome, progress: Progress
    ) -> torch.Tensor:
        """Store the data of subtasks that ended in this step; ``progress`` is that before the pointer moved.

        Returns:
            (W,) int64 label of the subtask that ended, an index into the ``labels`` of its `SubtaskSpec`; -1 for none.
        """
        assert self._labels is not None
        # A copy: the next subtask of the world overwrites it before records are asked for.
        first = self._history[:, 0].clone()
        hold = self._labels.must_hold
        self._ended = _Ended(signals, outcome, progress, first, hold, self._start_step)
        return label(self._labels, torch.where(outcome.ended, signals.kind, PADDING))

    def records(self, plans: Sequence[TaskPlan]) -> list[dict[str, Any] | None]:
        """Records of the subtasks that ended in the last step, (W,), as `tracking.Tracker.ended` writes them.

        Args:
            plans: plans of the worlds in that step.
        """
        records: list[dict[str, Any] | None] = [None] * len(plans)
        worlds = (
            np.flatnonzero(to_numpy(self._ended.outcome.ended))
            if self._ended
            else np.zeros(0, int)
        )
        if self._ended is None or not len(worlds):
            return records
        written = self._replay(self._ended, worlds, [plans[w] for w in worlds.tolist()])
        for w, record in zip(worlds.tolist(), written, strict=True):
            records[w] = record
        return records

    def _replay(
        self, ended: _Ended, worlds: np.ndarray, plans: list[TaskPlan]
    ) -> list[dict[str, Any] | None]:
        """Records of ``worlds`` (n,), from their stored steps, by the tracker of the cpu backend."""
        rows = torch.as_tensor(worlds, device=self._history.device)

        def chosen(values: torch.Tensor) -> np.ndarray:
            return to_numpy(values[rows])

        signals = map_record(chosen, ended.signals)
        outcome = map_record(chosen, ended.outcome)
        progress = map_record(chosen, ended.progress)
        start = chosen(ended.start_step)
        first = chosen(ended.first)
        hold = chosen(ended.must_hold)
        steps = progress.subtask_step
        bits = to_numpy(self._history[rows][:, : int(steps.max()) + 1]).copy()
        bits[:, 0] = first
        # That of the host: labels have one definition.
        tracker = Tracker(len(worlds), self._teleports)
        for t in range(bits.shape[1]):
            row = _row(bits[:, t], hold, signals.kind)
            # Shorter subtasks are done before the longest one.
            now = dataclasses.replace(progress, episode_step=start + t, done=t > steps)
            if t == 0:
                tracker.begin(np.ones(len(worlds), bool), row, now)  # type: ignore[arg-type]
            else:
                tracker.update(row, now)  # type: ignore[arg-type]
        return tracker.ended(signals, outcome, progress, plans)

    def _pack(self, now: torch.Tensor) -> torch.Tensor:
        """(K, W) bool to (W,) int16, row k as bit k."""
        return (now.to(torch.int16) * self._weights).sum(0, dtype=torch.int16)


def _row(bits: np.ndarray, must_hold: np.ndarray, kind: np.ndarray) -> _Row:
    held = {name: (bits >> k & 1).astype(bool) for k, name in enumerate(lb.WATCHED)}
    held["force_ok"] = ~held.pop("excess")
    return _Row(**held, must_hold=must_hold, kind=kind)
