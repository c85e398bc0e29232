"""Tables of learned policies: students.json (trainings) and students-judged.json (what comes with mjhab).

`python -m mjhab.reports.students docs/results/students.json RUN EVALUATION` adds rows to the first,
`python docs/scripts/judge_students.py` makes the second; ``result_tables.py`` fills the pages.
"""

from __future__ import annotations

from typing import Any

from result_files import interval, percent, place_of, read, source, table

from mjhab.reports.paper import paper_success
from mjhab.reports.students import WHOLE
from mjhab.tasks.subtasks.navigate import NAVIGATE

PAPER = ("bc", "rl_per")
FAILURE = "_failure"
"""End of the labels of failures."""
TRAINING_HEAD = (
    *("task", "subtask", "target", "px", "steps", "once %", "95 %", "of", "at end %"),
    *("demonstrations", "control steps", "samples", "minutes", "paper BC %", "RL-Per %"),
)


def minutes(training: dict[str, Any]) -> str:
    """CPU minutes of everything; of a training on a GPU its duration, without the demonstrations."""
    if training.get("device", "cpu") == "cpu":
        return f"{training['cpu_minutes']:.0f}"
    return f"{training['minutes']:.0f} (GPU)"


def views_of(row: dict[str, Any]) -> str:
    """What the images show if they are not whole ones."""
    views = row.get("views", WHOLE)
    return "" if views == WHOLE else f" {views}"


def student_table(assets: str) -> str:
    """One line per student of seed 0, trained and judged in the homes of a pack."""
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
        line = [
            row["task"],
            row["subtask"],
            row["target"] or "all",
            str(row["image_size"] or "states") + views_of(row),
            str(judged["horizon"] or NAVIGATE.limits.horizon),
        ]
        line += [
            f"**{percent(judged['success_once'], 1)}**",
            interval(judged["success_once_interval"]),
        ]
        line += [str(judged["episodes"]), percent(judged["success_at_end"], 1)]
        frames = training["frames"]
        line += [f"{training['episodes']:,}", "-" if frames is None else f"{frames:,}"]
        samples = training["samples"]
        line += [f"{samples / 1e6:.1f} M" if samples else "-", minutes(training)]
        line += [
            f"{paper[name]:.1f}" if name in paper else "-" for name in ("bc", "rl_per")
        ]
        lines.append(line)
    return table(TRAINING_HEAD, lines) + source("students")


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
            ", ".join(percent(rate, 1) for rate in rates),
        ]
        lines.append([*line, percent(sum(rates) / len(rates), 1)])
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
    return [
        percent(row["success_once"], 1),
        interval(row["interval"]),
        str(row["episodes"]),
    ]


def failure_of(row: dict[str, Any] | None) -> str:
    """The most frequent label of failures of an evaluation, with the number of its episodes."""
    labels = {} if row is None else row["labels"]
    failures = {name: labels[name] for name in labels if name.endswith(FAILURE)}
    if not failures:
        return "-"
    name = max(failures, key=lambda label: failures[label])
    return f"{name.removesuffix(FAILURE).replace('_', ' ')} {failures[name]}"


BETWEEN = {
    "teleport": "teleport",
    "drive": "the expert drives",
    "drive hand=open": "the expert drives, `hand=open`",
}
"""What happens between the subtasks of a whole task."""


def judged_rows(pack: str) -> list[dict[str, Any]]:
    return [row for row in read("students-judged")["rows"] if row["pack"] == pack]


def judged_table(pack: str) -> str:
    """One line per shipped student of a pack's homes, val beside test, with the paper's numbers for val."""
    rows = judged_rows(pack)
    rows = [row for row in rows if row["subtask"]]
    found = {(*place_of(row), row["seed"], row["split"]): row for row in rows}
    splits = [name for name in ("val", "test") if any(name in key for key in found)]
    head = ["task", "subtask", "target"]
    for split in splits:
        head += [f"{split} once %", "95 %", "of", "at end %", "most frequent failure"]
    lines = []
    for row in sorted(rows, key=place_of):
        keys = (*place_of(row), row["seed"])
        line = [row["task"], row["subtask"], row["target"] or "all"]
        for split in splits:
            judged = found.get((*keys, split))
            end = "-" if judged is None else percent(judged["success_at_end"], 1)
            line += [*share_of(judged), end, failure_of(judged)]
        paper = paper_success(row["task"], row["subtask"], "val", row["target"]) or {}
        line += [f"{paper[name]:.1f}" if name in paper else "-" for name in PAPER]
        if line not in lines:
            lines.append(line)
    lines.append(["mean of these rows", "", "", *_means(rows, splits), "", ""])
    columns = (*head, "paper BC % (its val)", "RL-Per %")
    return table(columns, lines) + source("students-judged")


def _means(rows: list[dict[str, Any]], splits: list[str]) -> list[str]:
    """Cells of the means over the rows of each split."""
    cells = []
    for split in splits:
        mine = [row for row in rows if row["split"] == split]
        means = [
            percent(sum(row[name] for row in mine) / len(mine), 1)
            for name in ("success_once", "success_at_end")
        ]
        count = sum(row["episodes"] for row in mine)
        cells += [f"**{means[0]}**", "", str(count), means[1], ""]
    return cells


def chain_table(pack: str) -> str:
    """One line per whole task, split and seed, in a pack's homes."""
    rows = [row for row in judged_rows(pack) if not row["subtask"]]
    head = ("task", "between", "split", "seed", "whole task %", "95 %", "of", "tainted")
    lines = []
    for row in rows:
        between = BETWEEN[row["navigate"]]
        line = [row["task"], between, row["split"], str(row["seed"]), *share_of(row)]
        line.append(str(row["tainted"]))
        counts = [part for part in row["subtasks"] if part["kind"] != "navigate"]
        shares = (
            f"{part['kind']} {part['successes']}/{part['reached']}" for part in counts
        )
        lines.append([*line, ", ".join(shares)])
    columns = (*head, "subtasks that succeeded of those reached, in plan order")
    return table(columns, lines) + source("students-judged")


TABLES = {
    "policies": lambda: judged_table("builtin"),
    "policies_replica_cad": lambda: judged_table("replica_cad?stage=stand-in"),
    "policies_chains": lambda: chain_table("builtin"),
    "policies_chains_replica_cad": lambda: chain_table("replica_cad?stage=stand-in"),
    "trainings": lambda: student_table("builtin"),
    "trainings_replica_cad": lambda: student_table("replica_cad"),
    "trainings_walls": lambda: student_table("replica_cad?stage=stand-in"),
    "trainings_door_walls": lambda: student_table(
        "replica_cad?stage=stand-in?door_walls=2"
    ),
    "trainings_seeds": seed_table,
}
