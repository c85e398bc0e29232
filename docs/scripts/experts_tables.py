"""Tables of docs/experts.md from the results of ``mjhab bench experts`` under docs/results.

    python docs/scripts/experts_tables.py
    python docs/scripts/experts_tables.py runs/experts/results.json --into experts-builtin

The first writes the tables into the page; the second first takes the rows of a run into
docs/results/experts-builtin.json. A row that a run measured replaces the row of the same pack, task, subtask,
target and navigation; rows that it did not finish are left out. Every row keeps the commit at which it was measured.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1]
PAGE = DOCS / "experts.md"
RESULTS = DOCS / "results"
PACKS = {"experts-builtin": "built-in", "experts-replica-cad": "ReplicaCAD"}
"""File under docs/results to the name of its homes in the page."""
TASKS = ("tidy_house", "prepare_groceries", "set_table")
SUBTASKS = ("pick", "place", "open", "close", "navigate")

Row = dict[str, Any]


def key(row: Row) -> tuple[str, ...]:
    return (row["pack"], row["task"], row["subtask"], row["target"], row["navigate"])


def read(name: str) -> dict[str, Any]:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def take(run: Path, name: str) -> None:
    """Put the finished rows and chains of a run in the place of those of before."""
    new = json.loads(run.read_text(encoding="utf-8"))
    path = RESULTS / f"{name}.json"
    kept = read(name) if path.exists() else {"what": new["what"]}
    for part in ("rows", "groups", "chains"):
        rows = {key(row): row for row in kept.get(part, [])}
        for row in new[part]:
            if row["episodes"] and row["episodes"] == row["wanted"]:
                rows[key(row)] = {**row, "commit": new["commit"]}
        kept[part] = list(rows.values())
    kept |= {name: new[name] for name in ("config", "versions", "cores")}
    path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def percent(share: float) -> str:
    return f"{100 * share:.0f}"


def interval(row: Row) -> str:
    low, high = row["interval"]
    return f"{percent(low)}-{percent(high)}"


def table(head: tuple[str, ...], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def figures(row: Row | None) -> list[str]:
    """Cells of one pack in a line of the subtasks' table."""
    if row is None:
        return [""] * 4
    return [
        percent(row["success_once"]),
        interval(row),
        percent(row["gentle"]),
        row["commit"][:7],
    ]


def place_of(row: Row) -> tuple[int, int, str]:
    return (TASKS.index(row["task"]), SUBTASKS.index(row["subtask"]), row["target"])


def subtask_table() -> str:
    """One line per task, subtask and target, packs side by side."""
    packs = [{key(row)[1:]: row for row in read(name)["rows"]} for name in PACKS]
    head = ["task", "subtask", "target"]
    for pack in PACKS.values():
        head += [f"{pack} once %", "95 %", "< 1,400 N %", "commit"]
    known = sorted(
        {name: row for pack in packs for name, row in pack.items()}.values(), key=place_of
    )
    lines = []
    for row in known:
        line = [row["task"], row["subtask"], row["target"] or "all"]
        for pack in packs:
            line += figures(pack.get(key(row)[1:]))
        line.append(f"{100 * row['paper']:.1f}" if row["paper"] is not None else "-")
        line.append(percent(row["asked"]) if row["asked"] is not None else "-")
        lines.append(line)
    return table((*head, "paper RL-Per %", "ask %"), lines)


def chain_table() -> str:
    """One line per pack, household task and navigation."""
    head = (
        "homes",
        "chain",
        "navigation",
        "n",
        "whole chain %",
        "95 %",
        "ask %",
        "commit",
    )
    lines = []
    for name, pack in PACKS.items():
        for row in read(name)["chains"]:
            line = [pack, row["task"], row["navigate"], str(row["episodes"])]
            line += [percent(row["success_once"]), interval(row), percent(row["asked"])]
            line += [
                row["commit"][:7],
                " ".join(f"{share:.2f}" for share in row["progressive"]),
            ]
            lines.append(line)
    return table(
        (*head, "share of episodes that did the first 1, 2, ... subtasks"), lines
    )


def profile_table() -> str:
    """The ten rows of the paper's Table 1 under ``--profile ms_hab``; Pick and Place over all their objects."""
    head = (
        "task",
        "subtask",
        "target",
        "n",
        "once %",
        "95 %",
        "at end %",
        "paper RL-Per %",
    )
    results = read("experts-ms-hab")
    rows = [row for row in results["groups"] if row["subtask"] in ("pick", "place")]
    rows += [row for row in results["rows"] if row["subtask"] in ("open", "close")]
    lines = []
    for row in sorted(rows, key=place_of):
        line = [row["task"], row["subtask"], row["target"], str(row["episodes"])]
        line += [f"{100 * row['success_once']:.1f}", interval(row)]
        line += [f"{100 * row['success_at_end']:.1f}", f"{100 * row['paper']:.1f}"]
        lines.append(line)
    return table(head, lines)


TABLES = {"subtasks": subtask_table, "chains": chain_table, "ms_hab": profile_table}


def page_with_tables(page: str, tables: dict[str, Callable[[], str]] = TABLES) -> str:
    """The page, every ``<!-- table: NAME -->`` ... ``<!-- end -->`` filled anew."""
    for name, make in tables.items():
        start, end = f"<!-- table: {name} -->\n", "<!-- end -->"
        before, mark, rest = page.partition(start)
        if mark:
            page = before + mark + make() + "\n" + end + rest.partition(end)[2]
    return page


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "run",
        nargs="?",
        type=Path,
        help="results.json of a run whose rows are to be taken",
    )
    parser.add_argument(
        "--into", help="name of the file under docs/results, without .json"
    )
    given = parser.parse_args()
    if (given.run is None) != (given.into is None):
        parser.error("a run and --into belong together")
    if given.run:
        take(given.run, given.into)
    PAGE.write_text(page_with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
