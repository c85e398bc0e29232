"""The report of a data set, and the published numbers beside it."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import re
from collections import Counter
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from mjhab.data.select.query import Filter
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes
from mjhab.data.store.shard import rewrite
from mjhab.render.film import FilmWriter
from mjhab.reports.dataset import render_data_report
from mjhab.reports.dataset_forces import force_plots
from mjhab.reports.dataset_labels import ALL, CHAINS, grouped, label_order, label_tables
from mjhab.reports.mosaics import EVERY, TILE, mosaic
from mjhab.reports.paper import POLICIES, paper_row, paper_success
from mjhab.tasks.subtasks.registry import SUBTASKS
from tests.data.fake_world import FakeEnv
from tests.data.make import record, record_pictures
from tests.refusals import refused


def test_every_published_row_adds_up() -> None:
    text = files("mjhab.reports").joinpath("paper_labels.csv").read_text()
    assert "Tables 6 to 13" in text.splitlines()[0] + text.splitlines()[1]
    rows = list(
        csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    )
    assert len(rows) == 292
    at_end = {
        "pick": {"success_then_drop", "success_then_excessive_collisions"},
        "place": {"dubious_success", "success_then_excessive_collisions"},
        "open": {"dubious_success", "success_then_excessive_collisions"},
        "close": {"dubious_success", "success_then_excessive_collisions"},
    }
    for row in rows:
        key = [row[name] for name in ("task", "subtask", "split", "target", "policy")]
        known = paper_row(*key)
        assert known is not None
        once = {name: share for name, share in known.labels.items() if "success" in name}
        assert sum(known.labels.values()) == pytest.approx(100, abs=0.06), key
        assert sum(once.values()) == pytest.approx(known.success_once, abs=0.06), key
        kept = sum(
            share for name, share in once.items() if name not in at_end[row["subtask"]]
        )
        assert kept == pytest.approx(known.success_at_end, abs=0.06), key


def test_the_paper_and_we_have_the_same_labels() -> None:
    for kind in ("pick", "place", "open", "close"):
        published = SUBTASKS[kind].published
        assert published is not None and set(published.columns) == set(
            SUBTASKS[kind].labels
        )


def test_targets_are_found_by_our_names() -> None:
    bowl = paper_row("set_table", "pick", "train", "024_bowl_:0003", "RL-Per")
    drawer = paper_row("set_table", "close", "train", "kitchen_counter/drawer3", "RL-Per")
    fridge = paper_row("set_table", "close", "train", "fridge/top_door", "RL-Per")
    assert bowl and drawer and fridge
    assert (drawer.success_once, fridge.labels["success_then_excessive_collisions"]) == (
        88.79,
        61.81,
    )
    assert paper_row("set_table", "open", "train", "fridge/top_door", "RL-All") is None
    assert paper_row("tidy_house", "open", "train", "fridge/top_door", "RL-Per") is None


def test_shares_of_labels_stand_in_the_table(tmp_path: Path) -> None:
    records, _ = record(tmp_path / "a.h5", range(8), FakeEnv(subtask="pick"))
    groups = grouped(records)
    page = render_data_report(tmp_path, FilmWriter)
    assert sum(map(len, groups.values())) == 8 and not any(
        group.target == ALL for group in groups
    )
    for rules, which in (("published rules", "legacy_label"), ("own rules", "label")):
        for label, count in Counter(
            getattr(r.subtasks[-1], which) for r in records
        ).items():
            assert (
                f'title="mjhab, {rules}, {label}: {count} of 8">{100 * count / 8:.1f}</td>'
                in page
            )
    assert any(r.subtasks[-1].label != r.subtasks[-1].legacy_label for r in records)
    (table,) = label_tables("pick", groups)
    assert [column.name for column in table.columns] == [
        "mjhab, published rules",
        "mjhab, own rules",
        *(f"paper {policy}" for policy in POLICIES),
    ]
    for policy in POLICIES:
        row = paper_row("set_table", "pick", "val", "024_bowl", policy)
        assert (
            row is not None
            and f"paper {policy}" in page
            and f">{row.success_once:.1f}</td>" in page
        )


def test_all_targets_come_last_and_chains_have_no_paper_rows(tmp_path: Path) -> None:
    records, _ = record(tmp_path / "a.h5", range(6), FakeEnv())
    tables = label_tables(
        "pick", {g: m for g, m in grouped(records).items() if g.kind == "pick"}
    )
    assert {table.group.suite for table in tables} == {CHAINS}
    assert {column.name for table in tables for column in table.columns} == {
        "mjhab, published rules",
        "mjhab, own rules",
    }


def test_labels_of_another_version_come_last(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    env = FakeEnv(subtask="pick", images=True)
    record(path, range(3), env, images=ImageFormat())
    told = {
        episode.name: dataclasses.replace(
            episode.record,
            subtasks=tuple(
                dataclasses.replace(subtask, label="older_failure")
                for subtask in episode.record.subtasks
            ),
        )
        for episode in episodes(tmp_path)
    }
    rewrite(path, told)
    page = render_data_report(tmp_path, FilmWriter)
    assert "own rules, older_failure: 3 of 3" in page
    assert "</b>: older failure <small>(" in page


def test_force_histograms_count_every_subtask(tmp_path: Path) -> None:
    records, _ = record(tmp_path / "a.h5", range(6), FakeEnv())
    subtasks = [subtask for r in records for subtask in r.subtasks]
    plots = force_plots(subtasks)
    for kind, count in Counter(subtask.kind for subtask in subtasks).items():
        for name in (f"peak-{kind}", f"sum-{kind}"):
            assert sum(sum(trace["y"]) for trace in plots[name]["data"]) == count
    json.dumps(plots, allow_nan=False)


def test_forces_that_are_not_finite_are_counted_beside_the_histogram(
    tmp_path: Path,
) -> None:
    records, _ = record(tmp_path / "a.h5", range(6), FakeEnv(subtask="pick"))
    subtasks = [subtask for r in records for subtask in r.subtasks]
    bad = [
        dataclasses.replace(subtasks[0], peak_force=force, cumulative_force=math.nan)
        for force in (math.nan, math.inf)
    ]
    for told, count in ((subtasks + bad, len(subtasks)), (bad, 0)):
        plots = force_plots(told)
        for name in ("peak-pick", "sum-pick"):
            assert sum(sum(trace["y"]) for trace in plots[name]["data"]) == count
            assert "2 not finite" in plots[name]["layout"]["xaxis"]["title"]["text"]
        json.dumps(plots, allow_nan=False)


def test_a_mosaic_shows_the_episodes_side_by_side(tmp_path: Path) -> None:
    record_pictures(tmp_path / "a.h5", range(5))
    members = [
        (tmp_path / "a.h5", episode.name) for episode in episodes(tmp_path / "a.h5")
    ]
    shapes = []

    class Film:
        def __init__(self, path: Path, fps: int) -> None:
            self.path = path

        def add(self, frame: np.ndarray) -> None:
            shapes.append(frame.shape)

        def close(self) -> None:
            self.path.write_bytes(b"film")

        def abort(self) -> None:
            raise AssertionError

    made = mosaic(members, Film)
    assert made is not None and (made.film, made.episodes, made.camera) == (
        b"film",
        5,
        "fetch_head rgb",
    )
    assert (
        len(shapes) == 20 // EVERY + 1
        and shapes[0][1] == made.width == 3 * TILE + 8
        and shapes[0][0] == 2 * TILE + 4
    )
    record(tmp_path / "b.h5", range(1), FakeEnv())
    assert (
        mosaic([(tmp_path / "b.h5", next(episodes(tmp_path / "b.h5")).name)], Film)
        is None
    )


def test_the_page_is_whole(tmp_path: Path) -> None:
    record_pictures(tmp_path / "a.h5", range(6))
    page = render_data_report(tmp_path, FilmWriter)
    found = re.search(r'id="page-data">(.*?)</script>', page, re.S)
    assert found is not None
    data = json.loads(found[1].replace("<\\/", "</"))
    assert set(data["plots"]) == {"peak-pick", "sum-pick"}
    labels = {episode.attributes["label"] for episode in episodes(tmp_path)}
    assert (
        page.count("data:video/mp4;base64,") == len(labels)
        and "http" not in page.split("<script>")[0]
    )
    record(tmp_path / "b.h5", range(2), FakeEnv(subtask="open"))
    bare = render_data_report(
        tmp_path / "b.h5", FilmWriter, Filter("index < 1 and (tainted or not tainted)")
    )
    assert "mjhab replay --render adds them" in bare and "<video" not in bare
    with refused(said="no episode passes"):
        render_data_report(tmp_path, FilmWriter, Filter("steps > 1000"))


def test_every_label_of_a_kind_has_a_row() -> None:
    for kind in SUBTASKS:
        names = label_order(kind)
        assert sorted(names) == sorted(SUBTASKS[kind].labels)
    assert label_order("navigate")[0] == "navigation_success"


def test_success_in_the_paper_is_that_of_the_row() -> None:
    assert paper_success("set_table", "close", "val", "fridge/top_door") == {
        "rl_per": 0.0,
        "bc": 0.0,
        "dp": 0.1,
    }
    drawer = paper_success("set_table", "open", "val", "kitchen_counter/drawer3")
    assert (drawer["rl_per"], drawer["dp"]) == (84.52, 15.18)
    assert paper_success("set_table", "pick", "val", "024_bowl") == paper_success(
        "set_table", "pick", "val", ""
    )
    assert paper_success("tidy_house", "navigate", "val", "") == {}
