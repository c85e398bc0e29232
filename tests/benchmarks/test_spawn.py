"""`benchmarks.spawn`: starts per second."""

from __future__ import annotations

import json

import pytest

from benchmarks.spawn import main


def test_starts_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    words = "--task set_table --subtask pick --count 20 --pool 2 --fresh 1 --json".split()
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"spawns_per_s", "tries_mean", "fallbacks", "episode_s"} <= set(found)
    assert found["spawns_per_s"] > 0 and found["tries_mean"] >= 1
    assert found["fallbacks"] == 0 and found["episode_s"] > 0
