"""Scores: fixed episodes, a file that cannot be edited, a check by replay, a table."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.cli.policies import score as score_command
from mjhab.core.errors import UsageError
from mjhab.evaluation.resolve import PolicyFacts
from mjhab.evaluation.score import manifest as manifests
from mjhab.evaluation.score import run as runs
from mjhab.evaluation.score.actions import Replayed, packed_actions, unpacked_actions
from mjhab.evaluation.score.capabilities import CAPABILITIES, profile
from mjhab.evaluation.score.check import check
from mjhab.evaluation.score.leaderboard import leaderboard
from mjhab.evaluation.score.manifest import (
    ScoreRow,
    ScoreTrack,
    manifest,
)
from mjhab.evaluation.score.result import (
    ScoreResult,
    digest_of,
    manifest_of,
    perturbed_arms,
    read_for_table,
    read_result,
    write_result,
)
from mjhab.evaluation.score.run import check_rules, score, scored_options
from mjhab.evaluation.score.spec import ScoreSpec
from mjhab.evaluation.score.summary import ScoredEpisode, summary_of
from mjhab.rollout.records import SubtaskRecord
from mjhab.rollout.store import read_records
from mjhab.tasks.household.set_table import BOWL_DRAWER
from tests.refusals import command, refused

ALL_TRACKS = dict(manifests.TRACKS)
ROWS = (
    ScoreRow("set_table", "close", BOWL_DRAWER, 2),
    ScoreRow("tidy_house", "navigate", episodes=1),
)


@pytest.fixture(scope="module")
def small() -> Any:
    """A track of three episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(manifests.TRACKS, "subtasks", ScoreTrack(ROWS))
        yield


@pytest.fixture(scope="module")
def result(
    small: Any, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, ScoreResult]:
    out = tmp_path_factory.mktemp("score")
    spec = ScoreSpec.of("random", "subtasks", out, worlds=2, threads=1)
    return out / "result.json", score(spec)


def test_a_score_is_made_of_the_episodes_of_the_manifest(
    result: tuple[Path, ScoreResult],
) -> None:
    path, scored = result
    assert scored.facts["policy"] == "random" and scored.facts["split"] == "test"
    assert {(e.row, e.record.index) for e in scored.episodes} == {
        (row.name, index) for row in ROWS for index in range(row.episodes)
    }
    assert all(e.record.seed == manifests.SEED for e in scored.episodes)
    summary = scored.summary
    assert summary["episodes"] == 3 and not summary["errors"]
    assert set(summary["capabilities"]) == set(CAPABILITIES)
    assert {"processor", "cores"} <= set(scored.facts["hardware"])
    assert "mujoco" in scored.facts["versions"]
    # Nothing is left to do: the second call reads what the first one left.
    again = score(ScoreSpec.of("random", "subtasks", path.parent, worlds=2, threads=1))
    assert again.summary == summary
    # The time is that of all starts, not that of the last one.
    assert again.facts["seconds"] == scored.facts["seconds"] > 0
    assert [e.record for e in again.episodes] == [e.record for e in scored.episodes]


def test_a_check_plays_the_actions_again(
    result: tuple[Path, ScoreResult], tmp_path: Path
) -> None:
    path, scored = result
    found = check(read_result(path))
    assert (found.episodes, found.wrong, found.inexact) == (3, {}, [])

    # Episodes that were claimed, not done: the digest is right, the replay tells.
    content = json.loads(path.read_text())
    for entry in content["episodes"]:
        entry["record"]["success_once"] = True
    claimed = tmp_path / "claimed.json"
    episodes = [
        ScoredEpisode(e.row, _won(e.record), e.start, e.actions) for e in scored.episodes
    ]
    write_result(claimed, scored.facts, episodes)
    assert len(check(read_result(claimed)).wrong) == 3


def test_a_check_sees_what_capabilities_and_starts_are_made_of(
    result: tuple[Path, ScoreResult], tmp_path: Path
) -> None:
    _, scored = result
    first, *rest = scored.episodes
    (subtask,) = first.record.subtasks
    forged = dataclasses.replace(
        subtask,
        events=((1, "contact"), (2, "grasped"), (3, "at_goal")),
        label="straightforward_success",
    )
    other = dataclasses.replace(first.record, subtasks=(forged,))
    for changed, kept in (
        (dataclasses.replace(first, record=other), "wrong"),
        (dataclasses.replace(first, start="0" * len(first.start)), "inexact"),
    ):
        path = tmp_path / f"{kept}.json"
        write_result(path, scored.facts, [changed, *rest])
        found = check(read_result(path), seed=3)
        assert found.seed == 3 and len(getattr(found, kept)) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("policies", {}), ("policy", None), ("versions", 3), ("policies", {"x": 1})],
)
def test_facts_that_cannot_be_read_are_refused(
    result: tuple[Path, ScoreResult], tmp_path: Path, name: str, value: Any
) -> None:
    _, scored = result
    with refused(where="facts.json", said=f"edited: facts.{name}"):
        write_result(
            tmp_path / "facts.json", {**scored.facts, name: value}, scored.episodes
        )


def test_perturbed_arms_are_paired_with_the_clean_episodes(
    result: tuple[Path, ScoreResult], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "score"
    shutil.copytree(result[0].parent, out)
    asked = ["--policy", "random", "--worlds", "2", "--threads", "1", "--out", str(out)]
    axes = "language:2,start:2"
    assert main(["score", *asked, "--perturb", axes, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    low = told["axes"][0]["low"]
    same = {"success_once": 0.0, "difference": 0.0, "low": low, "high": -low}
    assert told["axes"] == [
        {"axis": axis, "level": 2, **same, "episodes": 3}
        for axis in ("start", "language")
    ]
    assert set(told) == {"clean", "axes"} and told["clean"]["episodes"] == 3
    scored = read_result(out / "result.json")
    assert scored.summary == result[1].summary
    assert perturbed_arms(scored.facts) == told["axes"]
    assert check(scored, seed=1).wrong == {}
    for row in ROWS:
        folder = out / "perturbed" / "start_2" / row.name
        for record in read_records(folder):
            assert record.perturbation["start"]["level"] == 2
            (plain,) = (
                e.record
                for e in scored.episodes
                if (e.row, e.record.index) == (row.name, record.index)
            )
            assert record.final_state != plain.final_state
            assert record.instruction == plain.instruction
    details = json.loads((out / "robustness.json").read_text())
    # Sentences do not reach a policy that does not listen: those episodes are not run again.
    assert details["axes"][1]["unreached"] == [row.name for row in ROWS]
    assert details["axes"][0]["unreached"] == []
    redrawn = [
        record.perturbation["start"]["redrawn"]
        for row in ROWS
        for record in read_records(out / "perturbed" / "start_2" / row.name)
    ]
    assert details["axes"][0]["redrawn"] == sum(redrawn)
    assert (details["axes"][0]["kept"], details["axes"][1]["redrawn"]) == (0, 0)
    assert not (out / "perturbed" / "language_2").exists()
    assert details["axes"][1]["labels"] == [] and details["axes"][1]["p"] == 1.0
    page = (out / "robustness.html").read_text(encoding="utf-8")
    assert "random, subtasks, under perturbations" in page and '"language 2"' in page
    assert "Nothing of language reaches the policy" in page
    assert "| policy | start 2 | language 2 |" in leaderboard([scored])
    assert "Under perturbations" not in leaderboard([result[1]])


@pytest.mark.parametrize(
    "arms", [{}, [3], [{"axis": "light"}], [{"axis": "light", "level": True}]]
)
def test_arms_that_are_no_numbers_are_refused(
    result: tuple[Path, ScoreResult], tmp_path: Path, arms: Any
) -> None:
    facts = {**result[1].facts, "perturbed": arms}
    with refused("facts.perturbed", where="was edited"):
        write_result(tmp_path / "arms.json", facts, result[1].episodes)


def test_rows_by_name(small: Any) -> None:
    asked = manifest("subtasks", "test")
    names = [row.name for row in ROWS]
    assert [row.name for row in runs.rows_of(asked, ())] == names
    assert [row.name for row in runs.rows_of(asked, names[1:])] == names[1:]
    with refused(
        "row", "set_table.clos", expected="set_table.close.kitchen_counter-drawer3"
    ):
        runs.rows_of(asked, ["set_table.clos"])


def test_an_axis_that_is_none_is_refused_before_anything_is_run() -> None:
    with refused("axis of perturbation", "lihgt", expected="light"):
        ScoreSpec.of("random", perturb="lihgt:2")
    assert ScoreSpec.of("random", perturb={"light": 2}).perturb == "light:2"


def _won(record: Any) -> Any:
    from dataclasses import replace

    return replace(record, success_once=True, completed=1)


@pytest.mark.parametrize(
    "what", ["score", "record", "digest", "row", "manifest", "twice"]
)
def test_an_edited_file_is_refused(
    result: tuple[Path, ScoreResult], tmp_path: Path, what: str
) -> None:
    path, _ = result
    content = json.loads(path.read_text())
    sealed = what in ("row", "manifest", "twice")
    if what == "score":
        content["summary"]["score"] = 1.0
    elif what == "record":
        content["episodes"][0]["record"]["success_once"] ^= True
    elif what == "digest":
        content["digest"] = "0" * 64
    elif what == "row":
        content["episodes"][0]["row"] = "set_table.pick"
    elif what == "manifest":
        content["facts"]["manifest"] = "older"
    else:
        content["episodes"].append(content["episodes"][0])
    if sealed:
        content["digest"] = digest_of(content)
    edited = tmp_path / "edited.json"
    edited.write_text(json.dumps(content))
    expected = "not in the manifest|cannot be compared" if sealed else "was edited"
    with pytest.raises(UsageError, match=expected):
        read_result(edited)


def test_numbers_that_are_not_those_of_the_episodes_are_refused(
    result: tuple[Path, ScoreResult], tmp_path: Path
) -> None:
    content = json.loads(result[0].read_text())
    content["summary"]["score"] = 0.99
    content["digest"] = digest_of(content)
    edited = tmp_path / "sealed.json"
    edited.write_text(json.dumps(content))
    with refused(where="sealed.json", said="its numbers do not follow from its episodes"):
        read_result(edited)
    for text in ("", "[]", "{}", "[" * 100_000):
        edited.write_text(text)
        with refused(where="sealed.json", said="not a result file"):
            read_result(edited)


def test_a_table_has_policies_rows_and_capabilities(
    result: tuple[Path, ScoreResult],
) -> None:
    page = leaderboard([result[1]])
    assert "| random | test |" in page and "(incomplete)" not in page
    assert all(f"| {row.name} |" in page for row in ROWS)
    assert (
        "| policy | reach | grasp | carry | articulate | navigate | under force limit |"
        in page
    )


def test_starts_tell_episodes_from_others(
    small: Any, result: tuple[Path, ScoreResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mjhab.evaluation.score.starts import starts_of

    row = ROWS[0]
    digests = starts_of(manifest("subtasks", "test"), row, 1, 1)
    assert digests == [e.start for e in result[1].episodes if e.row == row.name]
    assert len(set(digests)) == row.episodes
    monkeypatch.setattr(
        manifests, "_starts", lambda: {"subtasks/test": {row.name: digests}}
    )
    asked = manifest("subtasks", "test")
    assert summary_of(asked, result[1].episodes)["complete"]
    digests[1] = "elsewhere"
    other = summary_of(manifest("subtasks", "test"), result[1].episodes)
    assert other["other_starts"] == 1 and not other["complete"]


def test_the_starts_of_the_package_fit_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    # What `small` has changed for other tests may still be so.
    for track, told in ALL_TRACKS.items():
        monkeypatch.setitem(manifests.TRACKS, track, told)
    for name, rows in json.loads(manifests.STARTS_FILE.read_text()).items():
        asked = manifest(*name.split("/")[:2])
        lengths = {row.name: asked.count(row) for row in asked.rows}
        assert {
            row: len(digests) for row, digests in rows.items()
        }.items() <= lengths.items()


def test_actions_come_back_and_are_played_to_their_end() -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 13)).astype(np.float32)
    np.testing.assert_array_equal(unpacked_actions(packed_actions(actions)), actions)
    for text in ("", "13:!!", "13:eJw=", "0:", packed_actions(np.full((1, 2), np.nan))):
        with refused(said="actions of an episode"):
            unpacked_actions(text)
    player = Replayed(2, 13, {4: actions}, {4: "no answer"})
    player.reset(np.ones(2, bool))
    info = {"episode_spec": [{"index": 4}, {"index": 9}]}
    for step in range(5):
        acted = player.act(None, info)
        np.testing.assert_array_equal(acted[0], actions[step])
        assert player.fault(0) == ("no answer" if step == 4 else "")
        assert "end here" in player.fault(1)


def test_scores_of_another_robot_are_of_another_manifest() -> None:
    own = manifest("subtasks", "test")
    other = manifest("subtasks", "test", "panda_omron")
    assert other.rows == own.rows and other.digest != own.digest and not other.starts
    assert manifest_of({"track": "subtasks", "split": "test"}) == own
    facts = {"track": "subtasks", "split": "test", "robot": "panda_omron"}
    assert manifest_of(facts) == other
    with refused("robot", "pandas", expected="panda_omron"):
        manifest("subtasks", "test", "pandas")


def test_other_rules_are_refused() -> None:
    check_rules(PolicyFacts("fine", env_options={"obs_mode": "rgb", "profile": "mjhab"}))
    with refused("env_options", {"force_limits": False}, advice="profile mjhab"):
        check_rules(PolicyFacts("sly", env_options={"force_limits": False}))
    with refused("track", "subtask"):
        manifest("subtask", "test")
    with refused("split", "tset"):
        manifest("subtasks", "tset")


def test_a_policy_of_another_profile_sees_and_moves_as_there_by_our_rules() -> None:
    plain = PolicyFacts("plain", env_options={"obs_mode": "rgb", "profile": "mjhab"})
    assert scored_options(plain) == {"obs_mode": "rgb"}
    trained = PolicyFacts("trained", env_options={"camera_size": 32, "profile": "ms_hab"})
    assert scored_options(trained) == {
        "camera_size": 32,
        "profile": "mjhab",
        "stationary": ("head",),
    }


def test_the_profile_counts_what_tells_something() -> None:
    def record(kind: str, label: str, *events: str, good: bool = False) -> SubtaskRecord:
        told = tuple((step, name) for step, name in enumerate(events))
        return SubtaskRecord(0, kind, "x", label, None, good, good, 0, 9, 0.0, 0.0, told)

    found = profile(
        [
            record("pick", "cant_grasp_failure", "contact"),
            record("pick", "excessive_collision_failure", "contact", "grasped"),
            record("open", "open_success", "contact", good=True),
            record("place", "drop_to_goal_failure", "at_goal"),
        ]
    )
    rates = {name: entry["rate"] for name, entry in found.items()}
    assert rates == {
        "reach": 1.0,
        "grasp": 0.5,
        "carry": 1.0,
        "articulate": 1.0,
        "navigate": None,
        "under force limit": 0.75,
    }


def test_the_command_warns_of_a_policy_that_was_never_trained(
    result: tuple[Path, ScoreResult],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    facts = dataclasses.replace(runs.describe_policy("random"), caution="it is random.")
    monkeypatch.setattr(runs, "describe_policy", lambda _: facts)
    told = runs.facts_for("random", ROWS[0])
    assert told is not None and told.described["policy_caution"] == "it is random."
    scored = dataclasses.replace(
        result[1],
        facts={**result[1].facts, "policies": {"a": told.described, "b": {}}},
    )
    monkeypatch.setattr(score_command, "score", lambda *_: scored)
    out = str(result[0].parent)
    assert main(["score", "--policy", "random", "--out", out, "--json"]) == 0
    assert capsys.readouterr().err == "mjhab: it is random.\n"


def test_the_command_checks_and_tabulates(
    result: tuple[Path, ScoreResult], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(result[0])
    scored = read_result(result[0])
    page = tmp_path / "page.md"
    assert main(["score", "--table", path, "--page", str(page), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["results"][0]["digest"] == scored.digest
    assert page.read_text() == leaderboard([scored])
    assert main(["score", "--check", path, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (told["checked"], told["exact"], told["wrong"]) == (3, 3, 0)
    assert set(told) >= {"track", "score", "episodes", "digest"}


@pytest.mark.parametrize(
    "words",
    [
        ["check", "result.json", "--policy", "zero"],
        ["check", "result.json", "--episodes", "3"],
        ["table", "result.json", "--seed", "1"],
        ["starts", "--policy", "zero"],
        ["--check-seed", "1"],
    ],
)
def test_options_of_another_command_are_refused(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["score", *words])
    assert ended.value.code == 2
    assert (
        next(word for word in words if word.startswith("--")) in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["check", "FOLDER"], "a folder; give the result.json in it"),
        (["table", "RESULT", "SUMMARY"], "the same result as"),
    ],
)
def test_a_folder_and_a_result_given_twice_are_refused(
    words: list[str],
    message: str,
    result: tuple[Path, ScoreResult],
) -> None:
    file = result[0]
    places = {
        "RESULT": file,
        "FOLDER": file.parent,
        "SUMMARY": file.with_name("summary.json"),
    }
    with refused(where=file.parent, said=message):
        command("score", *(places.get(word, word) for word in words))


def test_a_summary_makes_the_same_table_and_cannot_be_checked(
    result: tuple[Path, ScoreResult], tmp_path: Path
) -> None:
    summary = result[0].with_name("summary.json")
    assert leaderboard([read_for_table(summary)]) == leaderboard(
        [read_for_table(result[0])]
    )
    with refused(
        where="summary.json", said="no episodes to verify; give the result.json"
    ):
        read_result(summary)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("version",), 9, "not a summary of version"),
        (("facts",), 3, "damaged"),
        (("facts", "manifest"), "older", "cannot be compared"),
        (("facts", "versions"), None, "facts.versions"),
        (("summary", "score"), "high", "its summary is not that of a score"),
        (("summary", "rows", 0, "interval"), [0.0], "its summary is not that of a score"),
        (("summary", "rows", 0, "name"), "mine", "its summary is not that of a score"),
        (("summary", "capabilities"), {}, "its summary is not that of a score"),
    ],
)
def test_a_broken_summary_is_refused(
    result: tuple[Path, ScoreResult],
    tmp_path: Path,
    place: tuple[Any, ...],
    value: Any,
    message: str,
) -> None:
    content = json.loads(result[0].with_name("summary.json").read_text())
    *way, last = place
    part = content
    for key in way:
        part = part[key]
    part[last] = value
    broken = tmp_path / "summary.json"
    broken.write_text(json.dumps(content))
    with refused(where="summary.json", said=message):
        read_for_table(broken)
