"""Homes written by hand: what a file may state, and what is refused."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError
from mjhab.scenes.freespace import free_map
from mjhab.scenes.home_files import home_pack
from mjhab.scenes.packs import open_pack
from mjhab.scenes.roles import DINING_TABLE, FRIDGE_SHELF, OPEN_SURFACE, roles_in
from tests.refusals import refused

ROOM: dict[str, Any] = {
    "format": "mjhab-home-1",
    "name": "room",
    "floor": {"size": [6.0, 5.0]},
    "walls": {"outer": "wall_white"},
    "furniture": [
        {"kind": "table_01", "at": [2.0, 2.5]},
        {"kind": "chest_of_drawers", "at": [5.75, 2.5], "yaw_degrees": 180},
    ],
}
Change = Callable[[dict[str, Any]], Any]


def room(folder: Path, change: Change = lambda body: None) -> Path:
    body = copy.deepcopy(ROOM)
    change(body)
    path = folder / "room.json"
    path.write_text(json.dumps(body))
    return path


def test_a_room_is_a_pack(tmp_path: Path) -> None:
    path = room(tmp_path)
    pack = open_pack(str(path))
    (home,) = pack.homes
    assert (pack.name, home.name, home.split, len(home.walls)) == (
        "room",
        "room",
        "train",
        4,
    )
    assert open_pack(str(path)) is pack
    assert roles_in(pack, home) == {DINING_TABLE, OPEN_SURFACE}
    assert not home.articulations


def test_a_file_that_changed_is_read_anew(tmp_path: Path) -> None:
    first = open_pack(str(room(tmp_path)))
    again = open_pack(str(room(tmp_path, lambda body: body.update(name="other"))))
    assert (first.homes[0].name, again.homes[0].name) == ("room", "other")


def test_inner_walls_leave_their_doorways_free(tmp_path: Path) -> None:
    wall = {"start": [4.0, 0.0], "end": [4.0, 5.0], "doorways": [[1.0, 2.2]]}
    pack = home_pack(room(tmp_path, lambda body: body["walls"].update(inner=[wall])))
    (home,) = pack.homes
    free = free_map(home, pack)
    inside = free.clearance_at(np.array([[4.0, 1.6], [4.0, 3.5]]))
    assert inside[0] > 0.5 and inside[1] == 0.0


def test_roles_and_receptacles_of_a_file(tmp_path: Path) -> None:
    def change(body: dict[str, Any]) -> None:
        body["receptacles"] = [
            {
                "furniture": "chest_of_drawers",
                "name": "top",
                "center": [0.0, 0.0, 0.85],
                "half": [0.2, 0.4],
                "roles": ["open_surface", "altar"],
            },
            {"furniture": "table_01", "name": "top", "roles": [FRIDGE_SHELF]},
        ]

    pack = home_pack(room(tmp_path, change))
    assert roles_in(pack, pack.homes[0]) == {
        DINING_TABLE,
        OPEN_SURFACE,
        FRIDGE_SHELF,
        "altar",
    }
    assert pack.props["chest_of_drawers"].receptacles[-1].name == "top"
    own = home_pack(
        room(tmp_path, lambda body: (change(body), body.update(default_roles=False)))
    )
    assert roles_in(own, own.homes[0]) == {OPEN_SURFACE, FRIDGE_SHELF, "altar"}


def test_a_python_file_may_compute_a_home(tmp_path: Path) -> None:
    path = tmp_path / "room.py"
    path.write_text(f"HOME = {ROOM!r}\nHOME['floor']['size'] = (5.0 + 1.0, 5.0)\n")
    assert home_pack(path).homes == home_pack(room(tmp_path)).homes


def test_several_files_make_one_pack(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    other = room(tmp_path / "b", lambda body: body.update(name="hut"))
    pack = home_pack(room(tmp_path), other, name="village")
    assert [home.name for home in pack.homes] == [
        "room",
        "hut",
    ] and pack.name == "village"
    with refused(
        where="room.json", said="another home of the pack is called 'room', too"
    ):
        home_pack(room(tmp_path), room(tmp_path))


def furniture(*pieces: dict[str, Any]) -> Change:
    return lambda body: body["furniture"].extend(pieces)


def setting(part: str, **values: Any) -> Change:
    return lambda body: body[part].update(values)


TOO_HIGH = {
    "furniture": "table_01",
    "name": "x",
    "center": [0, 0, 2.5],
    "half": [0.1, 0.1],
    "roles": ["open_surface"],
}
BAD: dict[str, tuple[Change, dict[str, Any]]] = {
    "unknown furniture": (
        furniture({"kind": "tabel_01", "at": [4.0, 4.0]}),
        {"option": "furniture", "given": "tabel_01", "expected": "table_01"},
    ),
    "overlap": (
        furniture({"kind": "sofa", "at": [2.3, 2.5]}),
        {"said": "'sofa' at [2.3, 2.5] overlaps 'table_01' at [2, 2.5]"},
    ),
    "in the wall": (
        furniture({"kind": "sofa", "at": [0.2, 4.0]}),
        {"said": "overlaps walls.outer"},
    ),
    "in an inner wall": (
        lambda body: body["walls"].update(
            inner=[{"start": [2.0, 0.0], "end": [2.0, 5.0]}]
        ),
        {"said": "overlaps a wall of walls.inner"},
    ),
    "no walls": (
        lambda body: body.pop("walls"),
        {"option": "walls"},
    ),
    "no outer walls": (
        lambda body: body["walls"].pop("outer"),
        {"option": "outer", "where": "home.walls"},
    ),
    "unknown material": (
        setting("walls", outer="wall_whit"),
        {"option": "material", "given": "wall_whit", "where": "walls.outer"},
    ),
    "unknown inner material": (
        setting("walls", inner_material="wall_whit"),
        {"option": "material", "where": "walls.inner_material"},
    ),
    "unknown floor": (
        setting("floor", material="floor_oaks"),
        {"option": "material", "where": "floor.material", "expected": "floor_oak"},
    ),
    "small floor": (
        setting("floor", size=[0.5, 5.0]),
        {"option": "floor.size", "given": 0.5},
    ),
    "huge floor": (
        setting("floor", size=[6.0, 1e9]),
        {"option": "floor.size", "given": 1e9},
    ),
    "thick walls": (
        setting("walls", thickness=3.0),
        {"option": "walls.thickness", "given": 3.0},
    ),
    "outside": (
        furniture({"kind": "sofa", "at": [9.0, 2.0]}),
        {"option": "furniture 'sofa', x of at", "given": 9.0, "expected": "0 to 6"},
    ),
    "turned too far": (
        furniture({"kind": "sofa", "at": [4.0, 1.0], "yaw_degrees": 5000}),
        {"option": "furniture 'sofa', yaw_degrees", "given": 5000.0},
    ),
    "not a number": (
        furniture({"kind": "sofa", "at": [4.0, "left"]}),
        {"option": "home.furniture[2].at[1]", "given": "left"},
    ),
    "unknown field": (
        furniture({"kind": "sofa", "at": [4.0, 1.0], "color": "red"}),
        {
            "option": "field",
            "given": "color",
            "expected": "kind",
            "where": "home.furniture[2]",
        },
    ),
    "two fridges": (
        furniture(
            {"kind": "fridge", "at": [4.0, 0.4]}, {"kind": "fridge", "at": [4.0, 4.6]}
        ),
        {"said": "'fridge' stands 2 times"},
    ),
    "doorway beyond the wall": (
        lambda body: body["walls"].update(
            inner=[{"start": [4.0, 0.0], "end": [4.0, 2.0], "doorways": [[1.5, 2.5]]}]
        ),
        {"option": "doorways", "given": [[1.5, 2.5]], "where": "walls.inner[0]"},
    ),
    "receptacle of nothing": (
        lambda body: body.update(receptacles=[{"furniture": "sofa", "name": "seat"}]),
        {
            "option": "furniture of this home",
            "given": "sofa",
            "expected": "chest_of_drawers",
        },
    ),
    "receptacle that is not there": (
        lambda body: body.update(
            receptacles=[{"furniture": "table_01", "name": "drawer"}]
        ),
        {"where": "receptacles[0].name", "given": "drawer", "expected": "top"},
    ),
    "receptacle of another shape": (
        lambda body: body.update(
            receptacles=[
                {
                    "furniture": "table_01",
                    "name": "top",
                    "center": [0, 0, 1],
                    "half": [0.1, 0.1],
                }
            ]
        ),
        {"said": "'table_01' has another receptacle 'top' already"},
    ),
    "receptacle without end": (
        lambda body: body.update(
            receptacles=[
                {
                    "furniture": "table_01",
                    "name": "x",
                    "center": [0, 0, 1],
                    "half": [1e6, 0.1],
                }
            ]
        ),
        {"option": "props[0].receptacles[1].half", "given": 1e6},
    ),
    "receptacle out of reach": (
        lambda body: (
            body["walls"].update(inner=[{"start": [4.0, 0.0], "end": [4.0, 5.0]}]),
            body["furniture"].append({"kind": "table_02", "at": [5.0, 1.0]}),
        ),
        {"said": "m from where a robot can stand"},
    ),
    "receptacle too high": (
        lambda body: body.update(receptacles=[TOO_HIGH]),
        {
            "said": "'x' of 'table_01', which plays the role 'open_surface', is 2.50 m above"
        },
    ),
    "no room": (
        setting("floor", size=[1.9, 5.0]),
        {"option": "furniture 'table_01', x of at", "given": 2.0, "expected": "0 to 1.9"},
    ),
    "another format": (
        lambda body: body.update(format="home"),
        {"option": "format", "given": "home"},
    ),
    "bad name": (
        lambda body: body.update(name="../room"),
        {"option": "home.name", "given": "../room"},
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_name_the_file_and_what_is_wrong(tmp_path: Path, case: str) -> None:
    change, fields = BAD[case]
    path = room(tmp_path, change)
    with refused(**fields) as caught:
        home_pack(path)
    assert str(path) in caught.value.where


def test_broken_and_missing_files(tmp_path: Path) -> None:
    with refused(where="none.json", said="cannot be read"):
        home_pack(tmp_path / "none.json")
    (tmp_path / "cut.json").write_text("{")
    with refused(where="cut.json", said="not valid JSON"):
        home_pack(tmp_path / "cut.json")
    (tmp_path / "empty.py").write_text("")
    with refused(where="empty.py", said="has no variable HOME"):
        home_pack(tmp_path / "empty.py")
    with refused("home files", ()):
        home_pack()


def test_home_of_an_environment_may_be_a_file(tmp_path: Path) -> None:
    path = str(room(tmp_path))
    config = EnvConfig(task="tidy_house", home=path)
    assert (config.assets, config.home) == (path, "*")
    with refused("assets", "data", expected="left out"):
        EnvConfig(task="tidy_house", home=path, assets="data")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "HOME = {}\n1 / 0",
            r"raised ZeroDivisionError: division by zero \(.*hut\.py, line 2\)",
        ),
        ("HOME = (", r"raised SyntaxError: '\(' was never closed"),
        ("import sys\nsys.exit(3)", "raised SystemExit: 3"),
        ("HOUSE = {}", "has no variable HOME"),
    ],
)
def test_a_python_file_that_cannot_be_run_is_named(
    text: str, told: str, tmp_path: Path
) -> None:
    file = tmp_path / "hut.py"
    file.write_text(text)
    with pytest.raises(UsageError, match=rf"hut\.py: .*{told}"):
        home_pack(file)


@pytest.mark.parametrize("place", ["examples/home/nope.json", "nope.py"])
def test_a_home_file_that_does_not_exist_is_told(place: str) -> None:
    with refused("home file", place, expected="a .json or"):
        open_pack(place)
