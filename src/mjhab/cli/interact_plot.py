"""The plot of the Interact benchmark: speed over memory, with the points that the paper reports."""

from __future__ import annotations

from typing import Any

from mjhab.rollout.report import render_page
from mjhab.rollout.report_parts import section
from mjhab.rollout.report_plots import Figure

PAPER = (
    ("MS-HAB (ManiSkill 3), 4,096 environments", 15.35, 4299.18, 26.36, "#ea580c"),
    ("Habitat 2.0", 22.60, 1397.65, 11.02, "#64748b"),
)
"""Name, memory of the GPU [GB], control steps/s, 95 % confidence (MS-HAB paper Sec. 4: RTX 4090, i9-12900KS)."""


def interact_figure(found: dict[str, Any]) -> Figure:
    """Speed over memory of every point: of the GPU, or of the process where there is none."""
    points = sorted(found["points"], key=lambda point: point["worlds"])
    memory = [(p["rss_mb"] if p["device_mb"] is None else p["device_mb"]) / 1024 for p in points]
    ours = {
        "x": memory, "y": [p["sps_mean"] for p in points], "text": [f"{p['worlds']} worlds" for p in points],
        "error_y": {"type": "data", "array": [p["sps_ci95"] or 0.0 for p in points]}, "type": "scatter",
        "mode": "lines+markers", "name": f"mjhab, {found['backend']} on {found['device']}",
        "line": {"color": "#2563eb"},
    }  # fmt: skip
    paper = [
        {
            "x": [memory], "y": [sps], "error_y": {"type": "data", "array": [ci]}, "name": name, "type": "scatter",
            "mode": "markers", "marker": {"size": 11, "color": color, "symbol": "diamond"},
        }
        for name, memory, sps, ci, color in PAPER
    ]  # fmt: skip
    layout = {
        "xaxis": {"title": {"text": "memory [GB]"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "control steps per second, all worlds"}, "type": "log"},
        "height": 460,
    }
    return {"data": [ours, *paper], "layout": layout}


def interact_page(found: dict[str, Any]) -> str:
    """The report: the plot and what it does not say by itself."""
    cameras = "two 128 x 128 RGB-D pictures in every step" if found["render"] else "no pictures"
    memory = "of the process" if found["points"][0]["device_mb"] is None else "of the GPU, all processes"
    hint = (
        f"{found['steps']} control steps in {found['home']}, {found['seeds']} runs of each point, {cameras}; whiskers: "
        f"95 % confidence. Memory {memory}, the largest during the runs. The diamonds are what the MS-HAB paper "
        "reports: other scene, other actions, RTX 4090, with pictures."
    )
    if not found["render"]:
        hint += " Without pictures the two do not compare."
    body = "<h1>Interact benchmark</h1>" + section("Speed over memory", hint, '<div id="interact"></div>')
    return render_page("Interact benchmark", body, {"plots": {"interact": interact_figure(found)}, "force": []})
