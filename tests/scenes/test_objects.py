"""Objects from outside: from a GLB file, registered, and what is refused."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_glb

from mjhab.core.registration.plugins import PluginWarning, load_plugin
from mjhab.scenes.builtin.objects import builtin_objects
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.object_glb import object_from_glb
from mjhab.scenes.objects import (
    OBJECTS,
    ObjectModel,
    register_object,
    with_registered_objects,
)
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Geom, ObjectType
from tests.refusals import refused


def glb(path: Path, **meshes: trimesh.Trimesh) -> Path:
    scene = trimesh.Scene()
    for name, mesh in meshes.items():
        scene.add_geometry(mesh, geom_name=name)
    path.write_bytes(export_glb(scene))
    return path


def box(
    size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)
) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(at)


@pytest.fixture(autouse=True)
def nothing_registered() -> Iterator[None]:
    before = set(OBJECTS.names())
    yield
    for name in set(OBJECTS.names()) - before:
        OBJECTS.remove(name)


def test_collision_meshes_collide_and_the_others_are_seen(tmp_path: Path) -> None:
    file = glb(
        tmp_path / "a.glb",
        shown=box((0.1, 0.2, 0.05), (1.0, 0.0, 0.0)),
        collision_0=box((0.1, 0.1, 0.05), (1.0, 0.05, 0.0)),
        collision_1=box((0.1, 0.1, 0.05), (1.0, -0.05, 0.0)),
    )
    model = object_from_glb("thing", file, mass=0.3)
    # +y of the file is up.
    assert model.kind.half == pytest.approx((0.05, 0.025, 0.1))
    assert len(model.kind.collision) == 2 and model.kind.grasp_shape == "mesh"
    points = np.concatenate([model.meshes[g.mesh].vertices for g in model.kind.collision])
    np.testing.assert_allclose(points.min(axis=0), -points.max(axis=0), atol=1e-6)
    seen = model.meshes["thing/look"].vertices
    np.testing.assert_allclose(np.ptp(seen, axis=0), (0.1, 0.05, 0.2), atol=1e-6)


def test_without_collision_meshes_the_hulls_of_what_is_seen_collide(
    tmp_path: Path,
) -> None:
    file = glb(tmp_path / "a.glb", body=box((100.0, 100.0, 100.0)))
    model = object_from_glb("cube", file, mass=0.3, scale=0.001)
    assert model.kind.half == pytest.approx((0.05, 0.05, 0.05))
    assert len(model.kind.collision) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mass": 0.0}, "mass of thing must be in the range"),
        ({"mass": float("nan")}, "mass of 'thing' must be a finite number"),
        ({"mass": 0.1, "scale": 100.0}, "the object measures 10 x 10 x 10 m; expected"),
        ({"mass": 0.1, "scale": 0.001}, "Files are read in metres; `scale` converts"),
        ({"mass": 0.1, "name": "a mug"}, "name of the object must be a name"),
    ],
)
def test_bad_numbers_and_names(
    tmp_path: Path, options: dict[str, object], message: str
) -> None:
    file = glb(tmp_path / "a.glb", body=box((0.1, 0.1, 0.1)))
    with refused(said=message):
        object_from_glb(**{"name": "thing", "path": file, **options})  # type: ignore[arg-type]


def test_bad_files(tmp_path: Path) -> None:
    with refused(where="none.glb", said="cannot be read"):
        object_from_glb("thing", tmp_path / "none.glb", mass=0.1)
    flat = glb(tmp_path / "flat.glb", collision_a=box((0.1, 0.1, 0.0)))
    with refused(where="flat.glb", said="mesh 'collision_a' is flat"):
        object_from_glb("thing", flat, mass=0.1)
    many = {f"collision_{k}": box((0.01, 0.01, 0.01)) for k in range(65)}
    with refused(where="many.glb", said="65 collision pieces; an object has at most 64"):
        object_from_glb("thing", glb(tmp_path / "many.glb", **many), mass=0.1)


def test_registered_objects_join_every_pack(tmp_path: Path) -> None:
    assert open_pack() is builtin_pack()
    model = register_object(
        object_from_glb("cube", glb(tmp_path / "a.glb", a=box((0.05, 0.05, 0.05))), 0.1)
    )
    pack = open_pack()
    assert pack.objects["cube"] is model.kind and "cube/look" in pack.meshes
    assert {**pack.objects, "cube": None}.keys() - {
        "cube"
    } == builtin_pack().objects.keys()
    # What is derived from a pack is kept for the object that open_pack gives.
    assert open_pack() is pack
    with refused("object", "cube", expected="registered once"):
        register_object(model)
    OBJECTS.remove("cube")
    assert open_pack() is builtin_pack()


def test_a_pack_that_nobody_holds_is_not_kept_for_its_registered_objects() -> None:
    ball = Geom("sphere", (0.03, 0.0, 0.0))
    register_object(ObjectModel(ObjectType("ball", 0.1, (0.03, 0.03, 0.03), (ball,), ())))
    extended = with_registered_objects(dataclasses.replace(builtin_pack(), name="mine"))
    assert "ball" in extended.objects
    held = weakref.ref(extended)
    del extended
    gc.collect()
    assert held() is None


def test_a_plugin_with_an_object_of_a_built_in_name_is_left_out_and_the_rest_works(
    tmp_path: Path,
) -> None:
    kind = builtin_pack().objects["003_cracker_box"]
    with refused(where="object '003_cracker_box'", said="the built-in packs have"):
        register_object(ObjectModel(kind))
    file = tmp_path / "twice.py"
    file.write_text(
        "import mjhab\nbox = mjhab.open_pack().objects['003_cracker_box']\n"
        "mjhab.register_object(mjhab.ObjectModel(box))\n"
    )
    with pytest.warns(
        PluginWarning, match=r"twice\.py.*object '003_cracker_box': the built-in"
    ):
        load_plugin(file)
    assert open_pack() is builtin_pack()


def test_an_object_of_the_name_of_one_of_another_pack_is_refused() -> None:
    kind = builtin_pack().objects["003_cracker_box"]
    theirs = dataclasses.replace(kind, name="their_box")
    register_object(ObjectModel(theirs))
    pack = dataclasses.replace(
        builtin_pack(), name="theirs", objects={"their_box": theirs}
    )
    with refused(where="'their_box'", said="pack 'theirs' has 'their_box', too"):
        with_registered_objects(pack)


def test_objects_that_cannot_be_made() -> None:
    ball = ObjectType(
        "ball", 0.1, (0.03, 0.03, 0.03), (Geom("sphere", (0.03, 0.0, 0.0)),), ()
    )
    with refused(
        where="object 'ball'", said="a geom names the mesh 'skin'; given are: none"
    ):
        register_object(
            ObjectModel(
                dataclasses.replace(ball, visuals=(Geom("mesh", (1, 1, 1), mesh="skin"),))
            )
        )
    with refused(where="object 'ball'", said="has no collision geom"):
        register_object(ObjectModel(dataclasses.replace(ball, collision=())))
    with refused("objects[0].mass", 1000000000.0, where="ball"):
        register_object(ObjectModel(dataclasses.replace(ball, mass=1e9)))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"name": []}, "name must be a text"),
        ({"mass": {}}, "object 'thing': mass must be a finite number"),
        ({"half": 0.1}, "object 'thing': half must be a tuple"),
        ({"collision": None}, "object 'thing': collision must be a tuple"),
        ({"visuals": ("box",)}, "object 'thing': visuals"),
        ({"grasp_shape": "hull"}, "object 'thing': grasp_shape must be '' or 'mesh'"),
    ],
)
def test_values_of_another_type_are_refused(changes: dict[str, Any], said: str) -> None:
    kind = dataclasses.replace(builtin_objects()["013_apple"], name="thing")
    with refused(said=said):
        ObjectModel(dataclasses.replace(kind, **changes))
    with refused("meshes", where="object 'thing'"):
        ObjectModel(kind, meshes=[])  # type: ignore[arg-type]
