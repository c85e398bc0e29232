"""The path tracer sees what the rasterizer draws: geometry, textures, moving bodies, worlds; and lights it."""

from __future__ import annotations

import importlib.util
from typing import Any

import mujoco
import numpy as np
import pytest

from mjhab.layout.layout import Layout
from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import Cameras, look_at
from mjhab.render.home_scene import HomeRenderer
from mjhab.render.path_tracer.windows import (
    SKYLIGHT_M,
    one_home,
    open_windows,
    skylights,
)
from mjhab.render.raster.rasterizer import Rasterizer
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.shading import CUDA, EVENING, LLVM, MIDDAY, Shading, shading_of
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Geom, Light
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos
from tests.missing import missing
from tests.refusals import refused

if importlib.util.find_spec("mitsuba") is None:
    missing("mitsuba is absent: pip install 'mjhab[photo]'", whole_module=True)

from mjhab.render.path_tracer import library
from mjhab.render.path_tracer.lights import TIMES
from mjhab.render.path_tracer.tracer import PathTracer, _normals

SIZE = (48, 36)
FOVY = 1.0
NOT_SMOOTHED = Shading(samples=1, denoise=False)


def cameras(*views: tuple[Any, Any], size: tuple[int, int] = SIZE) -> Cameras:
    """One camera in each world, of (eye, target)."""
    pos = np.array([[eye] for eye, _ in views], float)
    mat = np.array([[look_at(eye, target)] for eye, target in views])
    return Cameras(pos, mat, FOVY, *size)


def bodies(*z: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the world and of one body at height z, in each world."""
    pos = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, height]] for height in z])
    return pos, np.tile(np.eye(3), (len(z), 2, 1, 1))


@pytest.fixture(scope="module")
def renderer() -> HomeRenderer:
    """Of two homes, with the robot."""
    pack = builtin_pack()
    return HomeRenderer(CpuSimulator(Layout(pack, ()), 1, 1), 1, NOT_SMOOTHED)


@pytest.fixture(scope="module")
def room() -> PathTracer:
    """A lamp over a floor and a box on body 1 of half a side of 0.2 m."""
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (3.0, 3.0, 0.1), (0.0, 0.0, -0.1)), seg="floor")
    builder.add_body_geom(Geom("box", (0.2, 0.2, 0.2)), 1)
    builder.add_light(0, Light((0.5, 0.5, 2.4)))
    return PathTracer(builder.build(), NOT_SMOOTHED)


def test_depth_of_a_home_is_that_of_the_rasterizer(renderer: HomeRenderer) -> None:
    sim = renderer._sim
    homes = ["builtin_m0_00", "builtin_m2_01"]
    poses = []
    for home in homes:
        data = mujoco.MjData(sim.model(home))
        data.qpos[sim.addresses.robot_q] = parked_robot_qpos(renderer.layout.robot)
        mujoco.mj_kinematics(sim.model(home), data)
        poses.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()))
    pos, mat = (np.stack(rows) for rows in zip(*poses, strict=True))
    eyes = [home.floor for home in renderer.layout.pack.homes if home.name in homes]
    views = [
        ((x0 + 1.0, y0 + 1.2, 1.4), ((x0 + x1) / 2, (y0 + y1) / 2, 0.6))
        for x0, y0, x1, y1 in eyes
    ]
    seen = cameras(*views, size=(96, 72))
    index = renderer.home_numbers(homes)
    drawn = renderer.rasterizer.render(index, pos, mat, seen, ("depth", "seg"))
    assert renderer.tracer is not None
    traced = renderer.tracer.depth(index, pos, mat, seen)
    # The rasterizer has neither ceilings nor open windows.
    names = np.array(renderer.scene.seg_names)[drawn["seg"]]
    both = (drawn["depth"] > 0.0) & ~np.char.startswith(names, "window")
    assert both.mean() > 0.7
    near = np.abs(traced - drawn["depth"]) < 1e-3
    assert near[both].mean() > 0.99
    rgb = renderer.render(index, pos, mat, seen, ("rgb", "depth"))
    np.testing.assert_array_equal(rgb["depth"], drawn["depth"])
    assert rgb["rgb"].shape == (2, 1, 72, 96, 3) and rgb["rgb"].std() > 20.0


def test_windows_are_holes_of_the_size_of_their_panes(renderer: HomeRenderer) -> None:
    home = [h.name for h in renderer.layout.pack.homes].index("builtin_m0_00")
    alone = one_home(renderer.scene, home)
    opened, windows = open_windows(alone)
    assert len(windows) == 3
    x0, y0, x1, y1 = renderer.layout.pack.homes[home].floor
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 1.2])
    for window in windows:
        sides = (np.linalg.norm(window.across), np.linalg.norm(window.up))
        assert sorted(sides) == pytest.approx([1.15 / 2, 1.4 / 2])
        assert (middle - window.middle) @ window.inward > 0.0

    def volume(scene: Any) -> float:
        walls = scene.instance_seg == scene.seg_names.index("wall")
        return float(8.0 * np.abs(scene.home_scale[0, walls]).prod(axis=1).sum())

    thickness = 2.0 * np.abs(alone.home_scale[0]).min(axis=1)
    walls = alone.instance_seg == alone.seg_names.index("wall")
    wall_m = float(thickness[walls & (thickness > 0.0)].min())
    assert volume(alone) - volume(opened) == pytest.approx(
        3 * 1.4 * 1.15 * wall_m, rel=0.01
    )


def test_the_sun_shines_through_the_ceiling_of_a_home_without_windows() -> None:
    height = 2.4
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (3.0, 3.0, 0.1), (0.0, 0.0, -0.1)), seg="floor")
    for x, y, half in ((3, 0, (0.1, 3.1)), (-3, 0, (0.1, 3.1)), (0, 3, (3.1, 0.1)), (0, -3, (3.1, 0.1))):  # fmt: skip
        size = (*half, height / 2)
        builder.add_world_geom(Geom("box", size, (x, y, height / 2)), seg="wall")
    builder.add_light(0, Light((1.0, 1.9, 2.2)))
    scene = builder.build()
    # Straight down: the picture shows 2.7 m across, x to the right and y up.
    pos, mat = bodies(0.0)
    view = cameras(((0.0, -0.01, 2.3), (0.0, 0.0, 0.0)))
    traced = {
        light: PathTracer(scene, Shading(8, light, denoise=False))
        for light in (MIDDAY, EVENING)
    }
    day, evening = (
        tracer.render(np.zeros(1, int), pos, mat, view, {})[0, 0].mean(axis=-1)
        for tracer in traced.values()
    )
    to_sun = np.array(TIMES[MIDDAY].to_sun)
    x, y = np.array([1.0, 1.9]) - height * to_sun[:2] / to_sun[2]
    pixels = SIZE[1] / (2.0 * 2.3 * np.tan(FOVY / 2))
    row, column = round(SIZE[1] / 2 - y * pixels), round(SIZE[0] / 2 + x * pixels)
    patch = (slice(row - 3, row + 4), slice(column - 3, column + 4))
    beside = (slice(row - 3, row + 4), slice(-10, None))
    assert day[patch].mean() > 1.5 * day[beside].mean()
    assert evening[patch].mean() < 1.5 * evening[beside].mean()


def test_a_ceiling_is_whole_but_for_its_skylights() -> None:
    span = (-3.0, -2.0, 3.0, 2.0)
    lamps = np.array([[0.0, 0.0, 2.3], [0.5, 0.0, 2.3], [2.0, 1.0, 2.3], [2.9, 0.0, 2.3]])
    holes, pieces = skylights(lamps, span, 2.5)
    # One lamp is beside another, one at the wall.
    places = [hole.middle.tolist() for hole in holes]
    assert places == [[0.0, 0.0, 2.5], [2.0, 1.0, 2.5]]
    area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in pieces)
    assert area == pytest.approx(24.0 - 2 * (2 * SKYLIGHT_M) ** 2)
    assert skylights(lamps, (0.0, 0.0, 0.0, 0.0), -np.inf)[0] == []


def test_the_denoiser_is_shown_the_normals_of_what_is_seen(room: PathTracer) -> None:
    pos, mat = bodies(-5.0)
    view = cameras(((1.2, 0.9, 0.8), (0.0, 0.0, 0.0)))
    drawn = Rasterizer(room.scene, 1).render(np.zeros(1, int), pos, mat, view, ["depth"])
    depth = drawn["depth"][0, 0]
    slope = 2.0 * np.tan(FOVY / 2) / SIZE[1]
    normal = _normals(depth, slope, view.mat[0, 0])[depth > 0.0]
    assert (np.abs(normal - (0.0, 0.0, 1.0)).max(axis=-1) < 0.02).mean() > 0.9


def test_a_body_moves_and_worlds_do_not_depend_on_each_other(room: PathTracer) -> None:
    view = ((1.2, 0.9, 0.8), (0.0, 0.0, 0.2))
    pos, mat = bodies(0.2, 0.5)
    home = np.zeros(2, int)
    both = room.render(home, pos, mat, cameras(view, view), {})
    raster = Rasterizer(room.scene, 1)
    drawn = raster.render(home, pos, mat, cameras(view, view), ("depth",))["depth"]
    traced = room.depth(home, pos, mat, cameras(view, view))
    there = drawn > 0.0
    assert (np.abs(traced - drawn) < 1e-3)[there].mean() > 0.99
    assert (np.abs(drawn[0] - drawn[1]) > 0.05).mean() > 0.02
    # In the other order, so that what was drawn before shows.
    for w in (1, 0):
        poses = pos[w : w + 1], mat[w : w + 1]
        alone = room.render(home[:1], *poses, cameras(view), {})
        np.testing.assert_array_equal(alone[0], both[w])


def test_a_texture_lies_as_the_rasterizer_draws_it() -> None:
    colors = [[(200, 30, 30), (30, 200, 30)], [(30, 30, 200), (200, 200, 30)]]
    image = np.repeat(np.repeat(np.array(colors, np.uint8), 8, 0), 8, 1)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    quad = Mesh(corners, faces, None, uv[faces], np.zeros(2, np.int32), (image,))
    builder = SceneBuilder(1)
    builder.add_world_instance(builder.add_mesh("quad", quad), (0, 0, 0))
    view = cameras(((0.0, -0.4, 2.6), (0.0, 0.0, 0.0)))
    pos, mat = bodies(0.0)
    scene = builder.build()
    home = np.zeros(1, int)
    drawn = Rasterizer(scene, 1).render(home, pos, mat, view, ("rgb", "depth"))
    tracer = PathTracer(scene, Shading(samples=16))
    assert set(tracer.guides) == set(drawn)
    found = tracer.render(home, pos, mat, view, drawn)[0, 0]
    for y, x in ((11, 16), (11, 32), (26, 16), (26, 32)):
        a, b = (im[y, x].astype(float) for im in (found, drawn["rgb"][0, 0]))
        assert np.corrcoef(a, b)[0, 1] > 0.9, (y, x, a, b)


def test_metal_and_evening_look_otherwise(room: PathTracer) -> None:
    view = cameras(((1.2, 0.9, 0.8), (0.0, 0.0, 0.2)))
    pos, mat = bodies(0.2)
    home = np.zeros(1, int)
    day = room.render(home, pos, mat, view, {})
    evening = PathTracer(room.scene, Shading(1, EVENING, denoise=False))
    night = evening.render(home, pos, mat, view, {})
    # Under the open sky it is day by the sun, and lamps are warm.
    assert day.mean() > night.mean()
    red, blue = ([picture[..., k].mean() for picture in (night, day)] for k in (0, 2))
    assert red[0] / blue[0] > 1.05 * red[1] / blue[1]


@pytest.mark.parametrize(
    ("shader", "options", "says"),
    [
        ("paths", {}, "path"),
        ("path", {"samples": 0}, "samples"),
        ("path", {"samples": 10**6}, "samples"),
        ("path", {"light": "noon"}, "midday"),
        ("path", {"variant": "cuda_rgb"}, CUDA),
        ("path", {"sample": 4}, "samples"),
        ("raster", {"samples": 4}, "path"),
    ],
)
def test_what_is_wrong_is_named(shader: str, options: dict[str, Any], says: str) -> None:
    with refused() as error:
        shading_of(shader, options)
    assert says in str(error.value)


def test_a_variant_that_cannot_run_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(library, "_has_cuda", lambda: False)
    monkeypatch.setattr(library, "_has_llvm", lambda: False)
    library._unavailable.cache_clear()
    for variant in (CUDA, LLVM):
        with refused(option="variant", given=variant) as error:
            library.mitsuba(variant)
        assert "\n" not in str(error.value) and "scalar_rgb" in str(error.value)
    library._unavailable.cache_clear()


def test_without_mitsuba_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "MODULES", ("mitsuba", "no_such_denoiser"))
    with refused() as error:
        library.mitsuba("")
    assert "photo" in str(error.value) and "no_such_denoiser" in str(error.value)


def test_materials_say_what_light_does_with_them() -> None:
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (1.0, 1.0, 0.1), material="steel"))
    builder.add_material(Material((0.5, 0.5, 0.5), kind="glass"))
    assert {"metal", "glass", ""} <= set(builder.build().mat_kind)
