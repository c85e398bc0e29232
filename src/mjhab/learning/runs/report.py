"""The report of a training run: one HTML file without external resources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.learning.runs.run import EVALUATIONS, TrainingFolder
from mjhab.reports.compared.page import flat
from mjhab.reports.compared.trainings import curve_figure, success_curves, with_minutes
from mjhab.reports.metrics import labels_by_kind, rows_by_kind
from mjhab.reports.pages import base64_text, render_page
from mjhab.reports.plots import Figure, labels_figure
from mjhab.reports.words import interval, percent
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.store import FILMS

LINE = "#14b8a6"
"""Colour of the loss curve."""


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
        "time-plot": success_curves(with_minutes(rows), "minutes"),
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
    return curve_figure([trace], "samples", {"title": {"text": "loss"}})


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
        # In the page itself, so that one file can be sent around.
        found[caption] = base64_text(path.read_bytes())
    return found
