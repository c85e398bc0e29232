"""Registry of household tasks."""

from __future__ import annotations

from collections.abc import Sequence

from mjhab.core.errors import UsageError
from mjhab.core.registration.registry import Registry, check_item
from mjhab.tasks.household.spec import TaskSpec
from mjhab.tasks.plan import Target, TaskPlan

TASKS: Registry[TaskSpec] = Registry(
    "task",
    {
        name: f"mjhab.tasks.household.{name}:{name.upper()}"
        for name in ("tidy_house", "prepare_groceries", "set_table")
    },
)


def register_task(spec: TaskSpec) -> TaskSpec:
    """Register a household task and return it.

    Raises:
        UsageError: it is not a `TaskSpec`, the name is taken, or its plan has a subtask that is not registered.
    """
    check_item("register_task", spec, TaskSpec)
    spec.subtasks  # noqa: B018 - its chain is tried here, where the error tells who is to blame
    return TASKS.add(spec.name, spec)


def chain(task: str, targets: Sequence[Target], home: str = "") -> TaskPlan:
    """Make the plan of a task for the targets of an episode, see `TaskSpec.plan`.

    Raises:
        UsageError: unknown task, wrong number of targets, or one without a link that the plan opens.
    """
    return TASKS[task].plan(targets, home)


def task_with(subtask: str) -> str:
    """Name of the first task that has a kind of subtask: the default for its training.

    Raises:
        UsageError: no task has it.
    """
    for name in TASKS:
        if subtask in TASKS[name].subtasks:
            return name
    raise UsageError(
        f"no task has the subtask {subtask!r}; register one whose plan contains it."
    )
