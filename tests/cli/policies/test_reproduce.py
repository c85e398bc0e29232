"""``mjhab reproduce table1``: rows of the paper, one student for each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mjhab.cli.main import main
from mjhab.learning import configs
from mjhab.learning.configs import DaggerConfig, InputConfig, TrainConfig
from mjhab.learning.reproduce.rows import table_rows
from mjhab.reports.paper import paper_success
from tests.learning.small import config

COMMAND = ["reproduce", "table1", "--rows", "set_table/close/drawer", "--preset", "tiny", "--json"]


def test_rows_are_those_of_the_paper() -> None:
    rows = table_rows()
    assert len(rows) == 10
    for split in ("train", "val"):
        found = [paper_success(row.task, row.subtask, split, row.target) for row in rows.values()]
        assert len({tuple(numbers.items()) for numbers in found}) == 10 and all(found)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--rows", "set_table/close/drawr"), "Did you mean 'set_table/close/drawer'"),
        (("--preset", "smal"), "Did you mean 'small'"),
        (("--split", "vla"), "unknown split"),
        (("--episodes", "0"), "--episodes must be at least 1"),
        (("--profile", "ms_hub"), "Did you mean 'ms_hab'"),
        (("--column", "rl_al"), "Did you mean 'rl_all'"),
        (("--column", "rl_all", "--preset", "small"), "preset"),
        (("--policies", "nowhere"), "not a folder of `mjhab reproduce`"),
    ],
)
def test_bad_input(
    words: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(["reproduce", "table1", "--out", str(out), *words]) == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_a_row_is_trained_judged_and_set_beside_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    student = config(inputs=InputConfig(image_size=16), demos=1, updates=2, hold_steps=5)
    dagger = DaggerConfig(rounds=0)
    monkeypatch.setitem(configs.PRESETS["dagger"], "tiny", TrainConfig(student, dagger))
    words = [
        *COMMAND,
        "--out",
        str(tmp_path),
        "--worlds",
        "1",
        "--threads",
        "1",
        "--split",
        "train",
    ]
    words += ["--episodes", "1"]
    assert main(words) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert row["row"] == "set_table/close/drawer" and row["episodes"] == 1
    assert row["low"] <= row["success_once"] <= row["high"]
    assert row["paper"] == {"rl_per": 88.79, "bc": 88.39, "dp": 89.29}
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "88.39" in text and 'src="http' not in text
    assert main(words) == 2
    assert "is not empty" in capsys.readouterr().err
    trained = (
        (tmp_path / "set_table.close.drawer" / "train" / "student.safetensors").stat().st_mtime_ns
    )
    # The same policy under other rules, without training.
    others = str(tmp_path / "others")
    again = ["reproduce", "force_limits", *words[2:], "--policies", str(tmp_path)]
    again[again.index("--out") + 1] = others
    assert main(again) == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [found["rules"] for found in results] == [
        "evaluation",
        "no_force_limit",
        "force_limit_1400",
    ]
    assert results[0]["success_once"] == row["success_once"]
    assert results[2]["paper_says"] == "5 to 20 points less" and not results[2]["paper"]
    assert main([*words, "--resume"]) == 0
    assert (
        tmp_path / "set_table.close.drawer" / "train" / "student.safetensors"
    ).stat().st_mtime_ns == trained
