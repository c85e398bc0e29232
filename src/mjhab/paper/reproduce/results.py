"""Results of a reproduction as JSON, table and HTML page, next to the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.files.cache import write_json, write_text
from mjhab.core.files.reading import read_json_object
from mjhab.data.store.episode_data import last_label
from mjhab.paper.reproduce.means import means
from mjhab.paper.reproduce.rows import RL_ALL, RL_PER, TableRow, table_rows
from mjhab.paper.reproduce.variants import (
    AS_PUBLISHED,
    CHOICES,
    CURVES,
    DEMO_COUNT,
    FILTERS,
    PER_ALL,
    REWARDED,
    SAC_PPO,
    STUDIES,
    TABLE1,
    TABLE5,
    VARIANTS,
)
from mjhab.reports.compared.trainings import ON_THE_WAY, SECONDS_PER_MINUTE, read_metrics
from mjhab.reports.metrics import label_counts, mean, wilson
from mjhab.reports.pages import Section, render_sections
from mjhab.reports.paper import ABLATIONS, SUCCESS_COLUMNS, paper_row, paper_success
from mjhab.reports.plots import Figure
from mjhab.rollout.store import read_records
from mjhab.scenes.pack_source import pack_request
from mjhab.scenes.packs import stage_of

RESULTS = "results.json"
REPORT = "report.html"
TITLES = {
    TABLE1: "Table 1",
    "force_limits": "Force limits",
    "goal_zones": "Shapes of goals",
    "long_horizon": "Whole tasks",
    TABLE5: "Table 5: imitation",
    DEMO_COUNT: "Number of demonstrations",
    FILTERS: "Place: which demonstrations",
    CHOICES: "Choices of the presets",
    SAC_PPO: "SAC and PPO",
    PER_ALL: "One policy per object, or one for all",
    CURVES: "Learning curves",
}
PAPER_TITLES = dict(
    zip(SUCCESS_COLUMNS, ("RL per object", "RL for all", "BC", "diffusion"), strict=True)
)
PAPER_POLICIES = {RL_PER: "RL-Per", RL_ALL: "RL-All"}
"""Policies of the paper's tables of labels by the variants of `PER_ALL`."""
_WHAT = {False: "Rules", True: "Ways of training"}
COLUMN_TITLES = (
    "row",
    "rules",
    "success once [%]",
    "95 % interval",
    "at end [%]",
    "episodes",
    "demonstrations",
    "samples",
    "CPU minutes",
)


def measured(runs: Sequence[Path], judged: Sequence[Path]) -> dict[str, Any]:
    """Success rates and training cost of the policies of a row, taken together.

    "untrained" is the number of policies without a single update. The rates are None without evaluations.

    Args:
        runs: folders of their training runs. judged: run folders of their evaluations, none for an untrained row.
    """
    summaries = [read_json_object(run / "summary.json") for run in runs]
    records = [record for folder in judged for record in read_records(folder)]
    successes = sum(record.success_once for record in records)
    low, high = wilson(successes, len(records))
    seconds = ordered_sum(summary["cpu_seconds"] for summary in summaries)
    return {
        "success_once": mean(record.success_once for record in records)
        if records
        else None,
        "low": low,
        "high": high,
        "success_at_end": mean(record.success_at_end for record in records)
        if records
        else None,
        "subtasks_completed": mean(
            record.completed / len(record.plan) for record in records
        )
        if records
        else None,
        "episodes": len(records),
        "policies": len(runs),
        "untrained": untrained(runs),
        "demonstrations": sum(summary["demonstrations"] for summary in summaries),
        "samples": sum(summary["samples"] for summary in summaries),
        "cpu_minutes": round(seconds / SECONDS_PER_MINUTE, 1),
        "labels": label_counts(last_label(record) for record in records),
        "curves": list(filter(None, map(learning_curve, runs))),
    }


def learning_curve(run: Path) -> list[tuple[int, float]]:
    """Samples and success once of every evaluation on the way of a training run, in homes of training."""
    return [
        (row["samples"], row["success_once"])
        for row in read_metrics(run)
        if row.get("evaluation") == ON_THE_WAY
    ]


def untrained(runs: Sequence[Path]) -> int:
    """Number of training runs whose network was never updated; those of earlier versions count as trained."""
    summaries = [read_json_object(run / "summary.json") for run in runs]
    return sum(not summary.get("trained", True) for summary in summaries)


def write_results(out: Path, rows: Sequence[TableRow]) -> list[dict[str, Any]]:
    """Write results.json and report.html with the finished variants of the rows, and return these."""
    config = read_json_object(out / "config.json")
    found = []
    for row in rows:
        path = out / row.folder / "row.json"
        if path.is_file():
            by_variant = read_json_object(path)
            found += [
                result_of(row, variant.name, by_variant[variant.name], config)
                for variant in VARIANTS[config["what"]]
                if variant.name in by_variant
            ]
    content = {
        "what": config["what"],
        "column": config["column"],
        **homes_of(config),
        "rows": found,
        "means": means(found),
    }
    write_json(out / RESULTS, content)
    write_text(out / REPORT, page(found, config))
    return found


def homes_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """The homes of a reproduction: {"assets"}, and the "stage" if they are scenes with stages."""
    return {"assets": config["assets"], **stage_of(config["assets"])}


def mean_cells(found: Mapping[str, Any]) -> tuple[Any, ...]:
    """Cells of a mean, in the order of ``titles``."""
    ours = round(100 * found["success_once"], 1)
    empty = [""] * (len(COLUMN_TITLES) - 3)
    paper = [found["paper"].get(name) for name in PAPER_TITLES]
    theirs = ["" if rate is None else round(rate, 1) for rate in paper]
    return (f"mean of {found['rows']} rows", found["rules"], ours, *empty, *theirs, "")


def all_cells(results: Sequence[Mapping[str, Any]]) -> list[tuple[Any, ...]]:
    """Rows of the table, and their means."""
    return [*map(cells, results), *map(mean_cells, means(results))]


def result_of(
    row: TableRow, variant: str, found: Mapping[str, Any], config: Mapping[str, Any]
) -> dict[str, Any]:
    """A row of results as JSON data; our rates are fractions, the paper's are percentages as printed there.

    "paper" holds the paper's success-once rates [%] under the rules of Table 1, by SUCCESS_COLUMNS. "paper_says" is the
    paper's statement about other rules, or "".
    """
    # The paper's rates are of these rules alone; beside others they would mislead.
    published = (variant == AS_PUBLISHED.name or config["what"] == TABLE5) and bool(
        row.subtask
    )
    per_policy = config["what"] == PER_ALL
    paper = (
        paper_success(row.task, row.subtask, config["split"], row.target)
        if published or per_policy
        else {}
    )
    if per_policy:
        paper = {name: rate for name, rate in paper.items() if name == variant}
    says = ABLATIONS.get(config["what"], {}).get(variant, "")
    if isinstance(says, dict):
        says = says.get(config["split"], "")
    return {
        "row": row.name,
        "rules": variant,
        **found,
        "paper": paper,
        "paper_says": says,
    }


def cells(result: Mapping[str, Any]) -> tuple[Any, ...]:
    """Cells of a row of the table, in the order of ``titles``."""
    if result["success_once"] is None:
        shown: tuple[Any, ...] = (
            f"no result: {result['untrained']} of {result['policies']} policies untrained, the budget was spent before "
            "their first update",
            "",
            "",
        )
    else:
        shown = (
            round(100 * result["success_once"], 1),
            f"{100 * result['low']:.0f} to {100 * result['high']:.0f}",
            round(100 * result["success_at_end"], 1),
        )
    return (
        result["row"],
        result["rules"],
        *shown,
        result["episodes"],
        result["demonstrations"],
        result["samples"],
        result["cpu_minutes"],
        *(result["paper"].get(name, "") for name in PAPER_TITLES),
        result["paper_says"],
    )


def outcomes(results: Sequence[Mapping[str, Any]], split: str) -> list[tuple[Any, ...]]:
    """Rows of the table of labels: row, variant, label, our share and the paper's of all episodes [%]."""
    rows = table_rows()
    found: list[tuple[Any, ...]] = []
    for result in results:
        row = rows[result["row"]]
        published = None
        if result["rules"] in PAPER_POLICIES:
            policy = PAPER_POLICIES[result["rules"]]
            published = paper_row(
                row.task, row.subtask, split, row.target or "all", policy
            )
        theirs = published.labels if published else {}
        counts = result["labels"]
        for label in dict.fromkeys((*counts, *theirs)):
            # A row whose policies were never trained has no episodes.
            share = 100 * counts.get(label, 0) / max(1, result["episodes"])
            found.append(
                (row.name, result["rules"], label, round(share, 1), theirs.get(label, ""))
            )
    return found


def curves_figure(results: Sequence[Mapping[str, Any]]) -> Figure:
    """Success on the way over samples; a line for each policy."""
    traces = [
        {
            "x": [samples for samples, _ in curve],
            "y": [success for _, success in curve],
            "name": f"{result['row']}, {result['rules']}",
            "type": "scatter",
            "mode": "lines+markers",
        }
        for result in results
        for curve in result.get("curves", ())
    ]
    return {
        "data": traces,
        "layout": {
            "height": 420,
            "xaxis": {"title": {"text": "samples"}},
            "yaxis": {
                "range": [0, 1.04],
                "tickformat": ".0%",
                "title": {"text": "success once"},
            },
        },
    }


def titles() -> tuple[str, ...]:
    """Column titles of the table."""
    return (
        *COLUMN_TITLES,
        *(f"paper: {title} [%]" for title in PAPER_TITLES.values()),
        "paper says",
    )


def page(results: Sequence[Mapping[str, Any]], config: Mapping[str, Any]) -> str:
    """HTML page with our numbers and those of the paper."""
    shown = {result["rules"] for result in results}
    rules = "; ".join(
        f"{rule.name}: {rule.about}"
        for rule in VARIANTS[config["what"]]
        if rule.name in shown
    )
    what = _WHAT[config["what"] in (*STUDIES, *REWARDED)]
    homes = homes_of(config)
    place = Path(pack_request(homes["assets"]).place).name
    stage = f" (stage: {homes['stage']})" if "stage" in homes else ""
    changes = ", ".join([config["preset"], *config.get("set", ())])
    hint = (
        f"Success-once rates of our policies in column {config['column']} (preset {changes}) in homes of "
        f"split {config['split']} of {place}{stage}. {what}: {rules}. Policies are trained under the rules of "
        "Table 1. The paper's policies were evaluated in ReplicaCAD homes, about 1,000 episodes each (MS-HAB, ICLR "
        "2025, Tables 1 and 5)."
    )
    columns = [(name, "") for name in titles()[:-1]] + [(titles()[-1], "words")]
    table = Section("Success", hint, columns=columns, rows=all_cells(results))
    sections = [table]
    if config["what"] in REWARDED:
        sections += _how_they_learned(results, config["split"])
    plots = {"curves": curves_figure(results)}
    return render_sections(TITLES[config["what"]], sections, plots)


def _how_they_learned(results: Sequence[Mapping[str, Any]], split: str) -> list[Section]:
    columns = [("row", ""), ("variant", ""), ("label", "words"), ("%", "n")]
    return [
        Section(
            "While they learn",
            "Success once in homes of training over samples, which are control steps of single worlds. The paper "
            "trains with 15 to 50 million.",
            chart="curves",
        ),
        Section(
            "Outcomes",
            f"Share of the episodes by label, in homes of split {split}, beside the paper's (Tables 6 to 13).",
            columns=[*columns, ("paper: %", "n")],
            rows=outcomes(results, split),
        ),
    ]
