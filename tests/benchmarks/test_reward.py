"""`benchmarks.reward`: what it prints and writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import reward


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = reward.main([*words, "--json"])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_bench_reward_writes_curves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = (
        *"--episodes 2 --worlds 2 --subtasks open --threads 1 --out".split(),
        str(tmp_path),
    )
    code, found = run(capsys, *args)
    told = found["subtasks"]["open"]
    assert code == 0 and told["episodes"] == 2 and told["rise_success"] > 0.2
    assert "reward-open" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert reward.main(["--subtasks", "pick,hold"]) == 2


def test_auc_is_the_chance_that_success_scores_higher() -> None:
    good = np.array([True, True, False, False])
    assert reward.auc(np.array([3.0, 2.0, 1.0, 0.0]), good) == 1.0
    assert reward.auc(np.array([0.0, 1.0, 2.0, 3.0]), good) == 0.0
    assert reward.auc(np.array([1.0, 1.0, 1.0, 1.0]), good) == 0.5
    assert reward.auc(np.array([3.0, 1.0, 2.0, 0.0]), good) == 0.75
    assert reward.auc(np.array([3.0, 1.0]), np.array([True, True])) is None


def test_summary_and_figure_of_two_curves() -> None:
    rising = np.linspace(0, 1, 20)
    flat = np.full(20, 0.1)
    told = reward.summary([(True, rising), (False, flat)])
    assert told["auc"] == 1.0 and told["successes"] == 1 and told["rising"] == 1.0
    assert told["rise_success"] == pytest.approx(18 / 19, abs=1e-3) and told[
        "return_failure"
    ] == pytest.approx(2.0)
    names = [
        trace.get("name")
        for trace in reward.figure([(True, rising), (False, flat)])["data"]
    ]
    assert names[2] == "success (1 episodes)" and names[5] == "failure (1 episodes)"


def test_a_file_in_place_of_the_folder_is_told_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "there"
    file.touch()
    monkeypatch.setattr(reward, "measure_rewards", lambda spec: pytest.fail("it began"))
    assert reward.main(["--out", str(file)]) == 2
    assert f"--out must be a folder, not a file, got '{file}'" in capsys.readouterr().err
