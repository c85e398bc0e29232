"""Registry of kinds of subtasks, their numbers in arrays, and tables of their properties by number."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from mjhab.core.arrays import Array, Table, constant
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.registration.plugins import PATHS_VARIABLE, failed_plugins
from mjhab.core.registration.registry import Registry, check_item
from mjhab.tasks.subtasks.spec import EVENT_EDGES, SubtaskSpec
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

SUBTASKS: Registry[SubtaskSpec] = Registry(
    "subtask",
    {
        name: f"mjhab.tasks.subtasks.{name}:{name.upper()}"
        for name in ("pick", "place", "navigate", "open", "close")
    },
)
"""Their order gives the numbers in arrays; the first five are those of mshab/envs/planner.py."""
PADDING = -1
"""Number in arrays for no subtask: after the end of a plan, and once a plan is finished."""


def register_subtask(spec: SubtaskSpec) -> SubtaskSpec:
    """Register a kind of subtask and return it.

    Raises:
        UsageError: it is not a `SubtaskSpec`, or the name is taken.
    """
    check_item("register_subtask", spec, SubtaskSpec)
    return SUBTASKS.add(spec.name, spec)


def subtask_names() -> tuple[str, ...]:
    """Names of all kinds; the number of a kind in arrays is its index."""
    return SUBTASKS.names()


def number_of(name: str) -> int:
    """The number of a kind in arrays.

    Raises:
        UsageError: there is no such subtask.
    """
    return SUBTASKS.names().index(SUBTASKS[name].name)


def recorded_number(name: str) -> int:
    """Number of a kind that is named in recorded data.

    Raises:
        UsageError: there is no such subtask; the message says how a plugin is loaded.
    """
    if name not in SUBTASKS:
        advice = (
            f"If a plugin registers it, load the plugin: {PATHS_VARIABLE}=PATH mjhab ..."
        )
        advice = f"{advice} {failed_plugins()}".strip()
        raise unknown_name("recorded subtask", name, SUBTASKS, advice=advice)
    return number_of(name)


def name_of(kind: int) -> str:
    """The name of a number.

    Raises:
        UsageError: there is no such subtask.
    """
    names = SUBTASKS.names()
    if not 0 <= kind < len(names):
        numbered = ", ".join(f"{number} {name}" for number, name in enumerate(names))
        raise wrong_value("number of a subtask", int(kind), f"one of {numbered}")
    return names[kind]


def spec_of(kind: int) -> SubtaskSpec:
    """The `SubtaskSpec` of a number.

    Raises:
        UsageError: there is no such subtask.
    """
    return SUBTASKS[name_of(kind)]


def check_kinds(kind: Array) -> None:
    """Check that kinds (W,) are registered; numpy only, because reading device arrays would wait for the device.

    Raises:
        UsageError: names the number and the kinds there are.
    """
    if isinstance(kind, np.ndarray) and kind.size:
        # Both ends suffice: what lies between is a number of a kind.
        for strange in (int(kind.max()), int(kind.min())):
            if strange != PADDING:
                name_of(strange)


def properties(kind: Array, *names: str) -> Array:
    """Properties of the kinds of subtasks.

    Args:
        kind: (...) int64 kinds, -1 for none, whose properties are all False.
        names: fields or properties of `SubtaskSpec` that are True or False, such as "navigates".

    Returns:
        (len(names), ...) bool.

    Raises:
        UsageError: a kind that is not registered, see `check_kinds`.
    """
    check_kinds(kind)
    # ``kind < kind`` is bool on the right device: the table gets the dtype of what it is made like.
    return constant(_property_table(names, SUBTASKS.version), kind < kind)[:, kind]


@lru_cache(maxsize=64)
def _property_table(names: tuple[str, ...], version: int) -> Table:
    """(N, K + 1); kind -1 reads the last column."""
    specs = SUBTASKS.values()
    return Table(
        tuple((*(bool(getattr(s, name)) for s in specs), False) for name in names)
    )


def shown(kind: Array) -> Array:
    """(2, W) bool: whether the observation of the kinds (W,) has an object, and a goal; kind -1 has neither."""
    check_kinds(kind)
    return constant(_shown_table(SUBTASKS.version), kind < kind)[:, kind]


@lru_cache(maxsize=8)
def _shown_table(version: int) -> Table:
    specs = SUBTASKS.values()
    return Table(
        tuple(
            (*(part in spec.shows for spec in specs), False)
            for part in ("object", "goal")
        )
    )


def limits_of(config: TaskConfig, name: str) -> SubtaskConfig:
    """The limits of a kind of subtask under a configuration.

    Raises:
        UsageError: there is no such subtask.
    """
    return config.limits.get(name) or SUBTASKS[name].limits


def horizons(config: TaskConfig) -> tuple[int, ...]:
    """Horizon of every kind [control steps], by number."""
    return tuple(limits_of(config, name).horizon for name in SUBTASKS)


def force_limits(config: TaskConfig) -> tuple[float, ...]:
    """Force limit of every kind [N x control steps], by number, then infinity: what a finished plan reads."""
    # The entry behind the last kind is what number -1 reads.
    return (*(limits_of(config, name).force_limit for name in SUBTASKS), math.inf)


def event_columns() -> tuple[str, ...]:
    """Columns of the event flags: the events of mjhab, then those that subtasks of plugins have of their own."""
    return _event_columns(SUBTASKS.version)


@lru_cache(maxsize=8)
def _event_columns(version: int) -> tuple[str, ...]:
    own = (event for spec in SUBTASKS.values() for event in spec.events)
    return tuple(dict.fromkeys((*EVENT_EDGES, *own)))


def all_labels() -> tuple[str, ...]:
    """Every label of any kind, without repeats."""
    return tuple(
        dict.fromkeys(label for spec in SUBTASKS.values() for label in spec.labels)
    )
