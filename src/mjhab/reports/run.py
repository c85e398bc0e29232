"""The report of a run: one self-contained HTML file with charts, films and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjhab.core.names import kind_of
from mjhab.reports.metrics import (
    AloneRates,
    labels_by_kind,
    progress_curves,
    rows_by_kind,
    rows_by_position,
    summarize,
    wilson,
)
from mjhab.reports.pages import base64_text, render_page
from mjhab.reports.plots import (
    LABEL_COLORS,
    Figure,
    event_tone,
    force_figure,
    labels_figure,
    progress_figure,
    tone,
)
from mjhab.reports.words import NOT_JUDGED, duration, interval, newtons, percent, spaced
from mjhab.rollout.films import FILM_EVERY, FILM_FPS
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord, skip_counts, skips_text

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
    # Records come in the order in which worlds finished.
    records = sorted(records, key=lambda record: record.index)
    paths = {r.index: film_path(r.index) for r in records} if film_path else {}
    filmed = [r for r in records if r.index in paths and paths[r.index].is_file()]
    by_position = rows_by_position(records)
    plots: dict[str, Figure] = {}
    if records:
        curves = progress_curves(records, alone)
        plots["progress-plot"] = progress_figure(by_position, *curves)
    if counts := labels_by_kind(records):
        plots["labels-plot"] = labels_figure(counts)
    with_force = records[:FORCE_EPISODES]
    return render_page(
        "reports/templates/run.html",
        title=_title(config),
        chips=_chips(records, config),
        banners=_banners(records, config),
        numbers=_numbers(records, summarize(records, seconds, alone)),
        records=records,
        config=config,
        filmed=bool(filmed),
        film_problem=film_problem,
        # Episodes without a film take no room for one: `mjhab eval --films 0` asks for none.
        shown=[
            shown_episode(record, paths.get(record.index))
            for record in filmed or records[:TIMELINES_WITHOUT_FILM]
        ],
        film_steps_per_second=FILM_FPS * FILM_EVERY,
        by_position=by_position,
        by_kind=rows_by_kind(records),
        bounded_by_alone=bool(alone),
        label_colors=LABEL_COLORS,
        with_force=with_force,
        tainted=_tainted(records),
        plots=plots,
        force=[force_figure(record) for record in with_force],
    )


def _title(config: Mapping[str, Any]) -> str:
    what = spaced(str(config.get("task", "run")))
    if config.get("subtask"):
        what = f"{config['subtask']}, {what}"
    return f"{what} by {config.get('policy', 'a policy')}"


def _chips(
    records: Sequence[EpisodeRecord], config: Mapping[str, Any]
) -> list[tuple[str, Any]]:
    homes = len({record.home for record in records})
    names = ("split", "assets", "stage", "seed", "worlds")
    chips = ((key, config.get(key)) for key in names)
    return [("homes", homes), *(chip for chip in chips if chip[1] is not None)]


def _banners(records: Sequence[EpisodeRecord], config: Mapping[str, Any]) -> list[str]:
    """What a reader must know before the numbers."""
    found = []
    wanted = config.get("episodes", len(records))
    if len(records) < wanted:
        found.append(
            f"Partial: {len(records)} of {wanted} episodes are finished. The same command with --resume continues "
            "the run."
        )
    errors = [record.error for record in records if record.error]
    if errors:
        reason, count = Counter(errors).most_common(1)[0]
        found.append(
            f"The policy ended {len(errors)} of {len(records)} episodes with an error; they count as what they had "
            f"reached. {count} of them: {reason}"
        )
    skipped = skip_counts(record.skipped_homes for record in records)
    if skipped:
        found.append(f"Skipped, because they have no room: {skips_text(skipped)}")
    return found


def _numbers(
    records: Sequence[EpisodeRecord], summary: Mapping[str, Any]
) -> list[tuple[str, str, str]]:
    """The main numbers: name, value, and what is told more."""
    total = len(records)
    length = max((len(record.plan) for record in records), default=0)
    # A run that was stopped early has a page before its first episode.
    completed = sum(record.completed for record in records) / max(total, 1)
    steps = sum(record.steps for record in records)
    seconds = summary["seconds"]
    bounds = wilson(sum(record.success_once for record in records), total)
    ended = (subtask for record in records for subtask in record.subtasks)
    teleports = any(subtask.teleported for subtask in ended)
    counted = "mean per episode" + (", teleports included" if teleports else "")
    values = [
        ("episodes", f"{total}", f"{steps:,} control steps"),
        (
            "success once",
            percent(summary["success_once"]),
            interval(*bounds) if total else "",
        ),
        (
            "success at end",
            percent(summary["success_at_end"]),
            "still true in the last step",
        ),
        ("subtasks completed", f"{completed:.1f}", f"of {length}, {counted}"),
        ("tainted episodes", f"{summary['tainted']}", "flagged by the simulation"),
        (
            "wall time",
            f"{seconds:,.0f} s",
            f"{steps / seconds:,.0f} control steps/s" if seconds else "",
        ),
    ]
    if summary["errors"]:
        more = "episodes that the policy could not finish"
        values.append(("errors", f"{summary['errors']}", more))
    return values


def _tainted(records: Sequence[EpisodeRecord]) -> dict[str, list[int]]:
    """Episodes by the simulation's fault flags."""
    found: dict[str, list[int]] = {}
    for record in records:
        for name in record.taint:
            found.setdefault(name, []).append(record.index)
    return found


def shown_episode(
    record: EpisodeRecord, film: Path | None, run: str = ""
) -> dict[str, Any]:
    """What the element ``film`` of pages shows: an episode with its timeline, whose places are in percent of the
    episode, and its film if the file exists; ``run``: its name, on pages of several.
    """
    # An episode that could not begin has no length to divide by.
    steps = max(record.steps, 1)
    outcome = f"{record.completed} of {len(record.plan)} subtasks"
    if record.success_once:
        outcome = f"success after {duration(record.steps_to_success)}"
    return {
        "record": record,
        "title": ": ".join(filter(None, (run, f"Episode {record.index}"))),
        # On a page of several runs the same index comes several times.
        "key": f"{run}{record.index}",
        # Within the page, which is then one file to send or keep.
        "film": base64_text(film.read_bytes()) if film and film.is_file() else "",
        "outcome": outcome,
        "spans": [_span(subtask, steps) for subtask in record.subtasks],
        "events": [
            {
                "step": step,
                "left": 100 * step / steps,
                "name": spaced(name),
                "tone": event_tone(name),
                "subtask": _subtask_of(record, step),
            }
            for step, name in record.events
        ],
    }


def _subtask_of(record: EpisodeRecord, step: int) -> str:
    """The subtask to which a control step belongs, in words."""
    for subtask in record.subtasks:
        if subtask.start_step < step <= subtask.end_step:
            return f"{subtask.kind} {kind_of(subtask.target)}"
    return ""


def _span(subtask: SubtaskRecord, steps: int) -> dict[str, Any]:
    """A subtask in a timeline of ``steps`` control steps."""
    length = subtask.end_step - subtask.start_step
    label = spaced(subtask.label or ("success" if subtask.success_once else "no success"))
    more = f"{NOT_JUDGED if subtask.teleported else label}; {duration(length)}"
    if subtask.success_once and not subtask.teleported:
        more += f", success after {duration(subtask.steps_to_success)}"
    more += (
        f", peak {newtons(subtask.peak_force)} (fingers {newtons(subtask.peak_finger_force)}), "
        f"sum {subtask.cumulative_force:,.0f} N x steps"
    )
    unlabelled = "good" if subtask.success_once else "bad"
    return {
        "step": subtask.start_step,
        "left": 100 * subtask.start_step / steps,
        "width": 100 * length / steps,
        "kind": subtask.kind,
        "name": f"{subtask.index + 1}. {subtask.kind} {kind_of(subtask.target)}",
        "more": more,
        "tone": tone(subtask.label) if subtask.label else unlabelled,
    }
