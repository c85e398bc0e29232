"""The report of a data set: labels next to the paper's, films per label, forces. One self-contained HTML file."""

from __future__ import annotations

import base64
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mjhab.core.names import kind_of
from mjhab.core.timing import STEP_SECONDS
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import Place, nothing_passes, select
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.places import shard_paths
from mjhab.data.store.reading import open_shard
from mjhab.reports import parts
from mjhab.reports.dataset_forces import SAFE_FORCE_N, force_plots
from mjhab.reports.dataset_labels import grouped, label_order, label_table
from mjhab.reports.metrics import wilson
from mjhab.reports.mosaics import Mosaic, OpenFilm, mosaic
from mjhab.reports.paper import beside_the_paper, rules_of
from mjhab.reports.plots import tone
from mjhab.reports.run import render_page
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of, recorded_number

_LABEL_HINT = (
    "Percent of the subtasks in this data set, from which a filter may have removed some labels. Published rules: the "
    "labels of MS-HAB's code, as in the columns of the paper (Tables 6 to 13, 1,008 episodes each: RL-Per has one "
    "policy per object, RL-All one for all objects, IL imitates RL-Per). Own rules: mjhab's labels, the field label of "
    "filters. Homes, objects and physics differ from the paper's, so this compares data sets, not policies."
)
_FILM_HINT = (
    "Episodes by the label of their last subtask, side by side, at four times real time, from the named camera. An "
    "episode that has ended shows its last image."
)
_FORCE_HINT = (
    "Contact force on the robot in every subtask, summed over its links without the fingers: the largest value of a "
    "control step, and the sum over the subtask, to which the force limit applies. Beside it the largest force on both "
    "fingers, which no limit counts. Axes are logarithmic."
)
_NO_IMAGES = "No images are stored with these episodes: mjhab replay --render adds them."


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
    for kind in dict.fromkeys(subtask.kind for subtask in subtasks):
        recorded_number(kind)
    plots = force_plots(subtasks)
    size = sum(path.stat().st_size for path in paths)
    text = where.text if where else None
    runs = _runs(found.matched)
    policies = list(dict.fromkeys(run.policy for run in runs))
    rules = "; ".join(dict.fromkeys(rules_of(run.config.get("env", {})) for run in runs))
    body = [
        _header(records, policies, rules, text),
        _cards(records, size / found.of),
        parts.section(
            "Labels", f"{_LABEL_HINT} {beside_the_paper(rules)}", _labels(records)
        ),
        parts.section(
            "Films", _FILM_HINT, _films(found.matched, records, open_film, begin)
        ),
        parts.section("Forces", _FORCE_HINT, _pairs(list(plots))),
        parts.section(
            "Homes and targets",
            "Homes and targets of the episodes.",
            _counts(records),
        ),
    ]
    return render_page("Recorded episodes", "\n".join(body), {"plots": plots})


def _runs(members: Sequence[Place]) -> list[RunInfo]:
    """The runs of the episodes."""
    # Names of episodes start with the hash of their run's config.
    configs: dict[Path, set[str]] = defaultdict(set)
    for path, name in members:
        configs[path].add(name.partition("-")[0])
    runs: list[RunInfo] = []
    for path, wanted in configs.items():
        with open_shard(path) as shard:
            runs += [run for run in shard.runs.values() if run.config_id in wanted]
    return runs


def _header(
    records: Sequence[EpisodeRecord],
    policies: Sequence[str],
    rules: str,
    where: str | None,
) -> str:
    tasks = sorted({record.task.replace("_", " ") for record in records})
    shown: list[tuple[str, Any]] = [
        ("task", ", ".join(tasks)),
        ("policy", ", ".join(policies)),
    ]
    shown += [
        ("rules", rules),
        ("split", ", ".join(sorted({r.split for r in records}))),
        ("homes", len({r.home for r in records})),
    ]
    if where:
        shown.append(("filter", where))
    chips = "".join(
        f'<span class="chip">{escape(k)} <b>{escape(str(v))}</b></span>' for k, v in shown
    )
    return (
        "<header><h1>Recorded episodes</h1><p>A robot in furnished homes, simulated by MuJoCo, labelled by "
        f'mjhab.</p><div class="chips">{chips}</div></header>'
    )


def _cards(records: Sequence[EpisodeRecord], size: float) -> str:
    count = len(records)
    steps = sum(record.steps for record in records)
    once = sum(record.success_once for record in records)
    gentle = sum(
        record.success_once and record.peak_force < SAFE_FORCE_N for record in records
    )
    low, high = wilson(once, count)
    values = [
        (
            "episodes",
            f"{count:,}",
            f"{steps * STEP_SECONDS / 60:,.1f} minutes of robot time",
        ),
        (
            "success once",
            parts.percent(once / count),
            f"{100 * low:.0f} to {100 * high:.0f} % (95 % CI)",
        ),
        ("gentle success", parts.percent(gentle / count), "never more than 1,400 N"),
        (
            "tainted",
            f"{sum(bool(record.taint) for record in records)}",
            "flagged by the simulation",
        ),
        ("size", f"{size / 1e6:,.2f} MB", "per episode, in the shards"),
    ]
    tiles = (
        f'<div class="card"><div class="name">{escape(name)}</div><div class="value">{escape(value)}</div>'
        f'<div class="more">{escape(more)}</div></div>'
        for name, value, more in values
    )
    return f'<div class="cards">{"".join(tiles)}</div>'


def _labels(records: Sequence[EpisodeRecord]) -> str:
    groups = grouped(records)
    tables = []
    for kind in SUBTASKS:
        members = {
            group: subtasks for group, subtasks in groups.items() if group.kind == kind
        }
        if members:
            tables.append(
                f'<h3 style="margin:18px 0 4px;font-size:16px">{kind}</h3>{label_table(kind, members)}'
            )
    return "".join(tables) or parts.empty("No subtask ended.")


def _films(
    members: Sequence[Place],
    records: Sequence[EpisodeRecord],
    open_film: OpenFilm,
    begin: Callable[[int], Callable[[], object]] | None,
) -> str:
    by_label: dict[tuple[str, str], list[Place]] = defaultdict(list)
    for place, record in zip(members, records, strict=True):
        if record.subtasks and record.subtasks[-1].label:
            by_label[record.subtasks[-1].kind, record.subtasks[-1].label].append(place)
    after = begin(len(by_label)) if begin else None
    figures = []
    for kind, label in sorted(by_label, key=_place_of_label):
        places = by_label[kind, label]
        made = mosaic(places, open_film)
        if made is not None:
            figures.append(
                _figure(
                    kind, label, made, f"{made.episodes} of {len(places)}, {made.camera}"
                )
            )
        if after is not None:
            after()
    if not figures:
        return parts.empty(_NO_IMAGES)
    columns = "display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,300px),1fr));gap:20px"
    return f'<div style="{columns}">{"".join(figures)}</div>'


def _place_of_label(key: tuple[str, str]) -> tuple[int, int, str]:
    """Sort key of a kind and a label; labels that the kind does not have here come last."""
    kind, label = key
    order = label_order(kind)
    place = order.index(label) if label in order else len(order)
    return number_of(kind), place, label


def _figure(kind: str, label: str, made: Mosaic, what: str) -> str:
    data = base64.b64encode(made.film).decode("ascii")
    style = f"display:block;width:100%;max-width:{made.width}px;border-radius:10px;background:#000"
    video = f'<video autoplay loop muted playsinline style="{style}"'
    return (
        f'<figure style="margin:0"><figcaption style="margin-bottom:6px"><span class="dot {tone(label)}"></span>'
        f"<b>{escape(kind)}</b>: {escape(label.replace('_', ' '))} <small>({escape(what)})</small></figcaption>"
        f'{video} src="data:video/mp4;base64,{data}"></video></figure>'
    )


def _pairs(names: Sequence[str]) -> str:
    if not names:
        return parts.empty("No subtask ended.")
    columns = "display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:14px 24px"
    return f'<div style="{columns}">{"".join(f"""<div id="{name}"></div>""" for name in names)}</div>'


def _counts(records: Sequence[EpisodeRecord]) -> str:
    targets = Counter(
        (s.kind, kind_of(s.target)) for record in records for s in record.subtasks
    )
    homes = Counter(record.home for record in records)
    rows = [
        (f"{kind} {target}", count) for (kind, target), count in sorted(targets.items())
    ]
    return _list("subtask", rows) + _list("home", sorted(homes.items()))


def _list(name: str, rows: Sequence[tuple[str, int]]) -> str:
    body = "".join(
        f'<tr><td>{escape(text)}</td><td class="n">{count}</td></tr>'
        for text, count in rows
    )
    head = f'<tr><th>{escape(name)}</th><th class="n">number</th></tr>'
    table = f'<table class="sortable"><thead>{head}</thead><tbody>{body}</tbody></table>'
    return f'<details open><summary>{escape(name)}s</summary><div class="scroll">{table}</div></details>'
