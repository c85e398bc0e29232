"""What opens, opens in physics as far as geometry says."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import FETCH_JOINTS
from mjhab.scenes.builtin.homes import make_home
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.shapes.openings import free_travel
from mjhab.scenes.spec import Geom

PUSH = {"slide": 40.0, "hinge": 12.0}
"""Force [N] on drawers and torque [N m] on doors: what a hand can do."""


@pytest.mark.parametrize("key", [(0, 7), (2, 8), (3, 19), (3, 20), (4, 20)])
def test_a_steady_push_opens_everything(key: tuple[int, int]) -> None:
    home = make_home(*key)
    layout = Layout(dataclasses.replace(builtin_pack(), homes=(home,)), ())
    model = compile_home(layout, home)
    data = mujoco.MjData(model)
    base = [model.joint(name).qposadr[0] for name in FETCH_JOINTS[:2]]
    data.qpos[base] = 15.0  # the robot stands aside and holds still
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    joints = [model.joint(name).id for name in layout.link_ids]
    data.qfrc_applied[model.jnt_dofadr[joints]] = [
        PUSH[ref.link.joint] for ref in layout.links
    ]
    for _ in range(400):
        mujoco.mj_step(model, data)
    limits = dict(home.open_limits)
    ends = np.array([limits.get(ref.id, ref.link.range[1]) for ref in layout.links])
    np.testing.assert_allclose(data.qpos[model.jnt_qposadr[joints]], ends, atol=0.03)
    assert all(
        limit <= free_travel(home, layout.pack)[name] for name, limit in limits.items()
    )


def test_a_box_in_the_way_stops_a_drawer_where_it_stands() -> None:
    """The counter of this home looks along +x; a lower drawer meets a box 30 cm before their handles."""
    home = make_home(0, 0)
    pack = builtin_pack()
    (counter,) = [p for p in home.articulations if p.template == "kitchen_counter"]
    assert counter.yaw == 0.0
    handle = 0.323 + 0.05 + 0.02
    box = Geom(
        "box",
        (0.05, 0.3, 0.1),
        (counter.pos[0] + handle + 0.30 + 0.05, counter.pos[1] + 1.0, 0.45),
    )
    found = free_travel(dataclasses.replace(home, walls=(*home.walls, box)), pack)
    free = free_travel(home, pack)
    changed = {name: found[name] for name in free if found[name] != free[name]}
    assert set(changed) == {"kitchen_counter/drawer4"}
    assert changed["kitchen_counter/drawer4"] == pytest.approx(0.30, abs=1e-3)


def test_a_door_above_a_shelf_swings_free() -> None:
    """The fridge of the hard case on a plinth higher than its wall: nothing is in the way of its doors."""
    home = make_home(3, 20)
    pack = builtin_pack()
    lifted = tuple(
        dataclasses.replace(p, pos=(*p.pos[:2], 2.7)) for p in home.articulations
    )
    free = free_travel(dataclasses.replace(home, articulations=lifted), pack)
    assert (free["fridge/top_door"], free["fridge/bottom_door"]) == (2.3, 2.5)
