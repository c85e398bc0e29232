"""Packs whose names or numbers no home can be made of are refused when they are read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.layout.compile import model_path
from mjhab.layout.layout import Layout
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.pack_check import check_pack
from mjhab.scenes.pack_folder import load_pack, save_pack
from mjhab.scenes.spec import Geom, Roles
from tests.refusals import refused


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a pack of one home with a chair, a fridge and a can, and its JSON."""
    pack = builtin_pack()
    props = {"chair_01": pack.props["chair_01"]}
    fridge = {"fridge": pack.articulations["fridge"]}
    can = {"002_master_chef_can": pack.objects["002_master_chef_can"]}
    home = pack.homes[0]
    home = replace(
        home,
        props=tuple(place for place in home.props if place.template in props),
        articulations=tuple(
            place for place in home.articulations if place.template in fridge
        ),
        open_limits=(),
    )
    text = repr((props, fridge, can, home))
    meshes = {name: mesh for name, mesh in pack.meshes.items() if repr(name) in text}
    folder = tmp_path_factory.mktemp("pack")
    save_pack(
        replace(
            pack,
            props=props,
            articulations=fridge,
            objects=can,
            homes=(home,),
            meshes=meshes,
            roles=Roles(),
        ),
        folder,
    )
    load_pack(folder)
    return folder, (folder / "pack.json").read_text()


def write(saved: tuple[Path, str], place: str, value: Any) -> Path:
    """Write the pack with another entry; returns its folder."""
    folder, text = saved
    body = json.loads(text)
    put(body, place, value)
    (folder / "pack.json").write_text(json.dumps(body))
    return folder


def put(body: Any, place: str, value: Any) -> None:
    """Set the entry of nested JSON that ``place`` ("homes.0.name") names."""
    way: list[Any] = [int(part) if part.isdigit() else part for part in place.split(".")]
    last = way.pop()
    for part in way:
        body = body[part]
    assert (last in body) if isinstance(body, dict) else (last < len(body))
    body[last] = value


NUMBERS = [
    ("props.0.geoms.0.pos.0", 1e300),
    ("props.0.geoms.0.pos.0", 5000.0),
    ("props.0.geoms.0.size.0", 1e300),
    ("props.0.geoms.0.size.0", 0.0),
    ("props.0.geoms.0.size.0", -0.1),
    ("props.0.geoms.0.size.0", float("nan")),
    ("props.0.geoms.0.size.0", float("inf")),
    ("props.0.geoms.0.size.0", 10**400),
    ("props.0.geoms.0.quat", [3.0, 0.0, 0.0, 0.0]),
    ("props.0.geoms.0.quat", [0.0, 0.0, 0.0, 0.0]),
    ("articulations.0.links.0.mass", 0.0),
    ("articulations.0.links.0.mass", -1.0),
    ("articulations.0.links.0.mass", 1e300),
    ("articulations.0.links.0.axis", [0.0, 0.0, 0.0]),
    ("articulations.0.links.0.range", [1.0, 0.0]),
    ("articulations.0.links.0.range", [0.0, 1e6]),
    ("articulations.0.links.0.handle.bar", [9.0, 0.0, 0.0]),
    ("articulations.0.links.0.handle.thickness", 0.0),
    ("articulations.0.receptacles.0.half.0", 1e300),
    ("articulations.0.receptacles.0.height", -1.0),
    ("objects.0.mass", 0.0),
    ("objects.0.mass", 1e9),
    ("objects.0.half.0", 1e300),
    ("objects.0.collision.0.size.0", 1e300),
    ("homes.0.walls.0.size.0", 1e300),
    ("homes.0.props.0.pos.0", 1e300),
    ("homes.0.props.0.yaw", 1e300),
    ("homes.0.floor", [0.0, 0.0, 1e300, 1.0]),
    ("homes.0.floor", [1.0, 0.0, 0.0, 1.0]),
    ("homes.0.macro", 10**12),
    ("homes.0.lights.0.intensity", -1.0),
]


@pytest.mark.parametrize(
    ("place", "value"),
    NUMBERS,
    ids=[f"{place}={str(value)[:12]}" for place, value in NUMBERS],
)
def test_numbers(saved: tuple[Path, str], place: str, value: Any) -> None:
    field = place.rstrip("0123456789.").rpartition(".")[2]
    with pytest.raises(
        UsageError,
        match=rf"pack\.json: .*{field}.*(in the range|of length|finite|empty|no area)",
    ):
        load_pack(write(saved, place, value))


NAMES = [
    "name",
    "props.0.name",
    "props.0.geoms.0.material",
    "articulations.0.links.0.name",
    "objects.0.name",
    "homes.0.name",
    "homes.0.pack",
    "homes.0.floor_material",
]


@pytest.mark.parametrize("value", ["../../x", "/abs/x", "a b", "x" * 1000, ""])
@pytest.mark.parametrize("place", NAMES)
def test_names(saved: tuple[Path, str], place: str, value: str) -> None:
    with refused(where="pack.json"):
        load_pack(write(saved, place, value))


@pytest.mark.parametrize(
    "place", ["articulations.0.links.0.geoms", "objects.0.collision"]
)
def test_what_moves_has_a_geom_that_collides(saved: tuple[Path, str], place: str) -> None:
    with pytest.raises(UsageError, match=rf"{place.split('.')[-1]}: none of the 0 geoms"):
        load_pack(write(saved, place, []))


def test_links_collide_as_primitives() -> None:
    pack = builtin_pack()
    fridge = pack.articulations["fridge"]
    shape = Geom("mesh", (1.0, 1.0, 1.0), mesh=next(iter(pack.meshes)))
    link = replace(fridge.links[0], geoms=(*fridge.links[0].geoms, shape))
    made = {"fridge": replace(fridge, links=(link, *fridge.links[1:]))}
    with refused(where="pack", said=("links[0].geoms", "collides as primitives")):
        check_pack(replace(pack, articulations=made), Path("pack"))


@pytest.mark.parametrize("what", ["nan", "far", "index", "shape"])
def test_meshes(what: str) -> None:
    pack = builtin_pack()
    used = next(
        g.mesh for o in pack.objects.values() for g in o.visuals if g.shape == "mesh"
    )
    mesh: Any = pack.meshes[used]
    vertices = mesh.vertices.copy()
    faces = mesh.faces.copy()
    if what == "nan":
        vertices[0, 0] = np.nan
    elif what == "far":
        vertices[0, 0] = 1e30
    elif what == "index":
        faces[0, 0] = len(vertices)
    else:
        vertices = vertices[:, :2]
    broken = replace(mesh, vertices=vertices, faces=faces)
    with pytest.raises(UsageError, match=f"pack: .*{used}"):
        check_pack(replace(pack, meshes={**pack.meshes, used: broken}), Path("pack"))


def test_the_built_in_pack_passes() -> None:
    assert check_pack(builtin_pack(), Path("builtin")) is builtin_pack()


def test_no_model_is_written_outside_of_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name of a home once led out of the cache, also where no file was read: a home made in Python."""
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path / "cache"))
    pack = builtin_pack()
    home = replace(pack.homes[0], name="../../x")
    layout = Layout(replace(pack, homes=(home,)), ())
    with refused(said="outside of"):
        model_path(layout, home)
