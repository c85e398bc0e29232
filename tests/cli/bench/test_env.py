"""`mjhab envs`, `mjhab bench env|soak|reward`: what they print and write."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mjhab.bench.environments.reward import auc, figure, summary
from mjhab.bench.environments.stages import STAGES
from mjhab.bench.soak.run import CURVE_POINTS, MemoryCurve
from mjhab.cli.main import main
from mjhab.cli.options.env import EnvsDescribeOptions
from mjhab.cli.worlds.envs import description
from mjhab.envs.catalog import env_ids
from tests.examples.plugins import loaded


def run(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, dict]:
    code = main([*args, "--json"])
    out = capsys.readouterr().out
    return code, json.loads(out.splitlines()[-1]) if out else {}


def test_envs_list_and_describe(capsys: pytest.CaptureFixture[str]):
    code, found = run(capsys, "envs", "list")
    assert code == 0 and [env["id"] for env in found["envs"]] == list(env_ids())
    assert found["envs"][2] == {
        "id": "mjhab/SetTable-v1",
        "task": "set_table",
        "subtask": None,
        "plugin": "",
        "robot": "fetch",
    }
    assert {env["robot"] for env in found["envs"]} == {"fetch"}
    assert (
        found["envs"][6]["subtask"] == "close" and found["envs"][6]["task"] == "set_table"
    )
    code, found = run(
        capsys,
        "envs",
        "describe",
        "mjhab/OpenSubtaskTrain-v1",
        "--obs",
        "depth",
        "--control",
        "pd_joint_vel",
    )
    assert (
        code == 0
        and len(found["actions"]) == 13
        and found["actions"][0]["unit"] == "rad/s"
    )
    keys = [row["key"] for row in found["observations"]]
    assert "sensor_data/fetch_head/depth" in keys and "agent/qpos" in keys
    assert sum(t["scale"] for t in found["reward_terms"] if t["when"] == "always") > 0
    assert {t["subtask"] for t in found["reward_terms"]} == {"open"} and found[
        "horizons"
    ] == {"open": 200}


GOAL = "extra/goal_pos_wrt_base"
OBJECT = "extra/obj_pose_wrt_base"


@pytest.mark.parametrize(
    ("env", "key", "told"),
    [
        (
            "Pick",
            OBJECT,
            "Pick: its object (position, quaternion with w >= 0, in the axes of object_axes); zero once",
        ),
        ("Pick", GOAL, "zero in Pick (position); zero once"),
        ("Place", GOAL, "Place: where its object goes"),
        ("Close", OBJECT, "zero in Close"),
        ("Open", GOAL, "Open: the handle"),
        ("Push", GOAL, "Push: where its object goes"),
    ],
)
def test_the_goal_is_explained_by_the_spec_of_the_subtask(
    env: str, key: str, told: str
) -> None:
    with loaded("push"):
        options = EnvsDescribeOptions(f"mjhab/{env}SubtaskTrain-v1")
        rows = {
            row["key"]: row["meaning"] for row in description(options)["observations"]
        }
    assert told in rows[key]
    others = {"Pick", "Place", "Close", "Open", "Push", "Navigate"} - {env}
    assert not any(other in rows[key] for other in others)


def test_an_unknown_id_names_the_nearest(capsys: pytest.CaptureFixture[str]):
    assert main(["envs", "describe", "mjhab/PickSubtask-v1"]) == 2
    assert "mjhab/PickSubtaskTrain-v1" in capsys.readouterr().err


def test_bench_env_splits_the_time_of_a_step(capsys: pytest.CaptureFixture[str]):
    small = (
        "--worlds",
        "1",
        "2",
        "--steps",
        "3",
        "--rounds",
        "1",
        "--camera-size",
        "16",
        "--threads",
        "1",
    )
    code, found = run(
        capsys,
        "bench",
        "env",
        "--env",
        "mjhab/CloseSubtaskTrain-v1",
        "--obs",
        "depth",
        *small,
    )
    assert code == 0 and list(found["stages"]) == list(STAGES)
    for stage in ("physics", "measure", "reward", "render", "reset"):
        assert found["stages"][stage] > 0, stage
    # Which of them is faster is a matter of what else the machine does.
    for rate in ("env_sps", "engine_sps", "cold_start_s"):
        assert found[rate] > 0, rate
    points = found["points"]
    assert found["backend"] == "cpu" and [point["worlds"] for point in points] == [1, 2]
    assert found["env_sps"] == max(point["env_sps"] for point in points)
    assert main(["bench", "env", "--worlds", "0"]) == 2


def test_bench_soak_counts_steps_and_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    code, found = run(
        capsys,
        "bench",
        "soak",
        "--out",
        str(tmp_path),
        "--steps",
        "2050",
        "--worlds",
        "2",
        "--threads",
        "1",
        "--task",
        "tidy_house",
    )
    assert found["steps"] == 2052 and len(found["rss_mb"]) == 4
    assert code == (0 if found["ok"] else 1)
    assert 0 < sum(found["cache_mb"].values()) <= found["cache_limit_mb"]
    assert json.loads((tmp_path / "soak.json").read_text()) == found
    assert "<polyline" in (tmp_path / "memory.svg").read_text()
    # 342 steps of each of pick, place and navigate; the first two end after 200.
    assert found["episodes"] == 4 and set(found["tainted"]) >= {"nan", "penetration"}


def test_memory_is_judged_by_its_second_half(monkeypatch: pytest.MonkeyPatch):
    readings = iter([100.0, 200.0, 203.0, 205.0, 207.0])
    monkeypatch.setattr("mjhab.bench.soak.run.resident_mb", lambda: next(readings))
    curve = MemoryCurve(4 * CURVE_POINTS)
    for done in (CURVE_POINTS, 2 * CURVE_POINTS, 3 * CURVE_POINTS, 4 * CURVE_POINTS):
        curve.note(done)
    found = curve.summary()
    assert found["rss_mb"] == [100.0, 200.0, 203.0, 205.0]
    assert found["growth_second_half"] == 0.025 and found["ok"]
    curve.points[-1] = (4 * CURVE_POINTS, 207.0)
    assert not curve.summary()["ok"]


def test_bench_reward_writes_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    args = (
        "--episodes",
        "2",
        "--worlds",
        "2",
        "--subtasks",
        "open",
        "--threads",
        "1",
        "--out",
        str(tmp_path),
    )
    code, found = run(capsys, "bench", "reward", *args)
    told = found["subtasks"]["open"]
    assert code == 0 and told["episodes"] == 2 and told["rise_success"] > 0.2
    assert "reward-open" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert main(["bench", "reward", "--subtasks", "pick,hold"]) == 2


def test_auc_is_the_chance_that_success_scores_higher():
    good = np.array([True, True, False, False])
    assert auc(np.array([3.0, 2.0, 1.0, 0.0]), good) == 1.0
    assert auc(np.array([0.0, 1.0, 2.0, 3.0]), good) == 0.0
    assert auc(np.array([1.0, 1.0, 1.0, 1.0]), good) == 0.5
    assert auc(np.array([3.0, 1.0, 2.0, 0.0]), good) == 0.75
    assert auc(np.array([3.0, 1.0]), np.array([True, True])) is None


def test_summary_and_figure_of_two_curves():
    rising = np.linspace(0, 1, 20)
    flat = np.full(20, 0.1)
    told = summary([(True, rising), (False, flat)])
    assert told["auc"] == 1.0 and told["successes"] == 1 and told["rising"] == 1.0
    assert told["rise_success"] == pytest.approx(18 / 19, abs=1e-3) and told[
        "return_failure"
    ] == pytest.approx(2.0)
    names = [
        trace.get("name") for trace in figure([(True, rising), (False, flat)])["data"]
    ]
    assert names[2] == "success (1 episodes)" and names[5] == "failure (1 episodes)"


def test_the_cpu_backend_measures_no_gpu(capsys: pytest.CaptureFixture[str]):
    assert main(["bench", "env", "--device", "cuda:0", "--worlds", "1"]) == 2
    assert "backend 'cpu' has no device 'cuda:0'" in capsys.readouterr().err


def test_random_actions_are_of_no_single_subtask(capsys: pytest.CaptureFixture[str]):
    assert main(["bench", "soak", "--subtask", "pick", "--steps", "1"]) == 2
    assert "--subtask needs --generate" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "work"),
    [
        ("soak", "mjhab.cli.bench.soak.soak"),
        ("interact", "mjhab.cli.bench.interact.measure_interact"),
        ("reward", "mjhab.cli.bench.reward.measure_rewards"),
    ],
)
def test_a_file_in_place_of_the_folder_is_told_before_the_work(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    work: str,
):
    file = tmp_path / "there"
    file.touch()
    monkeypatch.setattr(work, lambda options: pytest.fail("it began"))
    assert main(["bench", command, "--out", str(file)]) == 2
    assert f"--out {file} is a file; give a folder" in capsys.readouterr().err
