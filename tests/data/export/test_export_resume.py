"""Exports that were stopped or killed: they go on, and end up with the same bytes as those that were not."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mjhab.data.export.lerobot.features import Choice
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.select.query import Filter
from mjhab.render.film import FilmWriter, join_films
from tests.data.export.exporting import to_lerobot, to_maniskill
from tests.data.make import chains_and_picks
from tests.refusals import refused

EPISODES = 5
Export = Callable[..., Any]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return chains_and_picks(tmp_path_factory.mktemp("source"))


OPENED: list[Path] = []


def open_film(path: Path, fps: int) -> FilmWriter:
    OPENED.append(path)
    return FilmWriter(path, fps, 30, 2)


def lerobot(
    source: Path,
    out: Path,
    version: str = "3.0",
    settings: dict[str, Any] | None = None,
    **options: Any,
) -> Any:
    films = FilmTools(open_film, join_films, settings or {})
    return to_lerobot(source, out, films, version=version, **options)


WAYS: dict[str, Export] = {
    "3.0": lerobot,
    "2.1": functools.partial(lerobot, version="2.1"),
    "maniskill": to_maniskill,
}


@pytest.fixture(params=["3.0", "maniskill"])
def export(request: pytest.FixtureRequest) -> Export:
    """Version 2.1 goes on as 3.0 does, which `test_a_kill` tells."""
    return WAYS[request.param]


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def whole(
    source: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[Any, dict[str, bytes]]:
    """What exports hold that nothing has stopped."""
    folder = tmp_path_factory.mktemp("whole")
    found = {}
    for name, way in WAYS.items():
        way(source, folder / name)
        found[way] = bytes_of(folder / name)
    return found


def stop_after(episodes: int) -> Callable[[int], Callable[[], object]]:
    left = [episodes]

    def after() -> None:
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    return lambda total: after


@pytest.mark.parametrize("done", [1, EPISODES])
def test_it_goes_on_where_it_was_stopped(
    source: Path,
    tmp_path: Path,
    export: Export,
    whole: dict[Any, dict[str, bytes]],
    done: int,
) -> None:
    with pytest.raises(KeyboardInterrupt):
        export(source, tmp_path / "set", begin=stop_after(done))
    assert not (tmp_path / "set").exists()
    OPENED.clear()
    export(source, tmp_path / "set", resume=True)
    assert bytes_of(tmp_path / "set") == whole[export]
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert len(OPENED) == (0 if export is to_maniskill else EPISODES - done)


class Killed(BaseException):
    """Stands for the end of the process."""


@pytest.mark.parametrize("name", ["replace", "fsync"])
def test_a_stop_at_any_change_of_a_file(
    source: Path,
    tmp_path: Path,
    export: Export,
    whole: dict[Any, dict[str, bytes]],
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every go gets a few changes further; what is there between them is a whole export or none."""
    real = getattr(os, name)
    left = [0]

    def call(*args: Any, **options: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise Killed
        return real(*args, **options)

    monkeypatch.setattr(os, name, call)
    for goes in range(1, 200):
        left[0] = goes
        try:
            export(source, tmp_path / "set", resume=True)
            break
        except Killed:
            assert not (tmp_path / "set").exists()
    assert bytes_of(tmp_path / "set") == whole[export]
    assert goes >= 2


SCRIPT = """
import os, signal, sys
from pathlib import Path
from tests.data.export.test_export_resume import WAYS
left = [3]
def after():
    left[0] -= 1
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
WAYS[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]), begin=lambda total: after)
"""


@pytest.mark.parametrize("way", WAYS)
def test_a_kill(
    source: Path, tmp_path: Path, whole: dict[Any, dict[str, bytes]], way: str
) -> None:
    command = [sys.executable, "-c", SCRIPT, way, str(source), str(tmp_path / "set")]
    root = Path(__file__).parents[3]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), *sys.path])}
    done = subprocess.run(command, cwd=root, env=env, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    OPENED.clear()
    WAYS[way](source, tmp_path / "set", resume=True)
    assert bytes_of(tmp_path / "set") == whole[WAYS[way]]
    assert len(OPENED) == (0 if way == "maniskill" else EPISODES - 3)


def test_in_the_middle_of_a_film(
    source: Path,
    tmp_path: Path,
    whole: dict[Any, dict[str, bytes]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    add = FilmWriter.add
    frames = [0]

    def interrupted(self: FilmWriter, frame: Any) -> None:
        frames[0] += 1
        if frames[0] == 30:
            raise KeyboardInterrupt
        add(self, frame)

    monkeypatch.setattr(FilmWriter, "add", interrupted)
    with pytest.raises(KeyboardInterrupt):
        lerobot(source, tmp_path / "set")
    monkeypatch.undo()
    lerobot(source, tmp_path / "set", resume=True)
    assert bytes_of(tmp_path / "set") == whole[lerobot]


def test_what_was_begun_is_not_mixed_with_something_else(
    source: Path, tmp_path: Path, export: Export
) -> None:
    out = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        export(source, out, begin=stop_after(2))
    with refused(said="is unfinished; add --resume"):
        export(source, out)
    with refused(where="set", said="has another episodes (episodes: '5 of"):
        export(source, out, where=Filter("subtask == 'pick'"), resume=True)
    export(source, out, where=Filter("subtask == 'pick'"), overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    # One that is to take the place of another goes on, too.
    before = bytes_of(out)
    with pytest.raises(KeyboardInterrupt):
        export(source, out, overwrite=True, begin=stop_after(4))
    assert bytes_of(out) == before
    export(source, out, overwrite=True, resume=True)
    assert bytes_of(out) != before


@pytest.mark.parametrize("out", [".", "..", "/", "sub/.."])
def test_a_place_without_a_name_is_refused(
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    export: Export,
    out: str,
) -> None:
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path / "sub")
    with refused("out"):
        export(source, Path(out))
    assert [path.name for path in tmp_path.rglob("*")] == ["sub"]


def test_options_of_films_and_images_must_be_the_same(
    source: Path, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        lerobot(source, tmp_path / "set", settings={"quality": 18}, begin=stop_after(1))
    with refused(where="set", said="has another depth, quality, version"):
        lerobot(
            source,
            tmp_path / "set",
            "2.1",
            settings={"quality": 20},
            choice=Choice(depth=False),
            resume=True,
        )
    lerobot(source, tmp_path / "set", settings={"quality": 18}, resume=True)
