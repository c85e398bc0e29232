"""The compiled model of a home has the shapes that its pack describes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjhab.layout.layout import Layout
from mjhab.layout.model_spec import build_spec
from mjhab.scenes.packs import open_pack
from mjhab.scenes.shapes.hulls import hull_mesh
from mjhab.scenes.spec import Geom, ObjectType, Pack, Vec3

HALF = (0.04, 0.02, 0.03)


def with_wedge(pack: Pack, *scales: Vec3) -> Pack:
    """A pack with a mesh, and an object "wedge_<k>" of it in every scale."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    mesh = hull_mesh(signs * np.array(HALF))
    objects = {}
    for k, scale in enumerate(scales):
        x, y, z = np.multiply(HALF, scale).tolist()
        geom = Geom("mesh", scale, mesh="wedge", visual=False)
        objects[f"wedge_{k}"] = ObjectType(f"wedge_{k}", 0.2, (x, y, z), (geom,), ())
    return replace(
        pack,
        objects={**pack.objects, **objects},
        meshes={**pack.meshes, "wedge": mesh},
    )


def test_meshes_collide_at_the_scale_of_their_geoms():
    """One mesh in several scales, also of a file in millimetres."""
    scales = ((1.0, 1.0, 1.0), (0.5, 0.5, 0.5), (1.0, 2.0, 0.5))
    pack = with_wedge(open_pack("builtin"), *scales)
    kinds = tuple(f"wedge_{k}" for k in range(len(scales)))
    model = build_spec(Layout(pack, kinds), pack.homes[0]).compile()
    for kind, scale in zip(kinds, scales, strict=True):
        geom = model.geom(f"{kind}_:0000/0")
        # MuJoCo gives a mesh the axes of its inertia: the sorted half-extents do not depend on them.
        half = np.sort(model.geom_aabb[geom.id, 3:])
        np.testing.assert_allclose(half, np.sort(np.multiply(HALF, scale)), rtol=1e-5)
        assert model.body(f"{kind}_:0000").mass == pytest.approx(0.2)


def test_the_body_of_furniture_that_opens_may_be_a_mesh():
    pack = with_wedge(open_pack("builtin"))
    fridge = pack.articulations["fridge"]
    knob = Geom("mesh", (2.0, 2.0, 2.0), (0.0, 0.0, 1.9), mesh="wedge")
    pack = replace(
        pack,
        articulations={
            **pack.articulations,
            "fridge": replace(fridge, geoms=(*fridge.geoms, knob)),
        },
    )
    model = build_spec(Layout(pack, ()), pack.homes[0]).compile()
    solid = sum(geom.collide for geom in fridge.geoms)
    half = np.sort(model.geom_aabb[model.geom(f"fridge/{solid}").id, 3:])
    np.testing.assert_allclose(half, np.sort(np.multiply(HALF, 2.0)), rtol=1e-5)
