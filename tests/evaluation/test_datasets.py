"""Recorded episodes from Python: exports, replay and labels are what their commands do."""

from __future__ import annotations

import doctest
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mjhab
from mjhab.cli.main import main, parse
from mjhab.core.errors import UsageError
from mjhab.data.store.images import ImageFormat
from mjhab.evaluation.datasets.specs import LerobotSpec, ReplaySpec
from tests.data.fake_world import FakeEnv
from tests.data.make import record

FUNCTIONS = (mjhab.export_lerobot, mjhab.export_maniskill, mjhab.replay, mjhab.label)


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    path = tmp_path / "a.h5"
    env = FakeEnv(subtask="pick", images=True)
    record(path, range(2), env, images=ImageFormat())
    return path


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_the_example_of_the_docstring(
    function: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(function, function.__name__, globs={})
    assert len(example.examples) > 3
    assert doctest.DocTestRunner().run(example).failed == 0


def test_python_and_the_command_export_the_same(
    shard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = tmp_path / "ours"
    done = mjhab.export_lerobot(shard, ours, where="index < 1", depth=False)
    words = ["--out", str(tmp_path / "theirs"), "--where", "index < 1", "--no-depth"]
    assert main(["export", "lerobot", str(shard), *words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "episodes": done.episodes,
        "frames": done.frames,
        "images": list(done.images),
    }
    assert (done.episodes, done.frames) == (1, 20)
    for path in ours.rglob("*"):
        other = tmp_path / "theirs" / path.relative_to(ours)
        assert path.is_dir() or path.read_bytes() == other.read_bytes()
    with pytest.raises(UsageError):
        mjhab.export_lerobot(shard, ours)
    again = mjhab.export_lerobot([shard], str(ours), overwrite=True, rgb=False)
    assert again.episodes == 2 and not [name for name in again.images if "images" in name]


def test_labels_are_written_only_when_asked(shard: Path) -> None:
    before = shard.read_bytes()
    found = mjhab.label(str(shard))
    assert (found.episodes, found.without_signals, found.changes) == (2, 0, ())
    assert shard.read_bytes() == before


@pytest.mark.parametrize(
    ("function", "options", "words"),
    [
        (mjhab.export_lerobot, {"out": "x", "wher": "success"}, ("wher", "where")),
        (mjhab.export_lerobot, {"out": "x", "quality": 90}, ("quality", "at most 51")),
        (mjhab.export_lerobot, {"out": "x", "version": "4"}, ("version", "3.0")),
        (mjhab.export_lerobot, {"out": "x", "rgb": "yes"}, ("rgb", "True or False")),
        (mjhab.export_maniskill, {"out": "x", "until": "end+3"}, ("end+3", "success")),
        (mjhab.export_maniskill, {"out": 3}, ("out", "a path", "3")),
        (mjhab.export_maniskill, {"out": "x", "where": "lable == 1"}, ("label",)),
        (mjhab.replay, {"worlds": 0}, ("worlds", "at least 1")),
        (mjhab.replay, {"verify": True, "render": "rgb"}, ("one of the two",)),
        (mjhab.replay, {"render": "rgb"}, ("--out",)),
        (mjhab.replay, {"render": "dept", "out": "x.h5"}, ("depth",)),
        (mjhab.replay, {"render": "rgb", "out": "x.h5", "rgb": "gif"}, ("gif", "png")),
        (mjhab.label, {"write": "yes"}, ("write", "True or False")),
        (mjhab.label, {"where": "success"}, ("where",)),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    function: Callable[..., Any],
    options: dict[str, Any],
    words: tuple[str, ...],
    shard: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as error:
        function(shard, **options)
    assert all(word in str(error.value) for word in words), error.value
    assert [path.name for path in tmp_path.iterdir()] == [shard.name]


@pytest.mark.parametrize("function", (mjhab.replay, mjhab.label))
@pytest.mark.parametrize("places", ((), "nowhere.h5", 3, None))
def test_places_that_are_none(function: Callable[..., Any], places: Any) -> None:
    with pytest.raises(UsageError):
        function(places)


def test_shards_are_named_by_their_place_on_the_command_line(tmp_path: Path) -> None:
    spec = parse(["replay", "a.h5", "b", "--verify", "--camera-size", "12", "16"]).spec
    assert spec == ReplaySpec.of(["a.h5", Path("b")], verify=True, camera_size=(12, 16))
    one = parse(["export", "lerobot", "a.h5", "--out", "x", "--no-seg"]).spec
    assert one == LerobotSpec.of("a.h5", out=Path("x"), seg=False)
