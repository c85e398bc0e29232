"""The rasterizer against MuJoCo's ray casting: a furnished home with objects, seen by both cameras of the robot.

The ray caster needs no graphics library. Both get the collision shapes of the home, the robot aside: rays that start
inside a shape see it from within, pictures do not.
"""

from __future__ import annotations

import copy
import functools

import mujoco
import numpy as np
import pytest

from mjhab.core.rotations import mat_from_quat
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import Cameras
from mjhab.render.primitives import box_mesh
from mjhab.render.raster.rasterizer import NEAR, Rasterizer
from mjhab.robots.fetch import model as fetch
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.parts import CameraMount
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.freespace import free_map
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos

SIZE = 96
SHOWN = 0
HIDDEN = 5
"""Geom groups."""
KINDS = [
    int(mujoco.mjtGeom.mjGEOM_BOX),
    int(mujoco.mjtGeom.mjGEOM_MESH),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER),
]


@functools.cache
def home() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The first built-in home: the robot looks over it from its end, objects are in the air before it."""
    pack = builtin_pack()
    layout = Layout(pack, roster("set_table"))
    sim = CpuSimulator(layout, 1, 1)
    # The simulator's model is that of all tests of this process, and groups are set below.
    model = copy.copy(sim.model(pack.homes[0].name))
    data = mujoco.MjData(model)
    data.qpos[sim.addresses.robot_q] = parked_robot_qpos(ROBOT)
    rng = np.random.default_rng(4)
    grid = free_map(pack.homes[0], pack, cell=0.25)
    floor = grid.to_xy(np.argwhere(grid.navigable(0.3)))
    here = floor[np.linalg.norm(floor - floor.mean(axis=0), axis=1).argmax()]
    ahead = floor.mean(axis=0) - here
    yaw = np.arctan2(ahead[1], ahead[0])
    data.qpos[sim.addresses.robot_q[:3]] = *here, yaw
    for name in layout.object_names:
        forward, left, height = rng.uniform((0.5, -1.2, 0.3), (2.5, 1.2, 1.6))
        c = np.cos(yaw)
        s = np.sin(yaw)
        where = here[0] + c * forward - s * left, here[1] + s * forward + c * left, height
        turn = rng.normal(size=4)
        data.joint(model.body(name).jntadr[0]).qpos[:] = np.r_[
            where, turn / np.linalg.norm(turn)
        ]
    mujoco.mj_kinematics(model, data)
    root = model.body_rootid[model.body(fetch.LINKS[0]).id]
    for geom in range(model.ngeom):
        solid = model.geom_contype[geom] or model.geom_conaffinity[geom]
        own = model.body_rootid[model.geom_bodyid[geom]] == root
        kept = (
            solid
            and not own
            and model.geom_type[geom] in KINDS
            and data.geom_xpos[geom, 2] > -20
        )
        model.geom_group[geom] = SHOWN if kept else HIDDEN
    return model, data


def geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh:
    """Triangles of a geom in its own frame."""
    size = model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return box_mesh(size)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return fine_cylinder(size[0], size[1])
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    count = model.mesh_vertnum[mesh]
    start = model.mesh_faceadr[mesh]
    faces = model.mesh_facenum[mesh]
    return Mesh(
        model.mesh_vert[first : first + count].astype(np.float32),
        model.mesh_face[start : start + faces].astype(np.int32),
    )


def fine_cylinder(radius: float, half: float, sides: int = 140) -> Mesh:
    """A cylinder of so many sides that it is 0.02 % too thin, in fewer faces than a mesh with levels of detail has."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    low = np.c_[ring, np.full(sides, -half)]
    high = np.c_[ring, np.full(sides, half)]
    k = np.arange(sides)
    n = (np.arange(sides) + 1) % sides
    bottom = np.full(sides, 2 * sides)
    top = np.full(sides, 2 * sides + 1)
    faces = np.concatenate(
        [
            np.stack(f, 1)
            for f in (
                (k, n, n + sides),
                (k, n + sides, k + sides),
                (bottom, n, k),
                (top, k + sides, n + sides),
            )
        ]
    )
    points = np.concatenate([low, high, [[0, 0, -half], [0, 0, half]]])
    return Mesh(points.astype(np.float32), faces.astype(np.int32))


def rasterized(pos: np.ndarray, mat: np.ndarray, fovy: float) -> dict[str, np.ndarray]:
    """Depth and seg (h, w); seg counts geoms from 1."""
    model, data = home()
    builder = SceneBuilder(1)
    names = {"background": 0}
    for geom in np.flatnonzero(model.geom_group == SHOWN).tolist():
        mesh = builder.add_mesh(geom, geom_mesh(model, geom))
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, data.geom_xmat[geom])
        builder.add_world_instance(mesh, data.geom_xpos[geom], quat, seg=str(geom))
        names[str(geom)] = geom + 1
    scene = builder.build()
    images = Rasterizer(scene, 1).render(
        np.zeros(1, int),
        np.zeros((1, 1, 3)),
        np.eye(3)[None, None],
        Cameras(pos[None, None], mat[None, None], fovy, SIZE, SIZE),
        ("depth", "seg"),
    )
    own = np.array([names[name] for name in scene.seg_names])
    return {"depth": images["depth"][0, 0], "seg": own[images["seg"][0, 0]]}


def ray_cast(
    pos: np.ndarray, mat: np.ndarray, fovy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Planar depth (h, w), 0 where nothing is, and geom + 1."""
    model, data = home()
    focal = 0.5 * SIZE / np.tan(0.5 * fovy)
    u, v = np.meshgrid(*2 * [(np.arange(SIZE) + 0.5 - SIZE / 2) / focal])
    ray = (np.stack([u, -v, -np.ones_like(u)], -1) @ mat.T).reshape(-1, 3)
    length = np.linalg.norm(ray, axis=1)
    geom = np.empty(len(ray), np.int32)
    distance = np.empty(len(ray))
    groups = np.zeros(6, np.uint8)
    groups[SHOWN] = 1
    unit = np.ascontiguousarray((ray / length[:, None]).ravel())
    mujoco.mj_multiRay(
        model,
        data,
        pos,
        unit,
        groups,
        True,
        -1,
        geom,
        distance,
        None,
        len(ray),
        mujoco.mjMAXVAL,
    )
    depth = np.where(geom >= 0, distance / length, 0.0)
    return depth.reshape(SIZE, SIZE), (geom + 1).reshape(SIZE, SIZE)


def away_from_edges(seg: np.ndarray) -> np.ndarray:
    """Pixels (h, w) whose eight neighbours see the same."""
    same = np.ones(seg.shape, bool)
    padded = np.pad(seg, 1, mode="edge")
    for dy in range(3):
        for dx in range(3):
            same &= padded[dy : dy + seg.shape[0], dx : dx + seg.shape[1]] == seg
    return same


@pytest.mark.parametrize("camera", fetch.CAMERAS, ids=lambda c: c.name)
def test_depth_and_seg_agree_with_ray_casting(camera: CameraMount) -> None:
    model, data = home()
    body = model.body(camera.body).id
    frame = data.xmat[body].reshape(3, 3)
    pos = data.xpos[body] + frame @ np.array(camera.pos)
    mat = frame @ mat_from_quat(np.array(camera.quat))
    depth, seg = ray_cast(pos, mat, camera.fovy)
    own = rasterized(pos, mat, camera.fovy)
    assert len(np.unique(seg)) > 15, "the view is worth testing"
    inner = away_from_edges(seg)
    assert inner.mean() > 0.5
    assert (own["seg"] == seg)[inner].mean() >= 0.999
    assert (own["seg"] == seg).mean() > 0.98
    hit = (own["seg"] == seg) & (seg > 0) & (depth > NEAR)
    error = np.abs(own["depth"] - depth)[hit]
    assert np.median(error) < 1e-4 and np.quantile(error, 0.99) < 2e-3
    assert not own["depth"][own["seg"] == 0].any()
