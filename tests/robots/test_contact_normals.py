"""The base of a robot meets edges of furniture with the right normal and the right depth, on the CPU."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.model import add_robot, physics_options, prism

LEG_HALF = 0.0275
"""Half width of a square table leg [m]."""
DEPTH = 0.010
DIRECTIONS = 48


def contacts_with_leg(reach: float, angle: float) -> list[tuple[float, np.ndarray]]:
    """Distance [m] and normal of the base's contacts with a leg at the origin, ``reach`` from its axis."""
    spec = mujoco.MjSpec()
    physics_options(spec)
    spec.worldbody.add_geom(
        name="leg",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[LEG_HALF, LEG_HALF, 0.357],
        pos=[0, 0, 0.357],
        contype=-1 & 0x7FFFFFFF,
        conaffinity=-1 & 0x7FFFFFFF,
    )
    add_robot(spec, ROBOT)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:2] = reach * np.cos(angle), reach * np.sin(angle)
    mujoco.mj_forward(model, data)
    cylinder = model.geom("base_link/0").id
    return [
        (float(c.dist), c.frame[:3] * (1 if c.geom[0] == cylinder else -1))
        for c in data.contact
        if cylinder in c.geom
    ]


@pytest.mark.parametrize("angle", np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS + 0.03)
def test_the_base_meets_a_leg_along_the_shortest_way(angle: float) -> None:
    radius = ROBOT.body.collision["base_link"][0].size[0]
    way = np.array([np.cos(angle), np.sin(angle)])
    low, high = 0.0, 1.0
    for _ in range(50):
        reach = (low + high) / 2
        gap = np.linalg.norm(reach * way - np.clip(reach * way, -LEG_HALF, LEG_HALF))
        low, high = (reach, high) if gap < radius - DEPTH else (low, reach)
    nearest = np.clip(reach * way, -LEG_HALF, LEG_HALF)
    outwards = (reach * way - nearest) / np.linalg.norm(reach * way - nearest)
    found = contacts_with_leg(reach, angle)
    assert found
    for distance, normal in found:
        off = np.degrees(np.arccos(np.clip(-normal[:2] @ outwards, -1, 1)))
        assert off < 10.0 and abs(distance + DEPTH) < 0.003


def test_a_prism_has_the_volume_of_its_cylinder() -> None:
    corners = prism(0.264, 0.1745)[:24, :2]
    area = 0.5 * abs(
        np.sum(corners[:, 0] * np.roll(corners[:, 1], -1))
        - np.sum(corners[:, 1] * np.roll(corners[:, 0], -1))
    )
    assert area == pytest.approx(np.pi * 0.264**2)
    assert np.linalg.norm(corners, axis=1).max() < 0.264 * 1.006
