"""Joints of furniture: the constants of mjhab, or those that the files of the furniture publish."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import mjhab
from mjhab.layout.compile import compile_home, home_hash
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import FETCH_JOINTS
from mjhab.scenes.builtin.homes import make_home
from mjhab.scenes.packs import open_pack
from mjhab.scenes.shapes.openings import free_travel
from mjhab.scenes.spec import JOINT_DYNAMICS
from tests.refusals import refused

CORNER = "builtin_m3_20"
"""The home whose fridge opens against a wall."""
DOOR = "fridge/top_door"


def layout_of(dynamics: str) -> Layout:
    return Layout(open_pack("builtin"), (), None, dynamics)


def model_of(layout: Layout, home: str) -> mujoco.MjModel:
    return compile_home(layout, layout.pack.homes_by_name[home])


def world_of(model: mujoco.MjModel) -> mujoco.MjData:
    """A world whose robot stands aside and does nothing."""
    data = mujoco.MjData(model)
    data.qpos[[model.joint(name).qposadr[0] for name in FETCH_JOINTS[:2]]] = 15.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return data


def columns(layout: Layout, model: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Columns in qpos and qvel of the links."""
    found = [model.joint(name) for name in layout.link_ids]
    return [int(j.qposadr[0]) for j in found], [int(j.dofadr[0]) for j in found]


def test_ours_are_those_of_what_was_recorded_before_there_was_a_choice():
    layout = layout_of("ours")
    model = model_of(layout, CORNER)
    for ref in layout.links:
        joint = model.joint(ref.id)
        slide = ref.link.joint == "slide"
        assert joint.damping[0] == (5.0 if slide else 1.0)
        assert joint.frictionloss[0] == (1.0 if slide else 0.5)
        assert joint.armature[0] == 0.1
        dof = int(joint.dofadr[0])
        np.testing.assert_array_equal(model.jnt_solref[joint.id], [0.02, 1.0])
        np.testing.assert_array_equal(
            model.jnt_solimp[joint.id], [0.9, 0.95, 0.001, 0.5, 2]
        )
        assert model.dof_frictionloss[dof] == joint.frictionloss[0]
    assert model.joint(DOOR).range[1] == 1.85


def test_published_are_those_of_the_urdfs_and_the_range_stays_whole():
    layout = layout_of("published")
    for home in (CORNER, "builtin_m3_00"):
        model = model_of(layout, home)
        for ref in layout.links:
            joint = model.joint(ref.id)
            told = (joint.damping[0], joint.frictionloss[0], joint.armature[0])
            assert told == (0.01, 0.01, 0.0)
            assert tuple(joint.range) == ref.link.range


def test_each_has_a_hash_of_its_own_and_others_are_refused():
    home = open_pack("builtin").homes[0]
    hashes = {home_hash(layout_of(dynamics), home) for dynamics in JOINT_DYNAMICS}
    assert len(hashes) == 2
    with refused("joint dynamics", "publshed", expected="published"):
        layout_of("publshed")


@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_stops_take_the_speed_of_a_link_at_both_ends(speed: float):
    """Doors are thrown at 3 times the speed: it is that of their handles [m/s]."""
    layout = layout_of("published")
    model = model_of(layout, "builtin_m3_00")
    q, v = columns(layout, model)
    ends = np.array([ref.link.range for ref in layout.links])
    fast = np.where([ref.link.joint == "hinge" for ref in layout.links], 3.0, 1.0) * speed
    for end, way in ((0, -1.0), (1, 1.0)):
        data = world_of(model)
        data.qpos[q] = ends[:, end] - way * 0.05
        data.qvel[v] = way * fast
        deepest = np.zeros(len(q))
        back = np.zeros(len(q))
        for _ in range(200):
            mujoco.mj_step(model, data)
            deepest = np.maximum(deepest, way * (data.qpos[q] - ends[:, end]))
            back = np.maximum(back, -way * data.qvel[v])
        assert (back <= 0.01 * fast).all()
        # One time step passes before a stop notices.
        assert (deepest <= 0.011 * fast).all()
        assert (np.abs(data.qpos[q] - ends[:, end]) < 0.011 * fast).all()


def test_links_stay_where_they_are_left():
    layout = layout_of("published")
    model = model_of(layout, "builtin_m3_00")
    q, _ = columns(layout, model)
    data = world_of(model)
    left = np.array([0.7 * ref.link.range[1] for ref in layout.links])
    data.qpos[q] = left
    mujoco.mj_step(model, data, 500)
    np.testing.assert_allclose(data.qpos[q], left, atol=1e-3)


def test_a_door_meets_the_wall_and_nothing_touches_walls_by_itself():
    layout = layout_of("published")
    free = free_travel(make_home(3, 20), layout.pack)[DOOR]
    model = model_of(layout, CORNER)
    q, v = columns(layout, model)
    k = layout.link_ids.index(DOOR)
    data = world_of(model)
    data.qfrc_applied[v[k]] = 12.0
    mujoco.mj_step(model, data, 400)
    assert data.qpos[q[k]] == pytest.approx(free, abs=0.02) and free < 2.0
    names = {model.geom(int(g)).name for g in data.contact.geom[: data.ncon].ravel()}
    assert any(name.startswith("wall_") for name in names)
    assert any(name.startswith(DOOR) for name in names)
    for home in layout.pack.homes[::5]:
        model = model_of(layout, home.name)
        data = world_of(model)
        mujoco.mj_forward(model, data)
        assert data.ncon == 0, home.name


def test_no_episode_starts_with_a_door_in_the_wall():
    """Close begins with the door up to where the wall stops it, and it stands still there."""
    env = mjhab.make(
        task="set_table",
        subtask="close",
        target=DOOR,
        split="val",
        home=CORNER,
        profile="ms_hab",
        num_envs=3,
        threads=1,
        autoreset="disabled",
    )
    env.reset(seed=0)
    k = env.layout.link_ids.index(DOOR)
    column = env.sim.addresses.link_q[k]
    model = env.sim.model(CORNER)
    limit = dict(make_home(3, 20).open_limits)[DOOR]
    assert env.layout.joint_dynamics == "published"
    for world in range(3):
        data = mujoco.MjData(model)
        data.qpos[:] = env.sim.get_world(world)["qpos"]
        assert 0.75 * 2.3 - 1e-9 <= data.qpos[column] <= limit
        mujoco.mj_forward(model, data)
        pairs = data.contact.geom[: data.ncon]
        touched = [
            {model.geom(int(g)).name.split("_")[0] for g in pair} for pair in pairs
        ]
        assert not any("wall" in pair for pair in touched)
    before = [float(env.sim.get_world(w)["qpos"][column]) for w in range(3)]
    for _ in range(10):
        env.step(np.zeros((3, 13), np.float32))
    after = [float(env.sim.get_world(w)["qpos"][column]) for w in range(3)]
    np.testing.assert_allclose(after, before, atol=2e-3)
    env.close()
