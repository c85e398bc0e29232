"""Stops of furniture take the speed of what hits them on both engines."""

from __future__ import annotations

import numpy as np

from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.missing import need_warp
from tests.warp_device import TEST_DEVICE

need_warp()

HOME = "builtin_m3_20"
STEPS = 14
"""Control steps [0.05 s]."""
SPEED = 1.0
"""Of every drawer, and three times as much of every door [m/s, rad/s]."""


def test_links_do_not_bounce_and_a_door_stops_at_the_wall() -> None:
    """World 0 throws every drawer and door shut, world 1 open; the fridge of this home opens against a wall."""
    from mjhab.sim.warp.simulator import WarpSimulator

    layout = Layout(open_pack("builtin"), ("024_bowl",), None, "published")
    cpu = CpuSimulator(layout, 2, 1)
    warp = WarpSimulator(layout, 2, TEST_DEVICE)
    a = cpu.addresses
    model = cpu.model(HOME)
    ends = np.array([ref.link.range for ref in layout.links])
    speed = np.where(
        [ref.link.joint == "hinge" for ref in layout.links], 3 * SPEED, SPEED
    )
    limits = dict(layout.pack.homes_by_name[HOME].open_limits)
    stops = np.array([limits.get(ref.id, ref.link.range[1]) for ref in layout.links])
    qpos = np.tile(model.qpos0, (2, 1))
    qpos[:, a.robot_q[:2]] = 15.0
    qpos[0, a.link_q] = 0.1
    qpos[1, a.link_q] = stops - 0.1
    states = []
    for sim in (cpu, warp):
        sim.reset([0, 1], [HOME, HOME], qpos)
        for world, way in ((0, -1.0), (1, 1.0)):
            saved = sim.get_world(world)
            thrown = np.array(saved["qvel"])
            thrown[a.link_v] = way * speed
            state = {**saved, "qvel": thrown}
            sim.set_world(world, HOME, state)
        fastest_back = np.zeros(len(ends))
        for _ in range(STEPS):
            sim.step(np.zeros((2, model.nu)))
            moving = np.asarray(sim.state().link_qd)
            fastest_back = np.maximum(fastest_back, np.maximum(moving[0], -moving[1]))
        where = np.asarray(sim.state().link_q)
        assert (fastest_back <= 0.02 * speed).all(), (sim, fastest_back)
        assert (np.abs(where[0] - ends[:, 0]) < 0.05).all()
        assert (np.abs(where[1] - stops) < 0.06).all()
        states.append(where)
    np.testing.assert_allclose(states[0], states[1], atol=1e-3)
