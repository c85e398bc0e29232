"""The compiled checks of hand and joints: the bits of the array functions that define them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjhab.tasks.host_checks import HostBodyCheck
from mjhab.tasks.measure import active_entries, check_body
from mjhab.tasks.plan import PlanArrays, SubtaskKind
from mjhab.tasks.signals import Active
from mjhab.tasks.thresholds import TaskConfig
from tests.tasks.build import REST, config_of, plan_of, resting

WORLDS = 7
ENDLESS = tuple(joint in (4, 8, 10, 12) for joint in range(15))
CONFIGS = {
    "plain": config_of(),
    "endless": dataclasses.replace(
        config_of(endless=ENDLESS), ee_rest_pos=(0.5, 0.1, 1.25)
    ),
    "published": config_of(stillness="published"),
}


def of_all_worlds(plan: PlanArrays, worlds: int, config: TaskConfig) -> Active:
    """The first subtask of the plan of one world, active in several."""
    rows = {f.name: getattr(plan, f.name) for f in dataclasses.fields(plan)}
    many = {
        name: None if row is None else np.repeat(row, worlds, axis=0)
        for name, row in rows.items()
    }
    return active_entries(
        dataclasses.replace(plan, **many), np.zeros(worlds, np.int64), config
    )


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from((1e-3, 0.1, 1.0, 40.0)))
def test_the_compiled_checks_have_the_bits_of_the_array_functions(
    config: TaskConfig, seed: int, spread: float
) -> None:
    """States near their thresholds and far from them, hands that press, numbers that are not finite."""
    rng = np.random.default_rng(seed)

    def drawn(*shape: int) -> np.ndarray:
        values = rng.normal(0.0, spread, (WORLDS, *shape))
        values[rng.random(values.shape) < 0.01] = rng.choice((np.nan, np.inf, 0.0))
        return values

    state = resting(worlds=WORLDS)
    base = drawn(3)
    direction = state.finger_dir + 0.3 * drawn(2, 3)
    state = dataclasses.replace(
        state,
        base_pose=base,
        robot_q=np.asarray(REST) + drawn(15),
        robot_qd=0.1 * drawn(15),
        tcp_pos=state.tcp_pos + np.pad(base[:, :2], ((0, 0), (0, 1))) + drawn(3),
        finger_force=direction * rng.uniform(-1.0, 3.0, (WORLDS, 2, 1)),
        held_force=direction * rng.uniform(-1.0, 3.0, (WORLDS, 2, 1)),
        finger_dir=state.finger_dir,
    )
    kind = SubtaskKind(int(rng.integers(len(SubtaskKind))))
    plan = plan_of(kind, config=config, must_hold=kind == SubtaskKind.NAVIGATE)
    active = of_all_worlds(plan, WORLDS, config)
    with np.errstate(invalid="ignore", over="ignore"):
        wanted = check_body(state, active, config)
        found = HostBodyCheck(config)(state, active, config)
    for field in dataclasses.fields(wanted):
        rows = getattr(wanted, field.name)
        np.testing.assert_array_equal(getattr(found, field.name), rows, field.name)


def test_the_drawn_states_reach_both_sides_of_every_check() -> None:
    """Otherwise the test above would compare constants."""
    config = CONFIGS["plain"]
    rng = np.random.default_rng(0)
    worlds = 200
    state = resting(worlds=worlds)
    wide = rng.choice((0.0, 1.0), (worlds, 1))
    state = dataclasses.replace(
        state,
        robot_q=state.robot_q + wide,
        robot_qd=state.robot_qd + wide,
        tcp_pos=state.tcp_pos + wide,
        finger_force=state.finger_dir * wide[:, :, None],
    )
    plan = plan_of(SubtaskKind.PICK, config=config)
    active = of_all_worlds(plan, worlds, config)
    found = HostBodyCheck(config)(state, active, config)
    for name in ("is_grasped", "contact", "ee_rest", "robot_rest", "is_static"):
        assert 0 < getattr(found, name).sum() < worlds, name
