"""``mjhab bench photo``: what it is asked, and its page, without simulation."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjhab.bench.interact import photo
from mjhab.bench.specs import PhotoSpec
from mjhab.cli.main import main
from mjhab.config.env import EnvConfig
from mjhab.scenes.shading import EVENING, Shading
from tests.refusals import refused


def test_it_measures_each_number_of_samples(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Shading] = []
    actions: list[np.ndarray] = []

    class Bench:
        camera = "fetch_head"

        def __init__(self, scene: Any, shading: Shading) -> None:
            asked.append(shading)

        def reset(self) -> None:
            pass

        def step(self, action: np.ndarray) -> dict[str, np.ndarray]:
            actions.append(action)
            rgb = np.zeros((1, 1, 8, 8, 3), np.uint8)
            return {"rgb": rgb, "depth": np.ones((1, 1, 8, 8), np.float32)}

    monkeypatch.setattr(photo, "PhotoBench", Bench)
    monkeypatch.setattr(photo, "interact_scene", lambda _: SimpleNamespace(home="h"))
    monkeypatch.setattr(photo, "with_body", lambda _, arm: arm)
    words = "bench photo --samples 2 8 --runs 2 --steps 5 --shading.light evening --out"
    assert main([*words.split(), str(tmp_path / "out")]) == 0
    assert asked == [Shading(2, EVENING), Shading(8, EVENING)]
    assert len(actions) == 2 * (photo.WARM_STEPS + 2 * 5)
    assert 0.29 < np.abs(actions).max() <= photo.CLIP
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    found = json.loads((tmp_path / "out" / "photo.json").read_text(encoding="utf-8"))
    assert all(point["cpu_ms"] >= 0.0 for point in found["points"])
    assert "8 paths per pixel" in page and "MS-HAB, RTX 4090" in page
    assert "fetch_head" in capsys.readouterr().out


def test_samples_are_given_once() -> None:
    with refused(said="--samples"):
        PhotoSpec(env={"shading": {"samples": 4}})


def test_environments_know_the_shader() -> None:
    assert EnvConfig().path_shading is None
    config = EnvConfig(shader="path", shading={"samples": 8, "light": "evening"})
    assert config.path_shading == Shading(8, EVENING)
    with refused(said="'cpu'"):
        EnvConfig(shader="path", backend="auto")
