"""YCB objects: shapes stay close to the scans, the bowl is open, broken files are named."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mjhab.core.rotations import mat_from_quat
from mjhab.data.imports.ms_hab_layout import SCANNED_YAWS
from mjhab.scenes.builtin.objects import MASSES, SIZES, builtin_objects
from mjhab.scenes.formats.gltf import MAX_TEXTURE
from mjhab.scenes.replica_cad.ycb import (
    SCAN,
    Scan,
    hull_of,
    object_from_scan,
    read_scan,
    read_ycb,
)
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.simplify import simplify
from mjhab.scenes.spec import Geom, ObjectType
from tests.real_data import real_data
from tests.refusals import refused

BOXES = (
    "003_cracker_box",
    "004_sugar_box",
    "008_pudding_box",
    "009_gelatin_box",
    "010_potted_meat_can",
)
CANS = ("002_master_chef_can", "005_tomato_soup_can", "007_tuna_fish_can")
BOWL = "024_bowl"
APPLE = "013_apple"


@cache
def ycb() -> tuple[dict[str, ObjectType], dict[str, object]]:
    return read_ycb(real_data("ycb"))


def mesh(name: str) -> Mesh:
    found = ycb()[1][name]
    assert isinstance(found, Mesh)
    return found


def scan(name: str) -> Scan:
    return read_scan(real_data("ycb", name, SCAN))


def test_shapes_and_masses() -> None:
    types, _ = ycb()
    assert {name: kind.mass for name, kind in types.items()} == MASSES
    assert {
        name for name, kind in types.items() if kind.collision[0].shape == "box"
    } == set(BOXES)
    cans = {
        name
        for name, kind in types.items()
        if kind.collision[0].shape == "cylinder" and len(kind.collision) == 1
    }
    assert cans == set(CANS)
    assert [geom.shape for geom in types[APPLE].collision] == ["mesh"]
    for name, kind in types.items():
        # Upright sizes as in the data set's bounds along the object's own axes, sides within the tolerance.
        sides = np.sort(2 * np.array(kind.half[:2])), np.sort(SIZES[name][:2])
        np.testing.assert_allclose(*sides, atol=0.0065, err_msg=name)
        np.testing.assert_allclose(
            2 * kind.half[2], SIZES[name][2], atol=1e-4, err_msg=name
        )


def test_boxes_look_along_the_axes_and_know_their_scan() -> None:
    types, _ = ycb()
    for name in BOXES:
        kind = types[name]
        points = scan(name).vertices
        c = np.cos(kind.scan_yaw)
        s = np.sin(kind.scan_yaw)
        turned = np.stack(
            [c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]],
            axis=1,
        )
        assert np.abs(np.abs(turned).max(axis=0) - kind.half[:2]).max() < 0.0035, name
    assert abs(types["008_pudding_box"].scan_yaw) > 0.4
    text = (Path(__file__).parents[3] / "docs" / "assets.md").read_text(encoding="utf-8")
    for name, kind in types.items():
        own, builtin = (
            round(float(np.degrees(k.scan_yaw)), 1) + 0.0
            for k in (kind, builtin_objects()[name])
        )
        assert (f"| `{name}` | {own}° | {builtin}° |" in text) == (
            own != 0.0 or builtin != 0.0
        )
    turned_types = {name: kind.scan_yaw for name, kind in types.items() if kind.scan_yaw}
    assert turned_types == pytest.approx(SCANNED_YAWS, abs=1e-5)
    assert all(types[name].scan_yaw == 0.0 for name in (*CANS, APPLE, BOWL))


def test_origin_is_the_centre_of_the_bounding_box() -> None:
    for name in MASSES:
        points = scan(name).vertices
        np.testing.assert_allclose(
            points.min(axis=0) + points.max(axis=0), 0.0, atol=1e-12
        )


def test_looks_are_textured_and_in_place() -> None:
    for name in MASSES:
        look = mesh(f"{name}_look")
        points = scan(name).vertices
        (texture,) = look.textures
        assert max(texture.shape) <= MAX_TEXTURE and texture.std() > 20
        assert (
            look.uv is not None and look.uv.min() > -1e-3 and look.uv.max() < 1.0 + 1e-3
        )
        np.testing.assert_allclose(
            np.ptp(look.vertices[:, 2]), np.ptp(points[:, 2]), atol=1e-6, err_msg=name
        )


def seen_color(name: str) -> np.ndarray:
    """Median colour (3,) of the texture at the middle of the faces."""
    look = mesh(f"{name}_look")
    assert look.uv is not None
    (texture,) = look.textures
    column, row = (
        (look.uv.mean(axis=1) * (texture.shape[1], texture.shape[0])).astype(int).T
    )
    return np.median(texture[row, column] / 255.0, axis=0)


def test_cracker_box_is_red_and_sugar_box_yellow() -> None:
    cracker = seen_color("003_cracker_box")
    sugar = seen_color("004_sugar_box")
    assert cracker[0] > 0.4 > 2 * cracker[2]
    assert min(sugar[0], sugar[1]) > 1.25 * sugar[2]


def test_apple_hull_is_close_to_the_scan() -> None:
    hull = mesh(f"{APPLE}_hull")
    points = scan(APPLE).vertices
    planes = ConvexHull(hull.vertices).equations
    assert (points @ planes[:, :3].T + planes[:, 3]).max() < 0.0015
    np.testing.assert_allclose(
        np.ptp(hull.vertices, axis=0), np.ptp(points, axis=0), atol=1e-6
    )


def bowl_model(extra: str) -> mujoco.MjModel:
    kind = ycb()[0][BOWL]
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{extra}</worldbody></mujoco>'
    )
    for name in {geom.mesh for geom in kind.collision if geom.mesh}:
        spec.add_mesh(name=name, uservert=mesh(name).vertices.astype(float).ravel())
    body = spec.worldbody.add_body(name="bowl", pos=[0, 0, kind.half[2] + 0.001])
    body.add_freejoint()
    for geom in kind.collision:
        is_mesh = geom.shape == "mesh"
        added = body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH
            if is_mesh
            else mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=geom.pos,
            quat=geom.quat,
        )
        if is_mesh:
            added.meshname = geom.mesh
        else:
            added.size = geom.size
    return spec.compile()


def test_an_apple_sized_ball_falls_into_the_bowl_and_stays() -> None:
    radius = SIZES[APPLE][0] / 2
    # Rolling friction as the objects of a home have it: without it a ball never comes to rest.
    geom = f'<geom type="sphere" size="{radius}" mass="0.07" condim="6" friction="1 0.01 0.003"/>'
    model = bowl_model(
        f'<body name="ball" pos="0.02 0.01 0.15"><freejoint/>{geom}</body>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1500)
    bowl = data.body("bowl").xpos
    ball_at = data.body("ball").xpos
    assert np.linalg.norm(ball_at[:2] - bowl[:2]) < 0.03
    assert ball_at[2] - radius < 0.012, (
        "it lies on the floor of the bowl, 5 mm thick, not on its rim"
    )
    assert np.abs(data.qvel).max() < 0.05


def test_bowl_pieces_follow_the_scan() -> None:
    planes = [
        ConvexHull(mesh(g.mesh).vertices @ mat_from_quat(np.array(g.quat)).T).equations
        for g in ycb()[0][BOWL].collision
        if g.mesh
    ]
    points = scan(BOWL).vertices[::7]
    points = points[np.hypot(points[:, 0], points[:, 1]) > 0.047]
    # Farthest plane of the nearest piece: outside by so much; the wall is 4.5 mm thick.
    outside = np.min(
        [(points @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes], axis=0
    )
    assert np.percentile(outside, 98) < 0.003


def copy_of(tmp_path: Path, *, without: str = "") -> Path:
    folder = tmp_path / "ycb"
    for name in MASSES:
        (folder / name).mkdir(parents=True)
        if name != without:
            shutil.copyfile(real_data("ycb", name, SCAN), folder / name / SCAN)
    return folder


def test_a_missing_scan_is_named_with_the_command_that_gets_it(tmp_path: Path) -> None:
    with refused(where=tmp_path, said="YCB folder without 013_apple/textured.glb"):
        read_ycb(copy_of(tmp_path, without=APPLE))


@pytest.mark.parametrize("damage", ["cut", "text", "empty"])
def test_a_broken_scan_is_named(tmp_path: Path, damage: str) -> None:
    whole = real_data("ycb", BOWL, SCAN).read_bytes()
    path = tmp_path / SCAN
    path.write_bytes(
        {"cut": whole[: len(whole) // 3], "text": b"not a glb", "empty": b""}[damage]
    )
    with refused(where="textured.glb", said=("download", "again")) as caught:
        read_scan(path)
    assert "\n" not in str(caught.value)


def test_a_scan_of_another_size_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mjhab.scenes.object_glb.MAX_EXTENT_M", 0.01)
    with refused(
        where="textured.glb", said="no scan of a YCB object; download the file again"
    ) as caught:
        read_scan(real_data("ycb", BOWL, SCAN))
    assert "scale" not in str(caught.value)


def sphere(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, 2 * count, endpoint=False),
        np.linspace(0.02, np.pi - 0.02, count),
    )
    points = np.stack(
        [np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1
    ).reshape(-1, 3)
    hull = ConvexHull(points)
    faces = hull.simplices.copy()
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_simplify_keeps_the_shape_with_fewer_faces() -> None:
    vertices, faces = sphere()
    few = simplify(vertices, faces, 600)
    assert 250 < len(few.faces) <= 600
    assert abs(volume(few.vertices, few.faces) / volume(vertices, faces) - 1) < 0.05
    np.testing.assert_allclose(
        np.linalg.norm(few.vertices[np.unique(few.faces)], axis=1), 1.0, atol=0.05
    )
    # Every face is near the one that it was made from, corner by corner.
    moved = np.linalg.norm(few.vertices[few.faces] - vertices[faces[few.source]], axis=2)
    assert moved.max() < 0.25
    same = simplify(vertices, faces, len(faces))
    assert len(same.vertices) == len(vertices) and len(same.faces) == len(faces)


def test_a_hull_keeps_extremes_and_faces_outward() -> None:
    points = np.random.default_rng(0).normal(size=(3000, 3)) * (0.03, 0.02, 0.05)
    hull = hull_of(points)
    assert len(hull.vertices) <= 160 and volume(hull.vertices, hull.faces) > 0
    np.testing.assert_allclose(
        np.ptp(hull.vertices, axis=0), np.ptp(points, axis=0), rtol=1e-6
    )


def test_a_lump_becomes_one_hull_and_a_crate_a_box() -> None:
    vertices, faces = sphere(24)
    lump, meshes = object_from_scan(APPLE, Scan(vertices * (0.05, 0.04, 0.03), faces))
    assert lump.collision == (
        Geom("mesh", (1.0, 1.0, 1.0), mesh=f"{APPLE}_hull", visual=False),
    )
    assert set(meshes) == {f"{APPLE}_hull", f"{APPLE}_look"}
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (
        0.04,
        0.02,
        0.06,
    )
    turned = corners @ mat_from_quat(np.array([np.cos(0.15), 0, 0, np.sin(0.15)])).T
    hull = hull_of(turned)
    crate, _ = object_from_scan("003_cracker_box", Scan(hull.vertices, hull.faces))
    np.testing.assert_allclose(crate.half, (0.04, 0.02, 0.06), atol=2e-4)
    assert crate.scan_yaw == pytest.approx(-0.3, abs=0.003)
