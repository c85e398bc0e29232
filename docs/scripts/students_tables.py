"""Tables of docs/students.md from docs/results/students.json: ``python docs/scripts/students_tables.py``.

`python -m mjhab.reports.students docs/results/students.json RUN EVALUATION` adds rows to the file.
"""

from __future__ import annotations

import argparse
from typing import Any

from experts_tables import DOCS, page_with_tables, place_of, read, table

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
        "task", "subtask", "target", "px", "once %", "95 %", "of", "at end %", "demonstrations",
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


TABLES = {
    "students": lambda: student_table("builtin"),
    "replica_cad": lambda: student_table("replica_cad"),
    "seeds": seed_table,
}


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    text = page_with_tables(PAGE.read_text(encoding="utf-8"), TABLES)
    PAGE.write_text(text, encoding="utf-8")
