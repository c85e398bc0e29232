"""`benchmarks.sim` and `benchmarks.grasp` as commands: keys for machines, exit codes, wrong numbers."""

from __future__ import annotations

import json
from typing import Any, cast

import numpy as np
import pytest

from benchmarks import grasp, sim
from mjhab.bench.environments.speed import WARM_STEPS, measure_sps
from tests.rollout.fake_env import FakeEnv


class TimedEnv(FakeEnv):
    """Counts engine steps."""

    bare_steps = 0
    ctrl = np.zeros((1, 15))

    @property
    def sim(self) -> TimedEnv:
        return self

    def bare_step(self, ctrl: np.ndarray) -> None:
        self.bare_steps += 1


def test_bench_sim_measures_both_on_the_same_worlds() -> None:
    env = TimedEnv(3, quality=1.0)
    result = measure_sps(cast("Any", env), steps=5, rounds=4, seed=0)
    assert list(result) == ["engine_sps", "env_sps", "ratio", "worlds", "reset_ms"]
    assert result["worlds"] == 3 and 0 < result["env_sps"] < result["engine_sps"]
    assert result["ratio"] == pytest.approx(
        result["env_sps"] / result["engine_sps"], abs=1e-3
    )
    assert env.bare_steps == 20 and env.steps_taken == 4 * (2 * 5 + 3 * WARM_STEPS)
    # Every round runs its episodes three times: to record the commands, and timed for either side.
    assert env.resets == [[r, r + 1, r + 2] for r in (0, 3, 6, 9) for _ in range(3)]


def test_it_prints_the_keys(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "mjhab.envs.make", lambda **options: TimedEnv(options["num_envs"], quality=1.0)
    )
    words = ["--worlds", "2", "--steps", "3", "--rounds", "2", "--threads", "2", "--json"]
    assert sim.main(words) == 0
    result = json.loads(capsys.readouterr().out)
    keys = ["engine_sps", "env_sps", "ratio", "worlds", "reset_ms", "threads"]
    assert list(result) == keys
    assert (result["worlds"], result["threads"]) == (2, 2)


def test_bench_grasp_fails_when_an_object_drops(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [{"object": "013_apple", "slip_mm": 1.2, "dropped": False}]
    monkeypatch.setattr(grasp, "grasp_table", lambda **options: rows)
    assert grasp.main(["--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"grasps": rows}
    rows.append({"object": "024_bowl", "slip_mm": 99.0, "dropped": True})
    assert grasp.main([]) == 1
    assert "024_bowl" in capsys.readouterr().out


def test_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert sim.main(["--worlds", "0"]) == 2
    assert "--worlds must be at least 1" in capsys.readouterr().err
    assert sim.main(["--task", "tidy"]) == 2
    assert "tidy_house" in capsys.readouterr().err
    assert grasp.main(["--seconds", "0"]) == 2
    assert "--seconds must be at least" in capsys.readouterr().err
