from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from mjhab.core.rotations import mat_from_quat
from mjhab.layout.layout import Layout
from mjhab.render.layout_scene import build_render_scene
from mjhab.render.models import MAX_TEXTURE_SIDE, DrawnHome, Model, home_models
from mjhab.render.render_scene import RenderScene
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.viewer.drawn import glb as glb_file
from mjhab.viewer.drawn.posing import MAX_JUMP_M, PosedWorld, Poser, between


@pytest.fixture(scope="module")
def scene(env: Any) -> RenderScene:
    return build_render_scene(env.layout, env.sim.model(env.homes[0]))


@pytest.fixture(scope="module")
def home(env: Any) -> int:
    return [h.name for h in env.layout.pack.homes].index(env.homes[0])


@pytest.fixture(scope="module")
def models(scene: RenderScene, home: int) -> DrawnHome:
    return home_models(scene, home)


def faces_of(model: Model) -> int:
    return sum(len(part.faces) for part in model.parts)


def test_every_face_is_drawn_once(
    models: DrawnHome, scene: RenderScene, home: int
) -> None:
    shown = (scene.home_scale[home] != 0.0).all(axis=1)
    drawn = int(scene.mesh_face_count[scene.instance_mesh[shown]].sum())
    moving = sum(faces_of(model) * len(model.bodies) for model in models.movable)
    assert faces_of(models.home) + moving == drawn > 10_000
    bodies = [body for model in models.movable for body in model.bodies]
    assert sorted(bodies) == sorted(set(scene.instance_body[shown].tolist()) - {0})


def test_equal_objects_share_their_mesh(models: DrawnHome, env: Any) -> None:
    bowls = {
        env.sim.addresses.object_body[i]
        for i, kind in enumerate(env.layout.roster)
        if kind == "024_bowl"
    }
    assert len(bowls) > 1
    assert any(bowls == set(model.bodies) for model in models.movable)


def test_geometry_is_where_the_rasterizer_draws_it(
    models: DrawnHome, scene: RenderScene, home: int
) -> None:
    still = np.flatnonzero(
        (scene.instance_body == 0) & (scene.home_scale[home] != 0).all(axis=1)
    )
    lowest = np.full(3, np.inf)
    highest = -lowest
    for i in still:
        start = scene.mesh_face_start[scene.instance_mesh[i]]
        count = scene.mesh_face_count[scene.instance_mesh[i]]
        points = scene.vertices[np.unique(scene.faces[start : start + count])]
        world = (points * scene.home_scale[home, i]) @ scene.home_mat[home, i].T
        world += scene.home_pos[home, i]
        lowest = np.minimum(lowest, world.min(axis=0))
        highest = np.maximum(highest, world.max(axis=0))
    vertices = np.concatenate([part.vertices for part in models.home.parts])
    np.testing.assert_allclose(vertices.min(axis=0), lowest, atol=1e-4)
    np.testing.assert_allclose(vertices.max(axis=0), highest, atol=1e-4)


def test_parts_are_fit_to_draw(models: DrawnHome) -> None:
    for model in (models.home, *models.movable):
        for part in model.parts:
            assert part.faces.max() < len(part.vertices)
            assert np.isfinite(part.uv).all()
            np.testing.assert_allclose(
                np.linalg.norm(part.normals, axis=1), 1.0, atol=1e-3
            )
    textures = [look.texture for look in models.looks if look.texture is not None]
    assert textures and all(max(t.shape) <= MAX_TEXTURE_SIDE for t in textures)
    assert any(np.ptp(t) > 20 for t in textures)
    assert len(models.lamp_pos) and (models.lamp_color > 0).any(axis=1).all()


def test_a_file_holds_the_model(models: DrawnHome) -> None:
    model = models.movable[0]
    loaded = trimesh.load(io.BytesIO(glb_file.glb(model, models.looks)), file_type="glb")
    assert isinstance(loaded, trimesh.Scene)
    assert sum(len(mesh.faces) for mesh in loaded.geometry.values()) == faces_of(model)


def test_files_are_kept_on_disk(
    models: DrawnHome, env: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    small = DrawnHome(
        models.movable[0], models.movable[1:3], models.looks, *np.ones((2, 1, 3))
    )
    made = glb_file.home_files(env.layout, env.homes[0], lambda: small)
    kept = glb_file.home_files(
        env.layout, env.homes[0], lambda: pytest.fail("it is on the disk")
    )
    assert (kept.home, kept.movable) == (made.home, made.movable)
    next((tmp_path / "viewer").glob("*.npz")).write_bytes(b"broken")
    assert glb_file.home_files(env.layout, env.homes[0], lambda: small).home == made.home


def test_files_are_made_anew_for_other_looks() -> None:
    pack = builtin_pack()
    home = pack.homes[0].name
    corners = np.zeros((3, 3), np.float32)
    mesh = Mesh(corners, np.array([[0, 1, 2]], np.int32), face_color=corners[:1])
    paint = Material((1.0, 0.0, 0.0))
    visuals = ROBOT.visuals()
    robots = (
        ROBOT,
        dataclasses.replace(ROBOT, materials={**ROBOT.materials, "paint": paint}),
        dataclasses.replace(ROBOT, visuals=lambda: visuals[:3]),
    )
    meshes = (mesh, dataclasses.replace(mesh, face_color=corners[:1] + 1.0))
    layouts = [Layout(pack, (), robot) for robot in robots]
    layouts += [
        Layout(dataclasses.replace(pack, meshes={"sign": look}), ()) for look in meshes
    ]
    digests = [glb_file.home_digest(layout, home) for layout in layouts]
    assert len(set(digests)) == len(digests)
    assert glb_file.home_digest(Layout(pack, ()), home) == digests[0]


def test_poses_are_those_of_the_simulator(env: Any) -> None:
    pose = Poser(env.sim).pose(env.homes[0], env.sim.qpos[0])
    np.testing.assert_allclose(pose.pos, env.state.body_pos[0], atol=1e-9)
    np.testing.assert_allclose(mat_from_quat(pose.quat), env.state.body_mat[0], atol=1e-9)
    assert not len(pose.contacts)


def test_a_robot_in_a_wall_touches_it(env: Any) -> None:
    qpos = env.sim.qpos[0].copy()
    x0, _, _, y1 = env.layout.pack.homes[0].floor
    home = env.layout.pack.homes[0].name
    qpos[env.sim.addresses.robot_q[:2]] = (x0, y1)
    assert len(Poser(env.sim).pose(home, qpos).contacts)


def test_between_two_poses() -> None:
    still = np.array([[1.0, 0.0, 0.0, 0.0]])
    a = PosedWorld(np.zeros((1, 3)), still, np.zeros((0, 3)))
    b = PosedWorld(np.full((1, 3), 0.1), -still, np.ones((1, 3)))
    middle = between(a, b, 0.5)
    np.testing.assert_allclose(middle.pos, 0.05)
    np.testing.assert_allclose(middle.quat, still)
    far = PosedWorld(np.full((1, 3), MAX_JUMP_M), still, np.zeros((0, 3)))
    assert not between(a, far, 0.9).pos.any()
    np.testing.assert_allclose(between(a, far, 1.0).pos, far.pos)
