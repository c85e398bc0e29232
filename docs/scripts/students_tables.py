"""Tables of docs/students.md from docs/results/students.json: ``python docs/scripts/students_tables.py``.

`python -m mjhab.reports.students docs/results/students.json RUN EVALUATION` adds rows to the file, and
`python docs/scripts/judge_students.py` makes docs/results/students-judged.json.
"""

from __future__ import annotations

import argparse
from typing import Any

from experts_tables import DOCS, page_with_tables, place_of, read, table

from mjhab.reports.paper import paper_success
from mjhab.tasks.subtasks.navigate import NAVIGATE

PAGE = DOCS / "students.md"


def percent(share: float) -> str:
    return f"{100 * share:.1f}"


def minutes(training: dict[str, Any]) -> str:
    """CPU minutes of everything; of a training on a GPU its duration, without the demonstrations."""
    if training.get("device", "cpu") == "cpu":
        return f"{training['cpu_minutes']:.0f}"
    return f"{training['minutes']:.0f} (GPU)"


def student_table(assets: str) -> str:
    """One line per student of seed 0, trained and judged in the homes of a pack."""
    head = (
        "task", "subtask", "target", "px", "steps", "once %", "95 %", "of", "at end %", "demonstrations",
        "control steps", "samples", "minutes", "paper BC %", "RL-Per %", "commit",
    )  # fmt: skip
    lines = []
    rows = [
        row
        for row in read("students")["rows"]
        if (row["assets"], row["seed"]) == (assets, 0)
    ]
    for row in sorted(rows, key=place_of):
        training = row["training"]
        judged = row["evaluation"]
        paper = row["paper_success_once"] or {}
        low, high = judged["success_once_interval"]
        line = [
            row["task"],
            row["subtask"],
            row["target"] or "all",
            str(row["image_size"] or "states"),
            str(judged["horizon"] or NAVIGATE.limits.horizon),
        ]
        line += [
            f"**{percent(judged['success_once'])}**",
            f"{100 * low:.0f}-{100 * high:.0f}",
        ]
        line += [str(judged["episodes"]), percent(judged["success_at_end"])]
        frames = training["frames"]
        line += [f"{training['episodes']:,}", "-" if frames is None else f"{frames:,}"]
        samples = training["samples"]
        line += [f"{samples / 1e6:.1f} M" if samples else "-", minutes(training)]
        line += [
            f"{paper[name]:.1f}" if name in paper else "-" for name in ("bc", "rl_per")
        ]
        lines.append([*line, training["commits"][-1][:7] or "-"])
    return table(head, lines)


def seed_table() -> str:
    """One line per student that was trained with several seeds."""
    found: dict[tuple[str, ...], dict[int, dict[str, Any]]] = {}
    keys = ("task", "subtask", "target", "image_size", "assets", "preset")
    for row in sorted(read("students")["rows"], key=place_of):
        name = tuple(str(row[key]) for key in keys)
        found.setdefault(name, {})[row["seed"]] = row["evaluation"]
    lines = []
    for (task, subtask, target, size, assets, _), seeds in found.items():
        if len(seeds) < 2:
            continue
        rates = [seeds[seed]["success_once"] for seed in sorted(seeds)]
        line = [
            task,
            subtask,
            target or "all",
            size,
            assets,
            ", ".join(map(percent, rates)),
        ]
        lines.append([*line, percent(sum(rates) / len(rates))])
    head = (
        "task",
        "subtask",
        "target",
        "px",
        "homes",
        "once % with seeds 0, 1, 2",
        "mean",
    )
    return table(head, lines)


def share_of(row: dict[str, Any] | None) -> list[str]:
    """Cells of an evaluation: percent, interval, number of episodes; dashes where it was not made."""
    if row is None:
        return ["-", "-", "-"]
    low, high = row["interval"]
    interval = f"{100 * low:.0f}-{100 * high:.0f}"
    return [percent(row["success_once"]), interval, str(row["episodes"])]


def judged_table() -> str:
    """One line per shipped student, val beside test, with the paper's numbers for val."""
    rows = [row for row in read("students-judged")["rows"] if row["subtask"]]
    found = {(*place_of(row), row["seed"], row["split"]): row for row in rows}
    head = ["task", "subtask", "target"]
    for split in ("val", "test"):
        head += [f"{split} once %", "95 %", "of"]
    lines = []
    for row in sorted(rows, key=place_of):
        keys = (*place_of(row), row["seed"])
        line = [row["task"], row["subtask"], row["target"] or "all"]
        for split in ("val", "test"):
            line += share_of(found.get((*keys, split)))
        paper = paper_success(row["task"], row["subtask"], "val", row["target"]) or {}
        line += [f"{paper[name]:.1f}" if name in paper else "-" for name in PAPER]
        if line not in lines:
            lines.append(line)
    return table((*head, "paper BC % (its val)", "RL-Per %"), lines)


def chain_table() -> str:
    """One line per whole task, split and seed."""
    rows = [row for row in read("students-judged")["rows"] if not row["subtask"]]
    head = ("task", "split", "seed", "whole task %", "95 %", "of", "tainted", "commit")
    lines = []
    for row in rows:
        line = [row["task"], row["split"], str(row["seed"]), *share_of(row)]
        line += [str(row["tainted"]), row["commit"][:7]]
        counts = [part for part in row["subtasks"] if part["kind"] != "navigate"]
        told = (
            f"{part['kind']} {part['successes']}/{part['reached']}" for part in counts
        )
        lines.append([*line, ", ".join(told)])
    return table(
        (*head, "subtasks that succeeded of those reached, in plan order"), lines
    )


PAPER = ("bc", "rl_per")
TABLES = {
    "judged": judged_table,
    "chains": chain_table,
    "students": lambda: student_table("builtin"),
    "replica_cad": lambda: student_table("replica_cad"),
    "seeds": seed_table,
}


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    text = page_with_tables(PAGE.read_text(encoding="utf-8"), TABLES)
    PAGE.write_text(text, encoding="utf-8")
