"""``mjhab data ...`` and ``mjhab label``: operations on recorded episodes without a simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjhab.cli.options.datasets.data import (
    DataCheckOptions,
    DataFieldsOptions,
    DataImportOptions,
    DataMergeOptions,
    DataPackOptions,
    DataQueryOptions,
    DataRepairOptions,
    DataReportOptions,
    DataSplitOptions,
    DataStatsOptions,
)
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.outputs import check_file
from mjhab.core.progress import late_bar, progress_bar
from mjhab.data.imports.ms_hab import ABSENT, Origin, import_ms_hab
from mjhab.data.select.facts import FUNCTIONS, facts, target_of
from mjhab.data.select.query import PRESETS, read_filter
from mjhab.data.select.sets import GROUPINGS, merge, select, split, stats
from mjhab.data.store.checking import Repair, check, repair
from mjhab.data.store.packing import pack
from mjhab.data.store.places import shard_paths
from mjhab.data.store.schema import VERSION
from mjhab.data.store.storage import broken
from mjhab.evaluation.datasets.label import run_label
from mjhab.evaluation.datasets.specs import LabelSpec
from mjhab.rollout.records import EpisodeRecord

_MOST_ROWS = 20
IMPORTS = ("ms_hab",)
"""Formats that `mjhab data import` can read."""


def run_data(options: Any) -> int:
    """Run one of the commands of ``mjhab data``; returns the exit code."""
    runners = {
        DataQueryOptions: _query,
        DataStatsOptions: _stats,
        DataMergeOptions: _merge,
        DataSplitOptions: _split,
        DataPackOptions: _pack,
        DataCheckOptions: _check,
        DataRepairOptions: _repair,
        DataFieldsOptions: _fields,
        DataReportOptions: _report,
        DataImportOptions: _import,
    }
    return runners[type(options)](options)  # type: ignore[operator]


def _query(options: DataQueryOptions) -> int:
    at_least("list", options.list, 0)
    found = select(options.places, read_filter(options.where, options.preset))
    rows = [
        {**_row(record), "shard": str(path), "name": name}
        for (path, name), record in zip(found.matched, found.records, strict=True)
    ][: options.list]
    if options.json:
        listed = {"episodes": rows} if options.list else {}
        print_json(
            {
                "matched": len(found.matched),
                "of": found.of,
                "tainted_left_out": found.tainted,
                **listed,
            }
        )
        return 0
    if rows:
        print_table("Episodes", list(rows[0]), [list(row.values()) for row in rows])
    print(f"{len(found.matched)} of {found.of} episodes")
    if found.tainted:
        print(
            f"{found.tainted} more are tainted and left out; a filter that uses `tainted` can include them"
        )
    return 0


def _row(record: EpisodeRecord) -> dict[str, Any]:
    label = record.subtasks[-1].label if record.subtasks else None
    return {
        "seed": record.seed,
        "index": record.index,
        "task": record.task,
        "subtask": record.subtask or "chain",
        "target": target_of(record),
        "label": label or "-",
        "steps": record.steps,
        "max_force": record.peak_force,
        "max_finger_force": record.peak_finger_force,
    }


def _stats(options: DataStatsOptions) -> int:
    numbers = stats(options.places, read_filter(options.where, options.preset))
    if options.json:
        print_json(numbers)
        return 0
    columns = (
        "task",
        "subtask",
        "target",
        "episodes",
        "success %",
        "median N",
        "largest N",
        "on fingers",
    )
    print_table(
        "Recorded episodes", columns, [_stats_row(row) for row in numbers["rows"]]
    )
    labels = [
        (row["task"], row["subtask"], row["target"], label or "none", count)
        for row in numbers["rows"]
        for label, count in row["labels"].items()
    ]
    print_table("Labels", ("task", "subtask", "target", "label", "subtasks"), labels)
    print(
        f"{numbers['episodes']} of {numbers['of']} episodes, {numbers['steps']:,} steps, {numbers['tainted']} tainted; "
        f"{numbers['shards']} shards, {numbers['bytes']:,} bytes, {numbers['bytes_per_episode']:,} per episode"
    )
    return 0


def _stats_row(row: Mapping[str, Any]) -> tuple[object, ...]:
    force = row["max_force"]
    success = round(100 * row["success_once"], 1)
    head = (row["task"], row["subtask"], row["target"], row["episodes"])
    fingers = row["max_finger_force"]["max"]
    return (
        *head,
        success,
        force["median"],
        force["max"],
        "-" if fingers is None else fingers,
    )


def _report(options: DataReportOptions) -> int:
    from mjhab.render.film import FilmWriter
    from mjhab.reports.dataset import render_data_report

    check_file(options.out, ".html")
    where = read_filter(options.where, options.preset)
    with late_bar("films") as begin:
        page = render_data_report(options.places, FilmWriter, where, begin)
    try:
        write_atomic(options.out, lambda path: path.write_text(page, encoding="utf-8"))
    except OSError as error:
        raise broken(options.out, error) from error
    size = options.out.stat().st_size
    if options.json:
        print_json({"report": str(options.out), "bytes": size})
    else:
        print(f"{options.out} ({size / 1e6:.1f} MB); it opens without network")
    return 0


def _merge(options: DataMergeOptions) -> int:
    check_file(options.out, ".h5")
    done = merge(options.places, options.out, read_filter(options.where, options.preset))
    if options.json:
        print_json(
            {
                "written": done.written,
                "left_out": done.left_out,
                "repeated": done.repeated,
            }
        )
    else:
        print(
            f"{done.written} episodes written to {options.out}; {done.left_out} left out by the filter, "
            f"{done.repeated} were there already"
        )
    return 0


def _split(options: DataSplitOptions) -> int:
    if options.by not in GROUPINGS:
        raise unknown_name("--by", options.by, GROUPINGS)
    at_least("seed", options.seed, 0)
    sizes = split(
        options.places, options.out, _parts(options.parts), options.by, options.seed
    )
    if options.json:
        print_json({"parts": sizes})
    else:
        print_table(f"Parts in {options.out}", ("part", "episodes"), list(sizes.items()))
    return 0


def _parts(words: tuple[str, ...]) -> dict[str, float]:
    parts: dict[str, float] = {}
    for word in words:
        name, _, share = word.partition("=")
        try:
            number = float(share)
        except ValueError:
            number = float("nan")
        if not name or "/" in name or name in parts or number != number:
            raise UsageError(
                f"--parts {word!r}: give names, each once, with shares, as in: train=0.9 val=0.1"
            )
        parts[name] = number
    return parts


def _pack(options: DataPackOptions) -> int:
    at_least("shard-mb", options.shard_mb, 1)
    if not options.folders:
        raise UsageError("name the folders to pack, as in: mjhab data pack runs/pick")
    done = [pack(folder, options.shard_mb) for folder in options.folders]
    episodes = sum(each.episodes for each in done)
    shards = sum(len(each.shards) for each in done)
    size = sum(each.bytes for each in done)
    if options.json:
        print_json({"episodes": episodes, "shards": shards, "bytes": size})
    else:
        print(f"{episodes} episodes packed into {shards} shards, {size:,} bytes")
    return 0


def _import(options: DataImportOptions) -> int:
    if options.format not in IMPORTS:
        raise unknown_name("format", options.format, IMPORTS)
    if not options.files:
        raise UsageError(
            "name the files to import, as in: mjhab data import ms_hab 024_bowl.h5 --out runs/imported"
        )
    origin = Origin(options.task, options.split)
    done = []
    for path in options.files:
        with late_bar(path.name) as begin:
            done.append(import_ms_hab(path, options.out, origin, begin))
    episodes = sum(each.episodes for each in done)
    frames = sum(each.frames for each in done)
    present = sum(each.present for each in done)
    if options.json:
        print_json(
            {
                "episodes": episodes,
                "frames": frames,
                "present": present,
                "lacks": list(ABSENT),
            }
        )
        return 0
    print(
        f"{episodes} episodes, {frames:,} frames in {options.out}; {present} were there already"
    )
    print(
        f"The data lack {', '.join(ABSENT)}: they cannot be replayed, rendered or relabelled."
    )
    return 0


def _check(options: DataCheckOptions) -> int:
    with progress_bar("checking", len(shard_paths(options.places))) as advance:
        report = check(options.places, advance)
    damaged = [
        (str(path), name, "; ".join(wrong))
        for (path, name), wrong in report.damaged.items()
    ]
    unreadable = [(str(path), "", wrong) for path, wrong in report.unreadable.items()]
    if options.json:
        print_json(
            {
                "episodes": report.episodes,
                "ok": report.ok,
                "damaged": len(damaged),
                "unreadable": [path for path, _, _ in unreadable],
                "unfinished": [str(p) for p in report.unfinished],
                "doubled": len(report.doubled),
                "schemas": {str(k): report.schemas[k] for k in sorted(report.schemas)},
                "problems": [
                    {"shard": path, "episode": name, "wrong": wrong}
                    for path, name, wrong in damaged
                ],
            }
        )
        return 0 if report.clean else 1
    if damaged or unreadable:
        print_table(
            "Damaged",
            ("shard", "episode", "what is wrong"),
            (damaged + unreadable)[:_MOST_ROWS],
        )
    for path in report.unfinished:
        print(
            f"{path}: a writer was stopped; the next writer, or repair, completes the file"
        )
    for name in report.doubled[:_MOST_ROWS]:
        print(f"episode {name} occurs more than once")
    older = sum(count for schema, count in report.schemas.items() if schema < VERSION)
    if older:
        print(
            f"{older} episodes are of an older schema, read as those of schema {VERSION}, see docs/data/format.md"
        )
    print(
        f"{report.episodes} episodes, {report.ok} ok, {len(damaged)} damaged, {len(unreadable)} shards unreadable"
    )
    return 0 if report.clean else 1


def _repair(options: DataRepairOptions) -> int:
    done = [repair(path) for path in shard_paths(options.places)]
    kept = sum(r.kept for r in done)
    lost = sum(len(r.lost) for r in done)
    if options.json:
        aside = [str(r.kept_as) for r in done if r.kept_as]
        finished = sum(r.finished for r in done)
        print_json(
            {
                "kept": kept,
                "lost": lost,
                "finished": finished,
                "damaged_files": aside,
                # A file whose index is damaged is refused since schema 4.
                "indexed": True,
            }
        )
        return 0
    for each in done:
        print(_repaired(each))
    print(f"{kept} episodes kept, {lost} lost")
    return 0


def _repaired(done: Repair) -> str:
    if done.kept_as is not None:
        lost = f"{len(done.lost)} lost"
        return f"{done.path}: {done.kept} episodes saved, {lost}; the damaged file is {done.kept_as}"
    what = "an interrupted write was completed" if done.finished else "nothing to do"
    return f"{done.path}: {done.kept} episodes, {what}"


def _fields(options: DataFieldsOptions) -> int:
    names = [(fact.name, fact.kind, fact.meaning) for fact in facts().values()]
    names += [
        (f"{name}(event)", "a number", meaning)
        for name, (meaning, _) in FUNCTIONS.items()
    ]
    presets = [(name, text, meaning) for name, (text, meaning) in PRESETS.items()]
    if options.json:
        print_json(
            {
                "fields": [list(row) for row in names],
                "presets": [list(row) for row in presets],
            }
        )
        return 0
    print_table("Names in filters", ("name", "is", "meaning"), names)
    print_table("Presets", ("name", "filter", "meaning"), presets)
    return 0


def run_relabelling(spec: LabelSpec, json: bool) -> int:
    """Run ``mjhab label``; returns the exit code."""
    found = run_label(spec)
    labels = found.changed_labels
    if json:
        counts = {
            "episodes": found.episodes,
            "subtasks": found.subtasks,
            "changed": labels,
            "changes": len(found.changes),
        }
        skipped = {"without_signals": found.without_signals}
        print_json({**counts, **skipped} if found.without_signals else counts)
        return 0
    if found.changes:
        rows = [
            (name, str(c.subtask), c.what, str(c.old), str(c.new))
            for name, c in found.changes
        ]
        columns = ("episode", "subtask", "what", "recorded", "now")
        print_table("Changes", columns, rows[:_MOST_ROWS])
    written = " (written)" if spec.write and found.changes else ""
    others = len(found.changes) - labels
    print(
        f"{found.episodes} episodes, {found.subtasks} subtasks: {labels} labels and {others} other things "
        f"changed{written}"
    )
    if found.without_signals:
        print(
            f"{found.without_signals} episodes were imported without signals; their labels stay those of their source"
        )
    return 0
