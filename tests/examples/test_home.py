"""examples/home: homes of one's own are listed, drawn and checked, and the expert works in them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.core.errors import UsageError
from mjhab.core.registration.plugins import load_plugin
from mjhab.episodes import generator
from mjhab.scenes.pack_source import PACK_SOURCES

FOLDER = Path(__file__).parents[2] / "examples" / "home"
COTTAGE = str(FOLDER / "cottage.json")
HUT = str(FOLDER / "hut.py")


@pytest.fixture
def village() -> Iterator[None]:
    assert not load_plugin(FOLDER / "village.py").error
    yield
    PACK_SOURCES.remove("village")


def test_the_pack_of_the_plugin_is_listed_and_checked(
    village: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["homes", "list", "--assets", "village", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["homes"]
    assert [home["name"] for home in listed] == ["cottage", "hut"]
    assert main(["homes", "check", "--assets", "village", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] == 2 and not report["remarks"]


def test_a_home_file_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cottage.png"
    size = ("--width", "160", "--height", "120", "--json")
    assert (
        main(
            ["homes", "render", "cottage", "--assets", COTTAGE, "--out", str(out), *size]
        )
        == 0
    )
    assert out.stat().st_size > 1000
    assert json.loads(capsys.readouterr().out)["home"] == "cottage"


@pytest.mark.parametrize("home", [COTTAGE, HUT])
def test_every_task_starts_in_it(home: str) -> None:
    for task in ("tidy_house", "prepare_groceries", "set_table"):
        env = mjhab.make(task=task, home=home, autoreset="disabled")
        env.reset(seed=0)
        _, _, _, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert not info["taint"].any()
        env.close()


def test_a_home_without_room_for_the_objects_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generator, "MOST_DRAWS", 3)
    body = json.loads(Path(COTTAGE).read_text(encoding="utf-8"))
    kept = ("kitchen_counter", "chair_01")
    body["furniture"] = [row for row in body["furniture"] if row["kind"] in kept]
    body["receptacles"] = []
    bare = tmp_path / "bare.json"
    bare.write_text(json.dumps(body), encoding="utf-8")
    env = mjhab.make(task="tidy_house", home=str(bare))
    with pytest.raises(UsageError, match="home 'cottage' has no room for tidy_house"):
        env.reset(seed=0)
    env.close()


@pytest.mark.parametrize("subtask", ["pick", "place"])
def test_the_expert_picks_and_places_in_it(subtask: str, tmp_path: Path) -> None:
    run = mjhab.evaluate(
        "expert",
        task="tidy_house",
        subtask=subtask,
        target="005_tomato_soup_can",
        home=COTTAGE,
        episodes=2,
        worlds=2,
        films=0,
        out=tmp_path,
    )
    assert run.summary["success_once"] >= 0.5
