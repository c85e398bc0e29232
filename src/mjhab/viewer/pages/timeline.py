"""SVG and HTML of the page: time line of an episode (events, subtasks, actors), plan, forces, reward terms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from itertools import groupby

from mjhab.core.timing import STEP_SECONDS
from mjhab.reports.plots import event_tone, kind_color
from mjhab.viewer.sources.track import Track

WIDTH = 600
"""Width of the drawing, that of its panel [px], so that its letters have their size."""
BAR_HEIGHT = 22
EVENT_HEIGHT = 14
ACTOR_HEIGHT = 6
HEIGHT = EVENT_HEIGHT + BAR_HEIGHT + ACTOR_HEIGHT
TONE_COLORS = {"good": "#16a34a", "bad": "#dc2626", "none": "#64748b"}
NOW_COLOR = "#c026d3"
"""The line of the step that is shown; page.js of exported pages has the same."""
GAUGE_COLOR = "#3b82f6"
ACTOR_COLORS = ("#cbd5e1", "#f472b6", "#38bdf8", "#a3e635", "#fb923c")
MIN_NAMED_SHARE = 0.06
"""Subtasks that take a smaller fraction of the time line's width are not labelled."""


def timeline_svg(track: Track, now: float) -> str:
    """Draw the time line as SVG, with a cursor at control step ``now``.

    From top to bottom: events, subtasks, actors (whose legend is `actors_html`), all with tooltips.
    """
    scale = WIDTH / max(track.last, 1)
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" style="display:block;font:11px system-ui">'
    ]
    parts += _subtasks(track, scale)
    parts += _actors(track, scale)
    for step, name in track.events:
        color = TONE_COLORS[event_tone(name)]
        x = step * scale
        title = f"{name.replace('_', ' ')}, step {step} ({step * STEP_SECONDS:.2f} s)"
        parts.append(
            f'<path d="M{x:.1f} {EVENT_HEIGHT} l-4 -10 h8 z" fill="{color}"><title>{escape(title)}</title></path>'
        )
    x = now * scale
    parts.append(
        f'<path d="M{x:.1f} 0 V{HEIGHT}" stroke="{NOW_COLOR}" stroke-width="2"/></svg>'
    )
    return "".join(parts)


def subtask_spans(track: Track) -> list[tuple[int, int, int]]:
    """Compute (index in the plan, first state, last state) of the subtasks, in the order in which they were active."""
    spans: list[tuple[int, int, int]] = []
    start = 0
    for index, moments in groupby(moment.active for moment in track.moments):
        count = sum(1 for _ in moments)
        if index < len(track.plan):
            spans.append((index, start, start + count - 1))
        start += count
    return spans


def _subtasks(track: Track, scale: float) -> list[str]:
    parts = []
    for index, start, end in subtask_spans(track):
        color = kind_color(track.plan[index].kind)
        name = track.describe(index)
        width = max((end - start + 1) * scale, 1.0)
        title = f"{name}: {track.ended.get(index, 'running').replace('_', ' ')}"
        x = start * scale
        parts.append(
            f'<rect x="{x:.1f}" y="{EVENT_HEIGHT}" width="{width:.1f}" height="{BAR_HEIGHT}" rx="3" fill="{color}">'
            f"<title>{escape(title)}</title></rect>"
        )
        if width > MIN_NAMED_SHARE * WIDTH:
            y = EVENT_HEIGHT + 15
            parts.append(
                f'<svg x="{x:.1f}" y="0" width="{width:.1f}" height="{HEIGHT}">'
                f'<text x="5" y="{y}" fill="white" pointer-events="none">{escape(name)}</text></svg>'
            )
    return parts


def actor_colors(track: Track) -> dict[str, str]:
    """Choose the colour of each actor of an episode in the time line, by name."""
    names = track.actors()
    return {name: ACTOR_COLORS[k % len(ACTOR_COLORS)] for k, name in enumerate(names)}


def _actors(track: Track, scale: float) -> list[str]:
    colors = actor_colors(track)
    parts = []
    start = 0
    for name, run in groupby(moment.actor for moment in track.moments[1:]):
        count = sum(1 for _ in run)
        color = colors[name]
        parts.append(
            f'<rect x="{start * scale:.1f}" y="{EVENT_HEIGHT + BAR_HEIGHT}" width="{count * scale:.1f}" '
            f'height="{ACTOR_HEIGHT}" fill="{color}"><title>{escape(name)} acts</title></rect>'
        )
        start += count
    return parts


def actors_html(track: Track, step: int) -> str:
    """Write the legend of the actors; the actor of the control step that led to a state is bold."""
    acted = track.moments[step].actor
    marks = []
    for name, color in actor_colors(track).items():
        weight = "700" if name == acted else "400"
        marks.append(
            f'<span style="font-weight:{weight};margin-right:10px"><i style="display:inline-block;width:10px;'
            f'height:10px;border-radius:2px;background:{color};margin-right:4px"></i>{escape(name)}</span>'
        )
    return f'<div style="font-size:12px;padding:0 8px">{"".join(marks)}</div>'


def about_html(track: Track, step: int) -> str:
    """Write title, instruction, instruction of the subtask that is active in a state, and home of an episode."""
    lines = [f"<b>{escape(track.title)}</b>"]
    if track.instruction:
        lines.append(f"“{escape(track.instruction)}”")
    now = track.instruction_of(track.moments[step].active)
    if now not in ("", track.instruction):
        lines.append(f"now: “{escape(now)}”")
    lines.append(f"<small>home {escape(track.home)}</small>")
    return f'<div style="padding:0 8px">{"<br>".join(lines)}</div>'


def plan_html(track: Track, step: int) -> str:
    """Write the plan as a list that marks which subtasks are done, active and to come in a state."""
    active = track.moments[step].active
    rows = []
    for index, entry in enumerate(track.plan):
        color = kind_color(entry.kind)
        sign = "✓" if index < active else "▶" if index == active else "·"
        weight = "700" if index == active else "400"
        fade = "" if index <= active else "opacity:.6;"
        label = track.ended.get(index, "") if index <= active else ""
        note = f" <small>{escape(label.replace('_', ' '))}</small>" if label else ""
        rows.append(
            f'<li style="font-weight:{weight};{fade}border-left:4px solid {color};padding-left:6px;margin:2px 0">'
            f"{sign} {escape(track.describe(index))}{note}</li>"
        )
    over = (
        f'<p style="margin:4px 0"><b>Ended: {escape(track.over)}</b></p>'
        if track.over
        else ""
    )
    style = "list-style:none;margin:0;padding:0;font-size:13px"
    return f'<ul style="{style}">{"".join(rows)}</ul>{over}'


def gauge_html(name: str, value: float, limit: float, unit: str) -> str:
    """Write a bar that shows a value against its limit (infinite: no limit), red above 80 %."""
    share = 0.0 if math.isinf(limit) else min(value / max(limit, 1e-9), 1.0)
    color = TONE_COLORS["bad"] if share > 0.8 else GAUGE_COLOR
    of = "no limit" if math.isinf(limit) else f"of {limit:,.0f}"
    return (
        f'<div style="font-size:12px;margin:3px 0">{escape(name)}: <b>{value:,.0f}</b> {of} {escape(unit)}'
        f'<div style="background:#8883;height:6px;border-radius:3px"><div style="width:{100 * share:.1f}%;height:6px;'
        f'border-radius:3px;background:{color}"></div></div></div>'
    )


def terms_html(terms: Mapping[str, float], total: float) -> str:
    """Write the reward of a step and its terms, as bars to the right (positive) and left (negative) of zero."""
    if not terms:
        text = f"reward {total:.3f}; no terms in this state"
        return f'<p style="font-size:12px;margin:2px 0">{text}</p>'
    most = max(1e-9, *(abs(value) for value in terms.values()))
    rows = [f'<p style="font-size:12px;margin:2px 0">reward <b>{total:.3f}</b></p>']
    for name, value in terms.items():
        share = 50.0 * abs(value) / most
        left = 50.0 if value >= 0 else 50.0 - share
        color = TONE_COLORS["good" if value >= 0 else "bad"]
        rows.append(
            f'<div style="font-size:11px;display:flex;gap:6px"><span style="width:45%">{escape(name)}</span>'
            f'<span style="width:35%;position:relative;background:#8882"><i style="position:absolute;left:{left:.1f}%;'
            f'width:{share:.1f}%;height:100%;background:{color}"></i></span><span>{value:.3f}</span></div>'
        )
    return "".join(rows)
