"""Histograms of the forces in a data set."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.reports.plots import Figure, force_limits
from mjhab.rollout.records import SubtaskRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

SAFE_FORCE_N = 1400.0
"""Force allowed by an industrial safety limit, as discussed in the MS-HAB paper (Sec. 6) [N].

It is held against the largest force of a control step; `bench experts` holds it against the sum of an episode, too.
"""
_COLORS = {"success": "#16a34a", "failure": "#dc2626"}
_BINS = 32


def force_plots(subtasks: Sequence[SubtaskRecord]) -> dict[str, Figure]:
    """Figures by element id: peak force, of robot and fingers, and cumulative force of every kind of subtask."""
    limits = force_limits()
    figures: dict[str, Figure] = {}
    for kind in SUBTASKS:
        members = [subtask for subtask in subtasks if subtask.kind == kind]
        if not members:
            continue
        figures[f"peak-{kind}"] = _histogram(
            members,
            lambda s: s.peak_force,
            f"{kind}: largest force of a step [N]",
            {"1,400 N": SAFE_FORCE_N},
        )
        with_fingers = [s for s in members if s.peak_finger_force is not None]
        if with_fingers:
            figures[f"fingers-{kind}"] = _histogram(
                with_fingers,
                lambda s: s.peak_finger_force or 0.0,
                f"{kind}: largest force of a step on both fingers [N]",
                {"1,400 N": SAFE_FORCE_N},
            )
        limit = limits[kind]
        lines = {f"limit {limit:,.0f}": limit} if np.isfinite(limit) else {}
        name = f"{kind}: sum of forces [N x steps]"
        figures[f"sum-{kind}"] = _histogram(
            members, lambda s: s.cumulative_force, name, lines
        )
    return figures


def _histogram(
    members: Sequence[SubtaskRecord],
    value: Callable[[SubtaskRecord], float],
    title: str,
    lines: Mapping[str, float],
) -> Figure:
    """Stacked histogram on a logarithmic axis; the first bin holds all values up to 1 N.

    Values of tainted episodes that are not finite are left out; the title tells their number.
    """
    forces = np.array([value(member) for member in members])
    finite = np.isfinite(forces)
    if not finite.all():
        title += f", {int((~finite).sum())} not finite"
    # No force at all has no logarithm.
    values = np.log10(np.maximum(forces[finite], 1.0))
    good = np.array([member.success_once for member in members])[finite]
    largest = float(values.max(initial=0.0))
    top = max(largest, *(np.log10(line) for line in lines.values()), 1.0) * 1.02
    edges = np.linspace(0.0, top, _BINS + 1)
    data = []
    for name, mask in (("success", good), ("failure", ~good)):
        counts = np.histogram(values[mask], edges)[0]
        hover = [
            f"{10**low:,.0f} to {10**high:,.0f}"
            for low, high in itertools.pairwise(edges)
        ]
        data.append(
            {
                "type": "bar",
                "name": name,
                "x": ((edges[1:] + edges[:-1]) / 2).tolist(),
                "y": counts.tolist(),
                "width": float(edges[1]) * 0.94,
                "marker": {"color": _COLORS[name]},
                "text": hover,
                # The text is for the pointer; on the bars it would be unreadable.
                "textposition": "none",
                "hovertemplate": f"%{{y}} {name}<br>%{{text}}<extra></extra>",
            }
        )
    return {"data": data, "layout": _layout(title, top, lines)}


def _layout(title: str, top: float, lines: Mapping[str, float]) -> dict[str, Any]:
    ticks = list(range(int(top) + 1))
    marks = {name: float(np.log10(line)) for name, line in lines.items()}
    dash = {"color": "#94a3b8", "width": 2, "dash": "dash"}
    return {
        "height": 250,
        "barmode": "stack",
        "xaxis": {
            "title": {"text": title},
            "range": [-0.05, top],
            "tickvals": ticks,
            "ticktext": ["≤ 1", *(f"{10**tick:,}" for tick in ticks[1:])],
        },
        "yaxis": {"title": {"text": "subtasks"}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "y": 1.16, "traceorder": "normal"},
        "shapes": [
            {
                "type": "line",
                "x0": x,
                "x1": x,
                "yref": "paper",
                "y0": 0,
                "y1": 1,
                "line": dash,
            }
            for x in marks.values()
        ],
        "annotations": [
            {
                "x": x,
                "y": 1,
                "yref": "paper",
                "text": name,
                "showarrow": False,
                "xanchor": "right",
                "xshift": -4,
            }
            for name, x in marks.items()
        ],
    }
