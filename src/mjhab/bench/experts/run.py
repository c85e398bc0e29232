"""``mjhab bench experts``: the table of success rates of the scripted experts, and of whole tasks."""

from __future__ import annotations

import csv
import io
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from mjhab.bench.experts.report import render_experts
from mjhab.bench.experts.rows import (
    CHAIN,
    Episode,
    Result,
    Row,
    make_rows,
    result_dict,
    result_of,
    row_folder,
    together,
)
from mjhab.cli.generate import stop_signals
from mjhab.cli.options.expert import BenchExpertsOptions
from mjhab.cli.output import print_json, print_table
from mjhab.cli.profiles import profile_options, resolved_profile
from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.machine import cores
from mjhab.data.record.generation import Standing
from mjhab.data.record.provenance import source_commit, versions
from mjhab.data.store.reading import episodes as recorded_episodes
from mjhab.data.store.shard import StorageError
from mjhab.evaluation.generate import GenerateSpec, run_generation
from mjhab.rollout.store import write_text

CONFIG = "config.json"
RESULTS = "results.json"
TABLE = "table.csv"
REPORT = "report.html"
EPISODES = "episodes.jsonl"
CHAIN_WEIGHT = 8.0
"""A whole task takes about as long as so many single subtasks; for the estimate of what is left."""

Measured = dict[Row, list[Episode]]


def bench_experts(options: BenchExpertsOptions) -> int:
    """Run the command; returns 0, 1 if a row could not be measured, or 130 after Ctrl-C or SIGTERM."""
    rows = make_rows(options)
    _open_folder(options)
    measured: Measured = {row: read_row(options, row) for row in rows}
    errors: dict[Row, str] = {}
    begun = time.perf_counter()
    with stop_signals() as stopped, _progress(measured) as tell:
        for row in rows:
            if stopped():
                break
            try:
                measure_row(options, row, lambda now, row=row: tell(row, now.tried), stopped)
            except StorageError:
                raise
            except MjhabError as error:
                # The other rows of a night are worth having.
                errors[row] = str(error)
            measured[row] = read_row(options, row)
            tell(row, len(measured[row]))
            write_results(options, measured, errors)
    left = sum(row.episodes - len(found) for row, found in measured.items() if row not in errors)
    results = write_results(options, measured, errors)
    _tell(options, results, errors, left, time.perf_counter() - begun)
    return 1 if errors else 130 if left else 0


def measure_row(
    options: BenchExpertsOptions,
    row: Row,
    tell: Callable[[Standing], object],
    stopped: Callable[[], bool],
) -> Standing:
    """Record the episodes of a row that are not recorded yet.

    Raises:
        MjhabError: a worker failed, or the folder of the row holds something else. StorageError: the disk is full.
    """
    spec = GenerateSpec(
        out=row_folder(options.out, row),
        policy="expert",
        task=row.task,
        subtask=None if row.subtask == CHAIN else row.subtask,
        target=row.target or None,
        seed=options.seed,
        split=options.split,
        assets=row.assets,
        navigate=row.navigate or "teleport",
        env=profile_options(options),
        episodes=row.episodes,
        states=False,
        worlds=options.worlds,
        workers=max(1, min(options.workers, row.episodes // options.worlds)),
        resume=True,
    )
    return run_generation(spec, tell, stopped).standing


def read_row(options: BenchExpertsOptions, row: Row) -> list[Episode]:
    """Episodes of a row that are recorded, of those that are wanted, in order of their indices."""
    folder = row_folder(options.out, row)
    if not any(folder.glob("*.h5")):
        return []
    found = {e.record.index: Episode.of(e.record) for e in recorded_episodes(folder)}
    return [found[index] for index in sorted(found) if index < row.episodes]


def write_results(
    options: BenchExpertsOptions, measured: Measured, errors: Mapping[Row, str]
) -> list[Result]:
    """Write every file of results for what is measured so far; returns the rows."""
    results = [
        result_of(row, options.split, found, errors.get(row, "")) for row, found in measured.items()
    ]
    # Some targets alone are not what the paper's rows over all targets are about.
    groups = [] if options.target else together(list(measured.items()), options.split)
    config = {**_config(options), "assets": {row.pack: _short(row.assets) for row in measured}}
    document = {
        "what": "success of mjhab's scripted experts",
        "config": config,
        "versions": versions(),
        "commit": source_commit(),
        "cores": cores(),
        "rows": [result_dict(result) for result in results if result.subtask != CHAIN],
        "groups": [result_dict(result) for result in groups],
        "chains": [result_dict(result) for result in results if result.subtask == CHAIN],
    }
    lines = [
        json.dumps({"row": row.name, "seed": options.seed, **asdict(episode)})
        for row, found in measured.items()
        for episode in found
    ]
    write_text(options.out / EPISODES, "".join(f"{line}\n" for line in lines))
    write_text(options.out / RESULTS, json.dumps(document, indent=1) + "\n")
    write_text(options.out / TABLE, _csv([*results, *groups], options.profile))
    write_text(options.out / REPORT, render_experts(results, groups, config))
    return results


def _config(options: BenchExpertsOptions) -> dict[str, Any]:
    """What rows of one folder have in common."""
    resolved = resolved_profile(options)
    shown = {name: resolved[name] for name in ("profile", "stillness", "spawn_rule")}
    return {"split": options.split, "seed": options.seed, "policy": "expert", **shown}


def _short(assets: str) -> str:
    """Name of a pack's folder, without where it lies on this machine; generation.json of a row has that."""
    return Path(assets).name


def _open_folder(options: BenchExpertsOptions) -> None:
    """Make the folder, or check that what is in it can be gone on with.

    Raises:
        UsageError: it holds something, and --resume is not given or it was made with other options.
    """
    out = options.out
    config = _config(options)
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is a file; give a folder.")
    there = out.is_dir() and any(out.iterdir())
    if there and not options.resume:
        raise UsageError(
            f"{out} is not empty; add --resume to go on with what is in it, or choose another --out."
        )
    if there:
        try:
            before = json.loads((out / CONFIG).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UsageError(
                f"{out} holds no measurement of experts that could be gone on with ({error}); choose another --out."
            ) from error
        for key, value in config.items():
            if before.get(key) != value:
                raise UsageError(
                    f"{out} was made with {key} {before.get(key)}, now it is {value}. Give the same, or choose "
                    "another --out."
                )
    write_text(out / CONFIG, json.dumps(config, indent=1) + "\n")


def _csv(results: Sequence[Result], profile: str) -> str:
    """The table for spreadsheets: rates in percent, one line per row, groups of targets last."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        (
            "pack",
            "split",
            "profile",
            "task",
            "subtask",
            "target",
            "navigate",
            "episodes",
            "success_once",
            "low_95",
            "high_95",
            "success_at_end",
            "under_1400_sum",
            "under_1400_peak",
            "tainted",
            "asked",
            "paper_rl_per",
            "paper_table",
            "ours_minus_paper",
            "failures",
            "progressive",
            "error",
        )
    )
    for r in results:
        low, high = r.interval if r.episodes else (None, None)
        rates = (
            _percent(value)
            for value in (r.success_once, low, high, r.success_at_end, r.gentle, r.gentle_peak)
        )
        writer.writerow(
            (
                r.pack,
                r.split,
                profile,
                r.task,
                r.subtask,
                r.target,
                r.navigate,
                r.episodes,
                *rates,
                r.tainted,
                _percent(r.asked),
                _percent(r.paper),
                r.paper_table,
                r.over_paper,
                "; ".join(f"{n} {name}" for name, n in r.failures.items()),
                " ".join(f"{100 * share:.1f}" for share in r.progressive),
                r.error,
            )
        )
    return text.getvalue()


def _percent(rate: float | None) -> float | None:
    return None if rate is None else round(100 * rate, 2)


@contextmanager
def _progress(measured: Measured) -> Iterator[Callable[[Row, int], None]]:
    """A bar over all rows, on stderr; gives a function that says how many episodes of a row there are."""
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=10),
        MofNCompleteColumn(),
        TextColumn("{task.fields[what]}"),
    )
    done = {row: len(found) for row, found in measured.items()}
    first = _weight(done)
    begun = time.perf_counter()
    whole = _weight({row: row.episodes for row in measured})
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(
            "experts",
            total=sum(row.episodes for row in measured),
            completed=sum(done.values()),
            what="",
        )

        def tell(row: Row, count: int) -> None:
            done[row] = count
            hours = (time.perf_counter() - begun) / 3600
            gained = _weight(done) - first
            what = ""
            if gained > 0:
                left = round((whole - first - gained) * hours / gained * 60)
                what = f"{gained / hours:,.0f}/h, {left // 60} h {left % 60:02d} min left"
            bar.update(task, description=row.name, completed=sum(done.values()), what=what)

        yield tell


def _weight(counts: Mapping[Row, int]) -> float:
    """Work in so many episodes of each row, in single subtasks."""
    return sum(
        count * (CHAIN_WEIGHT if row.subtask == CHAIN else 1.0) for row, count in counts.items()
    )


def _tell(
    options: BenchExpertsOptions,
    results: Sequence[Result],
    errors: Mapping[Row, str],
    left: int,
    seconds: float,
) -> None:
    for row, error in errors.items():
        print(f"mjhab: {row.name} could not be measured: {error}", file=sys.stderr)
    if left:
        print(
            f"mjhab: stopped, {left} episodes are left. The same command with --resume goes on.",
            file=sys.stderr,
        )
    singles = [result for result in results if result.subtask != CHAIN]
    chains = [result for result in results if result.subtask == CHAIN]
    if options.json:
        print_json(
            {
                "profile": options.profile,
                "rows": len(results),
                "episodes": sum(result.episodes for result in results),
                "success_once": {name_of(result): result.success_once for result in results},
                "below_asked": [name_of(result) for result in results if result.met is False],
                "tainted": sum(result.tainted for result in results),
                "failed_rows": [row.name for row in errors],
                "left": left,
                "seconds": round(seconds, 1),
                "out": str(options.out),
            }
        )
        return
    for pack, task in dict.fromkeys((result.pack, result.task) for result in singles):
        rows = [_cells(result) for result in singles if (result.pack, result.task) == (pack, task)]
        columns = ("subtask", "target", "n", "once", "95 %", "< 1,400 N", "asked", "paper")
        print_table(
            f"{task}, {pack} homes, {options.split}, profile {options.profile}: success once [%]",
            columns,
            rows,
        )
    if chains:
        columns = ("chain", "n", "complete", "95 %", "asked", "completed 1, 2, ... subtasks")
        print_table(
            f"Progressive completion, {options.split}, profile {options.profile} [%]",
            columns,
            map(_chain_cells, chains),
        )
    print(f"report: {options.out / REPORT}")


def name_of(result: Result) -> str:
    """Name of a row for machines."""
    words = (result.pack, result.task, result.subtask, result.target, result.navigate)
    return " ".join(filter(None, words))


def _cells(r: Result) -> tuple[object, ...]:
    rates = (_text(r.success_once), _interval(r), _text(r.gentle), _text(r.asked), _text(r.paper))
    return r.subtask, r.target, r.episodes, *rates


def _chain_cells(r: Result) -> tuple[object, ...]:
    curve = " ".join(f"{100 * share:.0f}" for share in r.progressive)
    return (
        f"{r.pack} {r.task}, {r.navigate}",
        r.episodes,
        _text(r.success_once),
        _interval(r),
        _text(r.asked),
        curve,
    )


def _text(rate: float | None) -> str:
    return "-" if rate is None else f"{100 * rate:.1f}"


def _interval(r: Result) -> str:
    low, high = r.interval
    return f"{100 * low:.0f} to {100 * high:.0f}" if r.episodes else "-"
