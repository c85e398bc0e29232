"""`benchmarks.steps`: it steps, and refuses what is no number of worlds."""

from __future__ import annotations

import pytest

from benchmarks import steps


def test_it_steps_and_resets(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "STEPS_PER_RESET", 2)
    words = "--subtask close --task set_table --num-envs 1 --seconds 0.01".split()
    assert steps.main(words) == 0
    assert "control steps/s with resets" in capsys.readouterr().out
    assert steps.main(["--num-envs", "0"]) == 2
    assert "--num-envs must be at least 1" in capsys.readouterr().err
