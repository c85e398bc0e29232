"""Students for results of the MS-HAB paper: one for each row of its Table 1, and a page with both."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.config.env import SPLITS
from mjhab.config.profile_choice import ProfileChoice, profile_options
from mjhab.config.profiles import profile_named
from mjhab.core.errors import unknown_name
from mjhab.core.files.reading import read_json_object
from mjhab.core.machine import cores
from mjhab.episodes.generator import BOWL_DRAWER, FRIDGE_DOOR
from mjhab.evaluation.evaluate import EvalSpec, run_evaluation
from mjhab.learning.configs import preset_of
from mjhab.learning.require import require_learn
from mjhab.reports import parts
from mjhab.reports.paper import SUCCESS_COLUMNS, paper_success
from mjhab.reports.run import render_page
from mjhab.reports.students import student_row
from mjhab.rollout.sinks import Sink
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


@dataclass(frozen=True, kw_only=True)
class TableSpec(ProfileChoice):
    """What is trained and judged, and on what.

    what: one of RESULTS_OF_PAPER. rows: names of `table_rows`, () for all. preset: of `mjhab train dagger`.
    budget_minutes: training of a row stops after so many, 0 for no limit. split, episodes, films: of the judging.
    worlds, threads: change the speed. out: folder of the runs; resume: it may hold some.
    """

    what: str
    out: Path
    rows: tuple[str, ...]
    preset: str
    budget_minutes: float
    split: str
    episodes: int
    films: int
    seed: int
    assets: str
    worlds: int
    threads: int
    resume: bool


def reproduce(
    spec: TableSpec,
    sinks: Callable[[EvalSpec], Sequence[Sink]] = lambda judging: (),
    tell: Callable[[TableRow], object] = bool,
) -> tuple[list[dict[str, Any]], bool]:
    """Train and judge a student for every row, or what is missing of that, and write the page after each.

    Args:
        spec: what to do.
        sinks: listeners of the evaluation of a row.
        tell: called with every row before it is begun.

    Returns:
        Rows of results as `result_of` gives them; and whether Ctrl-C came before the last one (what is done is kept).

    Raises:
        UsageError: an unknown name, or a folder that cannot be gone on with; nothing was written.
    """
    require_learn()
    rows = chosen_rows(spec)
    config = table_config(spec)
    check_folder(spec.out, config, resume=spec.resume)
    spec.out.mkdir(parents=True, exist_ok=True)
    write_text(spec.out / CONFIG, json.dumps(config, indent=2) + "\n")
    interrupted = False
    try:
        for row in rows:
            tell(row)
            make_row(spec, row, sinks)
            write_results(spec.out, rows)
    except KeyboardInterrupt:
        interrupted = True
    return write_results(spec.out, rows), interrupted


def chosen_rows(spec: TableSpec) -> list[TableRow]:
    """The rows that are asked for.

    Raises:
        UsageError: an unknown name.
    """
    if spec.what not in RESULTS_OF_PAPER:
        raise unknown_name("result of the paper", spec.what, RESULTS_OF_PAPER)
    known = table_rows()
    for name in spec.rows:
        if name not in known:
            raise unknown_name("row", name, known)
    if spec.split not in SPLITS:
        raise unknown_name("split", spec.split, SPLITS)
    preset_of("dagger", spec.preset)
    profile_named(spec.profile)
    return [known[name] for name in spec.rows or known]


def table_config(spec: TableSpec) -> dict[str, Any]:
    """What all rows of a folder have in common, as plain JSON data."""
    names = ("what", "preset", "budget_minutes", "split", "episodes", "seed", "assets")
    return {**{name: getattr(spec, name) for name in names}, **profile_options(spec)}


def make_row(spec: TableSpec, row: TableRow, sinks: Callable[[EvalSpec], Sequence[Sink]]) -> None:
    """Train and judge the student of a row, or what is missing of that.

    Raises:
        KeyboardInterrupt: what is done is kept.
    """
    from mjhab.learning.runs.evaluation import EVALUATION_SEED
    from mjhab.learning.runs.train import train

    folder = spec.out / row.name.replace("/", ".")
    if (folder / ROW).is_file():
        return
    run = folder / "train"
    judged = folder / "evaluation"
    result = train(request_of(spec, row), run, resume=(run / CONFIG).is_file())
    if result.interrupted:
        raise KeyboardInterrupt
    judging = EvalSpec(
        policy=str(run / "student.safetensors"),
        task=row.task,
        subtask=row.subtask,
        target=row.target or None,
        episodes=spec.episodes,
        worlds=spec.worlds,
        seed=EVALUATION_SEED + spec.seed,
        split=spec.split,
        assets=spec.assets,
        threads=spec.threads,
        films=spec.films,
        env=profile_options(spec),
        out=judged,
        resume=(judged / CONFIG).is_file(),
    )
    run_evaluation(judging, sinks(judging))
    write_text(folder / ROW, json.dumps(student_row(run, judged), indent=1) + "\n")


def request_of(spec: TableSpec, row: TableRow) -> Request:
    """What is trained for a row."""
    from mjhab.learning.runs.collection import Means, Scene
    from mjhab.learning.runs.session import Request

    return Request(
        config=preset_of("dagger", spec.preset),
        scene=Scene(row.task, row.subtask, row.target, assets=spec.assets, **profile_options(spec)),
        means=Means(spec.worlds, 1, spec.threads or cores()),
        seed=spec.seed,
        budget_seconds=SECONDS_PER_MINUTE * spec.budget_minutes,
        eval_episodes=0,
        torch_threads=spec.threads,
    )


def write_results(out: Path, rows: Sequence[TableRow]) -> list[dict[str, Any]]:
    """Write results.json and report.html of the rows that are through, and return them."""
    split = read_json_object(out / CONFIG)["split"]
    found = []
    for row in rows:
        path = out / row.name.replace("/", ".") / ROW
        if path.is_file():
            found.append(result_of(row, read_json_object(path), split))
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
