"""Pictures of episodes: of recorded ones and of those of an evaluation, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mjhab
from mjhab.cli.main import main
from tests.refusals import command, refused

SMALL = {"width": 96, "height": 54}
WHAT: dict[str, Any] = {
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "episodes": 1,
    "horizon": 6,
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "close"
    mjhab.generate("random", **WHAT, out=out)
    return out


def test_a_still_shows_the_robot_from_where_it_is_told(recorded: Path) -> None:
    taken = mjhab.shot(recorded, **SMALL, step=3)
    assert (taken.step, taken.steps, taken.home) == (3, 6, "builtin_m0_00")
    assert taken.image.shape == (54, 96, 3) and taken.file is None
    # The same step twice is the same picture; a place of one's own is another.
    assert np.array_equal(taken.image, mjhab.shot(recorded, **SMALL, step=3).image)
    eye = taken.view.eye + np.array([0.0, 0.0, 0.3])
    free = mjhab.shot(recorded, **SMALL, step=3, camera=tuple(eye), fov=40)
    assert np.allclose(free.view.eye, eye) and np.isclose(free.view.fovy, np.radians(40))
    assert np.allclose(free.view.target, taken.view.target)
    assert not np.array_equal(free.image, taken.image)


def test_views_sheets_and_turntables(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    head = mjhab.shot(recorded, **SMALL, step=0, view="fetch_head")
    plan = mjhab.shot(recorded, **SMALL, step=0, view="plan")
    assert plan.view.eye[2] > 100.0 > head.view.eye[2]
    sheet = tmp_path / "sheet.png"
    taken = mjhab.shot(recorded, **SMALL, sheet=4, out=sheet)
    assert Image.open(sheet).size == taken.image.shape[1::-1]
    assert taken.image.shape[0] > 2 * 54 // 3
    monkeypatch.setattr("mjhab.evaluation.shots.shoot.TURN_FRAMES", 6)
    film = tmp_path / "around.mp4"
    size = ("--width", "96", "--height", "54")
    words = ("shot", str(recorded), "--turntable", "--out", str(film), "--json", *size)
    assert main([*words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert film.stat().st_size > 0 and told["file"] == str(film)
    assert {"seconds", "episode", "step", "camera", "look_at", "fov"} <= told.keys()


def test_episodes_of_an_evaluation_run_again(recorded: Path, tmp_path: Path) -> None:
    """The same policy in the same episode: its picture is that of the recorded states."""
    run = tmp_path / "run"
    mjhab.evaluate("random", **WHAT, films=0, out=run)
    again = mjhab.shot(run, **SMALL, step=3)
    first = mjhab.shot(recorded, **SMALL, step=3)
    assert again.home == first.home and np.allclose(again.view.eye, first.view.eye)
    assert np.abs(again.image.astype(int) - first.image).mean() < 0.5


def test_what_is_refused(recorded: Path, tmp_path: Path) -> None:
    place = str(recorded)
    with refused("episode", 7):
        command("shot", place, "--episode", "7")
    with refused("step", 40, expected="0 to 6"):
        command("shot", place, "--step", "40")
    with refused("view", "fetch_hed", expected="fetch_head"):
        command("shot", place, "--view", "fetch_hed")
    with refused("camera", "1,2"):
        command("shot", place, "--camera", "1,2")
    with refused("camera", None):
        command("shot", place, "--look-at", "1,2,1")
    with refused("fov", 200.0):
        command("shot", place, "--camera", "1,2,1", "--fov", "200")
    with refused("view", "plan"):
        command("shot", place, "--camera", "1,2,1", "--view", "plan")
    with refused("sheet", 4):
        command("shot", place, "--turntable", "--sheet", "4")
    with refused("out", "a.mp4"):
        command("shot", place, "--out", "a.mp4")
    with refused(where=tmp_path / "none"):
        command("shot", str(tmp_path / "none"))
