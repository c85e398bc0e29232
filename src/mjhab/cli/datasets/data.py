"""``mjhab data ...`` and ``mjhab label``: operations on recorded episodes without a simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mjhab.cli.output import Listing, report
from mjhab.core.files.cache import write_text
from mjhab.core.progress import late_bar, progress_bar
from mjhab.data.imports.ms_hab import ABSENT, import_ms_hab
from mjhab.data.select import sets
from mjhab.data.select.facts import FUNCTIONS, facts, target_of
from mjhab.data.select.query import PRESETS
from mjhab.data.store import checking
from mjhab.data.store.packing import pack
from mjhab.data.store.places import shard_paths
from mjhab.data.store.schema import VERSION
from mjhab.data.store.storage import broken
from mjhab.evaluation.datasets.label import run_label
from mjhab.evaluation.datasets.set_specs import (
    ImportSpec,
    MergeSpec,
    PackSpec,
    QuerySpec,
    RepairSpec,
    ReportSpec,
    ShardCheckSpec,
    SplitSpec,
    StatsSpec,
)
from mjhab.evaluation.datasets.specs import LabelSpec
from mjhab.rollout.records import EpisodeRecord

_MOST_ROWS = 20


@dataclass(frozen=True)
class FieldsSpec:
    """Print the names that filters can use, with their meanings, and the predefined filters."""


def query(spec: QuerySpec, json: bool) -> int:
    """Count and list episodes."""
    found = sets.select(spec.places, spec.filter())
    rows = [
        {**_row(record), "shard": str(path), "name": name}
        for (path, name), record in zip(found.matched, found.records, strict=True)
    ][: spec.list]
    facts = {
        "matched": len(found.matched),
        "of": found.of,
        "tainted_left_out": found.tainted,
        **({"episodes": rows} if spec.list else {}),
    }
    listed = [list(row.values()) for row in rows]
    report(
        json,
        facts,
        Listing("Episodes", list(rows[0]), listed) if rows else None,
        f"{len(found.matched)} of {found.of} episodes",
        f"{found.tainted} more are tainted and left out; a filter that uses `tainted` can include them"
        if found.tainted
        else "",
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


def stats(spec: StatsSpec, json: bool) -> int:
    """Print what a data set holds."""
    numbers = sets.stats(spec.places, spec.filter())
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
    labels = [
        (row["task"], row["subtask"], row["target"], label or "none", count)
        for row in numbers["rows"]
        for label, count in row["labels"].items()
    ]
    report(
        json,
        numbers,
        Listing(
            "Recorded episodes", columns, [_stats_row(row) for row in numbers["rows"]]
        ),
        Listing("Labels", ("task", "subtask", "target", "label", "subtasks"), labels),
        f"{numbers['episodes']} of {numbers['of']} episodes, {numbers['steps']:,} steps, {numbers['tainted']} tainted; "
        f"{numbers['shards']} shards, {numbers['bytes']:,} bytes, {numbers['bytes_per_episode']:,} per episode",
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


def write_report(spec: ReportSpec, json: bool) -> int:
    """Write the page of a data set."""
    from mjhab.render.film import FilmWriter
    from mjhab.reports.dataset import render_data_report

    with late_bar("films") as begin:
        page = render_data_report(spec.places, FilmWriter, spec.filter(), begin)
    try:
        write_text(spec.out, page)
    except OSError as error:
        raise broken(spec.out, error) from error
    size = spec.out.stat().st_size
    summary = f"{spec.out} ({size / 1e6:.1f} MB); it opens without network"
    report(json, {"report": str(spec.out), "bytes": size}, summary)
    return 0


def merge(spec: MergeSpec, json: bool) -> int:
    """Join data sets."""
    done = sets.merge(spec.places, spec.out, spec.filter())
    counts = {
        "written": done.written,
        "left_out": done.left_out,
        "repeated": done.repeated,
    }
    summary = (
        f"{done.written} episodes written to {spec.out}; {done.left_out} left out by the filter, {done.repeated} were "
        "there already"
    )
    report(json, counts, summary)
    return 0


def split(spec: SplitSpec, json: bool) -> int:
    """Divide a data set."""
    sizes = sets.split(spec.places, spec.out, spec.shares, spec.by, spec.seed)
    table = Listing(f"Parts in {spec.out}", ("part", "episodes"), list(sizes.items()))
    report(json, {"parts": sizes}, table)
    return 0


def pack_files(spec: PackSpec, json: bool) -> int:
    """Make shards of episode files."""
    done = [pack(folder, spec.shard_mb) for folder in spec.folders]
    episodes = sum(each.episodes for each in done)
    shards = sum(len(each.shards) for each in done)
    size = sum(each.bytes for each in done)
    report(
        json,
        {"episodes": episodes, "shards": shards, "bytes": size},
        f"{episodes} episodes packed into {shards} shards, {size:,} bytes",
    )
    return 0


def import_files(spec: ImportSpec, json: bool) -> int:
    """Read the data of another system."""
    done = []
    for path in spec.files:
        with late_bar(path.name) as begin:
            done.append(import_ms_hab(path, spec.out, spec.origin, begin))
    episodes = sum(each.episodes for each in done)
    frames = sum(each.frames for each in done)
    present = sum(each.present for each in done)
    counts = {"episodes": episodes, "frames": frames, "present": present}
    report(
        json,
        {**counts, "lacks": list(ABSENT)},
        f"{episodes} episodes, {frames:,} frames in {spec.out}; {present} were there already",
        f"The data lack {', '.join(ABSENT)}: they cannot be replayed, rendered or relabelled.",
    )
    return 0


def check(spec: ShardCheckSpec, json: bool) -> int:
    """Compare hashes and sizes; returns 1 if anything is damaged."""
    with progress_bar("checking", len(shard_paths(spec.places))) as advance:
        found = checking.check(spec.places, advance)
    damaged = [
        (str(path), name, "; ".join(wrong))
        for (path, name), wrong in found.damaged.items()
    ]
    unreadable = [(str(path), "", wrong) for path, wrong in found.unreadable.items()]
    facts = {
        "episodes": found.episodes,
        "ok": found.ok,
        "damaged": len(damaged),
        "unreadable": [path for path, _, _ in unreadable],
        "unfinished": [str(path) for path in found.unfinished],
        "doubled": len(found.doubled),
        "schemas": {str(key): found.schemas[key] for key in sorted(found.schemas)},
        "problems": [
            {"shard": path, "episode": name, "wrong": wrong}
            for path, name, wrong in damaged
        ],
    }
    problems = (damaged + unreadable)[:_MOST_ROWS]
    older = sum(count for schema, count in found.schemas.items() if schema < VERSION)
    report(
        json,
        facts,
        Listing("Damaged", ("shard", "episode", "what is wrong"), problems)
        if problems
        else None,
        *(
            f"{path}: a writer was stopped; the next writer, or repair, completes the file"
            for path in found.unfinished
        ),
        *(f"episode {name} occurs more than once" for name in found.doubled[:_MOST_ROWS]),
        f"{older} episodes are of an older schema, read as those of schema {VERSION}, see docs/data/format.md"
        if older
        else "",
        f"{found.episodes} episodes, {found.ok} ok, {len(damaged)} damaged, {len(unreadable)} shards unreadable",
    )
    # Scripts stop at damage; what a writer left unfinished completes itself.
    return 0 if found.clean else 1


def repair(spec: RepairSpec, json: bool) -> int:
    """Save what can be read of damaged files."""
    done = [checking.repair(path) for path in shard_paths(spec.places)]
    kept = sum(r.kept for r in done)
    lost = sum(len(r.lost) for r in done)
    facts = {
        "kept": kept,
        "lost": lost,
        "finished": sum(r.finished for r in done),
        "damaged_files": [str(r.kept_as) for r in done if r.kept_as],
        # A file whose index is damaged is refused since schema 4.
        "indexed": True,
    }
    report(json, facts, *map(_repaired, done), f"{kept} episodes kept, {lost} lost")
    return 0


def _repaired(done: checking.Repair) -> str:
    if done.kept_as is not None:
        lost = f"{len(done.lost)} lost"
        return f"{done.path}: {done.kept} episodes saved, {lost}; the damaged file is {done.kept_as}"
    what = "an interrupted write was completed" if done.finished else "nothing to do"
    return f"{done.path}: {done.kept} episodes, {what}"


def tell_fields(spec: FieldsSpec, json: bool) -> int:
    """Print what filters can name."""
    names = [(fact.name, fact.kind, fact.meaning) for fact in facts().values()]
    names += [
        (f"{name}(event)", "a number", meaning)
        for name, (meaning, _) in FUNCTIONS.items()
    ]
    presets = [(name, text, meaning) for name, (text, meaning) in PRESETS.items()]
    summary = {
        "fields": [list(row) for row in names],
        "presets": [list(row) for row in presets],
    }
    report(
        json,
        summary,
        Listing("Names in filters", ("name", "is", "meaning"), names),
        Listing("Presets", ("name", "filter", "meaning"), presets),
    )
    return 0


def run_relabelling(spec: LabelSpec, json: bool) -> int:
    """Run ``mjhab label``; returns the exit code."""
    found = run_label(spec)
    labels = found.changed_labels
    facts = {
        "episodes": found.episodes,
        "subtasks": found.subtasks,
        "changed": labels,
        "changes": len(found.changes),
    }
    if found.without_signals:
        facts["without_signals"] = found.without_signals
    rows = [
        (name, str(c.subtask), c.what, str(c.old), str(c.new))
        for name, c in found.changes
    ]
    columns = ("episode", "subtask", "what", "recorded", "now")
    written = " (written)" if spec.write and found.changes else ""
    others = len(found.changes) - labels
    report(
        json,
        facts,
        Listing("Changes", columns, rows[:_MOST_ROWS]) if rows else None,
        f"{found.episodes} episodes, {found.subtasks} subtasks: {labels} labels and {others} other things "
        f"changed{written}",
        f"{found.without_signals} episodes were imported without signals; their labels stay those of their source"
        if found.without_signals
        else "",
    )
    return 0
