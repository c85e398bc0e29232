"""What the tests of the GPU simulator begin with: worlds of a can and a box on three homes."""

from __future__ import annotations

import mujoco
import numpy as np

from mjhab.layout.layout import Layout
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos, settle
from mjhab.sim.protocol import TAINTS
from tests.warp_device import check_repeated

CAN = 0
BOX = 1
ROSTER = ("005_tomato_soup_can", "004_sugar_box")
WORLDS = 3


def chosen(layout: Layout) -> list[Home]:
    """The home of each world: with other rooms, not only other furniture."""
    homes = layout.pack.homes
    return [homes[0], homes[len(homes) // 2], homes[-1]]


def homes_of(layout: Layout, count: int = WORLDS) -> list[str]:
    return [home.name for home in chosen(layout)[:count]]


def on_table(layout: Layout, world: int) -> np.ndarray:
    """A point (3,) on the first dining table of a world's home."""
    at = next(p for p in chosen(layout)[world].props if p.template == "table_01")
    return np.array(
        [at.pos[0], at.pos[1], layout.pack.props["table_01"].receptacles[0].pos[2]]
    )


def up(height: float) -> np.ndarray:
    return np.array([0.0, 0.0, height])


def put(sim: CpuSimulator, qpos: np.ndarray, slot: int, pos: np.ndarray) -> None:
    start = sim.addresses.object_q[slot]
    qpos[start : start + 3] = pos


def starts(cpu: CpuSimulator, drop: float = 0.0) -> np.ndarray:
    """(W, nq): the robot out of the way, the can on the table of each world's home, ``drop`` [m] above it."""
    rows = []
    for i, home in enumerate(homes_of(cpu.layout)):
        qpos = cpu.model(home).qpos0.copy()
        qpos[cpu.addresses.robot_q] = parked_robot_qpos(ROBOT)
        put(cpu, qpos, CAN, on_table(cpu.layout, i) + up(cpu.layout.objects[CAN].half[2]))
        qpos = settle(cpu.model(home), cpu.addresses, qpos)[0]
        qpos[cpu.addresses.object_q[CAN] + 2] += drop
        rows.append(qpos)
    return np.stack(rows)


def holding(cpu: CpuSimulator, home: str) -> tuple[np.ndarray, np.ndarray]:
    """A state (nq,) with the can held by a robot far outside, and the ctrl (nu,) that holds it."""
    model = cpu.model(home)
    a = cpu.addresses
    data = mujoco.MjData(model)
    robot = parked_robot_qpos(ROBOT)
    robot[13:15] = 0.0345
    data.qpos[a.robot_q] = robot
    mujoco.mj_kinematics(model, data)
    body = a.robot_body["gripper_link"]
    turn = np.zeros(4)
    mujoco.mju_mulQuat(
        turn, data.xquat[body], np.array([np.sqrt(0.5), 0, -np.sqrt(0.5), 0])
    )
    start = a.object_q[CAN]
    data.qpos[start : start + 7] = [*data.xpos[body], *turn]
    ctrl = data.ctrl[:] = hold(cpu, data.qpos, fingers=-0.01)
    mujoco.mj_step(model, data, 150)
    return data.qpos.copy(), ctrl.copy()


def hold(cpu: CpuSimulator, qpos: np.ndarray, fingers: float | None = None) -> np.ndarray:
    """(nu,) commands that keep the robot of a state where it is."""
    model = cpu.model(homes_of(cpu.layout)[0])
    joints = model.actuator_trnid[:, 0]
    ctrl = np.where(
        model.actuator_biasprm[:, 1] != 0.0, qpos[model.jnt_qposadr[joints]], 0.0
    )
    if fingers is not None:
        ctrl[-2:] = fingers
    return ctrl


def bits_of(taint: np.ndarray) -> list[set[str]]:
    return [
        {name for i, name in enumerate(TAINTS) if int(mask) >> i & 1} for mask in taint
    ]


def rows_of(sim, world: int) -> list[np.ndarray]:
    """Everything of one world that a reset of another must keep."""
    engine = sim.engine
    state = sim.state()
    arrays = [
        engine.qpos_t,
        engine.qvel_t,
        engine.warmstart_t,
        engine.ctrl_t,
        engine.time_t,
        engine.asleep_t,
    ]
    arrays += [
        state.link_force,
        state.finger_force,
        state.finger_net,
        state.touch,
        state.tcp_vel,
    ]
    arrays += [state.body_pos, state.body_mat, state.body_quat, sim.taint()]
    return [array[world].numpy().copy() for array in arrays]


def bits(rows: list[np.ndarray]) -> list[bytes]:
    """To compare what nothing has computed anew."""
    return [row.tobytes() for row in rows]


def check_rows_repeated(ours: list[np.ndarray], theirs: list[np.ndarray]) -> None:
    """See `check_repeated`."""
    for number, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        check_repeated(a, b, f"row {number} of rows_of")
