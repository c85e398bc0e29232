"""Relabelling: labels computed again from stored signals, without simulator or policy."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.schema import DamagedError
from mjhab.rollout.records import EpisodeRecord, Event, SubtaskRecord
from mjhab.tasks.labelling.events import event_names, step_events
from mjhab.tasks.labelling.labels import label_history, label_names
from mjhab.tasks.labelling.legacy import legacy_history
from mjhab.tasks.labelling.state import History
from mjhab.tasks.subtasks.registry import recorded_number


@dataclass(frozen=True)
class Change:
    """A change of a subtask's record. what: "label", "legacy_label" or "events"."""

    subtask: int
    what: str
    old: object
    new: object


def relabel(episode: RecordedEpisode) -> tuple[EpisodeRecord, list[Change]]:
    """The record of an episode with labels and events by the current rules, and its changes.

    Subtasks that had not ended when the episode was cut keep having no label.

    Raises:
        DamagedError: its signals are not those of its record.
    """
    record = episode.record
    changes = []
    subtasks = []
    events = [e for e in record.events if e[0] > _last_end(record)]
    for k, old in reversed(list(enumerate(record.subtasks))):
        index, history = episode.history(k)
        if index != old.index or len(history.success) < 2:
            raise DamagedError(
                f"episode {episode.name} of {episode.shard.path}: its record has subtask {old.index}, and its signals "
                f"are {len(history.success)} states of subtask {index}. See what is wrong with: mjhab data check "
                f"{episode.shard.path}"
            )
        new = relabel_subtask(old, history)
        subtasks.insert(0, new)
        events[:0] = new.events
        for what in ("label", "legacy_label", "events"):
            before = getattr(old, what)
            after = getattr(new, what)
            if before != after:
                changes.insert(0, Change(old.index, what, before, after))
    if not changes:
        return record, []
    return dataclasses.replace(
        record, subtasks=tuple(subtasks), events=tuple(events)
    ), changes


def relabel_subtask(old: SubtaskRecord, history: History) -> SubtaskRecord:
    """The record of a subtask with label, published label and events computed from its signals (T+1, 1)."""
    rows, steps = _changing(history)
    kind = np.array([recorded_number(old.kind)])
    code = label_history(kind, rows)
    events: list[Event] = []
    for t in range(1, len(steps)):
        names = event_names(kind, step_events(kind, rows.row(t - 1), rows.row(t)))[0]
        events += [(old.start_step + int(steps[t]), name) for name in names]
    return dataclasses.replace(
        old,
        label=label_names(kind, code)[0] or None,
        legacy_label=legacy_history(int(kind[0]), rows)[0],
        events=tuple(events),
    )


def _changing(history: History) -> tuple[History, np.ndarray]:
    """The rows of a history that differ from the row before, and their steps; repeated rows do not affect labels.

    Rows 0 and 1 are always included, because the legacy labels treat the first step separately.
    """
    names = [f.name for f in dataclasses.fields(History)]
    rows = np.concatenate([getattr(history, name) for name in names], axis=1)
    keep = np.concatenate([[True], (rows[1:] != rows[:-1]).any(axis=1)])
    keep[1:2] = True
    return History(
        **{name: getattr(history, name)[keep] for name in names}
    ), np.flatnonzero(keep)


def _last_end(record: EpisodeRecord) -> int:
    return record.subtasks[-1].end_step if record.subtasks else 0
