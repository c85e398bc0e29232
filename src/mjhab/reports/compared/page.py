"""The page of `mjhab compare`: runs in the same episodes, or training runs in one chart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mjhab.reports.compared.paired import Paired, paired
from mjhab.reports.compared.trainings import curves_of_runs, with_minutes
from mjhab.reports.metrics import mean, wilson
from mjhab.reports.pages import Section, render_page, render_sections
from mjhab.reports.plots import Figure
from mjhab.reports.run import shown_episode
from mjhab.rollout.films import FILM_EVERY, FILM_FPS
from mjhab.rollout.records import EpisodeRecord

MOST_FILMED = 4
"""Number of episodes whose films stand side by side; a film of a whole task takes megabytes."""


@dataclass(frozen=True)
class ComparedRun:
    """An evaluation that is compared.

    Attributes:
        name: what it is called on the page and in the pairs.
        config: its options, one by one, see `flat`.
        records: its finished episodes.
        films: films by index of the episode, those that exist.
    """

    name: str
    config: Mapping[str, Any]
    records: Sequence[EpisodeRecord]
    films: Mapping[int, Path]

    @cached_property
    def by_index(self) -> dict[int, EpisodeRecord]:
        """Episodes by index."""
        return {record.index: record for record in self.records}

    @property
    def success_once(self) -> float:
        """Share of its episodes that it does."""
        return mean(record.success_once for record in self.records)

    @property
    def bounds(self) -> tuple[float, float]:
        """Wilson 95 % interval of ``success_once``."""
        won = sum(record.success_once for record in self.records)
        return wilson(won, len(self.records))


@dataclass(frozen=True)
class Pair:
    """Two runs by name, and what `paired` says of them."""

    a: str
    b: str
    found: Paired


def flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Flatten nested mappings; names are joined by dots."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{before}{name}.")
        else:
            found[f"{before}{name}"] = value
    return found


def pairs_of(runs: Sequence[ComparedRun]) -> list[Pair]:
    """Every run after the first one, paired with the first."""
    first = runs[0]
    return [
        Pair(first.name, run.name, paired(first.records, run.records)) for run in runs[1:]
    ]


def differing(configs: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[Any]]]:
    """Options that are not the same in all configurations, with the value in each ("-" where it is missing)."""
    names = dict.fromkeys(name for config in configs for name in config)
    values = {name: [config.get(name, "-") for config in configs] for name in names}
    return [
        (name, row) for name, row in values.items() if any(one != row[0] for one in row)
    ]


def render_comparison(
    runs: Sequence[ComparedRun], pairs: Sequence[Pair], cautions: Sequence[str] = ()
) -> str:
    """Return the page about two or more evaluations; ``cautions``: what a reader must know before the numbers."""
    first = runs[0]
    names = ("task", "subtask", "target", "split", "seed", "profile")
    chips = [(name, first.config.get(name)) for name in names]
    return render_page(
        "reports/templates/compared.html",
        title=" against ".join((first.name, ", ".join(run.name for run in runs[1:]))),
        chips=[chip for chip in chips if chip[1] not in (None, "")],
        banners=cautions,
        numbers=[_card(pair) for pair in pairs],
        pairs=[_row(pair) for pair in pairs],
        filmed=_side_by_side(runs, pairs),
        film_steps_per_second=FILM_FPS * FILM_EVERY,
        heads_of_runs=[(run.name, "words") for run in runs],
        differing=differing([run.config for run in runs]),
        plots={"rates-plot": rates_figure(runs)},
    )


def _card(pair: Pair) -> tuple[str, str, str]:
    found = pair.found
    more = f"{points(*found.interval)}, p = {found.p:.3g}, {found.episodes} episodes"
    return f"{pair.b} minus {pair.a}", points(found.difference), more


def points(*values: float) -> str:
    """Differences of rates as text: "+4.0" or "-2.0 to +11.0 points"."""
    return f"{' to '.join(f'{100 * value:+.1f}' for value in values)} points"


def _row(pair: Pair) -> dict[str, Any]:
    found = pair.found
    counts = [found.episodes, found.both, len(found.only_a), len(found.only_b)]
    told = [points(found.difference), points(*found.interval), f"{found.p:.3g}"]
    return {
        "a": pair.a,
        "b": pair.b,
        "cells": [*counts, found.neither, *told],
        "only_a": found.only_a,
        "only_b": found.only_b,
        "labels": found.labels,
    }


def _side_by_side(
    runs: Sequence[ComparedRun], pairs: Sequence[Pair]
) -> list[list[dict[str, Any]]]:
    """Films of the first episodes with different outcomes, one row per episode with the films of all runs."""
    split = {i for pair in pairs for i in (*pair.found.only_a, *pair.found.only_b)}
    filmed = [i for i in sorted(split) if sum(i in run.films for run in runs) > 1]
    return [
        [
            shown_episode(run.by_index[index], run.films[index], run.name)
            for run in runs
            # A run that is not finished has films without their records, or records without films.
            if index in run.films and index in run.by_index
        ]
        for index in filmed[:MOST_FILMED]
    ]


def rates_figure(runs: Sequence[ComparedRun]) -> Figure:
    """Success once of every run with its interval."""
    told = [f"{run.name} ({len(run.records)})" for run in runs]
    return bars(told, [run.success_once for run in runs], [run.bounds for run in runs])


def bars(
    names: Sequence[str], rates: Sequence[float], bounds: Sequence[tuple[float, float]]
) -> Figure:
    """Rates in 0..1 as bars to the right, one below the other, with the whiskers of their intervals."""
    up = [max(high - rate, 0.0) for rate, (_, high) in zip(rates, bounds, strict=True)]
    down = [max(rate - low, 0.0) for rate, (low, _) in zip(rates, bounds, strict=True)]
    error = {"type": "data", "symmetric": False, "array": up, "arrayminus": down}
    trace = {
        "type": "bar",
        "orientation": "h",
        "y": list(names),
        "x": list(rates),
        "error_x": {**error, "thickness": 1.5},
        "marker": {"color": "#14b8a6"},
        "hovertemplate": "%{y}: %{x:.1%}<extra></extra>",
    }
    layout = {
        "height": 90 + 40 * len(names),
        "bargap": 0.4,
        # A range to 1 would cut half of the line of a full bar.
        "xaxis": {"range": [0, 1.001], "tickformat": ".0%"},
        # plotly begins at the bottom; the first run belongs on top.
        "yaxis": {"autorange": "reversed"},
        "showlegend": False,
    }
    return {"data": [trace], "layout": layout}


def render_trainings(
    runs: Mapping[str, Sequence[Mapping[str, Any]]],
    configs: Sequence[Mapping[str, Any]],
) -> str:
    """Return the page about training runs: rows of metrics.jsonl by name, and their options in the same order."""
    timed = {name: with_minutes(rows) for name, rows in runs.items()}
    plots = {
        "samples-plot": curves_of_runs(timed, "samples"),
        "time-plot": curves_of_runs(timed, "minutes"),
    }
    rows = [(name, *map(str, values)) for name, values in differing(configs)]
    columns = [("option", ""), *((name, "words") for name in runs)]
    hint = "Success once of the evaluations of every run."
    return render_sections(
        "Training runs",
        [
            Section("Success over samples", hint, chart="samples-plot"),
            Section("Success over wall time", hint, chart="time-plot"),
            Section("What differs", "Options that are not the same.", "", columns, rows),
        ],
        plots,
    )


def pair_words(pair: Pair) -> str:
    """A pair in one line."""
    found = pair.found
    low, high = found.interval
    return (
        f"{pair.b} minus {pair.a}: {points(found.difference)} ({points(low, high)}, p = {found.p:.3g}) in "
        f"{found.episodes} episodes; {len(found.only_a)} by {pair.a} alone, {len(found.only_b)} by {pair.b} alone"
    )
