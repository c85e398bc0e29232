"""`benchmarks.soak`: what it prints and writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import soak


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = soak.main([*words, "--json"])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_bench_soak_counts_steps_and_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = run(
        capsys,
        "--out",
        str(tmp_path),
        *"--steps 1240 --worlds 2 --threads 1 --task tidy_house".split(),
    )
    assert found["steps"] == 1242 and len(found["rss_mb"]) == 4
    assert code == (0 if found["ok"] else 1)
    assert 0 < sum(found["cache_mb"].values()) <= found["cache_limit_mb"]
    assert json.loads((tmp_path / "soak.json").read_text()) == found
    assert "<polyline" in (tmp_path / "memory.svg").read_text()
    # 207 steps of each of pick, place and navigate; the first two end after 200.
    assert found["episodes"] == 4 and set(found["tainted"]) >= {"nan", "penetration"}


def test_memory_is_judged_by_its_second_half(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = iter([100.0, 200.0, 203.0, 205.0, 207.0])
    monkeypatch.setattr("benchmarks.soak.resident_mb", lambda: next(readings))
    curve = soak.MemoryCurve(4 * soak.CURVE_POINTS)
    for done in (
        soak.CURVE_POINTS,
        2 * soak.CURVE_POINTS,
        3 * soak.CURVE_POINTS,
        4 * soak.CURVE_POINTS,
    ):
        curve.note(done)
    found = curve.summary()
    assert found["rss_mb"] == [100.0, 200.0, 203.0, 205.0]
    assert found["growth_second_half"] == 0.025 and found["ok"]
    curve.points[-1] = (4 * soak.CURVE_POINTS, 207.0)
    assert not curve.summary()["ok"]


def test_random_actions_are_of_no_single_subtask(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert soak.main(["--subtask", "pick", "--steps", "1"]) == 2
    assert "--subtask needs --generate" in capsys.readouterr().err


def test_a_file_in_place_of_the_folder_is_told_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "there"
    file.touch()
    monkeypatch.setattr(soak, "soak", lambda spec: pytest.fail("it began"))
    assert soak.main(["--out", str(file)]) == 2
    assert f"--out must be a folder, not a file, got '{file}'" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["steps", "worlds", "seed", "generate"])
@pytest.mark.parametrize("value", ["-1", "18446744073709551616", "nan", "1e18", "", "x"])
def test_numbers_that_are_none_are_refused(option: str, value: str) -> None:
    try:
        assert soak.main([f"--{option}={value}"]) == 2
    except SystemExit as ended:  # tyro refuses what is no number
        assert ended.code == 2
