"""The real ReplicaCAD data set: 84 homes in one layout, its frames checked against its own navigation meshes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import home_shapes
from mjhab.layout.check import layout_hash
from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import placed_receptacles
from mjhab.robots.fetch.model import BASE_HEIGHT
from mjhab.scenes.formats.gltf import read_glb, read_hulls
from mjhab.scenes.formats.urdf import read_urdf
from mjhab.scenes.freespace import free_map, reach
from mjhab.scenes.pack_source import PackRequest
from mjhab.scenes.packs import open_pack
from mjhab.scenes.replica_cad.navmesh import read_navmesh
from mjhab.scenes.replica_cad.stage import stage_shape
from mjhab.scenes.shapes.footprints import all_geoms, outline
from mjhab.scenes.shapes.hulls import vertical_extent
from mjhab.scenes.spec import Pack
from tests.real_data import real_data

EVERYTHING = ("kitchen_cupboards", "cabinet", "chest_of_drawers")
EVERY_MACRO = (
    "v3_sc0_staging_00",
    "v3_sc1_staging_01",
    "v3_sc2_staging_10",
    "v3_sc3_staging_20",
)


@pytest.fixture(scope="module")
def folder() -> Path:
    return real_data("replica_cad")


@pytest.fixture(scope="module")
def pack(folder: Path) -> Pack:
    return open_pack(str(folder))


@pytest.fixture(scope="module")
def opening(folder: Path) -> Pack:
    """A home of every macro layout whose cupboards, cabinet and chest of drawers open."""
    return open_pack(PackRequest(str(folder), EVERYTHING, scenes=EVERY_MACRO))


@pytest.fixture(scope="module")
def layout(pack: Pack) -> Layout:
    return Layout(pack, ())


def test_all_84_scenes_are_homes_of_one_layout(pack: Pack, layout: Layout) -> None:
    assert Counter((h.split, h.macro) for h in pack.homes) == {
        ("train", 0): 21,
        ("train", 1): 21,
        ("train", 2): 21,
        ("val", 3): 21,
    }
    models = [compile_home(layout, home) for home in pack.homes]
    first = models[0]
    for model in models[1:]:
        for size in ("ngeom", "nbody", "nv", "nmesh", "nmeshvert", "nsensor", "nu"):
            assert getattr(model, size) == getattr(first, size)
        for field in (
            "geom_type",
            "geom_dataid",
            "geom_bodyid",
            "geom_contype",
            "jnt_type",
            "body_parentid",
        ):
            assert (getattr(model, field) == getattr(first, field)).all()
    # 15 joints of the robot, 7 drawers, 2 doors.
    assert first.nv == 24 and first.ngeom < 640
    copies = Counter(slot.template for slot in layout.prop_slots)
    assert copies.pop("chair_01") == copies.pop("beanbag") == 2 and set(
        copies.values()
    ) == {1}


def test_every_hull_of_the_data_set_is_read(folder: Path) -> None:
    hulls = [
        hull
        for file in sorted((folder / "objects" / "convex").glob("*.glb"))
        for hull in read_hulls(file)
    ]
    assert len(hulls) == 1128 and sum(map(len, hulls)) == 19372


def test_every_urdf_of_the_data_set_is_read(folder: Path) -> None:
    found = {p.stem: read_urdf(p) for p in sorted(folder.glob("urdf/*/*.urdf"))}
    assert len(found) == 12
    counter = found["kitchen_counter"]
    assert np.allclose(counter.links["body"].boxes[-1].half, [0.3085, 0.0725, 0.447])
    assert (
        counter.joints["drawer3"].limits == (0.0, 0.5)
        and counter.links["drawer3"].mass == 4
    )


def _walkable(folder: Path, name: str, xy: np.ndarray) -> np.ndarray:
    """Which points (N, 2) are on the floor of the navigation mesh of a scene."""
    found = np.zeros(len(xy), bool)
    for corners in read_navmesh(folder / "navmeshes" / f"{name}.navmesh").polygons:
        # Recast also walks on low furniture.
        if corners[:, 2].max() < 0.25:
            edge = np.roll(corners, -1, axis=0)[:, :2] - corners[:, :2]
            off = xy[:, None] - corners[:, :2]
            found |= (edge[:, 0] * off[..., 1] - edge[:, 1] * off[..., 0] >= 0).all(
                axis=1
            )
    return found


@pytest.mark.parametrize("name", EVERY_MACRO)
def test_ways_are_as_long_as_on_the_data_sets_walkable_areas(
    name: str, folder: Path, pack: Pack
) -> None:
    free = free_map(next(h for h in pack.homes if h.name == name), pack)
    walkable = _walkable(
        folder, name, free.to_xy(np.argwhere(np.ones_like(free.blocked)))
    ).reshape(free.blocked.shape)
    theirs = replace(free, blocked=~walkable, clearance=np.where(walkable, 1.0, 0.0))
    both = np.argwhere(theirs.navigable() & free.navigable())
    rng = np.random.default_rng(1)
    points = free.to_xy(both[rng.choice(len(both), (40, 2))])
    ours, told = (np.array([m.distance(a, b) for a, b in points]) for m in (free, theirs))
    assert told.max() > 5.0
    # Both keep 0.3 m from everything. The areas were made with the walls of the stage, which may be missing here: then
    # some of our ways are shorter, and none is longer.
    assert np.median(np.abs(ours - told)) < 0.05
    assert (ours < 1.03 * told + 0.15).all()
    assert (np.abs(ours - told) < 0.3 + 0.05 * told).mean() > 0.7


@pytest.mark.parametrize("name", EVERY_MACRO)
def test_the_data_sets_walkable_areas_are_free(name: str, folder: Path) -> None:
    """Of furniture; `test_stand_in` looks at walls."""
    pack = open_pack(PackRequest(str(folder), stage="none", scenes=EVERY_MACRO))
    home = pack.homes_by_name[name]
    free = free_map(home, pack)
    cells = np.argwhere(np.ones_like(free.blocked))
    walkable = _walkable(folder, name, free.to_xy(cells))
    clear = free.clearance[tuple(cells[walkable].T)]
    assert walkable.sum() * free.cell**2 > 25.0
    # Its agent has a radius of 0.3 m; its cells are 5 cm wide.
    assert (clear >= 0.2).mean() > 0.999 and (clear >= 0.28).mean() > 0.97


def test_scale_origins_and_fronts(pack: Pack) -> None:
    counter = pack.articulations["kitchen_counter"]
    fridge = pack.articulations["fridge"]
    links = {link.name: link for link in (*counter.links, *fridge.links)}
    drawer = links["drawer3"]
    # uniform_scale 0.98: lengths and travel by s, mass by s^3.
    assert drawer.pos == pytest.approx((-0.167635 * 0.98, 1.0264 * 0.98, 0.53 * 0.98))
    assert drawer.range == pytest.approx((0.0, 0.49)) and drawer.mass == pytest.approx(
        4 * 0.98**3
    )
    assert drawer.axis == pytest.approx((1, 0, 0))
    assert links["top_door"].axis[2] == pytest.approx(-1, abs=1e-4) and links[
        "top_door"
    ].range == (
        0.0,
        2.3,
    )
    at = next(p for p in pack.homes[0].articulations if p.template == "kitchen_counter")
    worktop = next(r for r in counter.receptacles if r.name == "counter_left")
    assert at.pos[2] + worktop.pos[2] == pytest.approx(0.859, abs=0.002)


def test_receptacles_of_the_tasks_carry_what_stands_on_them(
    pack: Pack, layout: Layout
) -> None:
    home = pack.homes[22]
    found = {r.id: r for r in placed_receptacles(layout, home)}
    wanted = {
        "table_01_0/tbl1_top1",
        "table_02_0/tbl2_top1",
        "chair_01_0/chr1_top1",
        "chair_01_1/chr1_top1",
        "sofa_0/sofa",
        "tvstand_0/tvstnd1_top1",
        "kitchen_counter/counter_left",
        "kitchen_counter/counter_right",
        "kitchen_counter/sink",
        "fridge/middle_top",
        "kitchen_counter/drawer_right_top",
    }
    assert wanted <= set(found)
    assert found["kitchen_counter/drawer_right_top"].link == "kitchen_counter/drawer3"
    for name in wanted:
        r = found[name]
        placed = {p.template: p for p in (*home.props, *home.articulations)}
        if r.template == "chair_01":
            placed["chair_01"] = [p for p in home.props if p.template == "chair_01"][
                int(name[9])
            ]
        at = placed[r.template]
        template = pack.props.get(r.template) or pack.articulations[r.template]
        turn = mat_from_quat(np.array(at.rotation)).T
        pieces = [
            outline(g, pack.meshes) @ turn + at.pos
            for g in all_geoms(template)
            if g.collide
        ]
        u, v = np.meshgrid(
            np.linspace(-0.97, 0.97, 9) * r.half[0],
            np.linspace(-0.97, 0.97, 9) * r.half[1],
        )
        points = np.array(
            [r.point(a, b) for a, b in zip(u.ravel(), v.ravel(), strict=True)]
        )
        low, high = (
            np.array(x)
            for x in zip(
                *(vertical_extent(p, points[:, :2]) for p in pieces), strict=True
            )
        )
        below = np.where(high < r.pos[2] + 0.05, high, -np.inf).max(axis=0)
        above = np.where(high >= r.pos[2] + 0.05, low, np.inf).min(axis=0)
        assert np.abs(below - r.pos[2]).max() < 0.012, name
        assert (above - r.pos[2]).min() > r.height - 0.012 and r.height > 0.13, name


@pytest.mark.parametrize(
    "link_id",
    [
        "kitchen_counter/drawer1_top",
        "kitchen_counter/drawer2_middle",
        "kitchen_counter/drawer3",
        "kitchen_counter/drawer4",
        "fridge/top_door",
        "fridge/bottom_door",
    ],
)
def test_handles_stand_free_and_are_narrower_than_the_gripper(
    link_id: str, pack: Pack, layout: Layout
) -> None:
    link = home_shapes(layout, pack.homes[0].name).links[link_id]
    pos, bar, out = link.handle_pose(0.0)
    across = np.cross(bar, out)
    boxes = link.boxes(0.0)

    def inside(point: np.ndarray) -> bool:
        return bool(
            (
                np.abs(np.einsum("kij,ki->kj", boxes.rot, point - boxes.center))
                <= boxes.half
            )
            .all(axis=1)
            .any()
        )

    assert link.handle.thickness < 0.09 and out @ [1, 0, 0] > 0.999
    deep = pos - 0.02 * out
    # The bar is between the fingers, and a finger of 14 mm fits beside it down to the fingertips, 31 mm ahead.
    assert all(
        inside(deep + s * 0.45 * link.handle.thickness * across) for s in (-1.0, 1.0)
    )
    for side in (-1.0, 1.0):
        for depth in np.linspace(0.0, 0.03, 7):
            for off in (0.002, 0.016):
                assert not inside(
                    pos - depth * out + side * (link.handle.thickness / 2 + off) * across
                )
    ends = [deep + s * 0.9 * link.handle.half_length * bar for s in (-1.0, 1.0)]
    assert all(inside(e) for e in ends)


@pytest.mark.parametrize(
    ("target", "point", "off"),
    [
        ("kitchen_counter/drawer3", (0.26, 0.0, 0.0), 0.04),
        ("fridge/top_door", (0.09, -0.66, 0.2), 0.03),
    ],
)
def test_published_handle_points_are_those_of_the_frames_of_the_urdf(
    target: str,
    point: tuple[float, float, float],
    off: float,
    folder: Path,
    pack: Pack,
    layout: Layout,
) -> None:
    """The point lies on the link of the URDF, whose frame has +y up: unscaled, near our own point."""
    handle = next(ref.link.handle for ref in layout.links if ref.id == target)
    assert handle.published is not None
    own = np.array(handle.pos)
    published = np.array(handle.published)
    assert np.linalg.norm(published) == pytest.approx(np.linalg.norm(point))
    assert np.linalg.norm(published - own) == pytest.approx(off, abs=0.005)
    assert (
        handle.point("published") == handle.published
        and handle.point("ours") == handle.pos
    )


def test_parts_without_a_published_handle_point_keep_ours(layout: Layout) -> None:
    having = {ref.id for ref in layout.links if ref.link.handle.published}
    assert having == {ref.id for ref in layout.links} - {"fridge/bottom_door"}
    lower = next(
        ref.link.handle for ref in layout.links if ref.id == "fridge/bottom_door"
    )
    assert lower.point("published") == lower.pos


@pytest.mark.parametrize(
    ("subtask", "target"),
    [("open", "kitchen_counter/drawer3"), ("close", "fridge/top_door")],
)
def test_observation_and_reward_take_the_handle_points_asked_for(
    subtask: str, target: str, folder: Path
) -> None:
    """The point is carried along by the link; what the expert grasps does not change."""
    options: dict[str, Any] = {
        "task": "set_table",
        "subtask": subtask,
        "target": target,
        "assets": str(folder),
        "home": "v3_sc1_staging_01",
        "reward_mode": "dense",
        "autoreset": "disabled",
        "threads": 1,
    }
    seen = {}
    for points in ("ours", "published"):
        env = envs.make(**options, handle_points=points)
        env.reset(seed=0)
        obs, _, _, _, info = env.step(np.zeros((1, 13), np.float32))
        goal = obs["extra/goal_pos_wrt_base"][0].astype(float)
        x, y, yaw = env.state.robot_q[0, :3]
        c = np.cos(yaw)
        s = np.sin(yaw)
        at = np.array(
            [
                x + c * goal[0] - s * goal[1],
                y + s * goal[0] + c * goal[1],
                goal[2] + BASE_HEIGHT,
            ]
        )
        index = env.layout.link_ids.index(target)
        body = env.sim.addresses.link_body[index]
        handle = env.layout.links[index].link.handle
        wanted = env.state.body_pos[0, body] + env.state.body_mat[0, body] @ np.array(
            handle.point(points)
        )
        np.testing.assert_allclose(at, wanted, atol=1e-5)
        seen[points] = (
            info["reward_terms"]["reach"][0],
            env.view(0).home.links[target].handle_pose(0.0)[0],
        )
        env.close()
    assert abs(seen["ours"][0] - seen["published"][0]) > 1e-3
    np.testing.assert_array_equal(seen["ours"][1], seen["published"][1])


def test_the_front_of_a_drawer_agrees_with_its_render_mesh(
    folder: Path, pack: Pack
) -> None:
    """Seen along the front's normal, collision shape and render mesh are equally deep."""
    part = read_glb(folder / "urdf" / "kitchen_counter" / "drawer3.glb", textures=False)[
        0
    ]
    link = next(
        k for k in pack.articulations["kitchen_counter"].links if k.name == "drawer3"
    )
    mesh = (
        np.stack([part.vertices[:, 0], -part.vertices[:, 2], part.vertices[:, 1]], axis=1)
        * 0.98
    )
    rng = np.random.default_rng(0)
    shapes = [outline(g) for g in link.geoms if g.collide]
    # Look from the front: x becomes height.
    turn = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], float)
    yz = rng.uniform([-0.40, -0.09], [0.40, 0.09], (300, 2))
    solid = np.max([vertical_extent(s @ turn.T, yz)[1] for s in shapes], axis=0)
    seen = np.full(len(yz), -np.inf)
    for a, b, c in (mesh[f] @ turn.T for f in part.faces):
        basis = np.stack([b[:2] - a[:2], c[:2] - a[:2]], axis=1)
        if abs(np.linalg.det(basis)) < 1e-9:
            continue
        st = np.linalg.solve(basis, (yz - a[:2]).T)
        hit = (st >= 0).all(axis=0) & (st.sum(axis=0) <= 1)
        seen = np.where(
            hit, np.maximum(seen, a[2] + st[0] * (b - a)[2] + st[1] * (c - a)[2]), seen
        )
    gap = np.abs(solid - seen)
    # The walls of the recess slope in the mesh; there the two differ.
    assert (gap < 0.005).mean() > 0.95


def test_doors_and_drawers_move_through_their_whole_range(
    pack: Pack, layout: Layout
) -> None:
    model = compile_home(layout, pack.homes[0])
    data = mujoco.MjData(model)
    data.qpos[:2] = 30.0
    ids = [model.joint(name).id for name in layout.link_ids]
    dofs = model.jnt_dofadr[ids]
    low_high = model.jnt_range[ids]
    assert (model.jnt_range[ids][:, 0] == 0).all()
    for end, force in ((1, 20.0), (0, -20.0)):
        for _ in range(400):
            data.qfrc_applied[dofs] = force
            mujoco.mj_step(model, data)
        assert np.abs(data.qpos[model.jnt_qposadr[ids]] - low_high[:, end]).max() < 0.02
    bodies = [model.body(name).id for name in layout.link_ids]
    assert model.body_mass[bodies] == pytest.approx(
        [ref.link.mass for ref in layout.links]
    )


def test_cupboards_cabinet_and_chest_open_when_asked_for(
    opening: Pack, pack: Pack, layout: Layout
) -> None:
    more = Layout(opening, ())
    closed = compile_home(layout, pack.homes[0])
    model = compile_home(more, opening.homes[0])
    others = {layout_hash(compile_home(more, home)) for home in opening.homes[1:]}
    assert others == {layout_hash(model)} != {layout_hash(closed)}
    # Eight cupboard doors, two sliding doors, six drawers; the same collision shapes.
    assert model.nv == closed.nv + 16 and model.ngeom == closed.ngeom
    assert set(layout.link_ids) < set(more.link_ids)
    data = mujoco.MjData(model)
    data.qpos[:2] = 30.0
    ids = [model.joint(name).id for name in more.link_ids]
    dofs = model.jnt_dofadr[ids]
    address = model.jnt_qposadr[ids]
    assert (model.jnt_range[ids][:, 0] == 0).all()
    for end, force in ((1, 20.0), (0, -20.0)):
        for _ in range(400):
            data.qfrc_applied[dofs] = force
            mujoco.mj_step(model, data)
        assert np.abs(data.qpos[address] - model.jnt_range[ids, end]).max() < 0.02
    data.qfrc_applied[:] = 0.0
    data.qpos[address] = model.jnt_range[ids].mean(axis=1)
    mujoco.mj_step(model, data, 200)
    assert np.abs(data.qvel[dofs]).max() < 1e-3
    assert np.abs(data.qpos[address] - model.jnt_range[ids].mean(axis=1)).max() < 0.01


def test_optional_links_keep_the_numbers_of_the_data_set(opening: Pack) -> None:
    links = {
        f"{a.name}/{k.name}": k for a in opening.articulations.values() for k in a.links
    }
    left, right = (
        links[f"kitchenCupboard_01/kitchencupboard_doorWhole_1{side}"] for side in "LR"
    )
    # Hinges open outwards: the left one counts downwards in the data set, both upwards here. uniform_scale 0.38.
    assert (left.mirrored, right.mirrored) == (
        True,
        False,
    ) and left.range == right.range == (
        0.0,
        2.3,
    )
    assert left.axis[2] == pytest.approx(-1, abs=1e-3) and right.axis[2] == pytest.approx(
        1, abs=1e-3
    )
    assert left.mass == pytest.approx(8 * 0.38**3)
    drawer = links["chestOfDrawers_01/drawer_midR"]
    assert drawer.range == pytest.approx((0.0, 0.2)) and drawer.axis == pytest.approx(
        (1, 0, 0), abs=1e-3
    )
    slide = links["cabinet/right_door"]
    assert (
        slide.mirrored
        and slide.range == (0.0, 0.76)
        and slide.axis == pytest.approx((-1, 0, 0))
    )
    # Bars and knobs are narrower than the gripper opens; the cabinet's doors have none.
    assert all(
        link.handle.thickness < 0.09
        for name, link in links.items()
        if not name.startswith("cabinet")
    )
    assert slide.handle.thickness == pytest.approx(0.5)


def test_walls_of_the_stage_mesh(folder: Path, pack: Pack) -> None:
    """Against the numbers of the data's README and the navigation mesh made for this stage."""
    file = folder / "stages" / "frl_apartment_stage_simple.glb"
    walls, extent = stage_shape(file)
    assert extent == pytest.approx((-2.677, -8.165, 4.582, 4.834), abs=0.001)
    mesh = read_navmesh(folder / "navmeshes" / "empty_stage.navmesh")
    assert extent == pytest.approx(mesh.bounds, abs=2e-4)
    triangles = np.concatenate(
        [p.vertices[p.faces] for p in read_glb(file, textures=False)]
    )
    normal = np.cross(
        triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    )
    upright = np.abs(normal[:, 1]) < 0.05 * np.linalg.norm(normal, axis=1)
    area = np.linalg.norm(normal[upright], axis=1).sum() / 2
    assert sum(4 * w.size[1] * w.size[2] for w in walls) == pytest.approx(area, rel=0.01)
    assert len(walls) < 150
    # No wall crosses the walkable area, and walkable places with the clearance of the mesh's agent are free.
    name = str(folder / "configs" / "scenes" / "empty_stage.scene_instance.json")
    staged = open_pack(PackRequest(name, stage_mesh=str(file)))
    assert staged.homes[0].walls == walls
    free = free_map(staged.homes[0], staged)
    points = np.concatenate(
        [p[:, :2].mean(axis=0)[None] for p in mesh.polygons if p[:, 2].max() < 0.25]
    )
    assert (free.clearance_at(points) > 0.2).all()


@pytest.mark.parametrize("name", EVERY_MACRO)
def test_receptacles_of_the_tasks_are_in_reach(name: str, pack: Pack) -> None:
    home = next(h for h in pack.homes if h.name == name)
    far = {
        f"{r.thing}/{r.receptacle}": r.center
        for r in reach(home, pack, free_map(home, pack))
    }
    for wanted in (
        "fridge/middle_top",
        "kitchen_counter/counter_right",
        "table_01/tbl1_top1",
    ):
        assert far[wanted] < 1.2
