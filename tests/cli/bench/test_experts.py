"""``mjhab bench experts``: the table of success rates, its files, and what survives a stop."""

from __future__ import annotations

import contextlib
import csv
import json
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mjhab.bench.experts import run as bench_experts
from mjhab.bench.experts.rows import (
    ALL,
    ExpertRow,
    MeasuredEpisode,
    make_rows,
    result_of,
    together,
)
from mjhab.bench.specs import ExpertsSpec
from mjhab.cli.main import main
from mjhab.core.errors import MjhabError
from mjhab.rollout.records import EpisodeRecord, PlanEntry
from tests.refusals import command, refused

COMMAND = (
    *("bench", "experts", "--task", "set_table", "--subtask", "close"),
    *("--episodes", "2", "--worlds", "1", "--workers", "1"),
)
ROW = ExpertRow("builtin", "builtin", "tidy_house", "pick", "003_cracker_box", "", 4)
EPISODE = MeasuredEpisode(
    0,
    "h",
    "pick",
    "straightforward_success",
    True,
    True,
    100.0,
    200.0,
    50.0,
    200,
    1,
    1,
    (),
)
FAILED = replace(
    EPISODE,
    label="drop_failure",
    success_once=False,
    success_at_end=False,
    force_to_success=None,
    completed=0,
)


def table(out: Path) -> list[dict[str, str]]:
    with open(out / "table.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rows of two episodes, measured without interruption."""
    out = tmp_path_factory.mktemp("experts") / "run"
    assert main([*COMMAND, "--out", str(out)]) == 0
    return out


def test_two_rows_end_to_end(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = {row["target"]: row for row in table(made)}
    assert list(rows) == ["kitchen_counter/drawer3", "fridge/top_door", ALL]
    assert [row["episodes"] for row in rows.values()] == ["2", "2", "4"]
    # MS-HAB paper, Table 11: RL-Per closes the drawer in 89.29 %, the fridge in 0 % of the val episodes.
    assert [row["paper_rl_per"] for row in rows.values()] == ["89.29", "0.0", ""]
    lines = [
        json.loads(line)
        for line in (made / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    ]
    assert [(line["row"].split("_")[-1], line["index"]) for line in lines] == [
        ("counter-drawer3", 0),
        ("counter-drawer3", 1),
        ("door", 0),
        ("door", 1),
    ]
    text = (made / "results.json").read_text(encoding="utf-8")
    assert str(made.parent) not in text
    document = json.loads(text)
    assert document["config"] == {
        "split": "val",
        "seed": 0,
        "policy": "expert",
        "profile": "mjhab",
        "stillness": "absolute",
        "spawn_rule": "front_box",
        "joint_dynamics": "ours",
        "assets": {"builtin": "builtin"},
    }
    assert {row["profile"] for row in rows.values()} == {"mjhab"}
    assert [row["successes"] for row in document["rows"]] == [
        sum(line["success_once"] for line in lines[first : first + 2]) for first in (0, 2)
    ]
    page = (made / "report.html").read_text(encoding="utf-8")
    assert "labels-close" in page and "paper-close" in page and "Partial" not in page
    assert "stillness published; ours are of profile mjhab, stillness absolute." in page
    assert not re.findall(r"<(?:script|link|img|video)\b[^>]*\s(?:src|href)=[^>]*>", page)
    capsys.readouterr()
    assert main([*COMMAND, "--out", str(made), "--resume", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["rows"], told["episodes"], told["left"], told["failed_rows"]) == (
        2,
        4,
        0,
        [],
    )
    once = [float(row["success_once"]) / 100 for row in table(made)][:2]
    assert list(told["success_once"].values()) == once


def stopped(out: Path, number: signal.Signals, most: int, *more: str) -> tuple[int, Any]:
    """Exit code and episodes by row of a run that gets a signal when it has more than ``most`` episodes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "mjhab.cli.main", *COMMAND, "--out", str(out), *more],
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    rows = make_rows(options := _options(out))
    count = 0
    while process.poll() is None and count <= most:
        time.sleep(0.02)
        # The shard may be in the middle of being made.
        with contextlib.suppress(MjhabError):
            count = sum(len(bench_experts.read_row(options, row)) for row in rows)
    process.send_signal(number)
    code = process.wait(timeout=120)
    return code, [bench_experts.read_row(options, row) for row in rows]


def test_a_stopped_run_goes_on_to_the_same_table(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    code, first = stopped(out, signal.SIGTERM, 0)
    assert code == 130 and first[0] and not first[1], "it was to stop in the middle"
    assert "Partial" in (out / "report.html").read_text(encoding="utf-8")
    code, second = stopped(out, signal.SIGKILL, len(first[0]), "--resume")
    assert code == -signal.SIGKILL and len(second[1]) < 2
    assert main([*COMMAND, "--out", str(out), "--resume"]) == 0
    assert (out / "table.csv").read_text() == (made / "table.csv").read_text()
    assert (out / "episodes.jsonl").read_text() == (made / "episodes.jsonl").read_text()
    after = [
        bench_experts.read_row(_options(out), row) for row in make_rows(_options(out))
    ]
    for kept in (first, second):
        for before, found in zip(kept, after, strict=True):
            assert all(episode in found for episode in before)


def _options(out: Path) -> ExpertsSpec:
    return ExpertsSpec(out=out, task=("set_table",), subtask=("close",), episodes=2)


def test_a_row_that_fails_does_not_stop_the_others(
    made: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    measure = bench_experts.measure_row

    def broken(options: ExpertsSpec, row: ExpertRow, *more: Any) -> Any:
        if row.target == "kitchen_counter/drawer3":
            raise MjhabError("no luck")
        return measure(options, row, *more)

    monkeypatch.setattr(bench_experts, "measure_row", broken)
    assert main([*COMMAND, "--out", str(made), "--resume", "--json"]) == 1
    captured = capsys.readouterr()
    assert "drawer3 could not be measured: no luck" in captured.err
    told = json.loads(captured.out)
    assert (
        told["failed_rows"] == ["builtin/set_table_close_kitchen_counter-drawer3"]
        and told["episodes"] == 4
    )
    assert "no luck" in (made / "report.html").read_text(encoding="utf-8")


def test_rows_of_the_whole_table() -> None:
    rows = make_rows(ExpertsSpec())
    assert len({row.name for row in rows}) == len(rows) == 53
    singles = [row for row in rows if row.subtask != "chain"]
    assert len(singles) == 2 * (9 + 9 + 1) + (2 + 2 + 2 + 2 + 1) and {
        row.episodes for row in singles
    } == {100}
    asked = {(row.task, row.subtask, row.target): row.asked for row in rows}
    assert asked["tidy_house", "pick", "003_cracker_box"] == 0.85
    assert (
        asked["set_table", "pick", "024_bowl"] == 0.8
        and asked["set_table", "place", "024_bowl"] == 0.9
    )
    assert (
        asked["set_table", "chain", ""] == 0.5
        and asked["tidy_house", "navigate", ""] is None
    )
    few = make_rows(ExpertsSpec(target=("013_apple",), navigate=("drive",)))
    assert [(row.task, row.subtask) for row in few] == [
        ("set_table", "pick"),
        ("set_table", "place"),
    ]
    only = make_rows(ExpertsSpec(subtask=("chain",), navigate=("drive",), chains=5))
    assert [row.name for row in only] == [
        f"builtin/{task}_chain_drive"
        for task in ("tidy_house", "prepare_groceries", "set_table")
    ]
    assert not [row for row in make_rows(ExpertsSpec(chains=0)) if row.subtask == "chain"]


def test_what_a_row_says() -> None:
    rough = replace(
        EPISODE,
        index=2,
        label="winding_success",
        force_to_success=1500.0,
        taint=("penetration",),
    )
    result = result_of(
        ROW, "val", [EPISODE, rough, FAILED, replace(EPISODE, index=3, peak_force=1400.0)]
    )
    assert (result.success_once, result.gentle, result.gentle_peak, result.tainted) == (
        0.75,
        0.5,
        0.5,
        1,
    )
    assert result.interval[0] < 0.75 < result.interval[1] and result.met is False
    assert (
        result.failures == {"drop_failure": 1}
        and next(iter(result.labels)) == "straightforward_success"
    )
    # MS-HAB paper, Table 7.
    assert (
        result.paper == 0.7341 and result.paper_table == 7 and result.over_paper == 1.59
    )
    nothing = result_of(ROW, "val", [], "broken")
    assert (nothing.success_once, nothing.met, nothing.error, nothing.over_paper) == (
        None,
        None,
        "broken",
        None,
    )


def test_chains_tell_how_far_they_came_and_where_they_ended() -> None:
    row = replace(ROW, subtask="chain", target="", navigate="drive")
    done = replace(EPISODE, completed=4, planned=4)
    ended = replace(FAILED, completed=1, planned=4)
    result = result_of(row, "val", [done, ended])
    assert result.progressive == (1.0, 0.5, 0.5, 0.5) and result.failures == {
        "pick drop_failure": 1
    }
    assert (result.asked, result.met, result.paper, result.gentle) == (
        0.4,
        True,
        None,
        None,
    )


def test_all_targets_together_stand_next_to_the_papers_row_for_all() -> None:
    other = replace(ROW, target="024_bowl", episodes=2)
    chain = replace(ROW, subtask="chain", target="")
    (found,) = together([(ROW, [EPISODE]), (other, [FAILED]), (chain, [EPISODE])], "val")
    assert (found.target, found.episodes, found.wanted, found.success_once) == (
        ALL,
        2,
        6,
        0.5,
    )
    assert found.paper == 0.7748 and found.asked is None


def test_force_counts_up_to_the_first_success() -> None:
    record = EpisodeRecord(
        0,
        7,
        "h",
        "set_table",
        "val",
        "pick",
        (PlanEntry("pick", "024_bowl_:0000"),),
        (),
        True,
        True,
        False,
        4,
        1,
        ((2, "contact"), (3, "success"), (4, "success")),
        40.0,
        100.0,
        (10.0, 20.0, 30.0, 40.0),
        (),
        False,
        "",
    )
    assert (
        MeasuredEpisode.of(record).force_to_success == 60.0
        and MeasuredEpisode.of(record).gentle
    )
    lost = MeasuredEpisode.of(replace(record, success_once=False, events=()))
    assert lost.force_to_success is None and not lost.gentle and lost.label == ""


def test_bad_input_is_refused_before_anything_is_made(made: Path, tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "new"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    other = tmp_path / "other"
    told: dict[str, Any]
    for args, told in (
        (("--task", "tidy", *out), dict(expected="tidy_house")),
        (("--subtask", "pick", "chian", *out), dict(expected="chain")),
        (("--target", "003_craker_box", *out), dict(expected="003_cracker_box")),
        (("--navigate", "fly", *out), dict(given="fly")),
        (("--split", "vall", *out), dict(option="split", expected="val")),
        (("--assets", "builtin", "builtin", *out), dict(said="both 'builtin'")),
        (("--assets", str(tmp_path / "absent"), *out), dict(option="asset folder")),
        (("--episodes", "-1", *out), dict(option="episodes", given=-1)),
        (("--workers", "0", *out), dict(option="workers", given=0)),
        (("--episodes", "0", "--chains", "0", *out), dict(said="nothing to measure")),
        (
            ("--subtask", "open", "--task", "tidy_house", *out),
            dict(said="nothing to measure"),
        ),
        (("--out", str(made)), dict(option="out", advice="Give --resume")),
        (
            ("--out", str(made), "--resume", "--seed", "1"),
            dict(said="started with seed = 0, now it is 1"),
        ),
        (("--out", str(other), "--resume"), dict(option="resume", given=str(other))),
        (("--out", str(other / "notes.txt")), dict(expected="a folder, not a file")),
    ):
        with refused(**told):
            command("bench", "experts", *args)
    assert not (tmp_path / "new").exists()
