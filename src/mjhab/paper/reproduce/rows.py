"""Rows and columns of the paper's Table 1, and the policies that are trained for each of them."""

from __future__ import annotations

from dataclasses import dataclass

from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.household.set_table import BOWL_DRAWER, FRIDGE_DOOR
from mjhab.tasks.subtasks.registry import SUBTASKS

STUDENTS = "students"
RL_PER = "rl_per"
RL_ALL = "rl_all"
POLICY_COLUMNS = (STUDENTS, RL_PER, RL_ALL)
"""students: imitation of the expert by take-over DAgger, one policy per row. rl_per: reinforcement learning, one policy
per object. rl_all: reinforcement learning, one policy for all objects of a row. Open and Close have one policy per link
in every column."""
FOR_ALL = ""
"""Target of a policy for all objects."""


@dataclass(frozen=True)
class TableRow:
    """A row of the paper's Table 1, or a whole task (subtask ""). target: the link for Open and Close, else ""."""

    name: str
    task: str
    subtask: str
    target: str

    @property
    def folder(self) -> str:
        """Name of the folder of its runs."""
        return self.name.replace("/", ".")


def table_rows() -> dict[str, TableRow]:
    """The ten rows by name, in the order of the table."""
    rows = [
        TableRow(f"{task}/{subtask}", task, subtask, FOR_ALL)
        for task in ("tidy_house", "prepare_groceries", "set_table")
        for subtask in ("pick", "place")
    ]
    rows += [
        TableRow(f"set_table/{subtask}/{name}", "set_table", subtask, target)
        for subtask in ("open", "close")
        for name, target in (("fridge", FRIDGE_DOOR), ("drawer", BOWL_DRAWER))
    ]
    return {row.name: row for row in rows}


def place_rows() -> dict[str, TableRow]:
    """The rows of Place by name; only there the shape of the goal matters."""
    return {name: row for name, row in table_rows().items() if row.subtask == "place"}


def task_rows() -> dict[str, TableRow]:
    """The whole tasks by name."""
    # A dict and no set, to keep the order of the table.
    names = dict.fromkeys(row.task for row in table_rows().values())
    return {name: TableRow(name, name, "", FOR_ALL) for name in names}


def rows_of_task(task: str) -> list[TableRow]:
    """The rows of Table 1 whose policies together execute a whole task."""
    return [row for row in table_rows().values() if row.task == task]


def policy_targets(row: TableRow, column: str) -> tuple[str, ...]:
    """Targets of the policies of a row, one each: an object type, a link, or FOR_ALL."""
    if column != RL_PER or SUBTASKS[row.subtask].jointed:
        return (row.target,)
    from mjhab.episodes.rosters import roster  # loads scipy

    return TASKS[row.task].object_types or tuple(sorted(set(roster(row.task))))


def algorithm_of(row: TableRow, column: str) -> str:
    """Algorithm that trains the policies of a row; RL columns use PPO for Open and Close, else SAC, as in the paper."""
    if column == STUDENTS:
        return "dagger"
    return "ppo" if SUBTASKS[row.subtask].jointed else "sac"
