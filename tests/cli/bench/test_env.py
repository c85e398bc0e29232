"""`mjhab envs`, `mjhab bench env`: what they print and write."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mjhab.bench.environments.stages import STEP_STAGES
from mjhab.cli.main import main
from mjhab.cli.worlds.envs import EnvsDescribeSpec, description
from mjhab.envs.catalog import env_ids
from tests.examples.plugins import loaded
from tests.refusals import command, refused


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
        options = EnvsDescribeSpec(f"mjhab/{env}SubtaskTrain-v1")
        rows = {
            row["key"]: row["meaning"] for row in description(options)["observations"]
        }
    assert told in rows[key]
    others = {"Pick", "Place", "Close", "Open", "Push", "Navigate"} - {env}
    assert not any(other in rows[key] for other in others)


def test_an_unknown_id_names_the_nearest():
    with refused(expected="mjhab/PickSubtaskTrain-v1"):
        command("envs", "describe", "mjhab/PickSubtask-v1")


def test_bench_env_splits_the_time_of_a_step(capsys: pytest.CaptureFixture[str]):
    small = "--worlds 1 2 --steps 3 --rounds 1 --camera-size 16 --threads 1".split()
    code, found = run(
        capsys,
        *"bench env --env mjhab/CloseSubtaskTrain-v1 --obs depth".split(),
        *small,
    )
    assert code == 0 and list(found["stages"]) == list(STEP_STAGES)
    for stage in ("physics", "measure", "reward", "render", "reset"):
        assert found["stages"][stage] > 0, stage
    # Which of them is faster is a matter of what else the machine does.
    for rate in ("env_sps", "engine_sps", "cold_start_s"):
        assert found[rate] > 0, rate
    points = found["points"]
    assert found["backend"] == "cpu" and [point["worlds"] for point in points] == [1, 2]
    assert found["env_sps"] == max(point["env_sps"] for point in points)
    assert main(["bench", "env", "--worlds", "0"]) == 2


def test_the_cpu_backend_measures_no_gpu():
    with refused("device", "cuda:0", expected="left out with backend 'cpu'"):
        command("bench", "env", "--device", "cuda:0", "--worlds", "1")


def test_a_file_in_place_of_the_folder_is_told_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    file = tmp_path / "there"
    file.touch()
    work = "mjhab.cli.bench.interact.measure_interact"
    monkeypatch.setattr(work, lambda options: pytest.fail("it began"))
    with refused("--out", str(file), expected="a folder"):
        command("bench", "interact", "--out", file)
