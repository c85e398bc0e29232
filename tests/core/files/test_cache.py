"""A cached file that is not whole is made again."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjhab.core.files.cache import _wanted_dir, assets_dir, read_cached
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.rosters import roster
from mjhab.layout.compile import compile_home, model_path
from mjhab.layout.layout import Layout
from mjhab.scenes.builtin.homes import make_home
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.sim.mujoco.cpu import CpuSimulator


@pytest.mark.parametrize(
    ("given", "cache", "assets"),
    [
        ({}, "/home/me/.cache/mjhab", "/home/me/.local/share/mjhab/assets"),
        (
            {"XDG_CACHE_HOME": "/c", "XDG_DATA_HOME": "/d"},
            "/c/mjhab",
            "/d/mjhab/assets",
        ),
        (
            {"XDG_CACHE_HOME": "/c", "MJHAB_CACHE": "mine", "MJHAB_ASSETS": "/a"},
            "mine",
            "/a",
        ),
    ],
)
def test_folders_on_linux_are_those_of_earlier_versions(
    given: dict[str, str],
    cache: str,
    assets: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME", "MJHAB_CACHE", "MJHAB_ASSETS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    assert (str(_wanted_dir()), str(assets_dir())) == (cache, assets)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda raw: b"",
    "cut": lambda raw: raw[: len(raw) // 2],
    "zeros": lambda raw: bytes(len(raw)),
    "something else": lambda raw: b'["a"]',
}


def read_arrays(path: Path) -> np.ndarray:
    with np.load(path, allow_pickle=False) as arrays:
        return arrays["a"]


def write_arrays(path: Path) -> None:
    np.savez(path, a=np.arange(3))


def read_object(path: Path) -> int:
    return json.loads(path.read_text(encoding="utf-8"))["a"]


def write_object(path: Path) -> None:
    path.write_text('{"a": 1}')


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize(
    ("read", "write"), [(read_arrays, write_arrays), (read_object, write_object)]
)
def test_damage_is_as_if_the_file_were_not_there(
    damage: str,
    read: Callable[[Path], object],
    write: Callable[[Path], None],
    tmp_path: Path,
):
    path = tmp_path / "kept.npz"
    assert read_cached(path, read) is None
    write(path)
    assert read_cached(path, read) is not None
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert read_cached(path, read) is None


@pytest.mark.parametrize("damage", DAMAGES)
def test_compiled_homes_and_settled_starts_are_made_again(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    home = make_home(0, 7)
    layout = Layout(
        dataclasses.replace(builtin_pack(), homes=(home,)), roster("set_table")
    )
    episodes = EpisodeMaker(CpuSimulator(layout, 1, 1), "set_table", home.split)
    model = compile_home(layout, home)
    episode = episodes.episode(0, 0)
    (start,) = (tmp_path / "episodes").rglob("*.json")
    for path in (model_path(layout, home), start):
        path.write_bytes(DAMAGES[damage](path.read_bytes()))
    again = compile_home(layout, home)
    assert np.array_equal(again.geom_pos, model.geom_pos)
    assert np.array_equal(episodes.episode(0, 0).object_pose, episode.object_pose)
    # They are whole on the disk, too.
    assert mujoco.MjModel.from_binary_path(str(model_path(layout, home))).nq == model.nq
    assert json.loads(start.read_text(encoding="utf-8"))["home"] == home.name
