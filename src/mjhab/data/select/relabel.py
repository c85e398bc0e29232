"""Relabelling: labels computed again from stored signals, without simulator or policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.data.store.places import shard_paths
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import rewrite
from mjhab.rollout.records import EpisodeRecord, Event, SubtaskRecord
from mjhab.tasks.label_state import History
from mjhab.tasks.labelling.events import event_names, step_events
from mjhab.tasks.labelling.labels import label_history, label_names
from mjhab.tasks.labelling.legacy import legacy_history
from mjhab.tasks.subtasks.registry import recorded_number


@dataclass(frozen=True)
class Change:
    """A change of a subtask's record. what: "label", "legacy_label" or "events"."""

    subtask: int
    what: str
    old: object
    new: object


@dataclass(frozen=True)
class Relabelled:
    """Result of `relabel_shards`.

    episodes, subtasks: numbers of those whose labels were computed. changes: name of the episode and change, in order.
    without_signals: number of episodes that were imported without signals; their labels stay those of their source.
    """

    episodes: int
    subtasks: int
    changes: tuple[tuple[str, Change], ...]
    without_signals: int

    @property
    def changed_labels(self) -> int:
        """Number of subtasks with another label."""
        return sum(change.what == "label" for _, change in self.changes)


def relabel_shards(places: Path | Sequence[Path], write: bool = False) -> Relabelled:
    """Compute labels and events of recorded episodes by the current rules.

    Args:
        places: shards, or folders of shards.
        write: write records that change into their shards.

    Raises:
        UsageError: there are no shards.
        DamagedError: see `relabel`.
        StorageError: the disk is full or broken.
    """
    episodes = subtasks = skipped = 0
    changes: list[tuple[str, Change]] = []
    for path in shard_paths(places):
        new: dict[str, EpisodeRecord] = {}
        with open_shard(path) as shard:
            for episode in shard:
                # Imported episodes have the label of their source, and nothing to compute another from.
                if "signals/checks" in episode.run.absent:
                    skipped += 1
                    continue
                record, changed = relabel(episode)
                episodes += 1
                subtasks += len(record.subtasks)
                changes += [(episode.name, change) for change in changed]
                if changed:
                    new[episode.name] = record
        if write and new:
            rewrite(path, new)
    return Relabelled(episodes, subtasks, tuple(changes), skipped)


def relabel(episode: RecordedEpisode) -> tuple[EpisodeRecord, list[Change]]:
    """The record of an episode with labels and events by the current rules, and its changes.

    Subtasks that had not ended when the episode was cut keep having no label.

    Raises:
        DamagedError: its signals are not those of its record.
    """
    record = episode.record
    changes = []
    subtasks = []
    # Events after the last subtask belong to none whose signals could be read again.
    events = [e for e in record.events if e[0] > _last_end(record)]
    # From the last one on, so that events are put before those that follow.
    for k, old in reversed(list(enumerate(record.subtasks))):
        index, history = episode.history(k)
        # A label needs a state before and one after an action.
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
        # Code 0 is a subtask without a label yet.
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
    # A slice, since an episode may have one row only.
    keep[1:2] = True
    return History(
        **{name: getattr(history, name)[keep] for name in names}
    ), np.flatnonzero(keep)


def _last_end(record: EpisodeRecord) -> int:
    return record.subtasks[-1].end_step if record.subtasks else 0
