"""The Fetch model against the numbers of the original robot."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from mjhab.core.errors import MjhabError
from mjhab.robots.fetch import model as fetch
from mjhab.robots.fetch import visuals as fetch_visuals
from mjhab.robots.fetch.geometry import COLLISION, INERTIALS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.model import add_robot, physics_options
from mjhab.scenes.spec import Geom

REST = np.array(fetch.REST_QPOS)
MOVING = [j for j, name in enumerate(fetch.FETCH_JOINTS) if not name.startswith("root")]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    physics_options(spec)
    add_robot(spec, ROBOT)
    return spec.compile()


def addresses(model: mujoco.MjModel) -> np.ndarray:
    return np.array([model.joint(name).qposadr[0] for name in fetch.FETCH_JOINTS])


def at(model: mujoco.MjModel, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[addresses(model)] = q
    mujoco.mj_forward(model, data)
    return data


def in_base(data: mujoco.MjData, body: str) -> np.ndarray:
    return data.body(body).xpos - data.body("base_link").xpos


def test_rest_pose_reaches_the_published_tcp(model: mujoco.MjModel) -> None:
    data = at(model, REST)
    np.testing.assert_allclose(
        in_base(data, fetch.TCP_LINK), (0.5104, -0.0046, 1.2493), atol=1e-3
    )
    axes = data.body(fetch.TCP_LINK).xmat.reshape(3, 3).T
    np.testing.assert_allclose(axes[0], (-0.363, 0.142, -0.921), atol=1e-3)
    np.testing.assert_allclose(axes[1], (-0.224, 0.946, 0.234), atol=1e-3)
    np.testing.assert_allclose(axes[2], (0.905, 0.291, -0.312), atol=1e-3)
    np.testing.assert_allclose(
        in_base(data, "torso_lift_link"), (-0.0869, 0.0, 0.7634), atol=1e-3
    )


def test_head_camera_sees_forward_and_down(model: mujoco.MjModel) -> None:
    data = at(model, REST)
    base = data.body("base_link").xpos
    np.testing.assert_allclose(
        data.cam("fetch_head").xpos - base, (0.1673, 0.0, 1.4142), atol=1e-3
    )
    axes = data.cam("fetch_head").xmat.reshape(3, 3)
    np.testing.assert_allclose(
        -axes[:, 2], (np.cos(0.562), 0.0, -np.sin(0.562)), atol=1e-6
    )
    assert axes[2, 1] > 0, "the image is upside down"
    np.testing.assert_allclose(np.radians(model.cam_fovy), 2.0)


def test_joints_limits_and_servos_have_the_published_order_and_values(
    model: mujoco.MjModel,
) -> None:
    assert [model.actuator(i).name for i in range(model.nu)] == list(fetch.FETCH_JOINTS)
    assert model.nv == len(fetch.FETCH_JOINTS) == 15
    for i, name in enumerate(fetch.FETCH_JOINTS):
        joint = model.joint(name)
        gains = ROBOT.gains_of[name]
        finite = np.isfinite(ROBOT.joint_limits[i][0])
        assert bool(model.jnt_limited[joint.id]) == finite
        if finite:
            np.testing.assert_allclose(joint.range, ROBOT.joint_limits[i])
        assert model.actuator_trnid[i, 0] == joint.id
        np.testing.assert_allclose(model.actuator_biasprm[i, 1:3], (-gains.kp, -gains.kd))
        np.testing.assert_allclose(
            model.jnt_actfrcrange[joint.id], (-gains.force, gains.force)
        )
    assert ROBOT.joint_limits[fetch.FETCH_JOINTS.index("shoulder_lift_joint")] == (
        -1.221,
        1.518,
    )


def test_masses_are_those_of_the_inertial_table(model: mujoco.MjModel) -> None:
    for link in fetch.LINKS:
        merged = [
            t.link
            for t in fetch.KINEMATIC_TREE
            if t.parent == link and t.link not in fetch.LINKS
        ]
        expected = INERTIALS[link].mass + sum(INERTIALS[m].mass for m in merged)
        assert model.body(link).mass[0] == pytest.approx(expected)
    assert model.body_mass.sum() == pytest.approx(sum(i.mass for i in INERTIALS.values()))
    assert model.body_mass.sum() == pytest.approx(121.28, abs=0.01)


def test_the_robot_has_no_gravity(model: mujoco.MjModel) -> None:
    data = at(model, REST)
    np.testing.assert_allclose(data.qfrc_passive - data.qfrc_bias, 0.0, atol=1e-9)


@pytest.mark.parametrize("joint", MOVING)
def test_no_self_contact_near_rest(model: mujoco.MjModel, joint: int) -> None:
    low, high = np.clip(
        np.array(ROBOT.joint_limits[joint]), REST[joint] - 1.0, REST[joint] + 1.0
    )
    for value in np.linspace(low, high, 9):
        q = REST.copy()
        q[joint] = value
        assert at(model, q).ncon == 0, (fetch.FETCH_JOINTS[joint], value)


def test_the_arm_feels_the_head(model: mujoco.MjModel) -> None:
    q = REST.copy()
    q[fetch.FETCH_JOINTS.index("elbow_flex_joint")] = -2.2
    touching = {model.body(model.geom_bodyid[c.geom1]).name for c in at(model, q).contact}
    touching |= {
        model.body(model.geom_bodyid[c.geom2]).name for c in at(model, q).contact
    }
    assert {"forearm_roll_link", "head_pan_link"} <= touching


@pytest.mark.parametrize("joint", MOVING)
def test_a_full_delta_neither_rings_nor_passes_its_target(
    model: mujoco.MjModel, joint: int
) -> None:
    low, high = ROBOT.joint_limits[joint]
    start = REST.copy()
    # away from the limits
    start[3] = 0.15
    start[11] = 1.5
    step = 0.03 if "finger" in fetch.FETCH_JOINTS[joint] else 0.1
    target = start.copy()
    target[joint] += step
    assert low <= target[joint] <= high
    if "finger" in fetch.FETCH_JOINTS[joint]:
        target[13:] = target[joint]
    data = at(model, start)
    data.ctrl[3:] = target[3:]
    trace = []
    for _ in range(300):
        mujoco.mj_step(model, data)
        trace.append(data.qpos[addresses(model)][joint])
    done = (np.array(trace) - start[joint]) / step
    overshoot = (
        1.4 if fetch.FETCH_JOINTS[joint] == "torso_lift_joint" else 1.05
    )  # its servo is underdamped
    assert done.max() < overshoot
    assert abs(done[-1] - 1.0) < 0.02


@pytest.mark.parametrize(("joint", "speed"), [(0, 1.0), (1, -1.0), (2, 3.14)])
def test_base_reaches_its_speed(model: mujoco.MjModel, joint: int, speed: float) -> None:
    data = at(model, REST)
    data.ctrl[3:] = REST[3:]
    data.ctrl[joint] = speed
    speeds = []
    for _ in range(80):
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[model.joint(fetch.FETCH_JOINTS[joint]).dofadr[0]] / speed)
    assert max(speeds) < 1.02
    assert speeds[-1] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("q", [0.0, 0.015, 0.05])
def test_opening_between_the_pads_is_twice_the_joint(
    model: mujoco.MjModel, q: float
) -> None:
    pose = REST.copy()
    pose[13:] = q
    data = at(model, pose)
    hand = data.body(fetch.TCP_LINK)
    faces = []
    for finger in fetch.FINGERS:
        link = finger.link
        opening = np.array(finger.opens)
        (pad, *_), (edge, *_) = (model.geom(f"{link}/{i}").size for i in (0, 1))
        at_pad, at_edge = (
            hand.xmat.reshape(3, 3).T @ (data.geom(f"{link}/{i}").xpos - hand.xpos)
            for i in (0, 1)
        )
        faces += [
            float(opening @ at_pad) - model.geom(f"{link}/0").size[1],
            float(opening @ at_edge) - edge,
        ]
        assert at_pad[0] - pad == pytest.approx(-0.029) and at_edge[
            0
        ] + edge == pytest.approx(0.031)
        assert np.abs([at_pad[2], at_edge[2]]).max() < 1e-9
    np.testing.assert_allclose(faces, q - 0.0004, atol=1e-9)


def _corners(geom: Geom) -> np.ndarray:
    """Corners of the box around a geom, in the link frame."""
    half = (
        geom.size if geom.shape == "box" else (geom.size[0], geom.size[0], geom.size[1])
    )
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array(geom.quat))
    return signs * half @ turn.reshape(3, 3).T + geom.pos


@pytest.mark.parametrize("link", list(COLLISION))
def test_collision_shapes_stay_within_the_visual_mesh(link: str) -> None:
    seen = np.concatenate(
        [mesh.vertices for name, mesh, _ in fetch_visuals.robot_meshes() if name == link]
    )
    shape = np.concatenate([_corners(geom) for geom in COLLISION[link]])
    assert (shape.min(0) >= seen.min(0) - 1.5e-3).all()
    assert (shape.max(0) <= seen.max(0) + 1.5e-3).all()


def test_robot_meshes_are_sound_and_materials_known() -> None:
    parts = fetch_visuals.robot_meshes()
    assert {name for name, _, _ in parts} == set(fetch.LINKS)
    for name, mesh, material in parts:
        assert material in ROBOT.materials
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices), name
        assert np.abs(mesh.vertices).max() < 1.0
    assert sum(len(mesh.faces) for _, mesh, _ in parts) < 25_000


def test_missing_mesh_package_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MjhabError, match=r"pip install .*gymnasium-robotics"):
        fetch_visuals.robot_meshes.__wrapped__()


def test_reading_the_meshes_does_not_import_their_package() -> None:
    code = (
        "import sys; from mjhab.robots.fetch.visuals import robot_meshes; robot_meshes(); "
        "sys.exit('gymnasium_robotics' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
