"""`benchmarks.pictures`: equal pictures pass, others do not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import pictures


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = pictures.main(["--sizes", "16", *words, "--json"])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_pictures_are_kept_and_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "SCENES", pictures.SCENES[:2])
    monkeypatch.setattr(pictures, "WORLDS", 2)
    code, found = run(capsys, "--out", str(tmp_path))
    assert code == 0 and all(row["rgbd_us"] > 0 for row in found["rows"])
    code, found = run(capsys, "--before", str(tmp_path))
    assert code == 0
    assert [row["rgb_equal_pct"] for row in found["rows"]] == [100.0, 100.0]
    file = next(tmp_path.glob("*-perturbed-16.npz"))
    with np.load(file) as kept:
        other = dict(kept)
    other["rgb"] = other["rgb"] ^ 2
    np.savez(file, **other)
    code, found = run(capsys, "--before", str(tmp_path))
    assert code == 1
    assert [row["rgb_within_1_pct"] for row in found["rows"]] == [100.0, 0.0]
    assert all(row["depth_equal"] for row in found["rows"])


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    words = ["--out", str(tmp_path / "a"), "--before", str(tmp_path)]
    assert pictures.main(words) == 2
    assert pictures.main(["--before", str(tmp_path / "none")]) == 2
