"""The charts of the report as plotly figures in JSON data; the page sets the colours of text and grid."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.reports.metrics import SubtaskRow
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

Figure = dict[str, Any]

OTHER_COLOR = "#57534e"
_TONES = {
    "good": ("#16a34a", "#84cc16", "#0d9488", "#14532d", "#99f6e4"),
    "fair": ("#eab308", "#fde68a", "#a16207", "#fde047", "#d97706", "#713f12"),
    "bad": (
        "#dc2626",
        "#fdba74",
        "#991b1b",
        "#f9a8d4",
        "#ea580c",
        "#db2777",
        "#701a75",
        "#d946ef",
    ),
}
"""Colours of labels by tone; any two of all tones differ by 19 or more in CIELAB, any two greens by 30
(tests/reports/test_colors.py)."""
_PATTERNS = ("", "/", "x", ".")
"""Hatching of the labels of a tone that has more labels than colours, one for each round of its colours."""
LABEL_COLORS = (
    "greens, clean success; yellows and browns, success with a flaw; reds, pinks and oranges, kinds of failure, "
    "hatched where there are more of them than colours"
)
"""What the colours of `labels_figure` mean, for the words beside a chart."""
_GOOD_EVENTS = frozenset(
    {
        "success",
        "grasped",
        "at_goal",
        "released_at_goal",
        "navigated_close",
        "opened",
        "closed",
    }
)
_BAD_EVENTS = frozenset(
    {
        "dropped",
        "left_goal",
        "released_outside_goal",
        "excessive_collisions",
        "lost_success",
        "lost_navigated_close",
    }
)
_FAIR_STARTS = ("success_then", "dubious", "winding", "dropped_to_goal")


def has_values(figure: Figure) -> bool:
    """Whether a figure has anything to draw."""
    return any(len(trace.get("y", ())) for trace in figure["data"])


def kind_color(kind: str) -> str:
    """Colour of a kind of subtask; grey for unknown kinds."""
    return SUBTASKS[kind].color if kind in SUBTASKS else OTHER_COLOR


def tone(label: str | None) -> str:
    """Return ``"good"``, ``"fair"`` (succeeded, but not cleanly), ``"bad"`` or ``"none"`` for a trajectory label."""
    if not label:
        return "none"
    if label.endswith("_failure"):
        return "bad"
    return "fair" if label.startswith(_FAIR_STARTS) else "good"


def event_tone(name: str) -> str:
    """Return ``"good"``, ``"bad"`` or ``"none"`` for the name of an event."""
    if name in _GOOD_EVENTS:
        return "good"
    return "bad" if name in _BAD_EVENTS else "none"


def force_limits() -> dict[str, float]:
    """Return the limit of cumulative force of every kind of subtask [N x control steps]."""
    return {name: SUBTASKS[name].limits.force_limit for name in SUBTASKS}


def progress_figure(
    rows: Sequence[SubtaskRow], curve: Sequence[float], bound: Sequence[float | None]
) -> Figure:
    """Progressive completion over the positions of the plan, with its upper bound where it is known."""
    names = [f"{(row.position or 0) + 1} {row.kind}" for row in rows]
    hover = [f"{row.kind} {row.target}" for row in rows]
    common = {"x": names, "type": "scatter", "text": hover}
    return {
        "data": [
            {
                **common,
                "y": list(bound),
                "name": "independent upper bound",
                "mode": "lines+markers",
                "line": {"dash": "dot", "width": 2, "color": "#94a3b8"},
                "marker": {"size": 6, "symbol": "diamond"},
                "hovertemplate": "%{text}<br>bound %{y:.1%}<extra></extra>",
            },
            {
                **common,
                "y": list(curve),
                "name": "completed so far",
                "mode": "lines+markers",
                "fill": "tozeroy",
                "fillcolor": "rgba(20,184,166,0.15)",
                "line": {"width": 3, "color": "#14b8a6"},
                "marker": {"size": 7},
                "hovertemplate": "%{text}<br>%{y:.1%} of episodes<extra></extra>",
            },
        ],
        "layout": {
            "height": 340,
            "yaxis": {
                "range": [0, 1.04],
                "tickformat": ".0%",
                "title": {"text": "episodes"},
            },
            "xaxis": {"type": "category", "tickangle": -40},
            "legend": {"orientation": "h", "y": 1.14},
        },
    }


def labels_figure(
    counts: Mapping[str, Counter[str]], order: Sequence[str] = ()
) -> Figure:
    """Stacked bars with the fraction of every trajectory label, per kind of subtask or per name in ``order``."""
    kinds = [kind for kind in order or SUBTASKS if kind in counts]
    totals = {kind: sum(counts[kind].values()) for kind in kinds}
    labels = sorted({label for kind in kinds for label in counts[kind]}, key=_label_order)
    used: Counter[str] = Counter()
    data = []
    for label in labels:
        marker = _label_marker(tone(label), used[tone(label)])
        used[tone(label)] += 1
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "name": label.replace("_", " "),
                "y": [f"{kind} ({totals[kind]})" for kind in kinds],
                "x": [counts[kind][label] / totals[kind] for kind in kinds],
                "customdata": [counts[kind][label] for kind in kinds],
                "marker": marker,
                "hovertemplate": f"{label}<br>%{{customdata}} of %{{y}}: %{{x:.1%}}<extra></extra>",
            }
        )
    return {
        "data": data,
        "layout": {
            "barmode": "stack",
            "height": 130 + 46 * len(kinds) + 18 * len(labels) // 3,
            "bargap": 0.35,
            "xaxis": {"range": [0, 1.001], "tickformat": ".0%"},
            "yaxis": {"autorange": "reversed"},
            # By default plotly hides the legend if there is only one label.
            "showlegend": True,
            "legend": {"orientation": "h", "y": -0.18, "traceorder": "normal"},
        },
    }


def _label_marker(label_tone: str, number: int) -> dict[str, Any]:
    """Colour and hatching of a label, the ``number``-th of its tone in a chart."""
    shades = _TONES[label_tone]
    rounds, shade = divmod(number, len(shades))
    marker: dict[str, Any] = {"color": shades[shade]}
    if rounds:
        shape = _PATTERNS[rounds % len(_PATTERNS)]
        marker["pattern"] = {"shape": shape, "fillmode": "overlay", "size": 7}
    return marker


def _label_order(label: str) -> tuple[int, str]:
    return ("good", "fair", "bad").index(tone(label)), label


def force_figure(record: EpisodeRecord) -> Figure:
    """Robot force in every control step, and its sum within the subtask with the limit.

    Forces of a tainted episode that are not finite are gaps, as are the sums from there on.
    """
    limits = force_limits()
    force = np.asarray(record.force, float)
    data: list[dict[str, Any]] = []
    drawn: set[str] = set()
    # Without any force the axis still needs a length.
    highest = 1.0
    for kind, target, start, end in _spans(record):
        steps = list(range(start + 1, end + 1))
        total = np.cumsum(force[start:end])
        highest = max(highest, float(total[np.isfinite(total)].max(initial=0.0)))
        name = f"{kind} {target}"
        common = {"type": "scatter", "mode": "lines", "x": steps, "legendgroup": kind}
        color = kind_color(kind)
        fill = {"fill": "tozeroy", "line": {"color": color, "width": 1}}
        top = {
            "y": _with_gaps(force[start:end]),
            "name": kind,
            # A kind that comes twice in a chain needs one entry in the legend.
            "showlegend": kind not in drawn,
            **fill,
        }
        top["hovertemplate"] = f"{name}<br>step %{{x}}: %{{y:.1f}} N<extra></extra>"
        low = {
            "y": _with_gaps(np.round(total, 1)),
            "showlegend": False,
            "yaxis": "y2",
            "line": {"color": color, "width": 2},
        }
        low["hovertemplate"] = (
            f"{name}<br>sum up to step %{{x}}: %{{y:.0f}}<extra></extra>"
        )
        data += [{**common, **top}, {**common, **low}]
        drawn.add(kind)
        limit = limits.get(kind, math.inf)
        if math.isfinite(limit):
            data.append(_limit_line(start, end, limit, "limit" not in drawn))
            drawn.add("limit")
            highest = max(highest, limit)
    return {"data": data, "layout": _force_layout(record.steps, highest)}


def _with_gaps(values: np.ndarray) -> list[float | None]:
    """Values for a chart; None, which JSON has, for those that are not finite."""
    return [float(value) if np.isfinite(value) else None for value in values]


def _spans(record: EpisodeRecord) -> list[tuple[str, str, int, int]]:
    """Kind, target, start and end step of every span; steps after the last finished subtask form the last span."""
    spans = [
        (s.kind, s.target, s.start_step, min(s.end_step, record.steps))
        for s in record.subtasks
    ]
    last = max((end for *_, end in spans), default=0)
    if last < record.steps:
        spans.append(("unfinished", "", last, record.steps))
    return [span for span in spans if span[3] > span[2]]


def _limit_line(start: int, end: int, limit: float, legend: bool) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "x": [start, end],
        "y": [limit, limit],
        "yaxis": "y2",
        "name": "limit of the sum",
        "legendgroup": "limit",
        "showlegend": legend,
        "line": {"color": "#dc2626", "width": 2, "dash": "dash"},
        "hovertemplate": f"limit {limit:.0f}<extra></extra>",
    }


def _force_layout(steps: int, highest: float) -> dict[str, Any]:
    return {
        "height": 460,
        "xaxis": {
            "title": {"text": "control step (20 per second)"},
            "range": [0, max(steps, 1)],
            "anchor": "y2",
        },
        "yaxis": {
            "title": {"text": "force [N]"},
            "domain": [0.56, 1.0],
            "rangemode": "tozero",
        },
        "yaxis2": {
            "title": {"text": "sum [N x steps]"},
            "domain": [0.0, 0.46],
            "range": [0, 1.08 * highest],
        },
        "legend": {"orientation": "h", "y": 1.12},
    }
