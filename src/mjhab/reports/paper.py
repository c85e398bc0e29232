"""Published results of the MS-HAB paper: trajectory labels (Tables 6 to 13) and success rates (Tables 1 and 5)."""

from __future__ import annotations

import csv
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from mjhab.core.names import kind_of
from mjhab.tasks.subtasks.registry import SUBTASKS

_COLUMNS = ("i", "ii", "iii", "iv", "v", "vi", "vii", "viii", "ix", "x", "xi", "xii")
SUCCESS_COLUMNS = ("rl_per", "rl_all", "bc", "dp")
"""Policies in the tables of success rates: RL per object, RL for all objects, behaviour cloning, diffusion policy."""
POLICIES = ("RL-Per", "RL-All", "IL")
"""Policies in the tables of labels: RL per object, RL for all objects (not for Open and Close), imitation of RL-Per."""

ABLATIONS: dict[str, dict[str, str | dict[str, str]]] = {
    "force_limits": {"force_limit_1400": "5 to 20 points less"},
    "long_horizon": {"simplified": "under 20 % of whole tasks"},
    "demo_count": {
        "demos_1": "0 %",
        "demos_10": "2 ± 3 %",
        "demos_100": "27 ± 19 %",
        "demos_500": "53 ± 13 %",
        "demos_1000": "62 ± 9 %",
    },
    "sac_ppo": {"ppo": "near 0 % in Place of PrepareGroceries and SetTable"},
    "filters": {
        "place_in_goal": {
            "train": "45.73 %, placed to dropped 3.17:1",
            "val": "54.46 %, placed to dropped 2.55:1",
        },
        "drop_to_goal": {
            "train": "49.21 %, placed to dropped 1:2.22",
            "val": "51.19 %, placed to dropped 1:2.86",
        },
        "split_50_50": {
            "train": "50.30 %, placed to dropped 1:1.71",
            "val": "55.56 %, placed to dropped 1:1.41",
        },
    },
}
"""What the paper says about other rules and ways of training, by result and variant, where it differs by split
(MS-HAB, ICLR 2025)."""


def rules_of(env: Mapping[str, Any]) -> str:
    """The rules by which episodes were judged, from options of `EnvConfig`; those of the first version have none."""
    return f"profile {env.get('profile', 'mjhab')}, stillness {env.get('stillness', 'absolute')}"


def beside_the_paper(rules: str) -> str:
    """A sentence for pages that show numbers judged by ``rules`` (see `rules_of`) beside the paper's."""
    return f"The paper's numbers are of profile ms_hab, stillness published; ours are of {rules}."


@dataclass(frozen=True)
class PaperRow:
    """Results of a policy in the paper, in percent; ``labels`` sum to 100 up to rounding. table: its number."""

    table: int
    success_once: float
    success_at_end: float
    labels: dict[str, float]


def _lines(name: str) -> csv.DictReader[str]:
    text = files("mjhab.reports").joinpath(name).read_text(encoding="utf-8")
    return csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))


@functools.cache
def _rows() -> dict[tuple[str, str, str, str, str], PaperRow]:
    rows = {}
    for row in _lines("paper_labels.csv"):
        published = SUBTASKS[row["subtask"]].published
        names = published.columns if published else ()
        labels = {
            name: float(row[column])
            # Kinds have fewer labels than the table has columns.
            for name, column in zip(names, _COLUMNS, strict=False)
        }
        key = (row["task"], row["subtask"], row["split"], row["target"], row["policy"])
        rows[key] = PaperRow(
            int(row["paper_table"]),
            float(row["success_once"]),
            float(row["success_at_end"]),
            labels,
        )
    return rows


def paper_row(
    task: str, subtask: str, split: str, target: str, policy: str
) -> PaperRow | None:
    """A row of the tables; None if the paper has no such row.

    Args:
        task, subtask, split: as in a record.
        target: object type or link, with or without the number of the copy, or "all" for all objects of the task.
        policy: one of POLICIES.
    """
    return _rows().get((task, subtask, split, _paper_target(target), policy))


def paper_success(task: str, subtask: str, split: str, target: str) -> dict[str, float]:
    """Success-once rates [%] of the paper's policies by SUCCESS_COLUMNS; empty if the paper has no such row.

    Args:
        task, subtask, split: as in a record.
        target: the link for Open and Close; Pick and Place have one row for all objects of a task.
    """
    articulation = _paper_target(target) if SUBTASKS[subtask].jointed else ""
    wanted = (task, subtask, split, articulation)
    for row in _lines("paper_success.csv"):
        if (row["task"], row["subtask"], row["split"], row["articulation"]) == wanted:
            # Some policies were not trained for all tasks: their cells are empty.
            return {name: float(row[name]) for name in SUCCESS_COLUMNS if row[name]}
    return {}


def _paper_target(target: str) -> str:
    furniture, _, link = kind_of(target).rpartition("/")
    if furniture:
        # The paper tells drawers of the counter from the fridge, but not from one another.
        return "drawer" if "drawer" in link else furniture
    return target.partition("_")[0]
