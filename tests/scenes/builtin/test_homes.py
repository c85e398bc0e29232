"""The built-in homes: one layout, room to work, and packs that survive the disk."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import itertools
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.scenes.builtin import homes
from mjhab.scenes.builtin.furniture import builtin_articulations
from mjhab.scenes.builtin.home_plans import HARD
from mjhab.scenes.builtin.homes import (
    EVERY,
    builtin_homes,
    keep_clear,
    make_home,
    split_of,
)
from mjhab.scenes.builtin.materials import MATERIALS
from mjhab.scenes.freespace import free_map, reach
from mjhab.scenes.pack_folder import load_pack, save_pack
from mjhab.scenes.packs import open_pack
from mjhab.scenes.shapes.footprints import all_geoms, footprint, meet, outline, rectangle
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.shapes.openings import free_travel, stuck_links
from mjhab.scenes.spec import Geom, Pack
from tests.refusals import refused

ALL = list(EVERY)
PINNED = "e78dcf33974516c9"
"""Hash of where everything stands in the homes that results were published for."""


def _pack() -> Pack:
    return open_pack("builtin")


def _geoms(pack: Pack) -> list[Geom]:
    links = [link for a in pack.articulations.values() for link in a.links]
    groups = (
        [p.geoms for p in pack.props.values()]
        + [a.geoms for a in pack.articulations.values()]
        + [link.geoms for link in links]
        + [o.collision + o.visuals for o in pack.objects.values()]
        + [h.walls + h.floor_patches for h in pack.homes]
    )
    return [g for group in groups for g in group]


def test_names_and_splits() -> None:
    listed = _pack().homes
    assert [h.name for h in listed][:2] == ["builtin_m0_00", "builtin_m0_01"]
    assert len({h.name for h in listed}) == len(listed) >= 6
    assert {h.macro: h.split for h in listed} == {
        0: "train",
        1: "train",
        2: "train",
        3: "val",
        4: "test",
    }
    assert Counter(split_of(macro) for macro, _ in ALL) == {
        "train": 63,
        "val": 21,
        "test": 21,
    }


def test_the_pieces_that_tasks_name_are_there() -> None:
    pack = _pack()
    counter = pack.articulations["kitchen_counter"]
    fridge = pack.articulations["fridge"]
    assert [link.name for link in counter.links] == [
        "drawer1_top",
        "drawer1_bottom",
        "drawer2_top",
        "drawer2_middle",
        "drawer2_bottom",
        "drawer3",
        "drawer4",
    ]
    assert [(link.name, link.range) for link in fridge.links] == [
        ("top_door", (0.0, 2.3)),
        ("bottom_door", (0.0, 2.5)),
    ]
    assert {"counter_left", "counter_right", "sink", "drawer3"} <= {
        r.name for r in counter.receptacles
    }
    assert {"bottom", "middle", "middle_bottom", "middle_top", "top"} == {
        r.name for r in fridge.receptacles
    }
    for home in pack.homes:
        assert {p.template for p in home.articulations} == {"kitchen_counter", "fridge"}
        placed = Counter(p.template for p in home.props)
        assert placed["chair_01"] == 4
        assert all(
            placed[name] == 1 for name in ("table_01", "table_02", "tvstand", "sofa")
        )


def test_every_material_and_mesh_exists_and_is_used() -> None:
    pack = _pack()
    geoms = _geoms(pack)
    used = {g.material for g in geoms} | {h.floor_material for h in pack.homes}
    assert used <= set(MATERIALS)
    assert {g.mesh for g in geoms if g.shape == "mesh"} == set(pack.meshes)
    for name, mesh in pack.meshes.items():
        assert isinstance(mesh, Mesh), name
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)


def test_one_layout_stays_small() -> None:
    """The union over homes of everything that collides, and of everything that is drawn."""
    pack = _pack()
    most: Counter[str] = Counter()
    for home in pack.homes:
        most |= Counter(p.template for p in home.props)
    furniture = [pack.props[name] for name in most.elements()] + list(
        pack.articulations.values()
    )
    felt = sum(g.collide for t in furniture for g in all_geoms(t)) + max(
        len(h.walls) for h in pack.homes
    )
    assert felt <= 250
    triangles = {"box": 12, "cylinder": 96, "sphere": 480}
    seen = 0
    for g in (g for t in furniture for g in all_geoms(t) if g.visual):
        mesh = pack.meshes.get(g.mesh)
        seen += len(mesh.faces) if isinstance(mesh, Mesh) else triangles[g.shape]
    assert seen <= 60_000


@pytest.mark.parametrize(("macro", "micro"), ALL)
def test_a_robot_reaches_every_receptacle(macro: int, micro: int) -> None:
    home = make_home(macro, micro)
    pack = _pack()
    free = free_map(home, pack)
    assert free.navigable(0.3).sum() >= 0.94 * (free.clearance >= 0.3).sum()
    reached = reach(home, pack, free)
    assert {r.receptacle: r.center for r in reached if r.center > 0.9} == {}
    assert {r.thing: r.farthest for r in reached if r.farthest > 1.0} == {}


@pytest.mark.parametrize(("macro", "micro"), ALL)
def test_nothing_stands_in_something_else(macro: int, micro: int) -> None:
    home = make_home(macro, micro)
    pack = _pack()
    areas = []
    for placement in (*home.props, *home.articulations):
        area = footprint(
            placement,
            pack.props.get(placement.template) or pack.articulations[placement.template],
        )
        if area is not None:
            areas.append(area)
    for a, b in itertools.combinations(areas, 2):
        assert not a.meets(b), (a.name, b.name)
    for wall in home.walls:
        corners = outline(wall)[:, :2][[0, 2, 6, 4]]
        for area in areas:
            assert not meet(corners, area.corners, -1e-6), area.name


@pytest.mark.parametrize(("macro", "micro"), ALL)
def test_floor_in_front_of_what_opens_is_free(macro: int, micro: int) -> None:
    home = make_home(macro, micro)
    pack = _pack()
    for placement in home.articulations:
        zone = rectangle(placement, *keep_clear(macro, micro)[placement.template])
        assert np.all(zone >= np.array(home.floor[:2]) - 1e-9) and np.all(
            zone <= np.array(home.floor[2:]) + 1e-9
        )
        for wall in home.walls:
            assert not meet(outline(wall)[:, :2][[0, 2, 6, 4]], zone, -1e-6)
        for other in home.props:
            area = footprint(other, pack.props[other.template])
            assert area is None or not meet(area.corners, zone), (
                placement.template,
                other.template,
            )


@pytest.mark.parametrize(("macro", "micro"), ALL)
def test_doors_and_drawers_swing_through_free_space(macro: int, micro: int) -> None:
    """Sweep each link over its range: it meets no wall and no furniture, but in the one home that says so."""
    home = make_home(macro, micro)
    pack = _pack()
    assert stuck_links(home, pack) == []
    assert bool(home.open_limits) == ((macro, micro) == (3, 20))


def test_hard_cases_open_toward_a_wall() -> None:
    """Val and test have a fridge with 0.9 m beside it; in one val home an open door stands against the wall."""
    pack = _pack()
    hard = {key: make_home(*key) for key in HARD}
    assert {home.split for home in hard.values()} == {"val", "test"}
    for key, home in hard.items():
        (fridge,) = [p for p in home.articulations if p.template == "fridge"]
        beside = rectangle(fridge, (-0.3, 0.3), (0.345, 0.345 + HARD[key].side))
        assert "hard case" in home.note
        walls = [outline(w)[:, :2][[0, 2, 6, 4]] for w in home.walls]
        assert not any(meet(wall, beside, -1e-6) for wall in walls)
        assert any(meet(wall, beside, 1e-6) for wall in walls)
    free = {key: free_travel(home, pack) for key, home in hard.items()}
    blocked = free.pop((3, 20))
    ranges = {f"fridge/{k.name}": k.range[1] for k in pack.articulations["fridge"].links}
    assert all(
        travel[name] == ranges[name] for travel in free.values() for name in ranges
    )
    # Open wide enough to count as open, with less room before the handle than a finger is thick.
    assert (
        0.75 * 2.3
        < dict(hard[3, 20].open_limits)["fridge/top_door"]
        < blocked["fridge/top_door"]
        < 1.9
    )


def test_a_stuck_link_is_found() -> None:
    home = dataclasses.replace(make_home(3, 20), open_limits=())
    assert stuck_links(home, _pack()) == [
        "fridge/top_door opens to 1.86 of 2.30",
        "fridge/bottom_door opens to 1.86 of 2.50",
    ]


def test_the_joint_ends_where_the_door_meets_the_wall() -> None:
    pack = dataclasses.replace(_pack(), homes=(make_home(3, 0), make_home(3, 20)))
    layout = Layout(pack, ())
    open_wide, blocked = (
        compile_home(layout, home).joint("fridge/top_door").range[1]
        for home in pack.homes
    )
    assert (open_wide, blocked) == (2.3, 1.85)


@pytest.mark.parametrize("thing", ["kitchen_counter", "fridge"])
def test_fingers_fit_around_every_handle(thing: str) -> None:
    """Fetch's fingers are 14 mm thick, 26 mm wide and reach 31 mm past the grasp point."""
    for link in builtin_articulations()[thing].links:
        handle = link.handle
        along = np.array(handle.bar)
        out = np.array(handle.out)
        open_dir = np.cross(along, out)
        assert handle.thickness <= 0.024 and handle.half_length >= 0.07
        for side in (-1.0, 1.0):
            mid = (
                np.array(handle.pos)
                + side * (handle.thickness / 2 + 0.001 + 0.007) * open_dir
            )
            room = np.abs(along) * 0.013 + np.abs(out) * 0.031 + np.abs(open_dir) * 0.007
            for g in (g for g in link.geoms if g.collide):
                p = outline(g)
                overlap = np.minimum(p.max(0), mid + room) - np.maximum(
                    p.min(0), mid - room
                )
                assert not np.all(overlap > 0), (link.name, g)
        front = max(
            outline(g)[:, 0].max()
            for g in link.geoms
            if g.material in ("cabinet_front", "fridge_door")
        )
        assert handle.pos[0] - handle.thickness / 2 - front >= 0.045


def test_set_table_drawer_shows_its_bowl_when_open() -> None:
    """Open by 0.441 m (0.9 of 0.49 m in the original), a bowl in the drawer's area is 10 cm clear of the worktop."""
    counter = builtin_articulations()["kitchen_counter"]
    (r,) = [r for r in counter.receptacles if r.name == "drawer3"]
    (link,) = [k for k in counter.links if k.name == "drawer3"]
    edge = max(outline(g)[:, 0].max() for g in counter.geoms if g.material == "worktop")
    assert link.pos[0] + r.pos[0] - r.half[0] + 0.441 >= edge + 0.10
    assert min(r.half) > 0.0805
    assert 0.70 <= link.pos[2] + link.handle.pos[2] <= 0.78
    assert r.height >= 0.055 + 0.05


@pytest.mark.parametrize("name", ["kitchen_counter", "fridge"])
def test_receptacles_lie_on_a_surface_with_free_room_above(name: str) -> None:
    thing = builtin_articulations()[name]
    links = {k.name: k for k in thing.links}
    boxes = [
        (outline(g).min(0), outline(g).max(0)) for g in all_geoms(thing) if g.collide
    ]
    for r in thing.receptacles:
        origin = np.array(links[r.link].pos) if r.link else np.zeros(3)
        p = np.array(r.pos) + origin
        corners = (
            np.array(
                [
                    [sx * r.half[0], sy * r.half[1], 0.0]
                    for sx in (-1, 1)
                    for sy in (-1, 1)
                ]
            )
            + p
        )
        for c in corners:
            assert any(
                np.all(c[:2] >= lo[:2])
                and np.all(c[:2] <= hi[:2])
                and abs(hi[2] - c[2]) < 1e-6
                for lo, hi in boxes
            ), (r.name, c)
        low = corners.min(0) + np.array([0.0, 0.0, 1e-4])
        high = corners.max(0)
        high[2] += 0.055 if r.link else r.height
        for lo, hi in boxes:
            overlap = np.minimum(high, hi) - np.maximum(low, lo)
            assert not np.all(overlap > 1e-6), (r.name, lo, hi)


def test_homes_are_the_same_every_time_and_differ_from_each_other() -> None:
    assert make_home.__wrapped__(1, 7) == make_home(1, 7)
    assert len({make_home(1, k).props for k in range(5)}) == 5
    with refused(said="macro is 0..4, micro 0..20"):
        make_home(5, 0)


def test_homes_keep_their_geometry() -> None:
    """A change of the search or of a template must not move furniture in homes that results were measured in."""

    def rounded(*values: float) -> list[float]:
        return [round(v, 6) + 0.0 for v in values]

    digest = hashlib.sha256()
    for macro, micro in ((0, 0), (0, 1), (1, 0), (2, 0), (3, 0), (4, 0)):
        home = make_home(macro, micro)
        for placement in (*home.props, *home.articulations):
            digest.update(
                repr(
                    (placement.template, rounded(*placement.pos, placement.yaw))
                ).encode()
            )
        for wall in home.walls:
            digest.update(repr(rounded(*wall.pos, *wall.size)).encode())
    assert digest.hexdigest()[:16] == PINNED


def test_furnished_homes_come_back_from_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    keys = ((4, 0), (3, 20))
    first = builtin_homes(keys)
    (file,) = (tmp_path / "homes").iterdir()
    monkeypatch.setattr(
        homes, "make_home", lambda macro, micro: pytest.fail("furnished again")
    )
    assert builtin_homes(keys) == first
    monkeypatch.undo()
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    for broken in ("", "{}", "[[]]", file.read_text()[:-40]):
        file.write_text(broken)
        assert builtin_homes(keys) == first
        assert json.loads(file.read_text()) != broken


def test_the_layout_of_all_homes_is_that_of_five() -> None:
    """Micro layouts bring no pieces of their own, so a model does not grow with the number of homes."""
    plans = Layout(
        dataclasses.replace(_pack(), homes=tuple(make_home(m, 0) for m in range(5))), ()
    )
    all_homes = Layout(
        dataclasses.replace(_pack(), homes=tuple(make_home(*key) for key in ALL)), ()
    )
    assert (
        all_homes.prop_slots == plans.prop_slots
        and all_homes.num_walls == plans.num_walls
    )


def test_a_pack_survives_the_disk(tmp_path: Path) -> None:
    pack = _pack()
    save_pack(pack, tmp_path / "mine")
    again = open_pack(str(tmp_path / "mine"))
    assert dataclasses.replace(again, meshes={}) == dataclasses.replace(pack, meshes={})
    assert set(again.meshes) == set(pack.meshes)
    for name, mesh in pack.meshes.items():
        other = again.meshes[name]
        assert isinstance(mesh, Mesh) and isinstance(other, Mesh)
        np.testing.assert_array_equal(mesh.vertices, other.vertices)
        np.testing.assert_array_equal(mesh.faces, other.faces)


def test_a_pack_whose_writing_fails_leaves_none_of_the_pack_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_pack(_pack(), tmp_path)

    def full(*args: object, **arrays: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        save_pack(dataclasses.replace(_pack(), name="other"), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["meshes.npz"]
    with refused(said="has no pack.json"):
        load_pack(tmp_path)


def test_unknown_packs_are_refused_with_a_hint(tmp_path: Path) -> None:
    with refused("asset pack", "bultin", expected="builtin"):
        open_pack("bultin")
    with refused(
        said="has no pack.json; a pack folder must hold pack.json and meshes.npz"
    ):
        open_pack(str(tmp_path))
    with refused("asset folder", str(tmp_path / "nowhere")):
        open_pack(str(tmp_path / "nowhere"))
    (tmp_path / "file.txt").write_text("x")
    with refused("asset pack", str(tmp_path / "file.txt")):
        open_pack(str(tmp_path / "file.txt"))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("format", "other", "'format' must be"),
        ("homes", None, "field 'homes' is missing"),
        ("props", [{"name": "a"}], "props[0]: field 'geoms' is missing"),
        (
            "props",
            [{"name": "a", "geoms": [], "wheels": 4}],
            "props[0]: unknown field 'wheels'",
        ),
        (
            "props",
            [{"name": "a", "geoms": [{"shape": "cone", "size": [1, 1, 1]}]}],
            ("must be 'box' or ", " got 'cone'"),
        ),
        (
            "props",
            [{"name": "a", "geoms": [{"shape": "box", "size": [1, "b", 1]}]}],
            "size[1] must be a finite number",
        ),
        (
            "props",
            [{"name": "a", "geoms": [{"shape": "box", "size": [1, 1]}]}],
            "size must be a tuple of 3",
        ),
        ("props", [], ("template '", "' is not in the pack")),
        ("meshes", ["nothing"], "array 'nothing/vertices' is missing"),
        ("meshes", [], "names the mesh"),
    ],
)
def test_broken_packs_name_the_file_and_the_field(
    tmp_path: Path, field: str, value: object, message: str | tuple[str, ...]
) -> None:
    save_pack(_pack(), tmp_path)
    body = json.loads((tmp_path / "pack.json").read_text())
    if value is None:
        del body[field]
    else:
        body[field] = value
    (tmp_path / "pack.json").write_text(json.dumps(body))
    with refused(said=message) as caught:
        load_pack(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_truncated_packs_are_refused(tmp_path: Path) -> None:
    save_pack(_pack(), tmp_path)
    whole = (tmp_path / "meshes.npz").read_bytes()
    (tmp_path / "meshes.npz").write_bytes(whole[: len(whole) // 2])
    with refused(where="meshes.npz", said="no file of the meshes of a pack"):
        load_pack(tmp_path)
    text = (tmp_path / "pack.json").read_text()
    (tmp_path / "pack.json").write_text(text[: len(text) // 2])
    with refused(where="pack.json", said="not valid JSON"):
        load_pack(tmp_path)
