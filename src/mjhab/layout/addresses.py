"""Where the joints, bodies and sensors of a layout are in the models of its homes."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjhab.layout.layout import Layout
from mjhab.robots.robot import Robot


@dataclass(frozen=True, eq=False)
class Addresses:
    """Indices into qpos, qvel, bodies and sensordata, valid for the models of all homes of a layout.

    Letters: J robot joints, N object slots, L moving links, K force links of the robot.

    Attributes:
        robot: the robot of the layout.
        robot_q: (J,) columns of qpos in the order of ``robot.joints``.
        robot_v: (J,) columns of qvel in the same order.
        object_q: (N,) first of the 7 columns of qpos of each object.
        object_v: (N,) first of the 6 columns of qvel of each object.
        object_body: (N,) body ids.
        link_q: (L,) columns of qpos.
        link_v: (L,) columns of qvel.
        link_body: (L,) body ids.
        robot_body: body id by name of the robot link.
        link_force: (K,) first column in sensordata of each force sensor, FORCE_SENSOR_WIDTH wide.
        hand_force: (3,) the same for [left finger, right finger, tcp link].
        touch: (N + L,) first column of the touch sensor of each target (objects, then links), TOUCH_SENSOR_WIDTH wide.
        tcp_velocity: first of 3 columns: velocity of the tcp in the world frame [m/s].
    """

    robot: Robot
    robot_q: np.ndarray
    robot_v: np.ndarray
    object_q: np.ndarray
    object_v: np.ndarray
    object_body: np.ndarray
    link_q: np.ndarray
    link_v: np.ndarray
    link_body: np.ndarray
    robot_body: dict[str, int]
    link_force: np.ndarray
    hand_force: np.ndarray
    touch: np.ndarray
    tcp_velocity: int


def addresses(layout: Layout, model: mujoco.MjModel) -> Addresses:
    """Look up the indices of a layout's joints, bodies and sensors in a compiled model of any of its homes."""

    def joints(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        ids = [model.joint(n).id for n in names]
        return model.jnt_qposadr[ids].copy(), model.jnt_dofadr[ids].copy()

    def sensors(names: list[str]) -> np.ndarray:
        return np.array([model.sensor(n).adr[0] for n in names])

    robot = layout.robot
    robot_q, robot_v = joints(robot.joints)
    object_q, object_v = joints(layout.object_names)
    link_q, link_v = joints(layout.link_ids)
    targets = (*layout.object_names, *layout.link_ids)
    return Addresses(
        robot=robot,
        robot_q=robot_q,
        robot_v=robot_v,
        object_q=object_q,
        object_v=object_v,
        link_q=link_q,
        link_v=link_v,
        object_body=np.array([model.body(n).id for n in layout.object_names]),
        link_body=np.array([model.body(n).id for n in layout.link_ids]),
        robot_body={n: model.body(n).id for n in robot.model_links},
        link_force=sensors([f"force/{n}" for n in robot.force_links]),
        hand_force=sensors([f"hand/{n}" for n in (*robot.finger_links, robot.tcp)]),
        touch=sensors([f"touch>{t}" for t in targets]),
        tcp_velocity=int(model.sensor("tcp_velocity").adr[0]),
    )
