"""`mjhab compare`: evaluations in pairs, trainings in one chart, and what is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.core.errors import UsageError
from mjhab.evaluation.compare import names_of
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.store import EvaluationFolder
from tests.refusals import refused
from tests.rollout.fake_env import FakeEnv

CONFIG: dict[str, Any] = {
    "policy": "zero",
    "task": "set_table",
    "subtask": None,
    "seed": 0,
    "episodes": 6,
    "worlds": 2,
    "split": "train",
    "profile": "mjhab",
    "horizon": 200,
    "assets": {"place": "/somewhere/replica_cad", "stage": "own"},
    "mjhab": "0.2.0",
}


def run_at(
    folder: Path, lost: tuple[int, ...] = (), films: int = 0, **changes: Any
) -> Path:
    """A run folder whose episodes all succeed but those that are ``lost``."""
    with EvaluationFolder.open(folder, {**CONFIG, **changes}) as opened:
        plan = (("pick", "024_bowl_:0000"), ("place", "024_bowl_:0000"))
        env = FakeEnv(2, plan, quality=1.0, taint_chance=0.0)
        for record in rollout(env, RandomPolicy(0), range(6), seed=0):
            if record.index in lost:
                record = dataclasses.replace(
                    record, success_once=False, subtasks=record.subtasks[:1]
                )
            opened.add(record)
            if record.index < films:
                opened.film_path(record.index).parent.mkdir(exist_ok=True)
                opened.film_path(record.index).write_bytes(b"a film")
    return folder


def test_pairs_films_and_labels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = run_at(tmp_path / "a", (1, 2, 3), films=2)
    moved = {"place": "/elsewhere/replica_cad", "stage": "own"}
    b = run_at(tmp_path / "b", (4,), films=2, policy="<b>", assets=moved, robot="fetch")
    page = tmp_path / "pages" / "ab.html"
    assert main(["compare", str(a), str(b), "--out", str(page), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (pair,) = found["pairs"]
    assert (pair["a"], pair["b"], pair["episodes"]) == ("a", "b", 6)
    assert (pair["only_a"], pair["only_b"]) == ([4], [1, 2, 3])
    assert pair["difference"] == 0.3333 and pair["low"] < 0 < pair["high"]
    assert pair["p"] == 0.625 and (pair["both"], pair["neither"]) == (2, 0)
    labels = {(row["a"], row["b"]): row["subtasks"] for row in pair["labels"]}
    assert labels == {
        ("not_reached", "placed_in_goal_success"): 3,
        ("placed_in_goal_success", "not_reached"): 1,
    }
    assert [run["success_once"] for run in found["runs"]] == [0.5, 0.8333]
    html = page.read_text(encoding="utf-8")
    # Of the episodes that one alone does, 1 is filmed in both runs.
    assert html.count("<video") == 2 and 'id="film-a1"' in html and 'id="film-b1"' in html
    assert "&lt;b&gt;" in html and "placed in goal success" in html


def test_words_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = run_at(tmp_path / "x" / "run"), run_at(tmp_path / "y" / "run", (0,))
    assert main(["compare", str(a), str(b), "--out", str(tmp_path / "p.html")]) == 0
    out = capsys.readouterr().out
    assert "y/run minus x/run: -16.7 points" in out and "1 by x/run alone" in out


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"profile": "ms_hab"}, ["profile"]),
        ({"horizon": 100, "split": "val"}, ["horizon", "split"]),
        ({"env": {"overrides": {"goal_tol": 0.3}}}, ["overrides.goal_tol"]),
        ({"assets": {"place": "replica_cad", "stage": "stand-in"}}, ["assets"]),
    ],
)
def test_runs_of_other_rules_are_refused(
    tmp_path: Path, changes: dict[str, Any], named: list[str]
) -> None:
    a, b = run_at(tmp_path / "a"), run_at(tmp_path / "b", **changes)
    page = tmp_path / "p.html"
    with pytest.raises(UsageError, match="other rules, homes or episodes") as refused:
        mjhab.compare(a, b, out=page)
    given = refused.value.given
    assert isinstance(given, list) and sorted(given) == named and not page.exists()


def test_what_a_policy_sees_is_its_own_affair(tmp_path: Path) -> None:
    a = run_at(tmp_path / "a", mjhab="0.1.0")
    b = run_at(tmp_path / "b", env={"obs_mode": "depth", "camera_size": 32}, films=0)
    found = mjhab.compare(a, b, out=tmp_path / "p.html")
    assert found.pairs[0].found.difference == 0.0
    assert found.cautions == (
        "The runs are of different versions of mjhab: 0.1.0, 0.2.0.",
    )


def test_trainings_come_into_one_chart(tmp_path: Path) -> None:
    scene = {"task": "set_table", "subtask": "close", "target": "", "assets": "builtin"}
    for number, name in enumerate(("a", "b")):
        folder = tmp_path / name
        folder.mkdir()
        config = {"algorithm": name, "scene": scene}
        (folder / "config.json").write_text(json.dumps(config))
        rows = [
            {"step": 9 * k, "samples": 90 * k, "seconds": 60.0 * k, "success_once": k / 4}
            for k in range(1, 3 + number)
        ]
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (folder / "metrics.jsonl").write_text(lines)
    page = tmp_path / "p.html"
    found = mjhab.compare(tmp_path / "a", tmp_path / "b", out=page)
    assert found.as_json()["trainings"] == {"a": 0.5, "b": 0.75} and not found.pairs
    html = page.read_text(encoding="utf-8")
    assert '"name":"a: on the way"' in html and '"name":"b: on the way"' in html
    with pytest.raises(UsageError, match="evaluations and training runs"):
        mjhab.compare(tmp_path / "a", run_at(tmp_path / "c"), out=page)
    config = {"algorithm": "a", "scene": {**scene, "subtask": "open"}}
    (tmp_path / "b" / "config.json").write_text(json.dumps(config))
    with pytest.raises(UsageError, match="subtask: 'close' and 'open'"):
        mjhab.compare(tmp_path / "a", tmp_path / "b", out=page)


def test_bad_folders(tmp_path: Path) -> None:
    a = run_at(tmp_path / "a")
    other = run_at(tmp_path / "b")
    lines = (other / "episodes.jsonl").read_text().replace('"home":"', '"home":"x')
    (other / "episodes.jsonl").write_text(lines)
    for folders, words in (
        ((a,), "at least two runs, got 1"),
        ((a, a), "named twice"),
        ((a, tmp_path), "holds no run"),
        ((a, tmp_path / "none"), "holds no run"),
        ((a, other), "is another one in b than in a"),
    ):
        with pytest.raises(UsageError, match=words):
            mjhab.compare(*folders, out=tmp_path / "p.html")
    with refused("--out", str(tmp_path / "p.txt"), expected=".html"):
        mjhab.compare(a, other, out=tmp_path / "p.txt")


def test_names_tell_runs_apart() -> None:
    assert names_of([Path("/r/a"), Path("/r/b")]) == ["a", "b"]
    assert names_of([Path("/r/a/x"), Path("/r/b/x")]) == ["a/x", "b/x"]
