"""Colours that stand side by side in one chart can be told apart: their distance in CIELAB (CIE 1976)."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable
from importlib.resources import files
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks import soak as memory_plot
from mjhab.bench.experts import report as experts
from mjhab.reports import dataset_forces
from mjhab.reports.plots import OTHER_COLOR, force_figure, kind_color, labels_figure, tone
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.subtasks.spec import SubtaskSpec
from mjhab.viewer.pages import timeline

LEAST = 15.0
"""Smallest distance of two colours of one chart."""
RGB_TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.072175],
        [0.0193339, 0.119192, 0.9503041],
    ]
)
"""Of linear sRGB, with the white of D65."""


def lab(color: str) -> np.ndarray:
    """L*, a* and b* of a colour such as "#dc2626"."""
    coded = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    t = RGB_TO_XYZ @ linear / RGB_TO_XYZ.sum(axis=1)
    x, y, z = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def distance(first: str, second: str) -> float:
    """Distance of two colours in CIELAB (CIE 1976)."""
    return float(np.linalg.norm(lab(first) - lab(second)))


def too_near(colors: Iterable[str]) -> list[tuple[str, str]]:
    """Pairs of colours that are nearer than they may be; a colour that comes twice is one of them."""
    return [pair for pair in itertools.combinations(colors, 2) if distance(*pair) < LEAST]


def label_markers() -> dict[str, dict[str, Any]]:
    """Marker of every label of all subtasks, all in one chart."""
    counts = {name: Counter(SUBTASKS[name].labels) for name in SUBTASKS}
    return {trace["name"]: trace["marker"] for trace in labels_figure(counts)["data"]}


def cards() -> list[str]:
    """What charts are drawn upon: the card of the light and of the dark page."""
    return re.findall(
        r"--card: (#\w{6})", files("mjhab.reports").joinpath("report.css").read_text()
    )


def test_distances_are_those_of_cielab() -> None:
    assert lab("#ffffff") == pytest.approx([100, 0, 0], abs=0.01)
    assert lab("#ff0000") == pytest.approx([53.24, 80.09, 67.20], abs=0.02)
    assert lab("#0000ff") == pytest.approx([32.30, 79.19, -107.86], abs=0.02)
    assert too_near(["#eab308", "#facc15", "#dc2626"]) == [("#eab308", "#facc15")]


def test_colors_of_labels_can_be_told_apart_in_one_chart() -> None:
    markers = label_markers()
    assert len(markers) == len(
        {label for kind in SUBTASKS for label in SUBTASKS[kind].labels}
    )
    assert too_near(sorted({marker["color"] for marker in markers.values()})) == []
    looks = {
        name: (m["color"], m.get("pattern", {}).get("shape", ""))
        for name, m in markers.items()
    }
    assert len(set(looks.values())) == len(looks), "two labels look the same"


def test_labels_can_be_told_from_the_page() -> None:
    assert len(cards()) == 2
    near = [
        (marker["color"], card)
        for marker in label_markers().values()
        for card in cards()
        if distance(marker["color"], card) < LEAST
    ]
    assert near == []


def test_a_chart_of_one_kind_needs_no_hatching() -> None:
    for name in SUBTASKS:
        figure = labels_figure({name: Counter(SUBTASKS[name].labels)})
        assert all("pattern" not in trace["marker"] for trace in figure["data"]), name


def test_greens_are_clean_successes_alone() -> None:
    for name, marker in label_markers().items():
        _, a, b = lab(marker["color"])
        assert (a < -10 and b > -10) == (tone(name.replace(" ", "_")) == "good"), name


def test_greens_which_lie_on_top_of_each_other_are_far_apart() -> None:
    """In the chart of a whole task every kind of subtask has its own green, and all stand in one legend."""
    greens = sorted(
        marker["color"]
        for name, marker in label_markers().items()
        if tone(name.replace(" ", "_")) == "good"
    )
    assert len(greens) == 5
    assert min(distance(*pair) for pair in itertools.combinations(greens, 2)) > 30


def test_a_chart_with_one_label_has_a_legend() -> None:
    figure = labels_figure({"pick": Counter(straightforward_success=8)})
    assert len(figure["data"]) == 1 and figure["layout"]["showlegend"] is True


def test_kinds_can_be_told_apart_in_the_force_chart() -> None:
    spans = [
        SimpleNamespace(kind=kind, target="", start_step=2 * i, end_step=2 * i + 2)
        for i, kind in enumerate(SUBTASKS)
    ]
    steps = 2 * len(spans) + 2
    record = SimpleNamespace(force=[1.0] * steps, subtasks=spans, steps=steps)
    figure = force_figure(cast(EpisodeRecord, record))
    named = {
        trace.get("name", ""): trace["line"]["color"]
        for trace in figure["data"]
        if "name" in trace
    }
    assert set(named) == {*SUBTASKS, "unfinished", "limit of the sum"}
    assert too_near(named.values()) == []


def test_a_subtask_without_a_colour_looks_like_no_other() -> None:
    assert SubtaskSpec.color == OTHER_COLOR == kind_color("unknown")


def test_the_step_that_is_shown_can_be_told_from_all_else_on_the_time_line() -> None:
    kinds = [kind_color(kind) for kind in SUBTASKS]
    drawn = {
        *kinds,
        *timeline.TONE_COLORS.values(),
        *timeline.ACTOR_COLORS,
        timeline.GAUGE_COLOR,
    }
    assert too_near([timeline.NOW_COLOR, *timeline.TONE_COLORS.values()]) == []
    assert [color for color in drawn if distance(color, timeline.NOW_COLOR) < LEAST] == []
    script = files("mjhab.viewer.export").joinpath("page.js").read_text(encoding="utf-8")
    assert f'NOW_COLOR = "{timeline.NOW_COLOR}"' in script


@pytest.mark.parametrize(
    "colors",
    [
        (*experts._COLORS, experts._PAPER_COLOR),
        memory_plot.COLORS,
        timeline.ACTOR_COLORS,
        tuple(dataset_forces._COLORS.values()),
    ],
    ids=["experts", "memory", "actors", "forces"],
)
def test_colors_of_other_charts_can_be_told_apart(colors: tuple[str, ...]) -> None:
    assert too_near(colors) == []
