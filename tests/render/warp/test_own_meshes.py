"""Meshes of files wound inwards, double-sided or mirrored look and weigh the same as the good ones on a device."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjhab.layout.layout import Layout
from mjhab.render.home_scene import HomeRenderer
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.missing import need_warp
from tests.render.own_meshes import CUBES, cube
from tests.warp_device import TEST_DEVICE

need_warp()

SIZE = (128, 128)
CAMERAS = ("fetch_hand",)
DEPTH_M = 2e-4
"""Tolerance of the depth between the renderers; the inside of the cube is 24 mm to 58 mm farther away."""
AHEAD_M = 0.2


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> Layout:
    """A home in which each cube lies."""
    folder = tmp_path_factory.mktemp("cubes")
    models = [cube(name, folder) for name in CUBES]
    pack = builtin_pack()
    pack = dataclasses.replace(
        pack,
        homes=pack.homes[:1],
        objects={**pack.objects, **{model.kind.name: model.kind for model in models}},
        meshes={
            **pack.meshes,
            **{name: mesh for model in models for name, mesh in model.meshes.items()},
        },
    )
    return Layout(pack, tuple(model.kind.name for model in models))


def test_every_cube_has_the_depth_of_the_good_one(layout: Layout) -> None:
    from mjhab.render.warp.cameras import WarpCameras
    from mjhab.sim.warp.buffers import BufferSizes
    from mjhab.sim.warp.simulator import WarpSimulator

    worlds = len(CUBES)
    sizes = BufferSizes(contacts=4096, ccd=1024, rows=1024)
    device = WarpSimulator(layout, worlds, TEST_DEVICE, sizes=sizes)
    host = CpuSimulator(layout, worlds, 1)
    homes = [layout.pack.homes[0].name] * worlds
    starts = _starts(host, worlds)
    for sim in (device, host):
        sim.reset(range(worlds), homes, starts)
    cameras = WarpCameras(device, CAMERAS, SIZE, ("depth", "seg"))
    drawn = {name: image.numpy()[:, 0] for name, image in cameras.draw().items()}
    wanted = HomeRenderer(host, 1).robot_views(
        host.state(), homes, SIZE, ("depth", "seg"), CAMERAS
    )
    names = cameras.segmentation_names
    for world in range(worlds):
        own = [name in layout.object_names for name in names]
        seen = np.array(own)[wanted["seg"][world, 0]]
        assert seen.sum() > 100, "the cube is not in the image"
        for depth in (drawn["depth"][world], wanted["depth"][world, 0]):
            off = np.abs(depth - wanted["depth"][0, 0])[seen]
            # Pixels on the outline may show what is behind.
            assert np.quantile(off, 0.97) < DEPTH_M, layout.object_names[world]


def _starts(host: CpuSimulator, worlds: int) -> np.ndarray:
    """States (W, nq): in world k the k-th cube hangs before the hand, the others are parked."""
    home = host.layout.pack.homes[0].name
    qpos = np.stack([host.model(home).qpos0] * worlds)
    a = host.addresses
    host.reset(range(worlds), [home] * worlds, qpos)
    renderer = HomeRenderer(host, 1)
    pos, mat = renderer.camera_poses(host.state(), CAMERAS)
    for world in range(worlds):
        first = a.object_q[world]
        qpos[world, first : first + 3] = pos[0, 0] - AHEAD_M * mat[0, 0][:, 2]
        qpos[world, first + 3 : first + 7] = 0.9, 0.3, 0.2, 0.245
    return qpos


def test_every_cube_collides_and_weighs_the_same(layout: Layout) -> None:
    """Pieces collide as convex hulls, whose winding is ours; MuJoCo refuses meshes with a negative volume."""
    model = CpuSimulator(layout, 1, 1).model(layout.pack.homes[0].name)
    bodies = [model.body(name).id for name in layout.object_names]
    np.testing.assert_allclose(model.body_mass[bodies], 0.2, rtol=1e-9)
    side = 0.2 * (0.06**2 + 0.06**2) / 12
    np.testing.assert_allclose(model.body_inertia[bodies], side, rtol=1e-4)
