"""Links from an MJCF file: frames become parallel, joints count from the posture that is asked for."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjhab.core.errors import MjhabError
from mjhab.robots.kinematics import Chain, ChainRoot
from mjhab.robots.mjcf import MeshGeom, MjcfLinks, boxes_around

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="shoulder" pos="0 0 0.3">
      <inertial pos="0 0 0.1" mass="2" diaginertia="0.1 0.2 0.3"/>
      <joint name="turn" axis="0 0 1" range="-1 1"/>
      <body name="arm" pos="0.1 0 0" quat="0.707106781 -0.707106781 0 0">
        <inertial pos="0 -0.2 0" mass="1" diaginertia="0.1 0.2 0.3"/>
        <joint name="lift" axis="0 0 1" range="-2 0.5"/>
        <body name="hand" pos="0 -0.4 0" quat="0.707106781 0 0 0.707106781">
          <inertial pos="0 0 0" mass="0.5" diaginertia="0.1 0.1 0.1"/>
          <joint name="slide" type="slide" axis="0 1 0" range="-0.04 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
ZERO = {"lift": np.pi / 2}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


def test_the_chain_agrees_with_mujoco(file: Path) -> None:
    links = MjcfLinks(file, "shoulder", zero=ZERO, flipped=("slide",))
    rows = links.tree("base", (0.0, 0.0, 0.3))
    order = ("turn", "lift", "slide")
    chain = Chain.from_tree(rows, order, tip="hand", root=ChainRoot("base", moves=False))
    assert rows[1].limits == pytest.approx((-2 - np.pi / 2, 0.5 - np.pi / 2))
    assert rows[2].limits == pytest.approx((0.0, 0.04))
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    for q in random.uniform(-0.5, 0.5, (5, 3)):
        data.qpos[:] = q[0], q[1] + ZERO["lift"], -q[2]
        mujoco.mj_kinematics(model, data)
        pos, rot = chain.tip_pose(q)
        np.testing.assert_allclose(pos[0], data.body("hand").xpos, atol=1e-5)
        own = data.body("hand").xmat.reshape(3, 3) @ links.rot("hand").T
        np.testing.assert_allclose(rot[0], own, atol=1e-6)


def test_masses_are_turned_with_their_links(file: Path) -> None:
    links = MjcfLinks(file, "shoulder", zero={"lift": 0.0})
    arm = links.inertials()["arm"]
    assert arm.mass == 1.0 and arm.com == pytest.approx((0.0, 0.0, 0.2))
    assert arm.inertia[:3] == pytest.approx((0.1, 0.3, 0.2))


def test_what_is_no_robot_of_ours_is_said(file: Path, tmp_path: Path) -> None:
    with pytest.raises(MjhabError, match="does not exist"):
        MjcfLinks(tmp_path / "none.xml", "shoulder")
    with pytest.raises(MjhabError, match="'slide' is not along x, y or z"):
        MjcfLinks(file, "shoulder", zero={"lift": 0.3}).tree("base", (0.0, 0.0, 0.0))


def test_boxes_cover_a_mesh(tmp_path: Path) -> None:
    stl = tmp_path / "cone.stl"
    import trimesh

    cone = trimesh.creation.cone(0.1, 0.4)
    cone.export(stl)
    mesh = MeshGeom("link", stl, np.eye(3), np.zeros(3), (1.0, 1.0, 1.0, 1.0), 0)
    boxes = boxes_around(mesh, 4)
    points = cone.sample(2000, seed=0)
    inside = np.zeros(len(points), bool)
    for box in boxes:
        inside |= (np.abs(points - box.pos) <= np.array(box.size) + 2e-3).all(axis=1)  # pyright: ignore[reportOperatorIssue]
    assert inside.all()
    # Slices follow the shape: the tip has a small box.
    assert boxes[-1].size[0] < 0.5 * boxes[0].size[0]
