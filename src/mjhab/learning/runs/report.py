"""The report of a training run: one HTML file without external resources."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mjhab.learning.runs.run import EVALUATIONS, FINAL, ON_THE_WAY, TrainingFolder
from mjhab.reports import parts
from mjhab.reports.metrics import labels_by_kind, rows_by_kind
from mjhab.reports.plots import labels_figure
from mjhab.reports.run import render_page
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.store import FILMS

Figure = dict[str, Any]
LINE = "#14b8a6"
POINTS = "#f59e0b"
FINAL_POINTS = "#6366f1"
"""Colours of the loss curve, of the success on the way, and of the final evaluation."""


def render_training_report(
    folder: TrainingFolder,
    rows: Sequence[Mapping[str, Any]],
    records: Sequence[EpisodeRecord],
    summary: Mapping[str, Any],
) -> str:
    """Render the report as one self-contained HTML page.

    Args:
        folder: of the run. rows: of metrics.jsonl. records: of the last evaluation. summary: see `train.summarize`.
    """
    body = [_header(folder, summary), _cards(summary)]
    plots = {
        "loss-plot": loss_curve(rows),
        "samples-plot": success_curves(rows, "samples"),
        "time-plot": success_curves([_minutes(row) for row in rows], "minutes"),
    }
    body.append(
        parts.section(
            "Loss",
            "Mean over the updates between two reports.",
            '<div id="loss-plot"></div>',
        )
    )
    hint = (
        "Fraction of the evaluated episodes that succeed at least once: of the evaluations on the way, and of the "
        "final one, which has other episodes."
    )
    body.append(
        parts.section("Success over samples", hint, '<div id="samples-plot"></div>')
    )
    body.append(
        parts.section(
            "Success over time",
            "Wall time, collection included.",
            '<div id="time-plot"></div>',
        )
    )
    if records:
        body.append(
            parts.section(
                "Last evaluation",
                "Results per target.",
                parts.success_table(rows_by_kind(records)),
            )
        )
        counts = labels_by_kind(records)
        if counts:
            plots["labels-plot"] = labels_figure(counts)
            hint = "Labels of the last evaluation's episodes."
            body.append(parts.section("Labels", hint, '<div id="labels-plot"></div>'))
    body.append(_rounds(rows))
    body.append(_films(folder))
    body.append(
        parts.section(
            "Run",
            "The resolved config of this run.",
            parts.config_list(flat(folder.config)),
        )
    )
    return render_page(_title(folder), "\n".join(filter(None, body)), {"plots": plots})


def loss_curve(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The loss over the samples."""
    told = [row for row in rows if "loss" in row]
    trace = {
        "x": [row["samples"] for row in told],
        "y": [row["loss"] for row in told],
        "type": "scatter",
        "mode": "lines",
        "line": {"color": LINE, "width": 2},
    }
    return _figure([trace], "samples", {"title": {"text": "loss"}})


def success_curves(rows: Sequence[Mapping[str, Any]], x: str) -> Figure:
    """Success once over key ``x``: a series for each kind of evaluation, in homes of one split, of as many episodes.

    Evaluations of other episodes make no curve together.
    """
    series: dict[tuple[str, str, int], list[Mapping[str, Any]]] = {}
    for row in rows:
        if "success_once" in row and x in row:
            # Runs of older versions do not tell which evaluation it was, and where.
            kind = row.get("evaluation", ON_THE_WAY)
            split = row.get("evaluated_split", "")
            episodes = int(row.get("evaluated_episodes", 0))
            series.setdefault((kind, split, episodes), []).append(row)
    traces = [_success_series(name, points, x) for name, points in series.items()]
    axis = {"title": {"text": "success once"}, "range": [0, 1]}
    figure = _figure(traces, x, axis)
    figure["layout"] |= {"showlegend": True, "legend": {"orientation": "h", "y": 1.16}}
    return figure


def _success_series(
    name: tuple[str, str, int], points: Sequence[Mapping[str, Any]], x: str
) -> dict[str, Any]:
    kind, split, episodes = name
    words = [
        kind.replace("_", " "),
        f"{episodes} episodes" if episodes else "",
        f"{split} homes" if split else "",
    ]
    final = kind == FINAL
    color = FINAL_POINTS if final else POINTS
    return {
        "x": [row[x] for row in points],
        "y": [row["success_once"] for row in points],
        "name": ", ".join(filter(None, words)),
        "type": "scatter",
        "mode": "markers" if final else "lines+markers",
        "line": {"color": color, "width": 2},
        "marker": {"color": color, "size": 11 if final else 6}
        | ({"symbol": "diamond"} if final else {}),
    }


def _figure(traces: list[dict[str, Any]], x: str, y_axis: dict[str, Any]) -> Figure:
    # Around a single value plotly would draw an axis of its own making.
    x_axis = {"title": {"text": x}, "rangemode": "tozero"}
    layout = {"height": 320, "xaxis": x_axis, "yaxis": y_axis}
    return {"data": traces, "layout": layout}


def flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Flatten nested mappings; names are joined by dots."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{before}{name}.")
        else:
            found[f"{before}{name}"] = value
    return found


def _minutes(row: Mapping[str, Any]) -> dict[str, Any]:
    return {**row, "minutes": round(row["seconds"] / 60.0, 2)}


def _title(folder: TrainingFolder) -> str:
    config = folder.config
    scene = config["scene"]
    what = " ".join(filter(None, (scene["subtask"], scene["target"] or "all targets")))
    more = len(config.get("also", ()))
    others = f" and {more} more" if more else ""
    return f"{config['algorithm']}: {what}, {scene['task'].replace('_', ' ')}{others}"


def _header(folder: TrainingFolder, summary: Mapping[str, Any]) -> str:
    shown = [
        ("preset", summary["preset"]),
        ("seed", folder.config["seed"]),
        ("homes of the training", folder.config["scene"]["split"]),
        ("homes of the last evaluation", summary["split"] or "none evaluated"),
    ]
    chips = "".join(
        f'<span class="chip">{escape(k)} <b>{escape(str(v))}</b></span>' for k, v in shown
    )
    return f'<header><h1>{escape(_title(folder))}</h1><div class="chips">{chips}</div></header>'


def _success_card(summary: Mapping[str, Any]) -> tuple[str, str, str]:
    """Name, value and what is told more of the success rate."""
    if summary["success_once"] is None:
        return "success once", "-", "not evaluated"
    low, high = summary["interval"]
    episodes = f"{summary['episodes']} episodes in homes of split {summary['split']}"
    at_end = parts.percent(summary["success_at_end"])
    more = f"{100 * low:.0f} to {100 * high:.0f} % (95 % CI), at end {at_end}, {episodes}"
    return "success once", parts.percent(summary["success_once"]), more


def _cards(summary: Mapping[str, Any]) -> str:
    values = [
        _success_card(summary),
        (
            "time",
            f"{summary['seconds'] / 60:.1f} min",
            "collection and evaluation included",
        ),
        ("updates", f"{summary['steps']:,}", f"{summary['samples']:,} samples"),
        *_time_card(summary),
        (
            "demonstrations",
            f"{summary['demonstrations']:,}",
            f"{summary['rounds']} rounds after the first",
        ),
    ]
    tiles = "".join(
        f'<div class="card"><div class="name">{escape(name)}</div><div class="value">{escape(value)}</div>'
        f'<div class="more">{escape(more)}</div></div>'
        for name, value, more in values
    )
    return f'<div class="cards">{tiles}</div>'


def _time_card(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Card with the time shares of a reinforcement learning run; empty for other runs."""
    shares = summary.get("time_shares")
    if not shares:
        return []
    rest = ", ".join(
        f"{name} {parts.percent(shares[name])}" for name in shares if name != "env"
    )
    return [("time in the environment", parts.percent(shares["env"]), rest)]


def _rounds(rows: Sequence[Mapping[str, Any]]) -> str:
    """Table of the demonstrations collected in every round."""
    collected = [row for row in rows if "collection_success" in row]
    if not collected:
        return ""
    lines = "".join(
        f"<tr><td>{row['round']}</td><td>{row['episodes']}</td><td>{parts.percent(row['collection_success'])}</td>"
        f"<td>{row['collection_seconds']:.0f} s</td></tr>"
        for row in collected
    )
    head = "<tr><th>round</th><th>demonstrations so far</th><th>episodes that succeeded</th><th>time</th></tr>"
    hint = "Demonstrations that the expert added."
    table = parts.scrolled(f"<table>{head}{lines}</table>")
    return parts.section("Collection", hint, table)


def _films(folder: TrainingFolder) -> str:
    evaluations = folder.path / EVALUATIONS
    # With several scenes the run folder of each lies below that of the evaluation.
    paths = sorted(evaluations.rglob(f"{FILMS}/episode_*.mp4"))
    if not paths:
        return ""
    films = "".join(
        f"<figure>{_video(path)}<figcaption>{escape(_caption(path.relative_to(evaluations)))}</figcaption></figure>"
        for path in paths
    )
    hint = "Episodes of the first and the last evaluation, at twice real time."
    return parts.section("Films", hint, f'<div class="films">{films}</div>')


def _caption(film: Path) -> str:
    """Evaluation, scene if there are several, and episode: "first, set_table.close, episode_00000"."""
    where = film.with_suffix("").parts
    return ", ".join(part for part in where if part != FILMS)


def _video(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<video controls muted playsinline src="data:video/mp4;base64,{data}"></video>'
    )
