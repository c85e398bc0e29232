"""The report of a data set: labels next to the paper's, films per label, forces. One self-contained HTML file."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjhab.core.names import kind_of
from mjhab.core.timing import STEP_SECONDS
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import nothing_passes, select
from mjhab.data.store.places import Place, shard_paths
from mjhab.reports.dataset_forces import SAFE_FORCE_N, force_plots
from mjhab.reports.dataset_labels import (
    LabelTable,
    grouped,
    label_order,
    label_tables,
)
from mjhab.reports.metrics import wilson
from mjhab.reports.mosaics import OpenFilm, mosaic
from mjhab.reports.pages import base64_text, render_page
from mjhab.reports.paper import beside_the_paper, rules_of
from mjhab.reports.words import interval, percent, spaced
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of, recorded_number


def render_data_report(
    places: Path | Sequence[Path],
    open_film: OpenFilm,
    where: Filter | None = None,
    begin: Callable[[int], Callable[[], object]] | None = None,
) -> str:
    """Return the report as one self-contained HTML page.

    Args:
        places: shards, or folders of shards.
        open_film: opens a film file for a path and frames/s (from ``render.film``, which this package may not import).
        where: filter on the episodes; None takes all.
        begin: called with the number of films; returns a function that is called after each.

    Raises:
        UsageError: no episode passes the filter, or one is of a subtask that is not registered here.
    """
    paths = shard_paths(places)
    found = select(paths, where)
    if not found.matched:
        raise nothing_passes()
    records = found.records
    subtasks = [subtask for record in records for subtask in record.subtasks]
    # A kind that this version does not know is refused here, and not halfway through the page.
    for kind in dict.fromkeys(subtask.kind for subtask in subtasks):
        recorded_number(kind)
    plots = force_plots(subtasks)
    # By identity: episodes of a shard share the object, and the dicts in it cannot be hashed.
    runs = list({id(run): run for run in found.runs}.values())
    policies = list(dict.fromkeys(run.policy for run in runs))
    rules = "; ".join(dict.fromkeys(rules_of(run.config.get("env", {})) for run in runs))
    chips = _chips(records, policies, rules)
    if where:
        chips.append(("filter", where.text))
    return render_page(
        "reports/templates/dataset.html",
        title="Recorded episodes",
        chips=chips,
        # By all episodes of the shards, whose bytes these are, and not by those that pass the filter.
        numbers=_numbers(records, sum(path.stat().st_size for path in paths) / found.of),
        beside_the_paper=beside_the_paper(rules),
        label_tables=_label_tables(records),
        mosaics=_mosaics(found.matched, records, open_film, begin),
        force_plots=list(plots),
        targets=_targets(subtasks),
        homes=sorted(Counter(record.home for record in records).items()),
        plots=plots,
    )


def _chips(
    records: Sequence[EpisodeRecord], policies: Sequence[str], rules: str
) -> list[tuple[str, Any]]:
    tasks = sorted({spaced(record.task) for record in records})
    return [
        ("task", ", ".join(tasks)),
        ("policy", ", ".join(policies)),
        ("rules", rules),
        ("split", ", ".join(sorted({r.split for r in records}))),
        ("homes", len({r.home for r in records})),
    ]


def _numbers(records: Sequence[EpisodeRecord], size: float) -> list[tuple[str, str, str]]:
    """The main numbers: name, value, and what is told more. size: of an episode [bytes]."""
    count = len(records)
    minutes = sum(record.steps for record in records) * STEP_SECONDS / 60
    once = sum(record.success_once for record in records)
    gentle = sum(
        record.success_once and record.peak_force < SAFE_FORCE_N for record in records
    )
    tainted = sum(bool(record.taint) for record in records)
    return [
        ("episodes", f"{count:,}", f"{minutes:,.1f} minutes of robot time"),
        ("success once", percent(once / count), interval(*wilson(once, count))),
        ("gentle success", percent(gentle / count), "never more than 1,400 N"),
        ("tainted", f"{tainted}", "flagged by the simulation"),
        ("size", f"{size / 1e6:,.2f} MB", "per episode, in the shards"),
    ]


def _label_tables(records: Sequence[EpisodeRecord]) -> dict[str, list[LabelTable]]:
    """Tables of labels by kind of subtask."""
    groups = grouped(records)
    found: dict[str, list[LabelTable]] = {}
    for kind in SUBTASKS:
        members = {
            group: subtasks for group, subtasks in groups.items() if group.kind == kind
        }
        if members:
            found[kind] = label_tables(kind, members)
    return found


def _mosaics(
    members: Sequence[Place],
    records: Sequence[EpisodeRecord],
    open_film: OpenFilm,
    begin: Callable[[int], Callable[[], object]] | None,
) -> list[dict[str, Any]]:
    """Films of the episodes by kind and label of their last subtask; none without images."""
    by_label: dict[tuple[str, str], list[Place]] = defaultdict(list)
    for place, record in zip(members, records, strict=True):
        if record.subtasks and record.subtasks[-1].label:
            by_label[record.subtasks[-1].kind, record.subtasks[-1].label].append(place)
    after = begin(len(by_label)) if begin else None
    found = []
    for kind, label in sorted(by_label, key=_place_of_label):
        places = by_label[kind, label]
        made = mosaic(places, open_film)
        if made is not None:
            found.append(
                {
                    "kind": kind,
                    "label": label,
                    "made": made,
                    "episodes": len(places),
                    "film": base64_text(made.film),
                }
            )
        if after is not None:
            after()
    return found


def _place_of_label(key: tuple[str, str]) -> tuple[int, int, str]:
    """Sort key of a kind and a label; labels that the kind does not have here come last."""
    kind, label = key
    order = label_order(kind)
    place = order.index(label) if label in order else len(order)
    return number_of(kind), place, label


def _targets(subtasks: Sequence[SubtaskRecord]) -> list[tuple[str, int]]:
    """Number of subtasks of every kind and target."""
    counts = Counter((subtask.kind, kind_of(subtask.target)) for subtask in subtasks)
    return [
        (f"{kind} {target}", count) for (kind, target), count in sorted(counts.items())
    ]
