"""Robots that stand in the open, outside every home, to try controllers on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from mjhab.layout.layout import Layout
from mjhab.robots.controllers import Controller, make_controller
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.parts import Drives
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState

WORLDS = 8
ARM = list(ROBOT.arm_columns)
BODY = list(ROBOT.body_columns)
BENT = np.array(REST_QPOS)
BENT[[7, 11]] = -0.5, 1.2
"""Rest with shoulder and wrist away from their limits."""
REMEMBERING = (
    "pd_joint_target_delta_pos",
    "pd_ee_target_delta_pos",
    "pd_ee_target_delta_pose",
    "pd_ee_target_delta_pose_maniskill",
    "pd_ee_pose",
    "pd_joint_delta_pos_stiff_body",
)


@lru_cache(maxsize=1)
def layout() -> Layout:
    return Layout(open_pack("builtin"), ("005_tomato_soup_can",))


@lru_cache(maxsize=4)
def simulator(drives: Drives) -> CpuSimulator:
    return CpuSimulator(layout(), WORLDS, 1, drives)


@dataclass
class Bench:
    """A controller on robots that stand in the open, outside every home."""

    sim: CpuSimulator
    controller: Controller
    state: SimState

    def step(self, actions: np.ndarray) -> None:
        self.sim.step(self.controller.ctrl(actions, self.state))
        self.state = self.sim.state()

    def arm(self) -> np.ndarray:
        return self.state.robot_q[:, ARM]

    def tip(self) -> tuple[np.ndarray, np.ndarray]:
        return ROBOT.arm_chain.tip_pose(self.arm())


def bench(mode: str, posture: np.ndarray = BENT, yaw: float = 0.0, **options) -> Bench:
    controller = make_controller(mode, WORLDS, **options)
    sim = simulator(controller.drives)
    home = sim.layout.pack.homes[0].name
    robot = posture.copy()
    robot[:2] = 17.0
    robot[2] = yaw
    qpos = sim.model(home).qpos0.copy()
    qpos[sim.addresses.robot_q] = robot
    sim.batch.bind("qfrc_applied")[:] = 0.0
    sim.reset(range(WORLDS), [home] * WORLDS, np.repeat(qpos[None], WORLDS, axis=0))
    state = sim.state()
    controller.reset(np.ones(WORLDS, bool), state)
    return Bench(sim, controller, state)


def still_state(count: int = WORLDS, posture: np.ndarray = BENT) -> SimState:
    """A state that holds nothing but joint positions."""
    empty = dict.fromkeys(SimState.__dataclass_fields__)
    return replace(SimState(**empty), robot_q=np.repeat(posture[None], count, axis=0))
