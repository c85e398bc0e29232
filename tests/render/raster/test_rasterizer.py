"""The rasterizer against ray casting done by hand, and its promises on homes, threads and clipping."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import typeof

from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import Cameras, look_at
from mjhab.render.gl_probe import GL_BACKENDS, renderer_probe
from mjhab.render.mesh_levels import corner_normals
from mjhab.render.primitives import primitive_mesh
from mjhab.render.raster.rasterizer import Rasterizer
from mjhab.render.raster.scenery import make_scenery
from mjhab.scenes.builtin.materials import Material
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Geom, Light
from tests.refusals import refused

SIZE = (96, 64)
FOVY = 1.2


def draw(builder: SceneBuilder, eye, target, homes=(0,), threads=1, **options):
    """All outputs (H, W[, 3]) of one camera per world, with no bodies but the world."""
    count = len(homes)
    pos = np.broadcast_to(np.asarray(eye, float), (count, 1, 3))
    mat = np.broadcast_to(look_at(eye, target), (count, 1, 3, 3))
    raster = Rasterizer(builder.build(), threads, options.pop("cull", True))
    images = raster.render(
        np.array(homes),
        np.zeros((count, 1, 3)),
        np.tile(np.eye(3), (count, 1, 1, 1)),
        Cameras(pos, mat, FOVY, *SIZE),
        **options,
    )
    raster.close()
    return {name: image[:, 0] for name, image in images.items()}


def rays(eye, target, size=SIZE, fovy=FOVY):
    """World rays (h, w, 3) through pixel centres, scaled so that the ray parameter is planar depth."""
    width, height = size
    focal = 0.5 * height / np.tan(0.5 * fovy)
    u, v = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) / focal,
        -(np.arange(height) + 0.5 - height / 2) / focal,
    )
    return np.stack([u, v, -np.ones_like(u)], -1) @ look_at(eye, target).T


def box_depth(eye, ray, center, half):
    """Ray parameter of the first hit of an axis-aligned box, 0 where none."""
    with np.errstate(divide="ignore"):
        a = (np.asarray(center) - half - eye) / ray
        b = (np.asarray(center) + half - eye) / ray
    near = np.minimum(a, b).max(-1)
    far = np.maximum(a, b).min(-1)
    return np.where((near < far) & (near > 0), near, 0.0)


def mesh_depth(eye, ray, mesh, center):
    """Ray parameter of the first triangle hit of a mesh at ``center`` (Moeller-Trumbore), 0 where none."""
    p = mesh.vertices[mesh.faces].astype(float) + center
    best = np.full(ray.shape[:2], np.inf)
    for a, b, c in p:
        cross = np.cross(ray, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            inv = 1.0 / (cross @ (b - a))
            u = (cross @ (eye - a)) * inv
            side = np.cross(eye - a, b - a)
            v = (ray @ side) * inv
            t = (side @ (c - a)) * inv
        best = np.where(
            (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < best), t, best
        )
    return np.where(np.isfinite(best), best, 0.0)


def sphere_depth(eye, ray, center, radius):
    """Ray parameter of the first hit of a sphere, 0 where none."""
    to = np.asarray(eye) - center
    a = (ray**2).sum(-1)
    b = (ray * to).sum(-1)
    c = (to**2).sum() - radius**2
    disc = b * b - a * c
    return np.where(disc > 0, (-b - np.sqrt(np.maximum(disc, 0))) / a, 0.0)


def test_box_depth_and_seg_are_exact():
    eye = np.array([2.0, -1.5, 1.3])
    center = np.array([0.1, 0.2, 0.3])
    half = np.array([0.4, 0.3, 0.5])
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", tuple(half), tuple(center)), seg="crate")
    image = draw(builder, eye, center)
    want = box_depth(eye, rays(eye, center), center, half)
    assert builder.build().seg_names[1] == "crate"
    np.testing.assert_array_equal(image["seg"][0], (want > 0).astype(np.int32))
    np.testing.assert_allclose(image["depth"][0], want, atol=1e-5)


def test_floor_under_the_camera_is_clipped_at_the_near_plane():
    # The floor reaches far behind the camera: every triangle crosses the near plane.
    eye = np.array([0.0, 0.0, 1.0])
    target = np.array([1.0, 0.3, 0.2])
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (50.0, 50.0, 0.5), (0.0, 0.0, -0.5)), seg="floor")
    image = draw(builder, eye, target)
    ray = rays(eye, target)
    want = np.where(ray[..., 2] < 0, -1.0 / ray[..., 2], 0.0)
    inside = (want > 0) & (np.abs(eye + want[..., None] * ray)[..., :2].max(-1) < 49.0)
    assert inside.mean() > 0.6
    np.testing.assert_allclose(image["depth"][0][inside], want[inside], rtol=2e-5)
    np.testing.assert_array_equal(image["seg"][0][ray[..., 2] > 0], 0)


def test_nothing_behind_or_nearer_than_the_near_plane_is_drawn():
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (0.3, 0.3, 0.3), (-2.0, 0.0, 0.0)), seg="behind")
    builder.add_world_geom(
        Geom("box", (0.004, 1.0, 1.0), (0.004, 0.0, 0.0)), seg="too near"
    )
    image = draw(builder, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), cull=False)
    assert not image["seg"].any() and not image["depth"].any()


def test_sphere_agrees_with_its_triangles_and_with_the_true_sphere():
    eye = np.array([1.5, 0.5, 0.8])
    center = np.array([0.0, 0.0, 0.4])
    ball = Geom("sphere", (0.5, 0.0, 0.0), tuple(center))
    builder = SceneBuilder(1)
    builder.add_world_geom(ball, seg="ball")
    image = draw(builder, eye, center)
    ray = rays(eye, center)
    want = mesh_depth(eye, ray, primitive_mesh(ball), center)
    true = sphere_depth(eye, ray, center, 0.5)
    np.testing.assert_array_equal(image["seg"][0], want > 0)
    np.testing.assert_allclose(image["depth"][0], want, atol=1e-4)
    both = (want > 0) & (true > 0)
    assert ((want > 0) != (true > 0)).mean() < 0.02
    assert (
        np.median(np.abs(image["depth"][0] - true)[both]) < 0.01
    )  # a sphere of 24 sides is 9 mm too thin


def test_any_mesh_pose_agrees_with_its_triangles():
    rng = np.random.default_rng(3)
    eye = np.zeros(3)
    for _ in range(8):
        # Big random triangles all around the camera: many cross the near plane or the sides of the image.
        vertices = rng.uniform(-3, 3, (24, 3)).astype(np.float32)
        mesh = Mesh(vertices, np.arange(24, dtype=np.int32).reshape(-1, 3))
        builder = SceneBuilder(1)
        builder.add_world_instance(builder.add_mesh("m", mesh), (0.0, 0.0, 0.0), seg="m")
        target = rng.normal(size=3)
        image = draw(builder, eye, target, cull=False, outputs=("depth", "seg"))
        want = mesh_depth(eye, rays(eye, target), mesh, 0.0)
        want[want < 0.01] = 0.0
        assert ((want > 0) == (image["seg"][0] > 0)).mean() > 0.999
        both = (want > 0) & (image["seg"][0] > 0)
        assert (
            np.median(np.abs(image["depth"][0] / np.maximum(want, 1e-9) - 1)[both]) < 1e-5
        )
        assert (np.abs(image["depth"][0] - want)[both] < 1e-3).mean() > 0.995


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_nearer_things_hide_farther_ones_in_any_order(order):
    shapes = [
        Geom("box", (0.1, 2.0, 2.0), (1.0, 0.0, 0.0)),
        Geom("sphere", (0.5, 0.0, 0.0), (3.0, 0.0, 0.0)),
    ]
    builder = SceneBuilder(1)
    for k in order:
        builder.add_world_geom(shapes[k], seg=("wall", "ball")[k])
    image = draw(builder, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert (image["seg"] == builder.segment("wall")).all()
    np.testing.assert_allclose(image["depth"], 0.9, atol=1e-5)


def test_instances_move_resize_and_vanish_per_home():
    builder = SceneBuilder(3)
    unit = builder.add_mesh("box", primitive_mesh(Geom("box", (1.0, 1.0, 1.0))))
    red = builder.add_material(Material((1.0, 0.0, 0.0)))
    blue = builder.add_material(Material((0.0, 0.0, 1.0)))
    pos = [[2.0, 0, 0], [3.0, 0, 0], [2.0, 0, 0]]
    scale = [[0.5] * 3, [0.5, 9.0, 9.0], [0.0] * 3]
    builder.add_world_instance(
        unit, pos, scale=scale, material=[red, blue, red], seg="thing"
    )
    image = draw(builder, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), homes=(1, 2, 0, 1))
    middle = image["depth"][:, SIZE[1] // 2, SIZE[0] // 2]
    np.testing.assert_allclose(middle, [2.5, 0.0, 1.5, 2.5], atol=1e-5)
    assert image["seg"][0].all() and not image["seg"][1].any()
    rgb = image["rgb"][:, SIZE[1] // 2, SIZE[0] // 2].astype(int)
    assert rgb[2, 0] > 80 > rgb[2, 2] and rgb[0, 2] > 80 > rgb[0, 0]
    np.testing.assert_array_equal(image["rgb"][0], image["rgb"][3])


def test_kernels_are_compiled_for_one_kind_of_scenery():
    """A pack of one home would cost many seconds of compiling."""
    kinds = set()
    for homes in (1, 2):
        builder = SceneBuilder(homes)
        builder.add_world_geom(Geom("box", (0.2, 0.2, 0.2), (0.0, 0.0, 0.0)), seg="box")
        kinds.add(typeof(make_scenery(builder.build())))
    assert len(kinds) == 1


def test_parked_pieces_are_not_drawn():
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (9.0, 9.0, 0.1), (0.0, 0.0, -50.0)), seg="parked")
    assert not draw(builder, (0.0, 0.0, 5.0), (0.0, 0.0, 0.0))["seg"].any()


def test_body_instances_follow_their_body():
    builder = SceneBuilder(1)
    builder.add_body_geom(Geom("box", (0.1, 0.2, 0.3), (0.5, 0.0, 0.0)), 2, "link")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    body_pos = np.zeros((1, 3, 3))
    body_mat = np.tile(np.eye(3), (1, 3, 1, 1))
    body_pos[0, 2] = (1.0, 2.0, 0.5)
    body_mat[0, 2] = turn
    eye = np.array([-1.0, 1.0, 1.0])
    target = np.array([1.0, 2.5, 0.5])
    image = Rasterizer(builder.build(), 1).render(
        np.zeros(1, int),
        body_pos,
        body_mat,
        Cameras(eye[None, None], look_at(eye, target)[None, None], FOVY, *SIZE),
    )
    # The body is turned by 90 deg: the box's centre is at (1, 2.5, 0.5) and its x and y half-extents swap.
    want = box_depth(eye, rays(eye, target), target, np.array([0.2, 0.1, 0.3]))
    np.testing.assert_allclose(image["depth"][0, 0], want, atol=1e-5)


def crowded() -> SceneBuilder:
    """Two homes with a floor, walls, many balls and boxes of every pattern, and lamps."""
    builder = SceneBuilder(2)
    rng = np.random.default_rng(0)
    builder.add_world_geom(
        Geom("box", (4.0, 4.0, 0.1), (0.0, 0.0, -0.1), material="floor_oak"), seg="floor"
    )
    builder.add_world_geom(
        Geom("box", (0.1, 4.0, 1.2), (-2.0, 0.0, 1.2), material="curtain"), seg="wall"
    )
    for k in range(40):
        geom = (
            Geom("sphere", (0.2, 0, 0), material="oak"),
            Geom("box", (0.2, 0.1, 0.3), material="floor_tile"),
            Geom("cylinder", (0.1, 0.2, 0), material="floor_carpet"),
            Geom("capsule", (0.1, 0.1, 0), material="steel"),
        )[k % 4]
        where = rng.uniform((-1.5, -1.5, 0.0), (1.5, 1.5, 2.0), (2, 3))
        builder.add_world_geom(geom, where, seg="x")
    for home in range(2):
        builder.add_light(home, Light((0.5, 0.2, 2.8)))
    return builder


@pytest.mark.parametrize("quality", ["fast", "nice"])
def test_images_do_not_depend_on_threads(quality):
    runs = [
        draw(
            crowded(),
            (3.0, 2.0, 2.0),
            (0.0, 0.0, 0.8),
            homes=(0, 1, 1, 0, 1),
            threads=n,
            quality=quality,
        )
        for n in (1, 2, 4)
    ]
    for run in runs[1:]:
        for name, image in run.items():
            np.testing.assert_array_equal(image, runs[0][name])
    assert runs[0]["rgb"].std() > 10 and len(np.unique(runs[0]["seg"])) == 4


def test_cameras_of_few_worlds_are_shared_among_threads():
    scene = crowded().build()
    count = 5
    eyes = np.array([[3.0, 0.5 * k, 1.0 + 0.2 * k] for k in range(count)])
    mats = np.stack([look_at(eye, (0.0, 0.0, 0.8)) for eye in eyes])
    images = []
    for threads in (1, 4):
        raster = Rasterizer(scene, threads)
        images.append(
            raster.render(
                np.array([1, 0]),
                np.zeros((2, 1, 3)),
                np.tile(np.eye(3), (2, 1, 1, 1)),
                Cameras(np.stack([eyes] * 2), np.stack([mats] * 2), FOVY, *SIZE),
            )
        )
        raster.close()
    for name, image in images[0].items():
        np.testing.assert_array_equal(images[1][name], image)
    rgb = images[0]["rgb"].reshape(2 * count, -1)
    assert len(np.unique(rgb, axis=0)) == 2 * count


def checked(side: int, cull: bool) -> dict[str, np.ndarray]:
    """Outputs (H, W[, 3]) for a floor of 4 m x 4 m, red and blue, of 2 x side x side triangles, all of them drawn."""
    number = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    corners = (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    a, b, c, d = (part.ravel() for part in corners)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    y, x = np.mgrid[-2 : 2 : (side + 1) * 1j, -2 : 2 : (side + 1) * 1j]
    vertices = np.stack([x, y, 0.0 * x], -1).reshape(-1, 3).astype(np.float32)
    red = vertices[faces, 0].mean(1) < 0.0
    color = np.where(red[:, None], (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)).astype(np.float32)
    builder = SceneBuilder(1)
    meshes = {"m": Mesh(vertices, faces.astype(np.int32), color)}
    number = builder.add_geom_mesh(Geom("mesh", (1, 1, 1), mesh="m"), meshes)[0]
    builder.add_world_instance(number, (0.0, 0.0, 0.0), seg="floor")
    builder.add_light(0, Light((0.0, 0.0, 2.0)))
    eye = np.array([0.3, -1.0, 1.5])
    raster = Rasterizer(builder.build(), 1, cull)
    images = raster.render(
        np.zeros(1, int),
        np.zeros((1, 1, 3)),
        np.eye(3)[None, None],
        Cameras(
            eye[None, None],
            look_at(eye, (0.1, 0.2, 0.0))[None, None],
            FOVY,
            *SIZE,
            level_error=-1.0,
        ),
    )
    return {name: image[0, 0] for name, image in images.items()}


def test_faces_smaller_than_pixels_look_like_large_ones():
    """Most faces cover no pixel, and more are seen than the table of faces holds."""
    fine = checked(200, True)
    for name, image in checked(200, False).items():
        np.testing.assert_array_equal(fine[name], image)
    large = checked(2, True)
    assert (large["seg"] > 0).mean() > 0.5 and len(large["rgb"].reshape(-1, 3)) > 6000
    assert (fine["seg"] == large["seg"]).mean() > 0.999
    np.testing.assert_allclose(fine["depth"], large["depth"], rtol=1e-4, atol=0)
    off = np.abs(fine["rgb"].astype(int) - large["rgb"]).max(-1)
    # Light on a large face is interpolated between the pixels at which it is computed.
    assert (off <= 2).mean() > 0.95 and np.median(off) <= 1
    red, _, blue = large["rgb"][SIZE[1] // 2].astype(int).T
    assert (red > 2 * blue).any() and (blue > 2 * red).any()


def test_lamps_cast_shadows_only_in_nice_pictures():
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (3.0, 3.0, 0.1), (0.0, 0.0, -0.1)), seg="floor")
    builder.add_world_geom(Geom("box", (0.4, 0.4, 0.02), (0.0, 0.0, 1.2)), seg="plate")
    builder.add_light(0, Light((0.0, 0.0, 2.4)))
    fast, nice = (
        draw(builder, (1.8, 0.0, 0.9), (0.0, 0.0, 0.2), quality=q)["rgb"][0].astype(int)
        for q in ("fast", "nice")
    )
    below = (
        slice(42, 46),
        slice(44, 52),
    )  # on the floor, in front of the middle of the plate's shadow
    assert nice[below].mean() < 0.8 * fast[below].mean()
    np.testing.assert_allclose(nice[60, 4], fast[60, 4], atol=12)


def test_ssaa_smooths_rgb_and_leaves_depth_and_seg_alone():
    plain, smooth = (
        draw(crowded(), (3.0, 2.0, 2.0), (0.0, 0.0, 0.8), ssaa=n) for n in (1, 2)
    )
    np.testing.assert_array_equal(plain["depth"], smooth["depth"])
    np.testing.assert_array_equal(plain["seg"], smooth["seg"])
    assert (plain["rgb"] != smooth["rgb"]).any()
    assert abs(plain["rgb"].mean() - smooth["rgb"].mean()) < 3.0


def test_shared_edges_leave_no_holes():
    # Pixel centres fall exactly on the diagonals and on seams between tiles of a wall seen head-on.
    builder = SceneBuilder(1)
    for y in range(-4, 4):
        for z in range(-4, 4):
            builder.add_world_geom(
                Geom("box", (0.1, 0.25, 0.25), (1.1, 0.5 * y, 0.5 * z)), seg="tile"
            )
    assert draw(builder, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))["seg"].all()


def test_boxes_drawn_by_their_sides_look_like_their_triangles():
    # With faces seen from behind drawn too, boxes go through the triangles of their meshes.
    sides, triangles = (
        draw(
            crowded(),
            (3.0, 2.0, 2.0),
            (0.0, 0.0, 0.8),
            cull=cull,
            outputs=("depth", "seg"),
        )
        for cull in (True, False)
    )
    assert (sides["seg"] == triangles["seg"]).mean() > 0.999
    off = np.abs(sides["depth"] - triangles["depth"])
    assert np.quantile(off, 0.999) < 1e-5


def test_mirrored_and_culled_faces():
    builder = SceneBuilder(1)
    mesh = builder.add_mesh("box", primitive_mesh(Geom("box", (1.0, 1.0, 1.0))))
    builder.add_world_instance(
        mesh, (2.0, 0.0, 0.0), scale=(-0.5, 0.5, 0.5), seg="mirrored"
    )
    assert draw(builder, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))[
        "depth"
    ].max() == pytest.approx(1.5, abs=1e-5)
    inside = [
        draw(builder, (2.0, 0.0, 0.0), (3.0, 0.0, 0.0), cull=cull)["seg"].any()
        for cull in (True, False)
    ]
    assert inside == [False, True]


def test_primitives_face_outwards_and_fill_their_size():
    geoms = (
        Geom("box", (0.3, 0.2, 0.1)),
        Geom("cylinder", (0.2, 0.4, 0)),
        Geom("capsule", (0.1, 0.3, 0)),
        Geom("sphere", (0.2, 0, 0)),
    )
    for geom in geoms:
        mesh = primitive_mesh(geom)
        p = mesh.vertices[mesh.faces].astype(float)
        volume = np.einsum("fi,fi->f", p[:, 0], np.cross(p[:, 1], p[:, 2])).sum() / 6
        a, b, c = geom.size
        exact = {
            "box": 8 * a * b * c,
            "cylinder": 2 * np.pi * a * a * b,
            "capsule": np.pi * a * a * (2 * b + 4 / 3 * a),
            "sphere": 4 / 3 * np.pi * a**3,
        }[geom.shape]
        assert 0.93 * exact < volume <= 1.000001 * exact


def test_normals_are_flat_on_boxes_and_smooth_on_spheres():
    box = primitive_mesh(Geom("box", (1, 2, 3)))
    ball = primitive_mesh(Geom("sphere", (2.0, 0, 0)))
    flat = corner_normals(box.vertices, box.faces)
    assert (flat == flat[:, :1]).all() and np.allclose(np.abs(flat).max(-1), 1.0)
    soup = Mesh(
        ball.vertices[ball.faces].reshape(-1, 3),
        np.arange(ball.faces.size, dtype=np.int32).reshape(-1, 3),
    )
    smooth = corner_normals(soup.vertices, soup.faces)
    np.testing.assert_allclose(smooth.reshape(-1, 3), soup.vertices / 2.0, atol=0.02)


def test_mesh_colors_become_materials():
    builder = SceneBuilder(1)
    box = primitive_mesh(Geom("box", (1.0, 1.0, 1.0)))
    color = np.tile(np.array([[0.0, 0.8, 0.0]], np.float32), (12, 1))
    assert (
        builder.add_geom_mesh(
            Geom("mesh", (1, 1, 1), mesh="m"), {"m": Mesh(box.vertices, box.faces, color)}
        )[0]
        == 0
    )
    builder.add_world_instance(0, (3.0, 0.0, 0.0), seg="green")
    r, g, b = draw(builder, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))["rgb"][
        0, SIZE[1] // 2, SIZE[0] // 2
    ].astype(int)
    assert g > 80 and g > 3 * r and g > 3 * b


def test_a_world_looks_the_same_in_any_batch_and_with_any_outputs():
    # Threads take worlds in portions: what a thread drew before must not show.
    eye = (3.0, 2.0, 2.0)
    target = (0.0, 0.0, 0.8)
    many = draw(crowded(), eye, target, homes=(0, 1) * 9, threads=2)
    for home in (0, 1):
        alone = draw(crowded(), eye, target, homes=(home,), outputs=("rgb",))["rgb"][0]
        for world in range(home, 18, 2):
            np.testing.assert_array_equal(many["rgb"][world], alone)


def test_corners_are_darker_than_open_floor():
    builder = SceneBuilder(1)
    builder.add_world_geom(Geom("box", (3.0, 3.0, 0.1), (0.0, 0.0, -0.1)), seg="floor")
    bare = draw(builder, (0.0, -1.0, 0.8), (0.0, 0.0, 0.0))["rgb"][0].astype(int)
    builder.add_world_geom(Geom("box", (0.2, 0.2, 0.3), (0.0, 0.3, 0.3)), seg="crate")
    image = draw(builder, (0.0, -1.0, 0.8), (0.0, 0.0, 0.0))
    floor = image["seg"][0] == builder.segment("floor")
    darker = bare[floor].mean(axis=1) - image["rgb"][0][floor].astype(int).mean(axis=1)
    assert (darker > 12).sum() > 30, "at the foot of the crate"
    assert np.median(darker) < 2, "and nowhere else"


def test_bad_input_is_named():
    raster = Rasterizer(crowded().build(), 1)
    eye = np.zeros((1, 1, 3))
    mat = np.eye(3)[None, None]
    home = np.zeros(1, int)
    cameras = Cameras(eye, mat, 1.0, 8, 8)
    with refused("output", "dept", expected="depth"):
        raster.render(home, eye, mat, cameras, outputs=("dept",))
    with refused("home"):
        raster.render(np.array([2]), eye, mat, cameras)
    with refused("cam_pos"):
        raster.render(home, eye, mat, replace(cameras, pos=np.zeros((1, 3))))
    for option, bad in (
        ("cam_pos", {"pos": eye + np.nan}),
        ("cam_mat", {"mat": mat + np.inf}),
    ):
        with refused(option, expected="finite"):
            raster.render(home, eye, mat, replace(cameras, **bad))
    with refused("material", "flor_oak", expected="floor_oak"):
        SceneBuilder(1).material("flor_oak")
    with refused(said="nothing was added"):
        SceneBuilder(1).build()
    with refused(said="same point"):
        look_at((1, 2, 3), (1, 2, 3))


def test_probe_names_every_renderer():
    probe = renderer_probe()
    assert set(probe) == {"rasterizer", *GL_BACKENDS} and probe["rasterizer"]
