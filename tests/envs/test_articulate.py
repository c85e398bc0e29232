"""Tasks in real homes whose cupboards, cabinet and chest of drawers open too."""

from __future__ import annotations

import numpy as np

from mjhab.envs import make
from mjhab.scenes.pack_source import PackRequest
from tests.real_data import real_data


def test_a_task_runs_beside_furniture_that_it_does_not_use() -> None:
    folder = real_data("replica_cad")
    assets = PackRequest(
        f"{folder}/v3_sc2_staging_00",
        ("kitchen_cupboards", "cabinet", "chest_of_drawers"),
    )
    env = make(
        task="set_table",
        subtask="open",
        target="kitchen_counter/drawer3",
        assets=assets,
        autoreset="disabled",
    )
    env.reset(seed=0)
    others = [
        k
        for k, name in enumerate(env.layout.link_ids)
        if not name.startswith(("fridge/", "kitchen_counter/"))
    ]
    assert len(others) == 16
    for _ in range(5):
        _, _, _, _, info = env.step(np.zeros((1, 13), np.float32))
    assert not info["taint"].any()
    np.testing.assert_allclose(env.sim.state().link_q[0, others], 0.0, atol=1e-3)
