"""`benchmarks.learner` with the worlds of the preset, and wrong numbers."""

from __future__ import annotations

import json

import pytest

from benchmarks import learner
from benchmarks.learner import main
from mjhab.learning.reinforcement.configs import ReinforcementConfig, changed

COMMAND = "--rounds 1 --updates 1 --batches 4 --threads 1 --json".split()


def test_it_measures_with_the_worlds_of_the_preset(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Presets as they are, but for worlds that would take minutes."""
    preset = learner.reinforcement_preset

    def few(*names: str) -> ReinforcementConfig:
        return changed(preset(*names), {"worlds": 3, "episode_pool": 3})

    monkeypatch.setattr(learner, "reinforcement_preset", few)
    assert main(COMMAND) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["ppo"]["worlds"] == 3 and found["ppo"]["ppo_sps"] > 0
    assert [row["batch"] for row in found["sac"]] == [4, 4]
    assert all(row["updates_per_second"] > 0 for row in found["sac"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--worlds", "-1"), "--worlds must be at least 1"),
        (("--rounds", "0"), "--rounds must be at least 1"),
        (("--batches", "1"), "--batches must be at least 2"),
    ],
)
def test_wrong_numbers(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert said in capsys.readouterr().err
