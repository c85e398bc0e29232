"""Compiled models of homes: shared between simulators that need the same, and between those only."""

from __future__ import annotations

from dataclasses import replace

from mjhab.layout.compile import compile_home
from mjhab.layout.home_models import HomeModels
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.parts import Drives
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Geom
from tests.refusals import refused


def test_robots_with_other_stiff_servos_have_models_of_their_own():
    pack = open_pack("builtin")
    stiff = replace(ROBOT.stiff_gains, kp=2.0 * ROBOT.stiff_gains.kp)
    robots = (ROBOT, replace(ROBOT, stiff_gains=stiff))
    drives = Drives(stiff=ROBOT.body_joints)
    home = pack.homes[0].name
    servo = ROBOT.body_joints[0]
    gains = [
        HomeModels(Layout(pack, (), robot), drives)(home).actuator(servo).gainprm[0]
        for robot in robots
    ]
    assert gains == [robot.stiff_gains.kp for robot in robots]
    again = HomeModels(Layout(pack, (), ROBOT), drives)(home)
    assert again is HomeModels(Layout(pack, (), ROBOT), drives)(home)


def test_a_home_that_mujoco_refuses_is_named() -> None:
    pack = open_pack("builtin")
    home = pack.homes[0]
    flat = replace(home, walls=(Geom("box", (0.0, 1.0, 1.0)), *home.walls))
    layout = Layout(replace(pack, homes=(flat,)), ())
    with refused(where=f"home '{home.name}'", said="does not compile"):
        compile_home(layout, flat)
