"""The stage that stands in for the missing ones of the real ReplicaCAD scenes, against their navigation meshes."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjhab
from mjhab.config.env import EnvConfig
from mjhab.data.record.provenance import describe_run
from mjhab.episodes.spawn_sets import SpawnRecipe, header_of
from mjhab.evaluation.recorded import recorded_env
from mjhab.layout.check import remarks
from mjhab.layout.compile import compile_home, home_hash
from mjhab.layout.layout import Layout
from mjhab.scenes.freespace import NAVMESH_BASE_RADIUS_M, FreeMap, free_map
from mjhab.scenes.pack_folder import load_pack, save_pack
from mjhab.scenes.pack_source import PackRequest, pack_request
from mjhab.scenes.packs import open_pack, stage_of
from mjhab.scenes.replica_cad.navmesh import read_navmesh
from mjhab.scenes.replica_cad.stage import stage_shape
from mjhab.scenes.replica_cad.stand_in import crossing_area
from mjhab.scenes.replica_cad.walkable import CELL_M, Walkable, fill, walkable_floor
from mjhab.scenes.spec import Home, Pack
from tests.real_data import real_data
from tests.refusals import refused
from tests.scenes.formats.glb import box_glb

EVERY_MACRO = (
    "v3_sc0_staging_00",
    "v3_sc1_staging_01",
    "v3_sc2_staging_10",
    "v3_sc3_staging_20",
)
DOOR = "fridge/top_door"
OPEN_ASKS_RAD = 0.75 * 2.3


@pytest.fixture(scope="module")
def folder() -> Path:
    return real_data("replica_cad")


@pytest.fixture(scope="module")
def pack(folder: Path) -> Pack:
    return open_pack(PackRequest(str(folder), stage="stand-in", scenes=EVERY_MACRO))


@pytest.fixture(scope="module")
def bare(folder: Path) -> Pack:
    return open_pack(PackRequest(str(folder), stage="none", scenes=EVERY_MACRO))


@pytest.fixture(scope="module")
def floor(folder: Path) -> Walkable:
    names = (p.stem for p in (folder / "navmeshes_default").glob("v3_*.navmesh"))
    return walkable_floor(folder, sorted(names))


def _theirs(folder: Path, home: Home, free: FreeMap) -> np.ndarray:
    """Cells of a map that are walkable for the data set's agent of radius 0.3 m."""
    fine = np.zeros([2 * n for n in free.blocked.shape], bool)
    for corners in read_navmesh(folder / "navmeshes" / f"{home.name}.navmesh").polygons:
        if corners[:, 2].max() < 0.25:
            fill(fine, np.array(free.origin), corners[:, :2])
    assert free.cell == 2 * CELL_M
    return fine[::2, ::2] & fine[1::2, 1::2]


def test_no_wall_is_left_on_walkable_floor(
    folder: Path, pack: Pack, floor: Walkable
) -> None:
    walls, _ = stage_shape(folder / "stages" / "frl_apartment_stage_simple.glb")
    assert 0.1 < crossing_area(walls, floor) < 0.2
    assert len({home.walls for home in pack.homes}) == 1
    assert crossing_area(pack.homes[0].walls, floor) == 0.0


@pytest.mark.parametrize("name", EVERY_MACRO)
def test_free_floor_is_that_of_the_navigation_meshes(
    name: str, folder: Path, pack: Pack, bare: Pack
) -> None:
    home = pack.homes_by_name[name]
    free = free_map(home, pack)
    theirs = _theirs(folder, home, free)
    assert (free.clearance[theirs] >= 0.2).mean() > 0.99
    ours = free.navigable()
    assert ours[theirs].mean() > 0.85
    # Walls cut nothing off.
    assert ours.sum() > 0.95 * (free.clearance >= NAVMESH_BASE_RADIUS_M).sum()
    # Bathroom and store room, whose doors are left out, are open; the stairs and what is outside of the walls are not.
    beyond = ours.sum() * free.cell**2 - theirs.sum() * free.cell**2
    open_floor = free_map(bare.homes_by_name[name], bare).navigable()
    assert beyond < 6.0 < 12.0 < (open_floor.sum() - theirs.sum()) * free.cell**2


def test_only_the_fridge_at_the_end_of_the_kitchen_line_meets_a_wall(pack: Pack) -> None:
    limits = {home.macro: dict(home.open_limits) for home in pack.homes}
    assert [limits[macro] for macro in range(3)] == [{}, {}, {}]
    assert set(limits[3]) == {DOOR, "fridge/bottom_door"}
    # The navigation meshes bound the wall: 1.72 to 1.795 rad.
    assert OPEN_ASKS_RAD < limits[3][DOOR] < 1.795
    home = pack.homes_by_name[EVERY_MACRO[3]]
    found = remarks(Layout(pack, ()), home)
    assert any(f"{DOOR} meets a wall" in remark for remark in found)
    ends = {}
    for dynamics in ("ours", "published"):
        model = compile_home(Layout(pack, (), joint_dynamics=dynamics), home)
        joints = {model.joint(k).name: model.joint(k).range[1] for k in range(model.njnt)}
        (ends[dynamics],) = (end for name, end in joints.items() if DOOR in name)
    assert ends["ours"] == pytest.approx(limits[3][DOOR])
    assert ends["published"] == pytest.approx(2.3)


def test_the_stage_is_told_and_part_of_the_identity(
    folder: Path, pack: Pack, bare: Pack, tmp_path: Path
) -> None:
    usual = open_pack(PackRequest(str(folder), scenes=EVERY_MACRO))
    own = open_pack(PackRequest(str(folder), stage="own", scenes=EVERY_MACRO))
    assert (pack.stage, bare.stage, own.stage) == ("stand-in", "none", "none")
    assert usual is pack
    assert own.homes == bare.homes and all(home.walls == () for home in bare.homes)
    hashes = {home_hash(Layout(p, ()), p.homes[0]) for p in (pack, bare)}
    assert len(hashes) == 2
    # A home does not depend on which others are opened.
    one = PackRequest(str(folder), stage="stand-in", scenes=EVERY_MACRO[3:])
    assert open_pack(one).homes[0] == pack.homes_by_name[EVERY_MACRO[3]]
    assert open_pack(one.as_json()) is open_pack(one)
    assert "stage: stand-in" in str(one)
    assert stage_of(one) == {"stage": "stand-in"} and stage_of("builtin") == {}
    save_pack(pack, tmp_path / "saved")
    again = load_pack(tmp_path / "saved")
    assert again.stage == "stand-in" and again.homes == pack.homes


def test_requests_say_the_stage_and_old_ones_had_none(folder: Path) -> None:
    """What was recorded before there was a stand-in had no walls; what is recorded now says what it has."""
    given = EnvConfig(assets=str(folder)).assets
    assert given == {"place": str(folder), "stage": "stand-in"}
    assert EnvConfig(assets=given).assets == given
    for old in (str(folder), {"place": str(folder)}, f"{folder}?articulate=cabinet"):
        assert pack_request(old, recorded=True).stage == "own"
    assert pack_request(given, recorded=True).stage == "stand-in"
    assert pack_request("builtin", recorded=True) == PackRequest("builtin")
    mesh = str(folder / "stages" / "frl_apartment_stage_simple.glb")
    assert pack_request(f"{folder}?stage={mesh}").stage == "own"


def test_an_old_recording_is_simulated_without_walls(folder: Path) -> None:
    env = mjhab.make(assets=PackRequest(str(folder), stage="own"), home=EVERY_MACRO[3])
    run = describe_run(env, {"name": "nobody"}, "none")
    env.close()
    options = {**run.config["env"], "assets": str(folder)}
    old = dataclasses.replace(run, config={**run.config, "env": options})
    again = recorded_env(old)
    assert again.layout.stage == "none" and not again.layout.pack.homes[0].walls
    again.close()


@pytest.mark.parametrize("lacks", ["stages", "navmeshes_default"])
def test_a_folder_without_a_stand_in_has_no_walls_as_before(
    lacks: str, folder: Path, tmp_path: Path
) -> None:
    for part in folder.iterdir():
        if part.name != lacks:
            (tmp_path / part.name).symlink_to(part)
    request = pack_request(str(tmp_path))
    assert request.stage == "own"
    pack = open_pack(dataclasses.replace(request, scenes=EVERY_MACRO[:1]))
    assert pack.stage == "none" and pack.homes[0].walls == ()


def test_one_line_tells_what_stands_in(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # A warning is logged once per process: this one names a file of this test.
    mesh = tmp_path / "like_mesh.glb"
    shutil.copy(folder / "stages" / "frl_apartment_stage_simple.glb", mesh)
    with caplog.at_level(logging.WARNING, "mjhab"):
        pack = open_pack(
            PackRequest(
                str(folder),
                stage="stand-in",
                stage_mesh=str(mesh),
                scenes=EVERY_MACRO[1:2],
            )
        )
    (line,) = (r.message for r in caplog.records if "Stage_" in r.message)
    assert "Stage_v3_sc1_staging.glb missing: like_mesh.glb stands in" in line
    assert pack.stage == "stand-in" and pack.homes[0].walls


def test_a_stand_in_of_another_frame_is_refused_with_numbers(
    folder: Path, tmp_path: Path
) -> None:
    other = box_glb(tmp_path / "other.glb", (1.0, 1.5, 3.0), at=((0.5, 1.5, 0.0),))
    request = PackRequest(
        str(folder), stage="stand-in", stage_mesh=str(other), scenes=EVERY_MACRO[:1]
    )
    with refused(where="other.glb", said=("m^2 of its walls", "at most 0.25")):
        open_pack(request)


def test_requests_with_a_stage(folder: Path, tmp_path: Path) -> None:
    assert pack_request(f"{folder}?stage=none") == PackRequest(str(folder), stage="none")
    with refused("stage", "walls", expected="stand-in"):
        PackRequest(str(folder), stage="walls")
    mesh = str(tmp_path / "walls.glb")
    with refused("stage_mesh", mesh):
        PackRequest(str(folder), stage="none", stage_mesh=mesh)
    with refused("stage", "stand-in"):
        open_pack(PackRequest("builtin", stage="stand-in"))


def test_runs_tell_their_stage_and_start_before_the_wall(
    folder: Path, pack: Pack, tmp_path: Path
) -> None:
    request = PackRequest(str(folder), stage="stand-in", scenes=EVERY_MACRO[3:])
    asked = {
        "task": "set_table",
        "subtask": "close",
        "target": DOOR,
        "split": "val",
        "profile": "ms_hab",
        "assets": request,
    }
    run = mjhab.evaluate("random", out=tmp_path / "run", episodes=1, films=0, **asked)
    assert run.summary["stage"] == "stand-in"
    assert "stand-in" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    env = mjhab.make(**asked)
    try:
        told = describe_run(env, {"name": "nobody"}, "none")
        limit = dict(pack.homes_by_name[EVERY_MACRO[3]].open_limits)[DOOR]
        door = env.layout.link_ids.index(DOOR)
        for index in range(4):
            start = env.source.start(env.source.episode(0, index))
            assert 1.7 < start.qpos[env.sim.addresses.link_q[door]] <= limit + 1e-6
    finally:
        env.close()
    assert told.layout["stage"] == "stand-in"
    assert json.loads(told.assets)["stage"] == "stand-in"
    recipe = SpawnRecipe("set_table", "close", DOOR, "val", 0, 1, request.as_json())
    assert header_of(recipe, Layout(pack, ()), {})["stage"] == "stand-in"


@pytest.mark.parametrize("speed", (0.2, 1.0, 2.0))
def test_the_door_does_not_bounce_off_the_wall(pack: Pack, speed: float) -> None:
    """Its centre of mass lies on the hinge, for which MuJoCo alone makes a contact that throws it back."""
    home = pack.homes_by_name[EVERY_MACRO[3]]
    model = compile_home(Layout(pack, (), joint_dynamics="published"), home)
    joint = model.body_jntadr[model.body(DOOR).id]
    at = model.jnt_qposadr[joint]
    dof = model.jnt_dofadr[joint]
    data = mujoco.MjData(model)
    for start in (1.5, 1.55, 1.65):
        mujoco.mj_resetData(model, data)
        data.qpos[at] = start
        data.qvel[dof] = speed
        slowest = farthest = 0.0
        for _ in range(200):
            mujoco.mj_step(model, data)
            slowest = min(slowest, data.qvel[dof])
            farthest = max(farthest, data.qpos[at])
        assert slowest > -0.01 * speed
        assert 1.75 < farthest < 1.80
