"""The plot of the Interact benchmark: speed over memory, with the points that the paper reports."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from mjhab.reports.pages import Section, render_sections
from mjhab.reports.plots import Figure

PAPER = (
    ("MS-HAB (ManiSkill 3), 4,096 environments", 15.35, 4299.18, 26.36, "#ea580c"),
    ("Habitat 2.0", 22.60, 1397.65, 11.02, "#64748b"),
)
"""Name, memory of the GPU [GB], control steps/s, 95 % confidence (MS-HAB paper Sec. 4: RTX 4090, i9-12900KS)."""


def interact_figure(found: dict[str, Any]) -> Figure:
    """Speed over memory of every point: of the GPU, or of the process where there is none."""
    points = sorted(found["points"], key=lambda point: point["worlds"])
    memory = [
        (p["rss_mb"] if p["device_mb"] is None else p["device_mb"]) / 1024 for p in points
    ]
    ours = {
        "x": memory,
        "y": [p["sps_mean"] for p in points],
        "text": [f"W = {p['worlds']:,}" for p in points],
        "error_y": {"type": "data", "array": [p["sps_ci95"] or 0.0 for p in points]},
        "type": "scatter",
        "mode": "lines+markers+text",
        "textposition": "middle right",
        "line": {"color": "#2563eb"},
        "name": f"mjhab, {found['backend']} on {found['device']}",
    }
    paper = [
        {
            "x": [memory],
            "y": [sps],
            "error_y": {"type": "data", "array": [ci]},
            "name": name,
            "type": "scatter",
            "mode": "markers",
            "marker": {"size": 11, "color": color, "symbol": "diamond"},
        }
        for name, memory, sps, ci, color in PAPER
    ]
    layout = {
        "xaxis": {"title": {"text": "memory [GB]"}, "rangemode": "tozero"},
        "yaxis": {
            "title": {"text": "control steps per second, all worlds"},
            "type": "log",
            "dtick": 1,
        },
        "height": 460,
    }
    return {"data": [ours, *paper], "layout": layout}


def interact_page(found: dict[str, Any], pictures: Mapping[str, np.ndarray]) -> str:
    """The report: the plot, the numbers, what the cameras saw, and what these do not say by themselves.

    Args:
        found: see ``measure_interact``.
        pictures: "rgb" (C, h, w, 3) uint8 and "depth" (C, h, w) float32 [m] of one world, or none.
    """
    cameras = (
        "two 128 x 128 RGB-D pictures in every step" if found["render"] else "no pictures"
    )
    memory = (
        "of the process"
        if found["points"][0]["device_mb"] is None
        else "of the GPU, all processes"
    )
    hint = (
        f"{found['steps']} control steps in {found['home']}, {found['seeds']} runs of each point, {cameras}; whiskers: "
        f"95 % confidence. Memory {memory}, the largest during the runs. The diamonds are what the MS-HAB paper "
        "reports: other scene, other actions, RTX 4090, with pictures."
    )
    if not found["render"]:
        hint += " Without pictures the two do not compare."
    sections = [
        Section("Speed over memory", hint, chart="interact"),
        Section("Numbers", _STAGES_HINT, columns=_HEADS, rows=_rows(found)),
    ]
    if pictures:
        says = "head and hand, colour and depth"
        sections.append(
            Section(
                "What the cameras see",
                _VIEWS_HINT,
                picture=_strip(pictures),
                picture_says=says,
            )
        )
    plots = {"interact": interact_figure(found)}
    return render_sections("Interact benchmark", sections, plots)


PAPER_PHOTO = (69.9, 19.9)
"""Control steps/s of MS-HAB and of BEHAVIOR-1K with one ray-traced camera of 128 x 128 (App. A.5, RTX 4090)."""
_PHOTO_COLUMNS = {
    "samples": "paths per pixel",
    "sps_mean": "control steps/s",
    "sps_ci95": "± 95 %",
    "reset_and_step_sps": "with the reset",
    "cpu_ms": "cores, together [ms/step]",
    "rss_mb": "process [MB]",
}


def photo_figure(found: dict[str, Any]) -> Figure:
    """Speed over paths per pixel, and what the paper reports."""
    points = sorted(found["points"], key=lambda point: point["samples"])
    samples = [point["samples"] for point in points]
    ours = {
        "x": samples,
        "y": [p["sps_mean"] for p in points],
        "error_y": {"type": "data", "array": [p["sps_ci95"] or 0.0 for p in points]},
        "type": "scatter",
        "mode": "lines+markers",
        "line": {"color": "#2563eb"},
        "name": f"mjhab, {found['variant']}",
    }
    names = ("MS-HAB, RTX 4090", "BEHAVIOR-1K, RTX 4090")
    paper = [
        {
            "x": samples,
            "y": [sps] * len(samples),
            "type": "scatter",
            "mode": "lines",
            "line": {"color": color, "dash": "dash"},
            "name": name,
        }
        for name, sps, (_, _, _, _, color) in zip(names, PAPER_PHOTO, PAPER, strict=True)
    ]
    layout = {
        "xaxis": {
            "title": {"text": "paths per pixel"},
            "type": "log",
            "tickvals": samples,
        },
        "yaxis": {
            "title": {"text": "control steps per second"},
            "type": "log",
            "dtick": 1,
        },
        "height": 460,
    }
    return {"data": [ours, *paper], "layout": layout}


def photo_page(
    found: dict[str, Any], pictures: Mapping[int, Mapping[str, np.ndarray]]
) -> str:
    """The report of ``bench photo``: the plot, the numbers, and what the camera saw.

    Args:
        found: see ``measure_photo``.
        pictures: by paths per pixel "rgb" (1, h, w, 3) uint8 and "depth" (1, h, w) float32 [m].
    """
    hint = (
        f"{found['steps']} control steps in {found['home']}, {found['runs']} runs of each point, one picture of "
        f"{found['size']} x {found['size']} RGB-D in every step; whiskers: 95 % confidence. Dashed: what the MS-HAB "
        "paper reports with its ray tracer."
    )
    points = sorted(found["points"], key=lambda point: point["samples"])
    rows = [
        ["-" if p[key] is None else f"{p[key]:,}" for key in _PHOTO_COLUMNS]
        for p in points
    ]
    heads = [(title, "n") for title in _PHOTO_COLUMNS.values()]
    sections = [
        Section("Speed over paths per pixel", hint, chart="photo"),
        Section("Numbers", "", columns=heads, rows=rows),
    ]
    for samples, images in pictures.items():
        sections.append(
            Section(
                f"{samples} paths per pixel",
                "The last step: colour and depth.",
                picture=_strip(images),
                picture_says=f"colour and depth with {samples} paths per pixel",
            )
        )
    return render_sections(
        "Pictures by the path tracer", sections, {"photo": photo_figure(found)}
    )


_COLUMNS = {
    "worlds": "worlds",
    "sps_mean": "control steps/s",
    "sps_ci95": "± 95 %",
    "reset_and_step_sps": "with the reset",
    "physics_ms": "physics [ms]",
    "render_ms": "pictures [ms]",
    "device_mb": "GPU [MB]",
    "rss_mb": "process [MB]",
    "tainted_worlds": "tainted worlds",
}
_HEADS = [(title, "n") for title in _COLUMNS.values()]
_STAGES_HINT = (
    "Physics and pictures: time of one control step of all worlds, "
    "measured apart after the runs, each waited for."
)
_VIEWS_HINT = (
    "World 0 at the end of those steps: head and hand, colour and depth "
    "(black: 0 m, or nothing; white: 3 m and more)."
)
_DEPTH_WHITE = 3.0
_SCALE = 2


def _rows(found: dict[str, Any]) -> list[list[str]]:
    """Cells of the table, by number of worlds."""
    points = sorted(found["points"], key=lambda point: point["worlds"])
    return [
        ["-" if point[key] is None else f"{point[key]:,}" for key in _COLUMNS]
        for point in points
    ]


def _strip(pictures: Mapping[str, np.ndarray]) -> bytes:
    """All pictures side by side, twice as large, as a PNG file."""
    tiles = []
    for rgb, depth in zip(pictures["rgb"], pictures["depth"], strict=True):
        grey = np.round(255.0 * np.clip(depth / _DEPTH_WHITE, 0.0, 1.0)).astype(np.uint8)
        tiles += [rgb, np.repeat(grey[..., None], 3, axis=2)]
    strip = Image.fromarray(np.concatenate(tiles, axis=1))
    buffer = io.BytesIO()
    # Not smoothed: a reader shall see the pixels that policies get.
    strip.resize(
        (_SCALE * strip.width, _SCALE * strip.height), Image.Resampling.NEAREST
    ).save(buffer, "PNG")
    return buffer.getvalue()
