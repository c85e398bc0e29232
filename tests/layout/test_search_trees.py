"""Search trees that are built anew: the same contacts, fewer boxes on the way."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.layout.model_spec import build_spec
from mjhab.layout.search_trees import FAR_M, GROWN_M
from mjhab.scenes.packs import open_pack

HOME = "builtin_m1_02"
POSES = 40
STEPS = 60


@pytest.fixture(scope="module")
def models() -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """A home as MuJoCo compiles it, and as the simulator gets it."""
    pack = open_pack("builtin")
    layout = Layout(pack, ())
    home = pack.homes_by_name[HOME]
    return build_spec(layout, home).compile(), compile_home(layout, home)


def _tree(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, ...]:
    rows = slice(
        model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body]
    )
    return model.bvh_child[rows], model.bvh_aabb[rows], model.bvh_nodeid[rows]


def test_every_geom_is_a_leaf_and_every_box_holds_those_below(
    models: tuple[mujoco.MjModel, mujoco.MjModel],
) -> None:
    before, after = (_tree(model, 0) for model in models)
    children, boxes, geoms = after
    assert sorted(geoms[geoms >= 0]) == sorted(before[2][before[2] >= 0])
    seen = []
    waiting = [0]
    while waiting:
        row = waiting.pop()
        seen.append(row)
        for child in children[row][children[row] >= 0].tolist():
            waiting.append(child)
            # A box that is no leaf is grown by a little more than it needs.
            spare = 0.0 if geoms[child] >= 0 else 2.0 * GROWN_M
            half = boxes[row, 3:] + spare
            low, high = (boxes[child, :3] + sign * boxes[child, 3:] for sign in (-1, 1))
            assert (boxes[row, :3] - half <= low).all()
            assert (boxes[row, :3] + half >= high).all()
    assert sorted(seen) == list(range(len(children)))
    # Nothing but the root is endless: the floor hangs there.
    assert (boxes[:, 3:].max(axis=1) > FAR_M).tolist()[1:].count(True) == 1


def _contacts(model: mujoco.MjModel, data: mujoco.MjData) -> list[np.ndarray]:
    found = data.contact
    return [np.array(found.geom), np.array(found.dist), np.array(found.pos)]


def test_contacts_and_steps_have_the_same_bits(
    models: tuple[mujoco.MjModel, mujoco.MjModel],
) -> None:
    plain = models[0]
    anew = copy.deepcopy(plain)
    for name in ("bvh_child", "bvh_aabb", "bvh_nodeid", "bvh_depth"):
        assert not np.array_equal(getattr(anew, name), getattr(models[1], name))
        getattr(anew, name)[:] = getattr(models[1], name)
    random = np.random.default_rng(0)
    touching = 0
    for _ in range(POSES):
        pose = plain.qpos0.copy()
        # The base anywhere in the home, the arm anyhow: into furniture, too.
        pose[:3] += random.uniform([-4.0, -4.0, -3.0], [4.0, 4.0, 3.0])
        pose[3:15] += random.uniform(-1.0, 1.0, 12)
        states = []
        for model in (plain, anew):
            data = mujoco.MjData(model)
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            found = _contacts(model, data)
            for _ in range(STEPS if touching < 5 else 1):
                mujoco.mj_step(model, data)
            states.append([*found, data.qpos.copy(), data.qvel.copy()])
        for one, other in zip(*states, strict=True):
            assert np.array_equal(one, other, equal_nan=True)
        touching += len(states[0][0]) > 0
    assert touching > POSES // 2
