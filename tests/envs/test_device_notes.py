"""Labels and events that are noted on the device against the tracker of the cpu backend, fed the same signals."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from mjhab.core.arrays import map_record
from mjhab.envs.device.notes import DeviceNotes
from mjhab.envs.parts.tracking import Tracker
from mjhab.tasks.labelling.events import event_names
from mjhab.tasks.plan import PADDING, Subtask, SubtaskKind, TaskPlan
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import spec_of


def test_history_tells_what_the_tracker_of_the_cpu_notes() -> None:
    rng = np.random.default_rng(0)
    worlds = 6
    kinds = np.array([0, 1, 2, 3, 4, 0])
    plans = [
        TaskPlan("", (Subtask(SubtaskKind(int(k)), obj="a", link="b"),)) for k in kinds
    ]
    tracker = Tracker(worlds, teleports=True)
    notes = DeviceNotes(worlds, 40, torch.device("cpu"), teleports=True)
    step = np.zeros(worlds, np.int64)
    within = np.zeros(worlds, np.int64)
    done = np.zeros(worlds, bool)
    signals = draw_signals(rng, kinds)
    progress = draw_progress(rng, step, within, done)
    tracker.begin(~done, signals, progress)
    notes.begin(torch.as_tensor(~done), *tensors(signals, progress))
    written = 0
    for _ in range(40):
        step = step + ~done
        within = within + ~done
        signals = draw_signals(rng, kinds)
        progress = draw_progress(rng, step, within, done)
        flags = notes.update(*tensors(signals, progress))
        assert tracker.update(signals, progress) == event_names(
            np.where(done, PADDING, kinds), flags
        )
        ended = (rng.random(worlds) < 0.1) & ~done
        outcome = StepOutcome(
            **{f.name: rng.random(worlds) < 0.5 for f in dataclasses.fields(StepOutcome)}
            | {"ended": ended}
        )
        expected = tracker.ended(signals, outcome, progress, plans)
        codes = notes.end(*tensors(signals, outcome, progress))
        # Some worlds go on with another subtask at once: what the last one did can still be told.
        moved = ended & (rng.random(worlds) < 0.8)
        done = done | (ended & ~moved)
        within = np.where(moved, 0, within)
        signals = draw_signals(rng, kinds)
        progress = draw_progress(rng, step, within, done)
        tracker.begin(moved, signals, progress)
        notes.begin(torch.as_tensor(moved), *tensors(signals, progress))
        assert notes.records(plans) == expected
        for w, record in enumerate(expected):
            label = (
                spec_of(int(kinds[w])).labels[int(codes[w])] if codes[w] >= 0 else None
            )
            assert label == (record and record["label"])
        written += sum(record is not None for record in expected)
    assert written > worlds


def draw_signals(rng: np.random.Generator, kinds: np.ndarray) -> Signals:
    values: dict[str, Any] = {
        f.name: rng.random(len(kinds)) < 0.5 for f in dataclasses.fields(Signals)
    }
    return Signals(**values | {"kind": kinds})


def draw_progress(
    rng: np.random.Generator, step: np.ndarray, within: np.ndarray, done: np.ndarray
) -> Progress:
    zero = np.zeros_like(step)
    force = rng.random(len(step)).astype(np.float32)
    fingers = rng.random(len(step)).astype(np.float32)
    return Progress(
        zero, zero, within.copy(), step.copy(), force, force, fingers, done, done.copy()
    )


def tensors(*records: Any) -> Any:
    return [map_record(lambda x: torch.as_tensor(x.copy()), record) for record in records]
