"""The table of physics in docs/ms_hab.md says what the models and the code have."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from mjhab.core.timing import SUBSTEPS, TIMESTEP_SECONDS
from mjhab.layout import joints
from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.layout.model_spec import OBJECT_FRICTION, SLIDING_FRICTION
from mjhab.robots import model as robot_model
from mjhab.robots.fetch import geometry
from mjhab.robots.fetch import model as fetch
from mjhab.scenes.builtin.objects import MASSES
from mjhab.scenes.packs import open_pack

PAGE = Path(__file__).parents[2] / "docs" / "ms_hab.md"
DOOR = "fridge/top_door"
DRAWER = "kitchen_counter/drawer3"


@pytest.fixture(scope="module")
def published() -> mujoco.MjModel:
    pack = open_pack("builtin")
    return compile_home(Layout(pack, (), None, "published"), pack.homes[0])


def rows() -> dict[str, list[str]]:
    """Cells of the table by its first column."""
    text = PAGE.read_text(encoding="utf-8").split("## Physics: ours")[1]
    found = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and len(cells) == 4:
            found[cells[0]] = cells
        if line.startswith(("## ", "Success once")):
            break
    del found["what"]
    return found


def test_every_row_says_what_differs() -> None:
    table = rows()
    assert len(table) > 30 and all(all(cells) for cells in table.values())


def test_joints_are_as_told(published: mujoco.MjModel) -> None:
    table = rows()
    for term, name, ours in (
        ("damping", "damping of drawers, doors", ("SLIDE_DAMPING", "HINGE_DAMPING")),
        (
            "frictionloss",
            "dry friction of drawers, doors",
            ("SLIDE_FRICTION", "HINGE_FRICTION"),
        ),
    ):
        _, here, original, why = table[name]
        for link in (DRAWER, DOOR):
            value = float(getattr(published.joint(link), term)[0])
            assert here.startswith(f"{value:g} ") and f"{value:g} " in original
        for constant in ours:
            assert f"{getattr(joints, constant)} N" in why
    _, here, _, why = table["armature of drawers, doors"]
    assert here == str(float(published.joint(DOOR).armature[0]))
    assert f"{joints.JOINT_ARMATURE} kg" in why
    stops = table["stops of drawers, doors"][1]
    assert "solref {}, {}".format(*joints.STOP_SOLREF) in stops
    assert "solimp {}, {}".format(*joints.STOP_SOLIMP) in stops
    masses = table["masses of drawers, doors"][1]
    for links in ("kitchen_counter", "fridge"):
        for link in open_pack("builtin").articulations[links].links:
            assert f"{link.mass}" in masses


def test_the_robot_is_as_told() -> None:
    table = rows()
    gains = table["robot: gains"][1]
    for group in (fetch.ARM_GAINS, fetch.BODY_GAINS, fetch.GRIPPER_GAINS):
        assert f"{group.kp}, {group.kd}, {group.force} N" in gains
    assert f"base {fetch.BASE_GAINS.kd}, {fetch.BASE_GAINS.force} N" in gains
    assert table["robot: armature"][1] == (
        f"arm, torso, head {fetch.ARM_GAINS.armature}, fingers {fetch.GRIPPER_GAINS.armature}, "
        f"base {fetch.BASE_GAINS.armature}"
    )
    assert fetch.ARM_GAINS == fetch.BODY_GAINS
    finger = geometry.INERTIALS["r_gripper_finger_link"].inertia[0]
    assert f"xx of a finger {finger}" in table["robot: masses, inertias, joint limits"][1]
    assert table["base above the floor"][1] == f"{fetch.BASE_HEIGHT} m"


def test_contact_and_solver_are_as_told(published: mujoco.MjModel) -> None:
    table = rows()
    pads = robot_model.PAD_FRICTION
    friction = table["friction"][1]
    assert friction.startswith(f"{SLIDING_FRICTION} of everything, pads {pads[0]} ")
    assert f"torsional {pads[1]} m of pads, {OBJECT_FRICTION[1]} m" in friction
    assert f"rolling {OBJECT_FRICTION[2]} m" in friction
    told = table["contact of pads"][1]
    assert "solref {}, {}".format(*robot_model.PAD_SOLREF) in told
    assert "solimp {}, {}".format(*robot_model.PAD_SOLIMP[:2]) in told
    option = published.opt
    assert table["time step, control"][1] == f"{TIMESTEP_SECONDS} s, {SUBSTEPS} of them"
    assert option.timestep == TIMESTEP_SECONDS
    assert option.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert table["solver"][1] == (
        f"Newton, {option.iterations} iterations, elliptic cones, impratio {option.impratio:g}"
    )
    assert table["sleep"][1].startswith(f"below {option.sleep_tolerance} m/s")
    assert table["gravity"][1] == f"{-option.gravity[2]:g} m/s²"
    for link in ("base_link", "gripper_link"):
        assert published.body_gravcomp[published.body(link).id] == 1.0
    for mass in MASSES.values():
        assert f" {mass}" in table["masses of the ten objects"][1]
