"""The report of a run: one self-contained HTML file with charts, films and tables."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from mjhab.reports import parts
from mjhab.reports.metrics import (
    AloneRates,
    labels_by_kind,
    progress_curves,
    rows_by_kind,
    rows_by_position,
    summarize,
)
from mjhab.reports.plots import (
    LABEL_COLORS,
    force_figure,
    has_values,
    labels_figure,
    progress_figure,
)
from mjhab.rollout.records import EpisodeRecord, skip_counts, skips_told

FORCE_EPISODES = 12
"""Number of episodes with a force plot; more would make the file large."""
TIMELINES_WITHOUT_FILM = 4
"""Number of episodes with a timeline if there are no films."""


def render_report(
    records: Sequence[EpisodeRecord],
    config: Mapping[str, Any],
    seconds: float,
    film_path: Callable[[int], Path] | None = None,
    film_problem: str | None = None,
    alone: AloneRates | None = None,
) -> str:
    """Return the report as one self-contained HTML page.

    Args:
        records: finished episodes; may be fewer than ``config["episodes"]``, even none.
        config: resolved options of the run; titles use "task", "subtask", "policy" and "episodes".
        seconds: wall time of the run [s].
        film_path: path of an episode's film; films that exist are embedded.
        film_problem: why films are missing, shown in the report.
        alone: rates for the upper bound, see ``metrics.progress_curves``.
    """
    records = sorted(records, key=lambda record: record.index)
    summary = summarize(records, seconds, alone)
    body = [_header(records, config), parts.cards(records, summary)]
    if records:
        body.append(_films(records, film_path, film_problem))
        body += _results(records, alone)
        body.append(
            parts.section(
                "Episodes", "Click a column head to sort.", parts.episode_table(records)
            )
        )
        body.append(
            parts.section("Simulation flags", _TAINT_HINT, parts.taint_table(records))
        )
    else:
        body.append(
            parts.section(
                "No episode finished",
                "",
                parts.empty("Resume the run to fill this report."),
            )
        )
    body.append(
        parts.section(
            "Run", "The resolved options of this run.", parts.config_list(config)
        )
    )
    return render_page(_title(config), "\n".join(body), _figures(records, alone))


_TAINT_HINT = (
    "Contact overflow, NaN, deep penetration and engine warnings make the physics of an episode unreliable. Flagged "
    "episodes count in the rates above, but filtered data sets exclude them."
)


def _title(config: Mapping[str, Any]) -> str:
    what = str(config.get("task", "run")).replace("_", " ")
    if config.get("subtask"):
        what = f"{config['subtask']}, {what}"
    return f"{what} by {config.get('policy', 'a policy')}"


def _header(records: Sequence[EpisodeRecord], config: Mapping[str, Any]) -> str:
    homes = len({record.home for record in records})
    shown = [
        ("homes", homes),
        *((key, config.get(key)) for key in ("split", "assets", "seed", "worlds")),
    ]
    chips = "".join(
        f'<span class="chip">{escape(key)} <b>{escape(str(value))}</b></span>'
        for key, value in shown
        if value is not None
    )
    wanted = config.get("episodes", len(records))
    banner = ""
    if len(records) < wanted:
        banner = (
            f'<div class="banner">Partial: {len(records)} of {wanted} episodes are finished. '
            "The same command with --resume continues the run.</div>"
        )
    errors = [record.error for record in records if record.error]
    if errors:
        reason, count = Counter(errors).most_common(1)[0]
        banner += (
            f'<div class="banner">The policy ended {len(errors)} of {len(records)} episodes with an error; they count '
            f"as what they had reached. {count} of them: {escape(reason)}</div>"
        )
    skipped = skip_counts(record.skipped_homes for record in records)
    if skipped:
        banner += f'<div class="banner">Skipped, because they have no room: {escape(skips_told(skipped))}</div>'
    title = escape(_title(config))
    return (
        f"<header><h1>{title[:1].upper()}{title[1:]}</h1><p>A robot in furnished homes, simulated by "
        f'MuJoCo and judged by mjhab.</p><div class="chips">{chips}</div>{banner}</header>'
    )


def _results(records: Sequence[EpisodeRecord], alone: AloneRates | None) -> list[str]:
    rows = rows_by_position(records)
    chain = len(rows) > 1
    out = []
    if chain:
        bound = (
            "The dotted line multiplies the success rates of the subtasks evaluated alone, from spawned starts: "
            "an upper bound for a chain whose subtasks do not affect each other."
            if alone
            else "The dotted line multiplies the success rates of the subtasks among the episodes that reached "
            "them. Give --alone with runs of single subtasks to bound the chain by those instead."
        )
        hint = (
            f"Fraction of episodes that completed at least this much of the plan. {bound}"
        )
        out.append(
            parts.section(
                "Progressive completion", hint, '<div id="progress-plot"></div>'
            )
        )
        hint = (
            "In plan order. A subtask counts only where an episode reached it; whiskers are Wilson 95 % intervals. "
            "What the environment does by teleport is not judged."
        )
        out.append(
            parts.section("Success along the plan", hint, parts.success_table(rows))
        )
    hint = (
        "All subtasks that ended, by kind and target; whiskers are Wilson 95 % intervals. Time to the first success "
        "and largest force of a control step are medians. Limits count the force on the robot without its fingers."
    )
    out.append(
        parts.section(
            "Success per subtask", hint, parts.success_table(rows_by_kind(records))
        )
    )
    hint = f"Outcomes of subtasks: {LABEL_COLORS}."
    labels = (
        '<div id="labels-plot"></div>'
        if labels_by_kind(records)
        else parts.empty("No subtask has a label.")
    )
    out.append(parts.section("Trajectory labels", hint, labels))
    hint = (
        "Contact force on the robot, summed over its links without the fingers. The lower chart adds it up within each "
        "subtask; a subtask fails when the sum passes the dashed limit (navigation has none)."
    )
    options = "".join(
        f"<option>episode {record.index}</option>" for record in records[:FORCE_EPISODES]
    )
    picker = f'<select id="force-episode" aria-label="episode">{options}</select><div id="force-plot"></div>'
    out.append(parts.section("Force over time", hint, picker))
    return out


def _films(
    records: Sequence[EpisodeRecord],
    film_path: Callable[[int], Path] | None,
    problem: str | None,
) -> str:
    paths = (
        {record.index: film_path(record.index) for record in records} if film_path else {}
    )
    filmed = [
        record
        for record in records
        if record.index in paths and paths[record.index].is_file()
    ]
    shown = filmed or list(records[:TIMELINES_WITHOUT_FILM])
    figures = "".join(parts.film(record, paths.get(record.index)) for record in shown)
    hint = "Films run at twice real time. Below each: the " if filmed else "The "
    hint += (
        "subtasks in the colours of their labels, and events as small marks (green: progress, red: setback, "
        "grey: other)."
    )
    note = (
        f'<div class="banner">Films stopped: {escape(problem)}</div><br>'
        if problem
        else ""
    )
    return parts.section(
        "Films and timelines", hint, f'{note}<div class="films">{figures}</div>'
    )


def _figures(
    records: Sequence[EpisodeRecord], alone: AloneRates | None
) -> dict[str, Any]:
    if not records:
        return {"progress": None, "labels": None, "force": []}
    counts = labels_by_kind(records)
    return {
        "progress": progress_figure(
            rows_by_position(records), *progress_curves(records, alone)
        ),
        "labels": labels_figure(counts) if counts else None,
        "force": [force_figure(record) for record in records[:FORCE_EPISODES]],
    }


def render_page(title: str, body: str, figures: Mapping[str, Any]) -> str:
    """Render a page in the common style: ``body`` is HTML, ``figures["plots"]`` maps element ids to plotly figures.

    A figure without a value would show axes of numbers that mean nothing: a sentence takes its place.
    """
    from plotly.offline import get_plotlyjs

    here = files("mjhab.reports")
    style, script = (
        here.joinpath(name).read_text(encoding="utf-8")
        for name in ("report.css", "report.js")
    )
    body, figures = _without_empty_charts(body, figures)
    data = json.dumps(figures, separators=(",", ":"), allow_nan=False).replace(
        "</", "<\\/"
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<main>
{body}
<footer>Made by mjhab. This file needs no network.</footer>
</main>
<script>{get_plotlyjs()}</script>
<script type="application/json" id="page-data">{data}</script>
<script>
{script}</script>
</body>
</html>
"""


def _without_empty_charts(
    body: str, figures: Mapping[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Put a sentence in the place of every chart that has no value, and drop its figure."""
    plots = figures.get("plots", {})
    kept = {name: figure for name, figure in plots.items() if has_values(figure)}
    for name in plots.keys() - kept.keys():
        body = body.replace(f'<div id="{name}"></div>', parts.empty("No values yet."))
    return body, {**figures, "plots": kept}
