"""`benchmarks.curves`: finished runs are not run again, breaks, and wrong numbers; without training."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import curves
from benchmarks.curves import main
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs.run import TrainingResult

SUCCESS = (0.1, 0.6, 0.9)
"""At evaluations after 100, 200 and 300 samples."""


class Trainer:
    """Writes what a run leaves behind; the run of number ``broken`` is interrupted."""

    def __init__(self, broken: int = -1) -> None:
        self.broken = broken
        self.runs: list[tuple[str, bool]] = []

    def __call__(self, spec: ReinforcementSpec) -> TrainingResult:
        out = spec.out
        interrupted = len(self.runs) == self.broken
        self.runs.append((out.name, spec.resume))
        out.mkdir(parents=True, exist_ok=True)
        (out / "config.json").write_text("{}")
        count = 1 if interrupted else len(SUCCESS)
        lines = [
            json.dumps({"samples": 100 * (number + 1), "success_once": success})
            for number, success in enumerate(SUCCESS[:count])
        ]
        (out / "metrics.jsonl").write_text(
            "\n".join([json.dumps({"loss": 1.0}), *lines]) + "\n"
        )
        summary = {"samples": 100 * count, "episodes": 64}
        (out / "summary.json").write_text(json.dumps(summary))
        return TrainingResult(summary, out / "report.html", interrupted)


def test_a_run_that_is_done_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "--out",
        str(tmp_path / "out"),
        *"--samples 300 --seeds 2".split(),
    ]
    trainer = Trainer(broken=1)
    monkeypatch.setattr(curves, "train_reinforcement", trainer)
    assert main(words) == 130
    assert "The same command goes on" in capsys.readouterr().err
    trainer.broken = -1
    assert main([*words, "--json"]) == 0
    assert trainer.runs == [
        ("fast_0", False),
        ("fast_1", False),
        ("fast_1", True),
        ("paper_state_0", False),
        ("paper_state_1", False),
    ]
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert json.loads(Path(found["file"]).read_text()) == found["runs"]
    assert set(found["runs"]) == {"fast/0", "fast/1", "paper_state/0", "paper_state/1"}
    assert found["runs"]["fast/1"] == {
        "curve": [[100, 0.1], [200, 0.6], [300, 0.9]],
        "samples_to": {"0.5": 200, "0.8": 300},
    }


def test_a_rate_that_is_not_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(curves, "train_reinforcement", Trainer())
    monkeypatch.setitem(globals(), "SUCCESS", (0.1, 0.2, 0.6))
    assert main(["--out", str(tmp_path), "--samples", "300"]) == 0
    assert "not reached" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--samples", "0"), "--samples must be at least 1"),
        (("--seeds", "0"), "--seeds must be at least 1"),
    ],
)
def test_wrong_numbers(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert said in capsys.readouterr().err
