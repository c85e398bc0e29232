"""``mjhab bench experts``: the table of success rates of the scripted experts, and of whole tasks."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mjhab.bench.experts.report import render_experts
from mjhab.bench.experts.rows import (
    CHAIN,
    ExpertRow,
    MeasuredEpisode,
    RowResult,
    make_rows,
    result_dict,
    result_of,
    row_folder,
    together,
)
from mjhab.bench.specs import ExpertsSpec
from mjhab.core.errors import MjhabError
from mjhab.core.files.cache import write_json, write_text
from mjhab.core.files.run_folder import REPORT, RunFolder
from mjhab.core.machine import cores
from mjhab.data.record.job import Standing
from mjhab.data.record.provenance import source_commit, versions
from mjhab.data.store.places import episodes as recorded_episodes
from mjhab.data.store.places import has_shards
from mjhab.data.store.storage import StorageError
from mjhab.evaluation.generate import GenerateSpec, run_generation
from mjhab.scenes.packs import stage_of

RESULTS = "results.json"
TABLE = "table.csv"
EPISODES = "episodes.jsonl"
Measured = dict[ExpertRow, list[MeasuredEpisode]]


class ExpertsFolder(RunFolder):
    """The folder of a measurement of experts; its rows are data sets."""

    WORK = ("*.h5",)


@contextmanager
def unwatched(measured: Measured) -> Iterator[Callable[[ExpertRow, int], None]]:
    """Tells nobody how far a measurement is."""
    yield lambda row, count: None


@dataclass(frozen=True)
class Measurement:
    """What `measure_experts` has found: rows of results, why rows failed, and how many episodes are left."""

    results: list[RowResult]
    errors: Mapping[ExpertRow, str]
    left: int


def measure_experts(
    spec: ExpertsSpec,
    stopped: Callable[[], bool] = bool,
    watch: Callable[
        [Measured], AbstractContextManager[Callable[[ExpertRow, int], None]]
    ] = unwatched,
) -> Measurement:
    """Measure all rows of ``spec`` that are not measured yet, and write the results after each.

    Args:
        spec: what to measure.
        stopped: asked between episodes whether to stop; what is done is kept.
        watch: opened with what is measured already; gives what is told how many episodes of a row there are.

    Raises:
        UsageError: nothing to measure, or a folder that cannot be gone on with. StorageError: the disk is full.
    """
    rows = make_rows(spec)
    with ExpertsFolder.open(spec.out, _config(spec), resume=spec.resume):
        return _measure(spec, rows, stopped, watch)


def _measure(
    spec: ExpertsSpec,
    rows: Sequence[ExpertRow],
    stopped: Callable[[], bool],
    watch: Callable[[Measured], AbstractContextManager[Callable[[ExpertRow, int], None]]],
) -> Measurement:
    measured: Measured = {row: read_row(spec, row) for row in rows}
    errors: dict[ExpertRow, str] = {}
    with watch(measured) as tell:
        for row in rows:
            if stopped():
                break
            try:
                measure_row(spec, row, lambda now, row=row: tell(row, now.tried), stopped)
            # A full disk would fail every other row, too.
            except StorageError:
                raise
            except MjhabError as error:
                # The other rows of a night are worth having.
                errors[row] = str(error)
            measured[row] = read_row(spec, row)
            tell(row, len(measured[row]))
            write_results(spec, measured, errors)
    left = sum(
        row.episodes - len(found) for row, found in measured.items() if row not in errors
    )
    return Measurement(write_results(spec, measured, errors), errors, left)


def measure_row(
    spec: ExpertsSpec,
    row: ExpertRow,
    tell: Callable[[Standing], object],
    stopped: Callable[[], bool],
) -> Standing:
    """Record the episodes of a row that are not recorded yet.

    Raises:
        MjhabError: a worker failed, or the folder of the row holds something else. StorageError: the disk is full.
    """
    wanted = GenerateSpec.of(
        out=row_folder(spec.out, row),
        policy="expert",
        task=row.task,
        subtask=None if row.subtask == CHAIN else row.subtask,
        target=row.target or None,
        seed=spec.asked.seed,
        split=spec.asked.split,
        assets=row.assets,
        navigate=row.navigate or "teleport",
        env=spec.of_profile,
        episodes=row.episodes,
        # States are most of the bytes, and the table needs none of them.
        states=False,
        worlds=spec.asked.num_envs,
        # A worker with fewer episodes than worlds would run worlds for nothing.
        workers=max(1, min(spec.workers, row.episodes // spec.asked.num_envs)),
        resume=True,
    )
    return run_generation(wanted, tell, stopped).standing


def read_row(spec: ExpertsSpec, row: ExpertRow) -> list[MeasuredEpisode]:
    """Episodes of a row that are recorded, of those that are wanted, in order of their indices."""
    folder = row_folder(spec.out, row)
    if not has_shards(folder):
        return []
    found = {
        e.record.index: MeasuredEpisode.of(e.record) for e in recorded_episodes(folder)
    }
    return [found[index] for index in sorted(found) if index < row.episodes]


def write_results(
    spec: ExpertsSpec, measured: Measured, errors: Mapping[ExpertRow, str]
) -> list[RowResult]:
    """Write every file of results for what is measured so far; returns the rows."""
    results = [
        result_of(row, spec.asked.split, found, errors.get(row, ""))
        for row, found in measured.items()
    ]
    # Some targets alone are not what the paper's rows over all targets are about.
    groups = [] if spec.target else together(list(measured.items()), spec.asked.split)
    config = {
        **_config(spec),
        "assets": {row.pack: _short(row.assets) for row in measured},
    }
    packs = {row.pack: row.assets for row in measured}
    stages = {pack: stage_of(assets) for pack, assets in packs.items()}
    if any(stages.values()):
        config["stage"] = {p: found["stage"] for p, found in stages.items() if found}
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
        json.dumps({"row": row.name, "seed": spec.asked.seed, **asdict(episode)})
        for row, found in measured.items()
        for episode in found
    ]
    write_text(spec.out / EPISODES, "".join(f"{line}\n" for line in lines))
    write_json(spec.out / RESULTS, document)
    write_text(spec.out / TABLE, _csv([*results, *groups], spec.asked.profile))
    write_text(spec.out / REPORT, render_experts(results, groups, config))
    return results


def _config(spec: ExpertsSpec) -> dict[str, Any]:
    """What rows of one folder have in common."""
    resolved = spec.asked.of_profile()
    names = ("profile", "stillness", "spawn_rule", "joint_dynamics")
    shown = {name: resolved[name] for name in names}
    return {
        "split": spec.asked.split,
        "seed": spec.asked.seed,
        "policy": "expert",
        **shown,
    }


def _short(assets: str) -> str:
    """Name of a pack's folder, without where it lies on this machine; generation.json of a row has that."""
    return Path(assets).name


_CSV_COLUMNS = (
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


def _csv(results: Sequence[RowResult], profile: str) -> str:
    """The table for spreadsheets: rates in percent, one line per row, groups of targets last."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_CSV_COLUMNS)
    for result in results:
        writer.writerow(_csv_row(result, profile))
    return text.getvalue()


def _csv_row(r: RowResult, profile: str) -> tuple[object, ...]:
    # Without episodes the interval is all of 0 to 1, which says nothing.
    low, high = r.interval if r.episodes else (None, None)
    rates = (
        _percent(value)
        for value in (
            r.success_once,
            low,
            high,
            r.success_at_end,
            r.gentle,
            r.gentle_peak,
        )
    )
    return (
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


def _percent(rate: float | None) -> float | None:
    return None if rate is None else round(100 * rate, 2)
