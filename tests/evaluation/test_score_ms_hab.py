"""Track ms_hab_7: both rules of termination in one run, several seeds, the homes of a pack."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.evaluation.resolve import PolicyFacts, resolve_policy
from mjhab.evaluation.score import manifest as manifests
from mjhab.evaluation.score.actions import StartKeeper
from mjhab.evaluation.score.check import check
from mjhab.evaluation.score.leaderboard import PUBLISHED_RESULTS, leaderboard
from mjhab.evaluation.score.manifest import ScoreHomes, ScoreRow, manifest
from mjhab.evaluation.score.result import (
    ScoreResult,
    digest_of,
    read_result,
    write_result,
)
from mjhab.evaluation.score.run import score, scored_options
from mjhab.evaluation.score.spec import ScoreSpec
from mjhab.evaluation.score.summary import summary_of
from mjhab.rollout.loop import rollout
from mjhab.scenes.pack_source import PackRequest
from mjhab.tasks.household.set_table import BOWL_DRAWER
from mjhab.tasks.signals import CHECKS, SIGNAL_CHECKS, Signals
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.success import succeeds_whatever_force
from tests.real_data import real_data
from tests.refusals import refused

TRACK = manifests.TRACKS["ms_hab_7"]
SEEDS = TRACK.seeds[:2]
ROW = ScoreRow("set_table", "close", BOWL_DRAWER, 1)
STAND_IN = ScoreHomes("replica_cad", "stand-in")


@pytest.fixture(scope="module")
def small() -> Iterator[None]:
    """The track with one row of one episode and two seeds."""
    with pytest.MonkeyPatch.context() as patch:
        less = dataclasses.replace(TRACK, rows=(ROW,), seeds=SEEDS)
        patch.setitem(manifests.TRACKS, "ms_hab_7", less)
        # Digests are of 100 episodes for each seed.
        patch.setattr(manifests, "_starts", dict)
        yield


@pytest.fixture(scope="module")
def result(small: Any, tmp_path_factory: pytest.TempPathFactory) -> ScoreResult:
    out = tmp_path_factory.mktemp("score")
    return score(ScoreSpec.of("random", "ms_hab_7", out, worlds=1, threads=1))


def test_the_track_is_that_of_the_publications() -> None:
    assert [(row.subtask, row.target) for row in TRACK.rows] == [
        ("pick", "013_apple"),
        ("pick", "024_bowl"),
        ("place", "013_apple"),
        ("place", "024_bowl"),
        ("open", "fridge/top_door"),
        ("open", "kitchen_counter/drawer3"),
        ("close", "kitchen_counter/drawer3"),
    ]
    assert {row.episodes for row in TRACK.rows} == {100} and len(set(TRACK.seeds)) == 3
    assert (TRACK.split, TRACK.profile) == ("val", "ms_hab")
    asked = ScoreSpec.of(track="ms_hab_7").asked
    assert asked.split == "val" and ScoreSpec.of().asked.split == "test"
    assert ScoreSpec.of(track="ms_hab_7", split="train").asked.split == "train"


@pytest.mark.parametrize("kind", ["pick", "place", "open", "close"])
def test_success_whatever_the_force_needs_every_other_condition(kind: str) -> None:
    needed = SUBTASKS[kind].needs(ignore_arm=False)

    def succeeds(*, but: str = "") -> bool:
        rows = {name: np.array([name in needed and name != but]) for name in CHECKS}
        if "let_go" in needed:
            rows["is_grasped"] = ~rows["let_go"]
        number = np.zeros(1)
        signals = Signals(
            **{name: rows[name] for name in SIGNAL_CHECKS},
            robot_force=number,
            target_force=number,
            cumulative_force=number,
            success=number > 0,
            placed_ok=number == 0,
            kind=np.array([list(SUBTASKS).index(kind)]),
            must_hold=number > 0,
        )
        return bool(succeeds_whatever_force(signals)[0])

    assert succeeds() and succeeds(but="force_ok")
    assert not any(succeeds(but=name) for name in needed if name != "force_ok")


@pytest.mark.parametrize("limit", [-1.0, 1e4])
def test_an_episode_goes_on_after_the_limit_on_the_force(limit: float) -> None:
    env = mjhab.make(
        task="set_table",
        subtask="close",
        target=BOWL_DRAWER,
        split="val",
        autoreset="disabled",
        threads=1,
    )
    # No option allows a limit that is exceeded from the start.
    limits = dict(env.task_config.limits)
    limits["close"] = dataclasses.replace(limits["close"], force_limit=limit)
    env.task_config = dataclasses.replace(env.task_config, limits=limits)
    kept = StartKeeper()
    (record,) = rollout(env, resolve_policy("expert", env), [0], 0, [kept])
    env.close()
    assert record.success_once == (limit > 0)
    assert kept.continuing[0] and len(kept.starts[0]) == 12


def test_a_score_has_both_rules_and_all_seeds(result: ScoreResult) -> None:
    summary = result.summary
    (row,) = summary["rows"]
    assert {e.record.seed for e in result.episodes} == {*SEEDS}
    assert summary["complete"] and summary["episodes"] == 2
    assert len(row["score_by_seed"]) == 2
    assert result.facts["policies"][row["name"]]["env_options"]["profile"] == "ms_hab"
    first, second = result.episodes
    asked = result.manifest
    later = [dataclasses.replace(first, continuing=True), second]
    told = summary_of(asked, later)
    assert (told["score"], told["score_continuing"]) == (summary["score"], 0.5)
    # An episode that cannot be trusted counts by neither rule.
    tainted = dataclasses.replace(first.record, taint=("nan",))
    bad = dataclasses.replace(first, record=tainted, continuing=True)
    assert summary_of(asked, [bad, second])["score_continuing"] == 0.0


def test_a_check_replays_both_rules(result: ScoreResult, tmp_path: Path) -> None:
    assert not check(result).wrong and check(result).episodes == 2
    first, second = result.episodes
    forged = dataclasses.replace(first, continuing=not first.continuing)
    other = write_result(tmp_path / "forged.json", result.facts, [forged, second])
    assert list(check(other).wrong) == [f"{ROW.name} 0 of seed {SEEDS[0]}"]
    for lacking in (None, 1):
        with refused(where="lacking.json", said="is not in the manifest"):
            bad = dataclasses.replace(first, continuing=lacking)  # type: ignore[arg-type]
            write_result(tmp_path / "lacking.json", result.facts, [bad, second])


def test_scores_of_other_homes_are_told_apart(
    result: ScoreResult, tmp_path: Path
) -> None:
    own = result.manifest
    homes = dataclasses.asdict(STAND_IN)
    asked = manifest("ms_hab_7", "val", homes=STAND_IN)
    assert asked.digest != own.digest
    none = dataclasses.replace(STAND_IN, stage="none")
    assert manifest("ms_hab_7", "val", homes=none).digest != asked.digest
    facts = {**result.facts, "homes": homes, "manifest": asked.digest}
    path = tmp_path / "result.json"
    elsewhere = write_result(path, facts, result.episodes)
    with refused("assets", "builtin", expected="replica_cad (stage: stand-in)"):
        check(elsewhere)
    # A stage that was edited has another manifest.
    with refused(where="result.json", said="cannot be compared"):
        write_result(path, {**facts, "homes": {**homes, "stage": "own"}}, ())
    content = json.loads(path.read_text())
    content["facts"]["homes"] = {"pack": 3}
    path.write_text(json.dumps({**content, "digest": digest_of(content)}))
    with refused(where="result.json", said="facts.homes must be texts"):
        read_result(path)
    page = leaderboard([result, elsewhere])
    assert "## Track: ms_hab_7\n" in page
    assert "## Track: ms_hab_7, homes of replica_cad (stage: stand-in)\n" in page
    assert page.count("What differs") == 2
    for one in PUBLISHED_RESULTS["ms_hab_7"]:
        (line, again) = [text for text in page.splitlines() if one.policy in text]
        assert line == again and f"| {one.mean:.1f} |" in line


def test_the_rules_are_those_of_the_paper_whatever_the_policy_was_trained_in() -> None:
    sees = {"camera_size": 32, "obs_mode": "depth"}
    ours = PolicyFacts("ours", env_options={**sees, "stationary": ()})
    assert scored_options(ours, "ms_hab") == {"profile": "ms_hab", **sees}
    own = PolicyFacts("own", env_options={**sees, "profile": "ms_hab"})
    assert scored_options(own, "ms_hab") == {"profile": "ms_hab", **sees}


def test_a_score_in_replica_cad_is_checked_in_the_same_stage(
    small: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = ["--assets", str(real_data("replica_cad")), "--scenes", "v3_sc3_staging_00"]
    out = str(tmp_path / "score")
    words = ["--policy", "zero", "--track", "ms_hab_7", "--out", out, "--worlds", "1"]
    assert main(["score", *words, *place, "--stage", "none", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"track", "score", "score_continuing", "rows", "stage", "digest"} <= set(told)
    assert (told["stage"], told["rows"]) == ("none", {ROW.name: 0.0})
    assert str(real_data()) not in (tmp_path / "score" / "summary.json").read_text()
    file = f"{out}/result.json"
    assert main(["score", "check", file, *place, "--stage", "none"]) == 0
    assert main(["score", "check", file, *place, "--stage", "stand-in"]) == 2
    said = capsys.readouterr().err
    assert "stage: none" in said and "stage: stand-in" in said
    request = PackRequest(place[1], stage="stand-in", scenes=("v3_sc3_staging_00",))
    assert ScoreHomes.of(request).stage == "stand-in"
