"""Textures, patterns and levels of detail: sampled where they belong, no shimmer, and no shape lost."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import LEVEL_ERROR, Cameras, look_at
from mjhab.render.mesh_levels import MIN_FACES, mesh_levels
from mjhab.render.patterns import PERIODS, SHADE_TOP, pattern_tile
from mjhab.render.raster.rasterizer import Rasterizer
from mjhab.render.textures import (
    LEVELS,
    Texels,
    TexturePool,
    blended_byte,
    texels_around,
)
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.shapes.meshes import Mesh, mesh_arrays, mesh_from_arrays
from mjhab.scenes.spec import Geom
from tests.refusals import refused

SIZE = (128, 96)
FOVY = 1.0
QUAD = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], np.float32)
QUAD_FACES = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
QUAD_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
"""A wall of 2 m x 2 m at x = 0, seen from -x; u grows with y, v downwards."""


def checks(count: int, texels: int) -> np.ndarray:
    """Black and white squares, ``count`` each way, of ``texels`` each way."""
    index = np.arange(count * texels) // texels
    return (
        (255 * ((index[:, None] + index) % 2)[..., None])
        .astype(np.uint8)
        .repeat(3, axis=2)
    )


def wall(image: np.ndarray, repeat: float = 1.0) -> Mesh:
    return Mesh(
        QUAD,
        QUAD_FACES,
        None,
        QUAD_UV[QUAD_FACES] * np.float32(repeat),
        np.zeros(2, np.int32),
        (image,),
    )


def draw(mesh: Mesh, eye, target, outputs=("rgb",)) -> dict[str, np.ndarray]:
    builder = SceneBuilder(1)
    builder.add_world_instance(builder.add_mesh("m", mesh), (0.0, 0.0, 0.0), seg="m")
    pos = np.asarray(eye, float)[None, None]
    mat = look_at(eye, target)[None, None]
    home = np.zeros(1, int)
    body = np.zeros((1, 1, 3))
    turn = np.eye(3)[None, None]
    images = Rasterizer(builder.build(), 1).render(
        home, body, turn, Cameras(pos, mat, FOVY, *SIZE), outputs
    )
    return {name: image[0, 0] for name, image in images.items()}


def wall_places(eye, target) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of pixels meet the plane of the wall: y and z (h, w)."""
    focal = 0.5 * SIZE[1] / np.tan(0.5 * FOVY)
    u, v = np.meshgrid(
        (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) / focal,
        -(np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) / focal,
    )
    ray = np.stack([u, v, -np.ones_like(u)], -1) @ look_at(eye, target).T
    place = np.asarray(eye, float) - (eye[0] / ray[..., :1]) * ray
    return place[..., 1], place[..., 2]


@pytest.mark.parametrize("eye", [(-2.5, 0.0, 0.0), (-0.7, -2.2, 0.4), (-1.0, 0.8, -1.6)])
def test_a_picture_lies_where_its_corners_say_also_in_perspective(eye) -> None:
    target = (0.0, 0.1, 0.0)
    rgb = draw(wall(checks(8, 16)), eye, target)["rgb"]
    y, z = wall_places(eye, target)
    # in squares
    p = (y + 1) * 4
    q = (1 - z) * 4
    inside = (p > 0) & (p < 8) & (q > 0) & (q < 8)
    # A texel is 1/16 square; a pixel is largest where the wall is seen at a slant.
    wide = np.maximum(np.abs(np.gradient(p)).max(0), np.abs(np.gradient(q)).max(0))
    edge = np.minimum(np.abs(p - np.round(p)), np.abs(q - np.round(q)))
    clear = inside & (edge > 0.1 + wide) & (wide < 0.3)
    white = (np.floor(p) + np.floor(q)) % 2 == 1
    assert clear.sum() > 250
    assert (rgb[clear & white].min(axis=1) > 90).all() and (
        rgb[clear & ~white].max(axis=1) < 40
    ).all()


def test_fine_detail_from_afar_is_its_mean_light() -> None:
    fine = draw(wall(checks(64, 1), 4.0), (-3.0, 0.2, 0.1), (0.0, 0.0, 0.0))[
        "rgb"
    ].astype(int)
    # sRGB 188 is half of the light of white.
    grey = draw(
        wall(np.full((4, 4, 3), 188, np.uint8)), (-3.0, 0.2, 0.1), (0.0, 0.0, 0.0)
    )["rgb"].astype(int)
    assert np.abs(fine - grey).max() <= 3 and grey[48, 64, 0] > 60


def test_moving_a_little_changes_little() -> None:
    image = np.random.default_rng(0).integers(0, 255, (256, 256, 3)).astype(np.uint8)
    views = [
        draw(wall(image, 2.0), (-3.0, step, 0.0), (0.0, step, 0.0))["rgb"].astype(float)
        for step in (0.0, 0.002)
    ]
    middle = (slice(36, 60), slice(52, 76))
    assert np.abs(views[0][middle] - views[1][middle]).mean() < 4.0


def sampled(texels: Texels, level: int, u: float, v: float) -> list[float]:
    """Bytes of the first texture at (u, v), as the kernels read it: places, texels, then the blend."""
    wide, high = (int(bits) for bits in np.maximum(texels.bits[0] - level, 0))
    x = np.float32(u * 2**wide - 0.5)
    y = np.float32(v * 2**high - 0.5)
    start = np.int32(texels.start[0, level])
    *places, across, down = texels_around(x, y, start, np.int32(wide), np.int32(high))
    near = [np.int32(texels.pixels[place]) for place in places]
    return [blended_byte(*near, across, down, shift) for shift in (0, 8, 16)]


def test_sampling_blends_four_texels_and_repeats() -> None:
    image = np.random.default_rng(1).integers(0, 255, (8, 16, 3)).astype(np.uint8)
    pool = TexturePool()
    assert [pool.add(image), pool.add(image.copy()), pool.add(image[::-1].copy())] == [
        0,
        0,
        1,
    ]
    texels = pool.build()
    for u, v in np.random.default_rng(2).uniform(-2, 3, (50, 2)):
        x = u * 16 - 0.5
        y = v * 8 - 0.5
        i = int(np.floor(x))
        j = int(np.floor(y))
        a = np.floor((x - i) * 16) / 16
        b = np.floor((y - j) * 16) / 16
        near = image[np.ix_([j % 8, (j + 1) % 8], [i % 16, (i + 1) % 16])].astype(float)
        want = np.einsum("r,c,rck->k", [1 - b, b], [1 - a, a], near)
        np.testing.assert_allclose(sampled(texels, 0, u, v), want, atol=0.6)
    # The smallest copy is one texel of the mean light.
    light = np.where(
        image / 255 <= 0.04045,
        image / 255 / 12.92,
        ((image / 255 + 0.055) / 1.055) ** 2.4,
    ).mean((0, 1))
    mean = 255 * (1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(sampled(texels, LEVELS - 1, 0.3, 0.9), mean, atol=2.5)


def test_pictures_of_other_sizes_are_refused() -> None:
    for image in (
        np.zeros((6, 8, 3), np.uint8),
        np.zeros((8, 1024, 3), np.uint8),
        np.zeros((8, 8, 3), np.float32),
    ):
        with refused("texture", expected="powers of two up to 512"):
            TexturePool().add(image)


@pytest.mark.parametrize("kind", PERIODS)
def test_patterns_repeat_without_a_seam_and_keep_their_brightness(kind: str) -> None:
    tile = pattern_tile(kind).astype(float)
    for axis in (0, 1):
        lines = np.moveaxis(tile, axis, 0)
        steps = np.abs(np.roll(lines, -1, axis=0) - lines).mean(axis=(1, 2))
        # The step from the last line to the first is one like others (boards and tiles have joints).
        assert steps[-1] <= 1.2 * steps[:-1].max()
    assert 0.75 < tile[..., 1].mean() / 255 * SHADE_TOP < 1.05
    assert 20 < tile[..., 0].std() < 130 and not tile[..., 2].any()


def test_a_picture_is_tinted_by_the_colour_of_its_faces() -> None:
    image = np.full((4, 4, 3), 255, np.uint8)
    green = Mesh(
        QUAD,
        QUAD_FACES,
        np.tile(np.array([[0.2, 0.9, 0.2]], np.float32), (2, 1)),
        wall(image).uv,
        np.zeros(2, np.int32),
        (image,),
    )
    r, g, b = draw(green, (-2.0, 0.0, 0.0), (0.0, 0.0, 0.0))["rgb"][48, 64].astype(int)
    assert g > 80 and g > 1.8 * r and g > 1.8 * b


def test_a_material_of_the_instance_replaces_the_picture() -> None:
    builder = SceneBuilder(1)
    mesh = builder.add_mesh("m", wall(checks(2, 4)))
    blue = builder.add_material(Material((0.1, 0.1, 0.9)))
    builder.add_world_instance(mesh, (0.0, 0.0, 0.0), material=blue, seg="m")
    builder.add_geom_mesh(Geom("box", (1, 1, 1)))
    scene = builder.build()
    assert scene.instance_material[0, 0] == blue and scene.mat_texture[blue] == -1
    assert sorted(np.unique(scene.mat_texture)) == [-1, 0]


def test_a_mesh_survives_a_file(tmp_path) -> None:
    mesh = wall(checks(2, 4))
    np.savez(tmp_path / "m.npz", allow_pickle=False, **mesh_arrays("a/b", mesh))
    with np.load(tmp_path / "m.npz") as arrays:
        back = mesh_from_arrays("a/b", arrays)
    for part in ("vertices", "faces", "uv", "face_texture"):
        np.testing.assert_array_equal(getattr(back, part), getattr(mesh, part))
    np.testing.assert_array_equal(back.textures[0], mesh.textures[0])
    assert back.face_color is None


def ball(rings: int = 48) -> Mesh:
    """A unit sphere of about 2 rings^2 x 2 triangles; u is the longitude, v the latitude, cut along a meridian."""
    lon, lat = np.meshgrid(
        np.linspace(0, 1, 2 * rings + 1), np.linspace(0.01, 0.99, rings + 1)
    )
    t = 2 * np.pi * lon
    p = np.pi * lat
    points = np.stack(
        [np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], -1
    ).reshape(-1, 3)
    k = (np.arange(rings)[:, None] * (2 * rings + 1) + np.arange(2 * rings)).ravel()
    below = k + 2 * rings + 1
    faces = np.concatenate(
        [np.stack([k, below, k + 1], 1), np.stack([k + 1, below, below + 1], 1)]
    ).astype(np.int32)
    uv = np.stack([lon.ravel(), lat.ravel()], 1)[faces].astype(np.float32)
    image = np.zeros((64, 64, 3), np.uint8)
    return Mesh(
        points.astype(np.float32),
        faces,
        None,
        uv,
        np.zeros(len(faces), np.int32),
        (image,),
    )


def test_levels_get_coarser_and_keep_shape_and_picture(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    mesh = ball()
    levels = mesh_levels(mesh)
    assert len(mesh.faces) >= MIN_FACES and len(levels) >= 3
    counts = [len(level.faces) for level in levels]
    errors = [float(level.error[0]) for level in levels]
    assert counts[0] == len(mesh.faces) and all(
        b < 0.7 * a for a, b in itertools.pairwise(counts)
    )
    assert errors[0] == 0.0 and all(a <= b < 0.5 for a, b in itertools.pairwise(errors))
    for level in levels:
        middle = level.vertices[level.faces].mean(axis=1).astype(float)
        one = np.concatenate([middle, np.ones((len(middle), 1))], axis=1)
        assert np.quantile(np.abs(np.linalg.norm(middle, axis=1) - 1.0), 0.95) < max(
            2.0 * float(level.error[0]), 2e-3
        )
        normal = np.einsum("fnc,fc->fn", level.normal, one)
        out = (
            np.einsum("fn,fn->f", normal, middle)
            / np.linalg.norm(normal, axis=1)
            / np.linalg.norm(middle, axis=1)
        )
        assert np.quantile(out, 0.02) > 0.9
        # The place in the picture is that of the direction, but for poles, where longitudes meet.
        place = np.einsum("fuc,fc->fu", level.uv, one)
        flat = np.abs(middle[:, 2]) < 0.8
        lon = np.arctan2(middle[:, 1], middle[:, 0]) / (2 * np.pi)
        off = np.abs((place[flat, 0] - lon[flat] + 0.5) % 1.0 - 0.5)
        assert np.quantile(off, 0.9) < max(0.2 * float(level.error[0]), 0.003)
    # The second time they come from the disk, unless the file is broken.
    (cached,) = (tmp_path / "meshes").glob("*.npz")
    again = mesh_levels(mesh)
    np.testing.assert_array_equal(again[-1].normal, levels[-1].normal)
    cached.write_bytes(b"broken")
    np.testing.assert_array_equal(mesh_levels(mesh)[-1].uv, levels[-1].uv)


@pytest.mark.parametrize("distance", [2.5, 6.0, 15.0])
def test_a_coarser_mesh_is_drawn_only_where_nobody_sees_it(
    distance: float, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    image = draw(ball(), (-distance, 0.0, 0.0), (0.0, 0.0, 0.0), outputs=("depth", "seg"))
    focal = 0.5 * SIZE[1] / np.tan(0.5 * FOVY)
    u, v = np.meshgrid(
        (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) / focal,
        (np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) / focal,
    )
    square = 1 + u * u + v * v
    root = distance**2 - square * (distance**2 - 1)
    depth = (distance - np.sqrt(np.maximum(root, 0.0))) / square
    face_on = root > 0.25
    pixel = distance / focal
    assert (image["seg"][face_on] == 1).all()
    assert (
        np.quantile(np.abs(image["depth"] - depth)[face_on], 0.95)
        < 1.5 * LEVEL_ERROR * pixel + 1e-3
    )
    assert (
        abs(int((image["seg"] > 0).sum()) - int((root > 0).sum()))
        <= 0.03 * (root > 0).sum() + 4
    )
