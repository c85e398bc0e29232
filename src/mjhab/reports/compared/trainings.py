"""Curves of training runs, from the rows that they report in metrics.jsonl."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mjhab.core.files.reading import parse_json
from mjhab.reports.plots import Figure

METRICS = "metrics.jsonl"
"""File of a training run with one line per report: step, samples, seconds and metrics."""
ON_THE_WAY = "on_the_way"
FINAL = "final"
"""Which evaluation a row of metrics.jsonl tells of ("evaluation"): one during training, or that of the finished policy.
"""
POINTS = "#f59e0b"
FINAL_POINTS = "#6366f1"
"""Colours of the success on the way, and of the final evaluation."""
RUN_COLORS = (
    "#14b8a6",
    "#f59e0b",
    "#6366f1",
    "#dc2626",
    "#84cc16",
    "#d946ef",
    "#0ea5e9",
    "#78716c",
)
"""Colours of several runs in one chart, over and over."""
SECONDS_PER_MINUTE = 60.0


def read_metrics(folder: Path, step: int | None = None) -> list[dict[str, Any]]:
    """Read the rows that a run has reported, up to ``step`` updates if given; incomplete lines are skipped."""
    path = folder / METRICS
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        # The run may be writing its last line right now.
        with suppress(ValueError):
            found.append(parse_json(line))
    return [row for row in found if step is None or row["step"] <= step]


def with_minutes(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows with "minutes", their "seconds" in another unit."""
    return [
        {**row, "minutes": round(row["seconds"] / SECONDS_PER_MINUTE, 2)} for row in rows
    ]


def success_curves(rows: Sequence[Mapping[str, Any]], x: str) -> Figure:
    """Success once over key ``x``: a series for each kind of evaluation, in homes of one split, of as many episodes.

    Evaluations of other episodes make no curve together.
    """
    return _success_figure(_success_traces(rows, x), x)


def curves_of_runs(runs: Mapping[str, Sequence[Mapping[str, Any]]], x: str) -> Figure:
    """`success_curves` of several runs in one chart: their rows by name, one colour each."""
    traces = []
    for number, (name, rows) in enumerate(runs.items()):
        color = RUN_COLORS[number % len(RUN_COLORS)]
        traces += _success_traces(rows, x, f"{name}: ", color)
    return _success_figure(traces, x)


def _success_traces(
    rows: Sequence[Mapping[str, Any]], x: str, run: str = "", color: str = ""
) -> list[dict[str, Any]]:
    series: dict[tuple[str, str, int], list[Mapping[str, Any]]] = {}
    for row in rows:
        if "success_once" in row and x in row:
            # Runs of older versions do not tell which evaluation it was, and where.
            kind = row.get("evaluation", ON_THE_WAY)
            split = row.get("evaluated_split", "")
            episodes = int(row.get("evaluated_episodes", 0))
            series.setdefault((kind, split, episodes), []).append(row)
    traces = [_success_series(name, points, x, color) for name, points in series.items()]
    return [{**trace, "name": f"{run}{trace['name']}"} for trace in traces]


def _success_series(
    name: tuple[str, str, int], points: Sequence[Mapping[str, Any]], x: str, color: str
) -> dict[str, Any]:
    kind, split, episodes = name
    words = [
        kind.replace("_", " "),
        f"{episodes} episodes" if episodes else "",
        f"{split} homes" if split else "",
    ]
    final = kind == FINAL
    color = color or (FINAL_POINTS if final else POINTS)
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


def _success_figure(traces: list[dict[str, Any]], x: str) -> Figure:
    axis = {"title": {"text": "success once"}, "range": [0, 1]}
    figure = curve_figure(traces, x, axis)
    figure["layout"] |= {"showlegend": True, "legend": {"orientation": "h", "y": 1.16}}
    return figure


def curve_figure(traces: list[dict[str, Any]], x: str, y_axis: dict[str, Any]) -> Figure:
    """A chart of traces over ``x``, which begins at 0."""
    # Around a single value plotly would draw an axis of its own making.
    x_axis = {"title": {"text": x}, "rangemode": "tozero"}
    layout = {"height": 320, "xaxis": x_axis, "yaxis": y_axis}
    return {"data": traces, "layout": layout}
