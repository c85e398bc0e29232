"""The report of a training run: one HTML file without external resources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.learning.runs.run import EVALUATIONS, FINAL, ON_THE_WAY, TrainingFolder
from mjhab.reports.metrics import labels_by_kind, rows_by_kind
from mjhab.reports.pages import base64_text, render_page
from mjhab.reports.plots import labels_figure
from mjhab.reports.words import interval, percent
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
    plots = {
        "loss-plot": loss_curve(rows),
        "samples-plot": success_curves(rows, "samples"),
        "time-plot": success_curves([_minutes(row) for row in rows], "minutes"),
    }
    if counts := labels_by_kind(records):
        plots["labels-plot"] = labels_figure(counts)
    return render_page(
        "learning/runs/report.html",
        title=_title(folder),
        chips=_chips(folder, summary),
        numbers=_numbers(summary),
        evaluated=bool(records),
        by_kind=rows_by_kind(records),
        collected=[row for row in rows if "collection_success" in row],
        films=_films(folder),
        config=flat(folder.config),
        plots=plots,
    )


def loss_curve(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The loss over the samples."""
    losses = [row for row in rows if "loss" in row]
    trace = {
        "x": [row["samples"] for row in losses],
        "y": [row["loss"] for row in losses],
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


def _chips(folder: TrainingFolder, summary: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [
        ("preset", summary["preset"]),
        ("seed", folder.config["seed"]),
        ("homes of the training", folder.config["scene"]["split"]),
        ("homes of the last evaluation", summary["split"] or "none evaluated"),
    ]


def _success_card(summary: Mapping[str, Any]) -> tuple[str, str, str]:
    """Name, value and what is told more of the success rate."""
    if summary["success_once"] is None:
        return "success once", "-", "not evaluated"
    episodes = f"{summary['episodes']} episodes in homes of split {summary['split']}"
    at_end = percent(summary["success_at_end"])
    more = f"{interval(*summary['interval'])}, at end {at_end}, {episodes}"
    return "success once", percent(summary["success_once"]), more


def _numbers(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """The main numbers: name, value, and what is told more."""
    minutes = f"{summary['seconds'] / 60:.1f} min"
    rounds = f"{summary['rounds']} rounds after the first"
    return [
        _success_card(summary),
        ("time", minutes, "collection and evaluation included"),
        ("updates", f"{summary['steps']:,}", f"{summary['samples']:,} samples"),
        *_time_card(summary),
        ("demonstrations", f"{summary['demonstrations']:,}", rounds),
    ]


def _time_card(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Card with the time shares of a reinforcement learning run; empty for other runs."""
    shares = summary.get("time_shares")
    if not shares:
        return []
    rest = ", ".join(
        f"{name} {percent(shares[name])}" for name in shares if name != "env"
    )
    return [("time in the environment", percent(shares["env"]), rest)]


def _films(folder: TrainingFolder) -> dict[str, str]:
    """Films in base64 by caption: evaluation, scene if there are several, and episode."""
    evaluations = folder.path / EVALUATIONS
    found = {}
    # With several scenes the run folder of each lies below that of the evaluation.
    for path in sorted(evaluations.rglob(f"{FILMS}/episode_*.mp4")):
        where = path.relative_to(evaluations).with_suffix("").parts
        caption = ", ".join(part for part in where if part != FILMS)
        found[caption] = base64_text(path.read_bytes())
    return found
