"""The names of the filter language: facts about an episode that a filter can test."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from mjhab.core.names import kind_of
from mjhab.core.timing import STEP_SECONDS
from mjhab.data.select.interventions import corrector_of
from mjhab.data.store.episode_data import RunInfo
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.style import NAMES, descriptions, field_words, value_of
from mjhab.tasks.subtasks.registry import SUBTASKS, all_labels, event_columns

NUMBER = "a number"
TEXT = "a text"
TRUTH = "yes or no"
TEXTS = "a list of texts"


@dataclass(frozen=True)
class Fact:
    """A named value of an episode. kind: its type, for messages. choices: all possible values; empty for any."""

    name: str
    kind: str
    meaning: str
    get: Callable[[EpisodeRecord, RunInfo], Any]
    choices: tuple[str, ...] = ()


def target_of(record: EpisodeRecord) -> str:
    """Object type or link of the last subtask that ended; if none ended, of the plan's first subtask."""
    return kind_of(
        record.subtasks[-1].target if record.subtasks else record.plan[0].target
    )


def events_of(record: EpisodeRecord) -> list[str]:
    """Names of all events in order."""
    return [name for _, name in record.events]


def _acted(record: EpisodeRecord, run: RunInfo) -> list[str]:
    # Old records do not count who acted, and then one policy did all of it.
    return list(record.actors) or [run.policy]


def _corrected(record: EpisodeRecord, run: RunInfo) -> int:
    return record.actors.get(corrector_of(run, record.actors), 0)


def _ended(record: EpisodeRecord, name: str) -> list[str]:
    return [getattr(entry, name) or "" for entry in record.subtasks]


def _last(record: EpisodeRecord, name: str) -> str:
    return next(iter(_ended(record, name)[::-1]), "")


def _event(name: str) -> Fact:
    return Fact(
        name, TRUTH, f"the event {name} occurred", lambda r, _: name in events_of(r)
    )


def _asked() -> tuple[Fact, ...]:
    """Facts about task, policy and home; the choices include registered plugins."""
    return (
        Fact("task", TEXT, "task", lambda r, _: r.task, TASKS.names()),
        Fact(
            "subtask",
            TEXT,
            "the subtask done alone, '' for a whole chain",
            lambda r, _: r.subtask or "",
            ("", *SUBTASKS),
        ),
        Fact(
            "split",
            TEXT,
            "split of the home",
            lambda r, _: r.split,
            ("train", "val", "test"),
        ),
        Fact("home", TEXT, "home", lambda r, _: r.home),
        Fact(
            "policy",
            TEXT,
            "name of what acted",
            lambda _, run: str(run.config.get("policy", {}).get("name", "")),
        ),
        Fact("actors", TEXTS, "who acted", _acted),
        Fact(
            "interventions",
            NUMBER,
            "control steps in which a person corrected a policy, or in rounds of DAgger the expert its student; 0 in "
            "older recordings",
            _corrected,
        ),
        Fact("robot", TEXT, "name of the robot", lambda _, run: run.robot),
        Fact(
            "profile",
            TEXT,
            "profile of the environment, '' where none is recorded",
            lambda _, run: str(run.config.get("env", {}).get("profile", "")),
        ),
        Fact("seed", NUMBER, "seed", lambda r, _: r.seed),
        Fact("index", NUMBER, "index", lambda r, _: r.index),
    )


def _subjects() -> tuple[Fact, ...]:
    """Facts about the objects, drawers and doors of an episode."""
    return (
        Fact(
            "target",
            TEXT,
            "object type or link of the last subtask that ended",
            lambda r, _: target_of(r),
        ),
        Fact(
            "furniture",
            TEXT,
            "furniture that the target is part of, '' for an object",
            lambda r, _: target_of(r).rpartition("/")[0],
        ),
        Fact(
            "targets",
            TEXTS,
            "object types and links of the plan",
            lambda r, _: [kind_of(e.target) for e in r.plan],
        ),
    )


def _judged() -> tuple[Fact, ...]:
    """Facts about labels and success; the choices include registered plugins."""
    labels = all_labels()
    return (
        Fact(
            "label",
            TEXT,
            "label of the last subtask that ended, '' if none did",
            lambda r, _: _last(r, "label"),
            ("", *labels),
        ),
        Fact(
            "labels",
            TEXTS,
            "labels of the subtasks that ended",
            lambda r, _: _ended(r, "label"),
            labels,
        ),
        Fact(
            "legacy_label",
            TEXT,
            "label by the rules of the published code",
            lambda r, _: _last(r, "legacy_label"),
            ("", *labels),
        ),
        Fact(
            "success",
            TRUTH,
            "the goal was reached at least once",
            lambda r, _: r.success_once,
        ),
        Fact(
            "success_at_end",
            TRUTH,
            "the goal holds in the last step",
            lambda r, _: r.success_at_end,
        ),
        Fact("fail", TRUTH, "the episode failed", lambda r, _: r.fail),
        Fact("completed", NUMBER, "subtasks completed", lambda r, _: r.completed),
        Fact("planned", NUMBER, "subtasks of the plan", lambda r, _: len(r.plan)),
    )


def _measured() -> tuple[Fact, ...]:
    """Facts about durations, forces, faults of the simulation, and events."""
    return (
        Fact("steps", NUMBER, "control steps", lambda r, _: r.steps),
        Fact("duration", NUMBER, "time [s]", lambda r, _: r.steps * STEP_SECONDS),
        Fact(
            "max_force",
            NUMBER,
            "largest force of a step on the robot [N]",
            lambda r, _: r.peak_force,
        ),
        Fact(
            "max_finger_force",
            NUMBER,
            "largest force of a step on both fingers [N]; nan in older recordings, for which no comparison holds",
            # A 0 would pass every "gentle" filter.
            lambda r, _: math.nan if r.peak_finger_force is None else r.peak_finger_force,
        ),
        Fact(
            "mean_force",
            NUMBER,
            # A division by 0 in an episode without a step would end the whole selection.
            "mean of it over the steps [N]",
            lambda r, _: r.cumulative_force / max(r.steps, 1),
        ),
        Fact(
            "cumulative_force",
            NUMBER,
            "sum of it over the steps [N x steps]",
            lambda r, _: r.cumulative_force,
        ),
        Fact(
            "tainted", TRUTH, "the simulation flagged a fault", lambda r, _: bool(r.taint)
        ),
        Fact("taints", TEXTS, "names of the faults", lambda r, _: list(r.taint)),
        Fact(
            "spawn_fallback",
            TRUTH,
            "no random start was valid, the nearest was taken",
            lambda r, _: r.spawn_fallback,
        ),
        Fact(
            "events",
            TEXTS,
            "names of all events in order",
            lambda r, _: events_of(r),
            event_columns(),
        ),
    )


def _styled(name: str) -> Fact:
    words = field_words(name)
    about = f"asked of the expert: {descriptions()[name]}"
    return Fact(
        f"style.{name}",
        TEXT if words else NUMBER,
        about,
        lambda r, _: value_of(r.style, name),
        words,
    )


def facts() -> Mapping[str, Fact]:
    """All names of the filter language, including events and labels of plugins."""
    # The versions change with every plugin, which brings new events and labels.
    return _facts((SUBTASKS.version, TASKS.version))


@lru_cache(maxsize=4)
def _facts(versions: tuple[int, int]) -> Mapping[str, Fact]:
    plain = (*_asked(), *_subjects(), *_judged(), *_measured())
    found = {fact.name: fact for fact in plain}
    found |= {f"style.{name}": _styled(name) for name in NAMES}
    found |= {name: _event(name) for name in event_columns() if name not in found}
    return found


def _steps_of(record: EpisodeRecord, event: str) -> list[int]:
    return [step for step, name in record.events if name == event]


FUNCTIONS: dict[str, tuple[str, Callable[[EpisodeRecord, str], float]]] = {
    "count": ("how often an event occurred", lambda r, event: len(_steps_of(r, event))),
    "first": (
        "control step of its first occurrence",
        lambda r, event: min(_steps_of(r, event), default=float("nan")),
    ),
    "last": (
        "control step of its last occurrence",
        lambda r, event: max(_steps_of(r, event), default=float("nan")),
    ),
}
"""Functions of the filter language: meaning and implementation by name. ``first`` and ``last`` of an event that did not
occur are NaN, with which every comparison is false."""
