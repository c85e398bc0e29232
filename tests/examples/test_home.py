"""examples/home: homes of one's own are listed, drawn and checked, and the expert works in them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.cli.output import tell_skipped
from mjhab.core import errors
from mjhab.core.errors import UsageError
from mjhab.core.registration.plugins import load_plugin
from mjhab.episodes import generator
from mjhab.rollout.store import read_records
from mjhab.scenes.pack_source import PACK_SOURCES
from tests.refusals import refused

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


@pytest.fixture
def street() -> Iterator[Callable[..., None]]:
    """Registers a pack "street" of the home files that it is given."""

    def register(*files: str) -> None:
        pack = mjhab.home_pack(*files, name="street")
        mjhab.register_pack(mjhab.PackSource("street", lambda request: pack))

    yield register
    PACK_SOURCES.remove("street")


def bare(file: Path, name: str = "cottage") -> str:
    """Write the cottage without the furniture that has room for objects; return its path."""
    body = json.loads(Path(COTTAGE).read_text(encoding="utf-8"))
    kept = ("kitchen_counter", "chair_01")
    body["name"] = name
    body["furniture"] = [row for row in body["furniture"] if row["kind"] in kept]
    body["receptacles"] = []
    file.write_text(json.dumps(body), encoding="utf-8")
    return str(file)


def test_a_home_without_room_for_the_objects_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generator, "MOST_DRAWS", 3)
    env = mjhab.make(task="tidy_house", home=bare(tmp_path / "bare.json"))
    with refused(said="home 'cottage' has no room for tidy_house"):
        env.reset(seed=0)
    env.close()


def test_a_home_without_room_in_a_pattern_is_skipped_named_and_counted(
    street: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before, one such home ended the whole evaluation."""
    monkeypatch.setattr(generator, "MOST_DRAWS", 3)
    monkeypatch.setattr(errors, "_warned", set())
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path / "cache"))
    street(bare(tmp_path / "bare.json", name="bare"), COTTAGE)
    asked: dict[str, Any] = {
        "task": "tidy_house",
        "subtask": "pick",
        "assets": "street",
        "home": "*",
        "episodes": 3,
        "worlds": 1,
        "horizon": 1,
    }
    run = mjhab.evaluate("zero", **asked, films=0, out=tmp_path / "run")
    assert [record.home for record in run.records] == ["cottage"] * 3
    assert [record.skipped_homes for record in run.records] == [("bare",), (), ("bare",)]
    assert run.summary["skipped_homes"] == {"bare": 2}
    summary = json.loads((run.path / "summary.json").read_text(encoding="utf-8"))
    assert summary["skipped_homes"] == {"bare": 2}
    assert read_records(run.path) == list(run.records)
    assert "bare in 2 episodes" in run.report.read_text(encoding="utf-8")
    warned = [line.message for line in caplog.records if "has no room" in line.message]
    assert len(warned) == 1 and "home 'bare'" in warned[0]
    # From the cache, and in another order: the same home.
    del asked["worlds"]
    made = mjhab.generate(
        "zero", **asked, workers=0, keep="not success", out=tmp_path / "data"
    )
    assert made.summary["skipped_homes"] == {"bare": 2}
    assert [episode.record.home for episode in made.episodes()] == ["cottage"] * 3
    tell_skipped(run.summary["skipped_homes"])
    assert "no room: bare in 2 episodes" in capsys.readouterr().err


def test_check_tells_for_which_tasks_a_home_has_room(
    street: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(generator, "MOST_DRAWS", 3)
    street(bare(tmp_path / "bare.json", name="bare"), COTTAGE)
    asked = ["homes", "check", "--assets", "street", "--tasks"]
    assert main([*asked, "--json"]) == 0
    tasks = json.loads(capsys.readouterr().out)["tasks"]
    assert "home 'bare' has no room for tidy_house" in tasks["bare"]["tidy_house"]
    assert set(tasks["cottage"].values()) == {""} and len(tasks["cottage"]) >= 3


def test_a_pattern_of_homes_without_room_names_them(
    street: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generator, "MOST_DRAWS", 2)
    names = ("bare_1", "bare_2")
    street(*(bare(tmp_path / f"{name}.json", name=name) for name in names))
    env = mjhab.make(task="tidy_house", assets="street", home="bare_?")
    with pytest.raises(UsageError) as error:
        env.reset(seed=0)
    env.close()
    told = str(error.value)
    assert "none of the 2 homes (bare_1, bare_2) has room" in told and "\n" not in told


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
