"""The report: one file, no network, every section, any number of episodes, nothing unescaped."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from mjhab.reports.metrics import labels_by_kind, progress_curves, rows_by_position
from mjhab.reports.plots import (
    force_figure,
    force_limits,
    labels_figure,
    progress_figure,
    tone,
)
from mjhab.reports.run import render_report
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy, ZeroPolicy
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS
from tests.rollout.fake_env import FakeEnv

CONFIG = {
    "task": "set_table",
    "subtask": None,
    "policy": "expert",
    "episodes": 8,
    "worlds": 4,
    "seed": 0,
}
VOID = {"meta", "br", "link", "img", "input", "hr"}


class Page(HTMLParser):
    """Collects tags with attributes, text of scripts by id, and checks that tags nest."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.scripts: dict[str, str] = {}
        self.script_id = ""
        self.words: list[str] = []
        self.feed(html)
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.script_id = dict(attrs).get("id") or ""
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[self.script_id] = self.scripts.get(self.script_id, "") + data
        elif self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def count(self, tag: str, css: str = "") -> int:
        return sum(
            t == tag and css in (a.get("class") or "").split() if css else t == tag
            for t, a in self.tags
        )


@pytest.fixture(scope="module")
def records() -> list[EpisodeRecord]:
    return rollout(
        FakeEnv(4, quality=0.9, taint_chance=0.5), RandomPolicy(0), range(8), seed=0
    )


def page_of(records: list[EpisodeRecord], **options: Any) -> Page:
    return Page(render_report(records, options.pop("config", CONFIG), 20.0, **options))


def test_all_sections_are_there(records: list[EpisodeRecord]) -> None:
    page = page_of(records)
    for title in (
        "Films and timelines",
        "Progressive completion",
        "Success along the plan",
        "Success per subtask",
        "Trajectory labels",
        "Force over time",
        "Episodes",
        "Simulation flags",
        "Run",
    ):
        assert title in page.text
    assert "contact_overflow" in page.text and "Partial" not in page.text
    data = json.loads(page.scripts["page-data"])
    assert len(data["force"]) == 8 and set(data["plots"]) == {
        "progress-plot",
        "labels-plot",
    }


def test_teleports_are_not_judged_and_time_is_that_to_success(
    records: list[EpisodeRecord],
) -> None:
    first = records[0].subtasks[0]
    assert first.kind == "navigate"
    done = replace(first, success_once=True, success_at_end=True, end_step=500)
    done = replace(done, events=((37, "success"),), peak_finger_force=2410.4)
    alone = replace(
        records[0],
        subtask="navigate",
        plan=records[0].plan[:1],
        subtasks=(done,),
        steps=500,
        completed=1,
        success_once=True,
        success_at_end=True,
    )
    text = page_of([alone]).text
    assert "success after 1.9 s" in text and "25.0 s in all" in text
    assert "2,410 N" in text and "by teleport" not in text
    driven = replace(alone, subtasks=(replace(done, teleported=True),))
    text = page_of([driven]).text
    assert "navigate" in text and "by teleport" in text and "teleports included" in text


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_forces_that_are_not_finite_are_gaps(
    records: list[EpisodeRecord], bad: float
) -> None:
    first = records[0]
    tainted = replace(
        first,
        force=(*first.force[:3], bad, *first.force[4:]),
        peak_force=bad,
        cumulative_force=bad,
        subtasks=(
            replace(first.subtasks[0], peak_force=bad, cumulative_force=bad),
            *first.subtasks[1:],
        ),
    )
    data = json.loads(page_of([tainted, *records[1:]]).scripts["page-data"])
    own = [trace["y"] for trace in data["force"][0]["data"]]
    clean = [trace["y"] for trace in force_figure(first)["data"]]
    assert own[0] == [*clean[0][:3], None, *clean[0][4:]]
    assert own[1] == [*clean[1][:3], *[None] * (len(clean[1]) - 3)]
    assert own[2:] == clean[2:]


def test_nothing_is_loaded_from_elsewhere(
    records: list[EpisodeRecord], tmp_path: Path
) -> None:
    film = tmp_path / "0.mp4"
    film.write_bytes(b"film")
    html = render_report(records, CONFIG, 20.0, lambda index: tmp_path / f"{index}.mp4")
    own = re.sub(r"<script>.*?</script>", "", html, flags=re.S)
    assert not re.search(r"""(src|href)\s*=\s*["'](https?:)?//""", own)
    assert (
        "http://" not in own
        and "https://" not in own
        and "@import" not in own
        and "url(" not in own
    )
    assert "Plotly" in html


def test_film_is_inside_and_its_timeline_below(
    records: list[EpisodeRecord], tmp_path: Path
) -> None:
    (tmp_path / "1.mp4").write_bytes(b"0123456789")
    page = page_of(records, film_path=lambda index: tmp_path / f"{index}.mp4")
    assert page.count("video") == page.count("figure", "film") == 1
    assert page.scripts["film-1"] == "MDEyMzQ1Njc4OQ=="
    assert page.count("button", "span") == len(records[1].subtasks)
    assert page.count("button", "tick") == len(records[1].events)
    spans = [
        attrs
        for tag, attrs in page.tags
        if tag == "button" and "span" in (attrs["class"] or "")
    ]
    assert [int(span["data-step"] or -1) for span in spans] == [
        s.start_step for s in records[1].subtasks
    ]
    assert "straightforward success" in str([span["title"] for span in spans])


def test_timelines_stand_alone_without_films(records: list[EpisodeRecord]) -> None:
    page = page_of(records, film_problem="RuntimeError: no <GL> here")
    assert page.count("video") == 0 and page.count("figure", "film") == 4
    assert "RuntimeError: no <GL> here" in page.text


def test_no_episode_and_partial_runs(records: list[EpisodeRecord]) -> None:
    page = page_of([])
    assert "No episode finished" in page.text and "0 of 8 episodes" in page.text
    page = page_of(records[:3])
    assert "Partial: 3 of 8 episodes" in page.text


def test_single_subtask_run_has_no_chain_sections() -> None:
    env = FakeEnv(2, plan=(("pick", "024_bowl_:0000"),), subtask="pick")
    page = page_of(
        rollout(env, ZeroPolicy(), range(3), seed=0), config={**CONFIG, "subtask": "pick"}
    )
    assert (
        "Progressive completion" not in page.text and "Success per subtask" in page.text
    )
    assert "Pick, set table by expert" in page.text


def test_names_from_records_are_escaped(records: list[EpisodeRecord]) -> None:
    evil = "<script>alert(1)</script>"
    subtask = replace(records[0].subtasks[0], target=evil, label=f"{evil}_failure")
    changed = replace(
        records[0], home=evil, subtasks=(subtask,), events=((1, evil),), taint=(evil,)
    )
    html = render_report([changed], {**CONFIG, "home": evil}, 1.0)
    assert evil not in html
    Page(html)


def test_flawed_success_is_not_green() -> None:
    assert tone("straightforward_success") == tone("placed_in_goal_success") == "good"
    assert (
        tone("winding_success")
        == tone("success_then_drop")
        == tone("dubious_success")
        == "fair"
    )
    assert tone("too_slow_failure") == "bad" and tone(None) == "none"
    for spec in SUBTASKS.values():
        assert {tone(label) for label in spec.labels} == {"good", "fair", "bad"}


def test_label_bars_sum_to_one(records: list[EpisodeRecord]) -> None:
    figure = labels_figure(labels_by_kind(records))
    for k in range(len(figure["data"][0]["y"])):
        assert sum(trace["x"][k] for trace in figure["data"]) == pytest.approx(1.0)


def test_force_chart_sums_within_subtasks_up_to_the_record(
    records: list[EpisodeRecord],
) -> None:
    record = records[0]
    figure = force_figure(record)
    sums = [
        trace
        for trace in figure["data"]
        if trace.get("yaxis") == "y2" and "dash" not in trace["line"]
    ]
    tops = [trace for trace in figure["data"] if "yaxis" not in trace]
    assert len(sums) == len(tops) == len(record.subtasks)
    assert [value for trace in tops for value in trace["y"]] == list(record.force)
    for trace, subtask in zip(sums, record.subtasks, strict=True):
        assert trace["y"][-1] == pytest.approx(
            subtask.cumulative_force, abs=0.1 * len(trace["y"])
        )
    limits = {trace["y"][0] for trace in figure["data"] if trace["line"].get("dash")}
    assert limits <= {5000.0, 7500.0, 10000.0}


def test_force_chart_of_a_cut_episode_shows_the_rest() -> None:
    (record,) = rollout(FakeEnv(1, quality=1.0), ZeroPolicy(), [0], seed=0, max_steps=3)
    assert [
        trace["name"] for trace in force_figure(record)["data"] if "yaxis" not in trace
    ] == ["unfinished"]


def test_force_limits_are_those_of_the_tasks() -> None:
    assert force_limits() == {
        "pick": 5e3,
        "place": 7.5e3,
        "navigate": float("inf"),
        "open": 1e4,
        "close": 1e4,
    }


def test_progress_chart_has_a_point_per_subtask(records: list[EpisodeRecord]) -> None:
    rows = rows_by_position(records)
    figure = progress_figure(rows, *progress_curves(records))
    assert [len(set(trace["x"])) for trace in figure["data"]] == [16, 16], (
        "names must differ or points merge"
    )


def test_episodes_that_the_policy_could_not_finish_are_shown(
    records: list[EpisodeRecord],
) -> None:
    assert "could not finish" not in render_report(records, CONFIG, 1.0)
    broken = [replace(records[0], error="no answer <in> 30 s"), *records[1:]]
    page = render_report(broken, CONFIG, 1.0)
    assert "episodes that the policy could not finish" in page
    assert "no answer &lt;in&gt; 30 s" in page
