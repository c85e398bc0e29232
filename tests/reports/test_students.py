"""The table of students: rows of runs and evaluations, and rows that are judged again."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from mjhab.reports.students import judged_row, main, read_rows, student_row
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import ZeroPolicy
from mjhab.rollout.store import EvaluationFolder
from tests.refusals import refused
from tests.rollout.fake_env import FakeEnv

SUMMARY = {
    "steps": 10,
    "samples": 80,
    "seconds": 6.0,
    "cpu_seconds": 12.0,
    "demonstrations": 7,
}


def make_run(folder: Path, size: int = 64) -> Path:
    student = {"preset": "small", "inputs": {"image_size": size}}
    config = {
        "algorithm": "bc",
        "config": {"student": student},
        "scene": {"task": "set_table", "split": "train"},
        "seed": 0,
    }
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(config))
    told = {**SUMMARY, "frames": 900, "device": "cuda:0", "commit": "abc"}
    (folder / "summary.json").write_text(json.dumps(told))
    (folder / "metrics.jsonl").write_text('{"step": 5, "success_once": 0.25}\n')
    (folder / "student.safetensors").write_bytes(b"weights")
    (folder / "compact.safetensors").write_bytes(b"small")
    return folder


def make_evaluation(folder: Path, weights: bytes, **changes: Any) -> Path:
    config = {
        "task": "tidy_house",
        "subtask": "pick",
        "target": None,
        "assets": "builtin",
        "seed": 0,
        "split": "val",
        "profile": "ms_hab",
        "policy_profile": "ms_hab",
        "policy_sha256": hashlib.sha256(weights).hexdigest(),
        "horizon": 200,
        "env": {"obs_mode": "depth", "camera_size": 64},
        **changes,
    }
    records = rollout(FakeEnv(2), ZeroPolicy(), range(4), 0)
    with EvaluationFolder.open(folder, config) as store:
        for record in records:
            store.add(record)
    return folder


def test_a_row_joins_training_and_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run")
    judged = make_evaluation(tmp_path / "judged", b"small")
    file = tmp_path / "students.json"
    assert main([str(file), str(run), str(judged)]) == 0
    assert "tidy_house pick" in capsys.readouterr().out
    (row,) = read_rows(file)
    assert (row["task"], row["target"], row["image_size"]) == ("tidy_house", "", 64)
    training = row["training"]
    assert (training["episodes"], training["frames"], training["device"]) == (
        7,
        900,
        "cuda:0",
    )
    assert training["commits"] == ["abc"] and training["cpu_minutes"] == 0.2
    assert training["success_once_on_the_way"] == [0.25]
    assert row["evaluation"]["episodes"] == 4

    again = make_evaluation(tmp_path / "again", b"other", seed=1)
    assert main([str(file), "-", str(again)]) == 0
    (newer,) = read_rows(file)
    assert newer["training"] == training and newer["evaluation"]["seed"] == 1


def test_a_row_of_another_image_size_stays(tmp_path: Path) -> None:
    file = tmp_path / "students.json"
    for size, weights in ((32, b"weights"), (64, b"weights")):
        run = make_run(tmp_path / f"run{size}", size)
        assert (
            main(
                [
                    str(file),
                    str(run),
                    str(make_evaluation(tmp_path / f"e{size}", weights)),
                ]
            )
            == 0
        )
    assert [row["image_size"] for row in read_rows(file)] == [32, 64]


def test_rows_of_other_seeds_and_packs_stay_and_name_no_folder(tmp_path: Path) -> None:
    file = tmp_path / "students.json"
    run = make_run(tmp_path / "run")
    judged = [
        make_evaluation(tmp_path / "built-in", b"weights"),
        make_evaluation(tmp_path / "scanned", b"weights", assets="/data/replica_cad"),
    ]
    for evaluation in judged:
        assert main([str(file), str(run), str(evaluation)]) == 0
    config = json.loads((run / "config.json").read_text(encoding="utf-8"))
    (run / "config.json").write_text(json.dumps({**config, "seed": 1}), encoding="utf-8")
    assert main([str(file), str(run), str(judged[0])]) == 0
    # Trained with walls beside doors, judged in the same homes.
    scene = {**config["scene"], "assets": {"place": "builtin", "door_walls": 2}}
    (run / "config.json").write_text(json.dumps({**config, "scene": scene}))
    assert main([str(file), str(run), str(judged[0])]) == 0
    found = [(row["assets"], row["seed"]) for row in read_rows(file)]
    packs = [("builtin", 0), ("replica_cad", 0), ("builtin", 1)]
    assert found == [*packs, ("builtin?door_walls=2", 0)]


def test_students_that_act_together_are_one_row(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name) for name in ("one", "two")]
    both = "".join(
        hashlib.sha256(weights).hexdigest() for weights in (b"small", b"weights")
    )
    judged = make_evaluation(tmp_path / "judged", both.encode())
    file = tmp_path / "students.json"
    assert main([str(file), "+".join(map(str, runs)), str(judged)]) == 0
    training = read_rows(file)[0]["training"]
    assert (training["members"], training["episodes"], training["cpu_minutes"]) == (
        2,
        14,
        0.4,
    )


def test_what_does_not_belong_together_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run")
    judged = make_evaluation(tmp_path / "judged", b"of another student")
    with refused(where="judged", said="not an evaluation of a checkpoint"):
        student_row(run, judged)
    with refused(said="0 rows are of tidy_house/pick//64/builtin/0, not one"):
        judged_row([], judged)
    assert main([str(tmp_path / "f.json"), str(run), str(tmp_path / "nothing")]) == 1
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "f.json").exists()
