"""HTML elements of the report. Every text from a record is escaped here."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mjhab.core.names import kind_of
from mjhab.core.timing import STEP_SECONDS
from mjhab.reports.metrics import SubtaskRow, wilson
from mjhab.reports.plots import kind_color, tone
from mjhab.rollout.films import FILM_EVERY, FILM_FPS
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord

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


def event_tone(name: str) -> str:
    """Return ``"good"``, ``"bad"`` or ``"none"`` for the name of an event."""
    if name in _GOOD_EVENTS:
        return "good"
    return "bad" if name in _BAD_EVENTS else "none"


def section(title: str, hint: str, body: str) -> str:
    """A section with a title and one sentence of explanation."""
    return f'<section><h2>{escape(title)}</h2><p class="hint">{escape(hint)}</p>{body}</section>'


def empty(text: str) -> str:
    """A line for an empty section that says why it is empty."""
    return f'<p class="empty">{escape(text)}</p>'


def scrolled(table: str) -> str:
    """A table that scrolls where the page is narrower than it."""
    return f'<div class="scroll">{table}</div>'


def percent(value: float) -> str:
    """A rate in 0..1 as text."""
    return f"{100 * value:.0f} %" if value in (0.0, 1.0) else f"{100 * value:.1f} %"


NOT_JUDGED = "by teleport"
"""In place of rates of subtasks that the environment did itself."""


def duration(steps: float | None) -> str:
    """Control steps as seconds; "-" for None."""
    return "-" if steps is None else f"{steps * STEP_SECONDS:.1f} s"


def newtons(force: float | None) -> str:
    """A force [N] as text; "-" for None."""
    return "-" if force is None else f"{force:,.0f} N"


def cards(records: Sequence[EpisodeRecord], summary: Mapping[str, Any]) -> str:
    """Cards with the main numbers."""
    total = len(records)
    low, high = wilson(sum(record.success_once for record in records), total)
    length = max((len(record.plan) for record in records), default=0)
    completed = sum(record.completed for record in records) / max(total, 1)
    steps = sum(record.steps for record in records)
    seconds = summary["seconds"]
    speed = f"{steps / seconds:,.0f} control steps/s" if seconds else ""
    values = [
        ("episodes", f"{total}", f"{steps:,} control steps"),
        (
            "success once",
            percent(summary["success_once"]),
            f"{100 * low:.0f} to {100 * high:.0f} % (95 % CI)" if total else "",
        ),
        (
            "success at end",
            percent(summary["success_at_end"]),
            "still true in the last step",
        ),
        ("subtasks completed", f"{completed:.1f}", f"of {length}, {_counted(records)}"),
        ("tainted episodes", f"{summary['tainted']}", "flagged by the simulation"),
        ("wall time", f"{seconds:,.0f} s", speed),
    ]
    if summary["errors"]:
        values.append(
            (
                "errors",
                f"{summary['errors']}",
                "episodes that the policy could not finish",
            )
        )
    tiles = (
        f'<div class="card"><div class="name">{escape(name)}</div><div class="value">{escape(value)}</div>'
        f'<div class="more">{escape(more)}</div></div>'
        for name, value, more in values
    )
    return f'<div class="cards">{"".join(tiles)}</div>'


def _counted(records: Sequence[EpisodeRecord]) -> str:
    ended = (subtask for record in records for subtask in record.subtasks)
    teleports = any(subtask.teleported for subtask in ended)
    return "mean per episode" + (", teleports included" if teleports else "")


def _kind(kind: str) -> str:
    return (
        f'<span class="kind" style="background:{kind_color(kind)}"></span>{escape(kind)}'
    )


def _rate_bar(row: SubtaskRow) -> str:
    low, high = row.interval
    return (
        f'<div class="rate" title="{percent(low)} to {percent(high)}"><i style="width:{100 * row.success_once:.1f}%">'
        f'</i><u style="left:{100 * low:.1f}%;width:{100 * (high - low):.1f}%"></u></div>'
    )


def success_table(rows: Sequence[SubtaskRow]) -> str:
    """Success per row with its interval; the first column is the position in the plan, if rows have one."""
    placed = any(row.position is not None for row in rows)
    heads = [("#", "n")] if placed else []
    heads += [
        ("subtask", ""),
        ("target", ""),
        ("reached", "n"),
        ("success once", "n"),
        ("95 % interval", ""),
    ]
    heads += [("at end", "n"), ("time to success", "n"), ("peak force", "n")]
    heads += [("on fingers", "n")]
    head = "".join(f'<th class="{css}">{escape(name)}</th>' for name, css in heads)
    body = []
    for row in rows:
        cells = [
            f'<td class="n">{row.position + 1}</td>' if row.position is not None else ""
        ]
        cells += [
            f"<td>{_kind(row.kind)}</td><td>{escape(row.target)}</td>",
            f'<td class="n">{row.reached}</td>',
        ]
        if row.reached and row.judged:
            cells += [
                f'<td class="n">{percent(row.success_once)}</td><td>{_rate_bar(row)}</td>',
                f'<td class="n">{percent(row.success_at_end)}</td>',
                f'<td class="n">{duration(row.steps_to_success)}</td>',
                f'<td class="n">{newtons(row.peak_force)}</td>',
                f'<td class="n">{newtons(row.peak_finger_force)}</td>',
            ]
        else:
            shown = NOT_JUDGED if row.reached else "-"
            cells += [f'<td class="n">{shown}</td><td></td>', '<td class="n">-</td>' * 4]
        body.append(f"<tr>{''.join(cells)}</tr>")
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    return scrolled(table)


def film(record: EpisodeRecord, path: Path | None) -> str:
    """One episode: its film if ``path`` exists, its timeline, and the list of its events.

    Episodes without a film take no room for one: `mjhab eval --films 0` asks for none.
    """
    name = f"film-{record.index}"
    if path is not None and path.is_file():
        data = base64.b64encode(path.read_bytes()).decode("ascii")
        view = f'<video controls muted playsinline preload="metadata" data-film="{name}"></video>'
        view += f'<script type="text/plain" id="{name}">{data}</script>'
        hint = "Click a stretch or a mark of the timeline to jump there."
    else:
        view = ""
        hint = "Click a stretch or a mark of the timeline to read what it is."
    outcome = (
        f"success after {duration(record.steps_to_success)}"
        if record.success_once
        else f"{record.completed} of {len(record.plan)} subtasks"
    )
    flags = f", tainted: {escape(', '.join(record.taint))}" if record.taint else ""
    return (
        f'<figure class="film" data-steps="{record.steps}" data-steps-per-second="{FILM_FPS * FILM_EVERY}">'
        f"<h3>Episode {record.index} <small>in {escape(record.home)}: {escape(outcome)}, "
        f"{duration(record.steps)} in all{flags}</small></h3>"
        f'{view}{_timeline(record)}<p class="now">{hint}</p>{_event_list(record)}</figure>'
    )


def _timeline(record: EpisodeRecord) -> str:
    steps = max(record.steps, 1)
    parts = [_span(subtask, steps) for subtask in record.subtasks]
    for step, name in record.events:
        css = event_tone(name)
        title = f"{name.replace('_', ' ')} at {step * STEP_SECONDS:.1f} s (step {step})"
        place = f"left:{100 * step / steps:.2f}%"
        parts.append(
            f'<button type="button" class="tick {css}" style="{place}" data-step="{step}" title="{escape(title)}" '
            f'aria-label="{escape(title)}"></button>'
        )
    return f'<div class="timeline">{"".join(parts)}<div class="playhead"></div></div>'


def _span(subtask: SubtaskRecord, steps: int) -> str:
    left = 100 * subtask.start_step / steps
    width = 100 * (subtask.end_step - subtask.start_step) / steps
    title = f"{subtask.index + 1}. {subtask.kind} {kind_of(subtask.target)}"
    label = (
        subtask.label or ("success" if subtask.success_once else "no success")
    ).replace("_", " ")
    if subtask.teleported:
        label = NOT_JUDGED
    more = f"{label}; {duration(subtask.end_step - subtask.start_step)}"
    if subtask.success_once and not subtask.teleported:
        more += f", success after {duration(subtask.steps_to_success)}"
    more += (
        f", peak {newtons(subtask.peak_force)} (fingers {newtons(subtask.peak_finger_force)}), "
        f"sum {subtask.cumulative_force:,.0f} N x steps"
    )
    css = (
        tone(subtask.label)
        if subtask.label
        else ("good" if subtask.success_once else "bad")
    )
    return (
        f'<button type="button" class="span {css}" style="left:{left:.2f}%;width:{width:.2f}%" '
        f'data-step="{subtask.start_step}" data-name="{escape(title)}" data-more="{escape(more)}" '
        f'title="{escape(f"{title}: {more}")}">{escape(subtask.kind)}</button>'
    )


def _event_list(record: EpisodeRecord) -> str:
    rows = []
    for step, name in record.events:
        owner = next(
            (s for s in record.subtasks if s.start_step < step <= s.end_step), None
        )
        where = f"{owner.kind} {kind_of(owner.target)}" if owner else ""
        rows.append(
            f'<tr data-step="{step}"><td class="n">{step * STEP_SECONDS:.1f} s</td><td class="n">{step}</td>'
            f"<td>{escape(where)}</td><td>{escape(name.replace('_', ' '))}</td></tr>"
        )
    if not rows:
        return ""
    head = '<tr><th class="n">time</th><th class="n">step</th><th>subtask</th><th>event</th></tr>'
    table = f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"
    return f'<details><summary>{len(rows)} events</summary><div class="scroll">{table}</div></details>'


def episode_table(records: Sequence[EpisodeRecord]) -> str:
    """One line per episode; clicking a column head sorts the table."""
    heads = "".join(
        f'<th class="{css}">{name}</th>'
        for name, css in (
            ("episode", "n"),
            ("home", ""),
            ("completed", "n"),
            ("success", ""),
            ("last subtask", ""),
            ("its label", ""),
            ("steps", "n"),
            ("to success", "n"),
            ("peak force", "n"),
            ("on fingers", "n"),
            ("flags", ""),
        )
    )
    body = "".join(_episode_row(record) for record in records)
    table = f'<table class="sortable"><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>'
    return scrolled(table)


def _episode_row(record: EpisodeRecord) -> str:
    last = record.subtasks[-1] if record.subtasks else None
    label = (last.label or "") if last else ""
    success = (
        "at end" if record.success_at_end else "once" if record.success_once else "no"
    )
    css = "good" if record.success_at_end else "fair" if record.success_once else "bad"
    fingers = "" if record.peak_finger_force is None else record.peak_finger_force
    return (
        f'<tr><td class="n">{record.index}</td><td>{escape(record.home)}</td>'
        f'<td class="n" data-value="{record.completed}">{record.completed} / {len(record.plan)}</td>'
        f'<td><span class="dot {css}"></span>{success}</td>'
        f"<td>{escape(f'{last.kind} {kind_of(last.target)}' if last else '')}</td>"
        f'<td><span class="dot {tone(label)}"></span>{escape(label.replace("_", " "))}</td>'
        f'<td class="n">{record.steps}</td>'
        f'<td class="n" data-value="{record.steps_to_success or ""}">{record.steps_to_success or "-"}</td>'
        f'<td class="n" data-value="{record.peak_force}">{newtons(record.peak_force)}</td>'
        f'<td class="n" data-value="{fingers}">{newtons(record.peak_finger_force)}</td>'
        f"<td>{escape(', '.join(filter(None, (*record.taint, record.error))))}</td></tr>"
    )


def taint_table(records: Sequence[EpisodeRecord]) -> str:
    """Table of the simulation's fault flags and the episodes that have them."""
    by_name: dict[str, list[int]] = {}
    for record in records:
        for name in record.taint:
            by_name.setdefault(name, []).append(record.index)
    if not by_name:
        return empty("No episode was flagged.")
    rows = "".join(
        f'<tr><td>{escape(name)}</td><td class="n">{len(indices)}</td><td>{_indices(indices)}</td></tr>'
        for name, indices in sorted(by_name.items())
    )
    head = '<tr><th>flag</th><th class="n">episodes</th><th>which</th></tr>'
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'


def _indices(indices: Sequence[int]) -> str:
    shown = ", ".join(str(index) for index in indices[:12])
    return shown + (f" and {len(indices) - 12} more" if len(indices) > 12 else "")


def config_list(config: Mapping[str, Any]) -> str:
    """Every resolved option of the run."""
    items = "".join(
        f"<div><dt>{escape(key)}</dt><dd>{escape('-' if value is None else str(value))}</dd></div>"
        for key, value in config.items()
    )
    return f'<dl class="config">{items}</dl>'
