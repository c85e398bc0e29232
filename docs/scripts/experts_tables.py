"""Tables of the experts' success, and what takes a run of ``mjhab bench experts`` into docs/results.

    python docs/scripts/experts_tables.py runs/experts/results.json --into experts-builtin --command "mjhab bench ..."

A row that a run measured replaces the row of the same pack, task, subtask, target and navigation; rows that it did not
finish are left out. Every row keeps the commit at which it was measured. ``result_tables.py`` fills the pages.
"""

from __future__ import annotations

import argparse
import datetime
import json
from pathlib import Path

from result_files import (
    RESULTS,
    TASKS,
    Row,
    interval,
    percent,
    place_of,
    read,
    source,
    table,
    write,
)

PACKS = {"experts-builtin": "built-in", "experts-replica-cad": "ReplicaCAD (no walls)"}
"""File under docs/results to the name of its homes in the pages."""
PROFILE_PACKS = {
    ("experts-ms-hab", "builtin"): "built-in",
    ("experts-ms-hab", "replica_cad"): "ReplicaCAD (no walls)",
    ("experts-walls", "replica_cad"): "ReplicaCAD (stand-in walls)",
}
"""Files of profile ``ms_hab`` and packs in them, to the name of the homes."""


def key(row: Row) -> tuple[str, ...]:
    """What identifies a row of a file."""
    return (row["pack"], row["task"], row["subtask"], row["target"], row["navigate"])


def take(run: Path, name: str, command: str) -> None:
    """Put the finished rows and chains of a run in the place of older ones."""
    new = json.loads(run.read_text(encoding="utf-8"))
    kept = read(name) if (RESULTS / f"{name}.json").exists() else {"what": new["what"]}
    for part in ("rows", "groups", "chains"):
        rows = {key(row): row for row in kept.get(part, [])}
        for row in new[part]:
            if row["episodes"] and row["episodes"] == row["wanted"]:
                rows[key(row)] = {**row, "commit": new["commit"]}
        kept[part] = list(rows.values())
    kept |= {name: new[name] for name in ("config", "versions", "cores")}
    kept["date"] = datetime.date.fromtimestamp(run.stat().st_mtime).isoformat()
    write(name, kept | {"version": new["versions"]["mjhab"], "command": command})


def summary_table() -> str:
    """One line per subtask, tasks side by side, both packs in a cell; the last lines are whole tasks."""
    packs = [read(name) for name in PACKS]
    lines = []
    for subtask in ("pick", "place", "navigate", "open", "close"):
        cells = [_cell(packs, "groups", task, subtask, "") for task in TASKS]
        lines.append([subtask, *cells])
    for navigate in ("drive", "teleport"):
        cells = [_cell(packs, "chains", task, "chain", navigate) for task in TASKS]
        lines.append([f"whole task, {navigate}", *cells])
    head = ("success once %", "TidyHouse", "PrepareGroceries", "SetTable")
    return table(head, lines)


def _cell(packs: list[Row], part: str, task: str, subtask: str, navigate: str) -> str:
    """Success of all targets of a subtask, or of a whole task, in each pack."""
    cells = []
    for pack in packs:
        rows = pack[part] if part == "chains" else pack["rows"]
        found = [row for row in rows if (row["task"], row["subtask"]) == (task, subtask)]
        if part == "chains":
            found = [row for row in found if row["navigate"] == navigate]
        episodes = sum(row["episodes"] for row in found)
        good = sum(row["successes"] for row in found)
        cells.append(percent(good / episodes) if episodes else "-")
    return "-" if set(cells) == {"-"} else " / ".join(cells)


def subtask_table() -> str:
    """One line per task, subtask and target, packs side by side."""
    packs = [{key(row)[1:]: row for row in read(name)["rows"]} for name in PACKS]
    head = ["task", "subtask", "target"]
    for pack in PACKS.values():
        head += [f"{pack} once %", "95 %", "< 1,400 N %"]
    known = sorted(
        {name: row for pack in packs for name, row in pack.items()}.values(), key=place_of
    )
    lines = []
    for row in known:
        line = [row["task"], row["subtask"], row["target"] or "all"]
        for pack in packs:
            line += _figures(pack.get(key(row)[1:]))
        line.append(percent(row["paper"], 1) if row["paper"] is not None else "-")
        line.append(percent(row["asked"]) if row["asked"] is not None else "-")
        lines.append(line)
    return table((*head, "paper RL-Per %", "ask %"), lines) + source(*PACKS)


def _figures(row: Row | None) -> list[str]:
    if row is None:
        return [""] * 3
    share = percent(row["success_once"])
    return [share, interval(row["interval"]), percent(row["gentle"])]


def chain_table() -> str:
    """One line per pack, household task and navigation."""
    return _chains(PACKS)


def profile_chain_table() -> str:
    """Whole tasks under ``--profile ms_hab``, in homes with walls."""
    return _chains({"experts-walls": "ReplicaCAD (stand-in walls)"})


def _chains(packs: dict[str, str]) -> str:
    head = ("homes", "task", "navigation", "n", "whole task %", "95 %", "ask %")
    lines = []
    for name, pack in packs.items():
        for row in read(name)["chains"]:
            line = [pack, row["task"], row["navigate"], str(row["episodes"])]
            line += [percent(row["success_once"]), interval(row["interval"])]
            shares = " ".join(f"{share:.2f}" for share in row["progressive"])
            lines.append([*line, percent(row["asked"]), shares])
    told = "share of episodes that did the first 1, 2, ... subtasks"
    return table((*head, told), lines) + source(*packs)


def profile_table() -> str:
    """The ten rows of the paper's Table 1 under ``--profile ms_hab``; Pick and Place over all their objects."""
    head = ["homes", "task", "subtask", "target", "n", "once %", "95 %", "at end %"]
    lines = []
    for (file, pack), homes in PROFILE_PACKS.items():
        results = read(file)
        rows = [row for row in results["groups"] if row["subtask"] in ("pick", "place")]
        rows += [row for row in results["rows"] if row["subtask"] in ("open", "close")]
        rows = [row for row in rows if row["pack"] == pack]
        for row in sorted(rows, key=place_of):
            line = [homes, row["task"], row["subtask"], row["target"]]
            line += [str(row["episodes"]), percent(row["success_once"], 1)]
            line += [interval(row["interval"]), percent(row["success_at_end"], 1)]
            lines.append([*line, percent(row["paper"], 1)])
    files = dict.fromkeys(file for file, _ in PROFILE_PACKS)
    return table((*head, "paper RL-Per %"), lines) + source(*files)


TABLES = {
    "experts": subtask_table,
    "experts_summary": summary_table,
    "experts_chains": chain_table,
    "experts_chains_ms_hab": profile_chain_table,
    "experts_ms_hab": profile_table,
}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, help="results.json of a run")
    parser.add_argument(
        "--into", required=True, help="file under docs/results, without .json"
    )
    parser.add_argument("--command", required=True, help="what made the run")
    given = parser.parse_args()
    take(given.run, given.into, given.command)
