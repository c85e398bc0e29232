"""``mjhab reproduce table1``: one student for each row of the paper's Table 1, and a page with both."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.cli.evaluate import ProgressSink, sigterm_interrupts
from mjhab.cli.options.reproduce import ReproduceOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.cli.profiles import profile_options
from mjhab.config.env import SPLITS
from mjhab.config.profiles import profile_named
from mjhab.core.errors import unknown_name
from mjhab.episodes.generator import BOWL_DRAWER, FRIDGE_DOOR
from mjhab.evaluation.evaluate import EvalSpec, run_evaluation
from mjhab.learning.require import require_learn
from mjhab.reports import parts
from mjhab.reports.paper import SUCCESS_COLUMNS, paper_success
from mjhab.reports.run import render_page
from mjhab.reports.students import student_row
from mjhab.rollout.store import check_folder, write_text

if TYPE_CHECKING:
    from mjhab.learning.runs.session import Request

CONFIG = "config.json"
ROW = "row.json"
RESULTS = "results.json"
REPORT = "report.html"
PAPER_TITLES = dict(
    zip(SUCCESS_COLUMNS, ("RL per object", "RL for all", "BC", "diffusion"), strict=True)
)
RESULTS_OF_PAPER = ("table1",)
SECONDS_PER_MINUTE = 60.0


@dataclass(frozen=True)
class TableRow:
    """A row of the paper's Table 1. target: the link of Open and Close; "" for all objects of the task."""

    name: str
    task: str
    subtask: str
    target: str


def table_rows() -> dict[str, TableRow]:
    """The ten rows by name, in the order of the table."""
    rows = [
        TableRow(f"{task}/{subtask}", task, subtask, "")
        for task in ("tidy_house", "prepare_groceries", "set_table")
        for subtask in ("pick", "place")
    ]
    rows += [
        TableRow(f"set_table/{subtask}/{name}", "set_table", subtask, target)
        for subtask in ("open", "close")
        for name, target in (("fridge", FRIDGE_DOOR), ("drawer", BOWL_DRAWER))
    ]
    return {row.name: row for row in rows}


def run_reproduce(options: ReproduceOptions) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C or SIGTERM (what is done is kept)."""
    require_learn()
    rows = chosen_rows(options)
    config = table_config(options)
    check_folder(options.out, config, resume=options.resume)
    options.out.mkdir(parents=True, exist_ok=True)
    write_text(options.out / CONFIG, json.dumps(config, indent=2) + "\n")
    interrupted = False
    with sigterm_interrupts():
        try:
            for row in rows:
                print(f"mjhab: {row.name}", file=sys.stderr)
                make_row(options, row)
                write_results(options.out, rows)
        except KeyboardInterrupt:
            interrupted = True
    tell(options, write_results(options.out, rows), interrupted)
    return 130 if interrupted else 0


def chosen_rows(options: ReproduceOptions) -> list[TableRow]:
    """The rows that are asked for.

    Raises:
        UsageError: an unknown name, or a number out of range; nothing was written.
    """
    from mjhab.learning.configs import preset_of

    if options.what not in RESULTS_OF_PAPER:
        raise unknown_name("result of the paper", options.what, RESULTS_OF_PAPER)
    known = table_rows()
    for name in options.rows:
        if name not in known:
            raise unknown_name("row", name, known)
    if options.split not in SPLITS:
        raise unknown_name("split", options.split, SPLITS)
    for name, least in (("episodes", 1), ("worlds", 1), ("films", 0), ("seed", 0), ("threads", 0)):
        at_least(name, getattr(options, name), least)
    at_least("budget-minutes", options.budget_minutes, 0)
    preset_of("dagger", options.preset)
    profile_named(options.profile)
    return [known[name] for name in options.rows or known]


def table_config(options: ReproduceOptions) -> dict[str, Any]:
    """What all rows of a folder have in common, as plain JSON data."""
    names = ("what", "preset", "budget_minutes", "split", "episodes", "seed", "assets")
    return {**{name: getattr(options, name) for name in names}, **profile_options(options)}


def make_row(options: ReproduceOptions, row: TableRow) -> None:
    """Train and judge the student of a row, or what is missing of that.

    Raises:
        KeyboardInterrupt: what is done is kept.
    """
    from mjhab.learning.runs.evaluation import EVALUATION_SEED
    from mjhab.learning.runs.train import train

    folder = options.out / row.name.replace("/", ".")
    if (folder / ROW).is_file():
        return
    run = folder / "train"
    judged = folder / "evaluation"
    result = train(request_of(options, row), run, resume=(run / CONFIG).is_file())
    if result.interrupted:
        raise KeyboardInterrupt
    spec = EvalSpec(
        policy=str(run / "student.safetensors"),
        task=row.task,
        subtask=row.subtask,
        target=row.target or None,
        episodes=options.episodes,
        worlds=options.worlds,
        seed=EVALUATION_SEED + options.seed,
        split=options.split,
        assets=options.assets,
        threads=options.threads,
        films=options.films,
        env=profile_options(options),
        out=judged,
        resume=(judged / CONFIG).is_file(),
    )
    run_evaluation(spec, [ProgressSink(spec)])
    write_text(folder / ROW, json.dumps(student_row(run, judged), indent=1) + "\n")


def request_of(options: ReproduceOptions, row: TableRow) -> Request:
    """What is trained for a row."""
    from mjhab.cli.doctor import cores
    from mjhab.learning.configs import preset_of
    from mjhab.learning.runs.collection import Means, Scene
    from mjhab.learning.runs.session import Request

    return Request(
        config=preset_of("dagger", options.preset),
        scene=Scene(
            row.task, row.subtask, row.target, assets=options.assets, **profile_options(options)
        ),
        means=Means(options.worlds, 1, options.threads or cores()),
        seed=options.seed,
        budget_seconds=SECONDS_PER_MINUTE * options.budget_minutes,
        eval_episodes=0,
        torch_threads=options.threads,
    )


def write_results(out: Path, rows: Sequence[TableRow]) -> list[dict[str, Any]]:
    """Write results.json and report.html of the rows that are through, and return them."""
    split = json.loads((out / CONFIG).read_text(encoding="utf-8"))["split"]
    found = []
    for row in rows:
        path = out / row.name.replace("/", ".") / ROW
        if path.is_file():
            found.append(result_of(row, json.loads(path.read_text(encoding="utf-8")), split))
    write_text(out / RESULTS, json.dumps({"rows": found}, indent=1) + "\n")
    write_text(out / REPORT, page(found, split))
    return found


def result_of(row: TableRow, measured: Mapping[str, Any], split: str) -> dict[str, Any]:
    """A row for machines; ours as shares, the paper's in percent as it prints them."""
    judged = measured["evaluation"]
    low, high = judged["success_once_interval"]
    return {
        "row": row.name,
        "success_once": judged["success_once"],
        "low": low,
        "high": high,
        "success_at_end": judged["success_at_end"],
        "episodes": judged["episodes"],
        "demonstrations": measured["training"]["episodes"],
        "cpu_minutes": measured["training"]["cpu_minutes"],
        "labels": judged["labels"],
        "paper": paper_success(row.task, row.subtask, split, row.target),
    }


COLUMNS = (
    "row",
    "success once [%]",
    "95 % interval",
    "at end [%]",
    "episodes",
    "demonstrations",
    "CPU minutes",
)


def cells(result: Mapping[str, Any]) -> tuple[Any, ...]:
    """A row for people, without the paper."""
    return (
        result["row"],
        round(100 * result["success_once"], 1),
        f"{100 * result['low']:.0f} to {100 * result['high']:.0f}",
        round(100 * result["success_at_end"], 1),
        result["episodes"],
        result["demonstrations"],
        result["cpu_minutes"],
    )


def page(results: Sequence[Mapping[str, Any]], split: str) -> str:
    """The page with our numbers and those of the paper."""
    titles = (*COLUMNS, *(f"paper: {title} [%]" for title in PAPER_TITLES.values()))
    head = "".join(f"<th>{escape(title)}</th>" for title in titles)
    lines = []
    for result in results:
        values = (*cells(result), *(result["paper"].get(name, "") for name in PAPER_TITLES))
        lines.append(
            "<tr>" + "".join(f"<td>{escape(str(value))}</td>" for value in values) + "</tr>"
        )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    hint = (
        f"Success once in homes of split {split}. The paper's policies were judged in ReplicaCAD homes, about 1,000 "
        "episodes each (MS-HAB, ICLR 2025, Tables 1 and 5)."
    )
    return render_page(
        "Table 1", "<h1>Table 1</h1>" + parts.section("Success", hint, table), {"plots": {}}
    )


def tell(
    options: ReproduceOptions, results: Sequence[Mapping[str, Any]], interrupted: bool
) -> None:
    """Print the table, or its JSON."""
    if interrupted:
        print("mjhab: interrupted. The same command with --resume goes on.", file=sys.stderr)
    if options.json:
        print_json({"rows": list(results), "report": str(options.out / REPORT)})
        return
    titles = (*COLUMNS, *PAPER_TITLES.values())
    rows = [
        (*cells(result), *(result["paper"].get(name, "") for name in PAPER_TITLES))
        for result in results
    ]
    print_table(f"Table 1, split {options.split}", titles, rows)
    print(f"report: {options.out / REPORT}")
