"""Published stillness and rewards against a plain port of the original's formulas, on numpy and on torch.

The port is written for one world with scalars, after mshab/envs/sequential_task.py, open.py, close.py and
mani_skill/agents/robots/fetch/fetch.py.
"""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from math import tanh
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.arrays import map_record
from mjhab.tasks.measure import measure
from mjhab.tasks.progress import start
from mjhab.tasks.rewards.table import RewardView
from mjhab.tasks.scoring import DenseReward, RewardOptions
from tests.refusals import refused
from tests.tasks.build import CONFIG, REST, plan_of, resting, to_torch
from tests.tasks.rewards.states import (
    BEST,
    CLOSE,
    NAVIGATE,
    OPEN,
    PICK,
    PLACE,
    RANDOM,
    view_of,
)

PUBLISHED = replace(CONFIG, stillness="published")
OPTIONS = RewardOptions(formula="published", normaliser="published")
WHOLE = {PICK: 28.0, PLACE: 44.0, NAVIGATE: 28.0, OPEN: 27.0, CLOSE: 37.0}
IDEAL = 1.0
OPEN_SHARE = 0.9
LOW = 0.0
HIGH = 0.5
"""A drawer: ideal speed [m/s], share of its range that counts as open, range [m]."""


@dataclasses.dataclass
class State:
    """One world as the original sees it; ``force``: cumulative [N x steps], ``distance``: hand to handle [m]."""

    q: np.ndarray
    qvel: np.ndarray
    tcp: np.ndarray
    joint: float
    joint_speed: float
    distance: float
    torso: float
    grasped: bool
    closed_near: bool
    force: float

    @property
    def ee(self) -> float:
        """Distance of the tool centre from its rest point; the base is at the origin."""
        return float(np.linalg.norm(self.tcp - np.array([0.5, 0.0, 1.27])))

    @property
    def posture(self) -> float:
        return float(np.linalg.norm(self.q[3:13] - np.array(REST)[3:13]))

    @property
    def at_rest(self) -> bool:
        off = np.abs(self.q[3:13] - np.array(REST)[3:13])
        return bool(off[0] < 0.01 and off[1:].max() < 0.2 and self.ee <= 0.05)

    @property
    def still(self) -> bool:
        return bool((self.qvel[3:13] <= 0.2).all() and (self.qvel[:3] <= 0.05).all())

    @property
    def calm(self) -> float:
        return 1 - tanh(float(np.linalg.norm(self.qvel[:13])))


def original_open(s: State) -> float:
    target = OPEN_SHARE * (HIGH - LOW) + LOW
    opened = s.joint > target
    reward = 6.0 if opened else 5.0 if s.grasped else 3 * (1 - tanh(s.distance))
    reward += 6 * (1 - max((target - s.joint) / (target - LOW), 0))
    reward += 3 * (s.joint > LOW + 0.01) + 3 * (s.joint_speed <= IDEAL)
    if opened:
        reward += 2 * (1 - tanh(s.posture)) + s.torso + 2 * (1 - tanh(s.ee))
        if s.at_rest:
            reward += s.calm
        if s.at_rest and s.still and s.force < 10000:
            reward += 3
    return reward


def original_close(s: State) -> float:
    target = 0.01 * (HIGH - LOW) + LOW
    reward = 8.0 if s.closed_near else 7.5 if s.grasped else 7 * (1 - tanh(s.distance))
    reward += 5 * (1 - max((s.joint - target) / (HIGH - target), 0)) + 5 * (
        abs(s.joint_speed) <= IDEAL
    )
    arm = 1 - (tanh(s.posture) + tanh(s.posture / 5)) / 2
    reward += 10 * arm if s.closed_near else arm
    if s.closed_near:
        reward += s.torso + 2 - (tanh(s.ee) + tanh(3 * s.ee))
        if s.at_rest:
            reward += 2 * s.calm
        if s.at_rest and s.still and s.force < 10000 and s.joint < target:
            reward += 3
    return reward


def drawn(kind: int, seed: int) -> tuple[State, RewardView]:
    """A world that is at its best but for some quantities, as the port sees it and as ours does."""
    rng = np.random.default_rng(seed)
    over = dict(BEST[kind])
    # Stillness is what differs: one time in two the robot moves backwards only.
    over["robot_qd"] = rng.normal(0, 0.3, 15) * (rng.random() < 0.7)
    if rng.random() < 0.5:
        over["robot_qd"] = -np.abs(over["robot_qd"])
    over["joint_q"] = (
        rng.uniform(-0.05, 0.55)
        if rng.random() < 0.6
        else {OPEN: 0.47, CLOSE: 0.002}[kind]
    )
    over["joint_qd"] = rng.normal(0, 1.5)
    over["torso_up"] = rng.uniform(-0.1, 1.1)
    over["handle_distance"] = rng.exponential(0.5)
    over["joint_ideal"] = IDEAL
    for name in ("tcp_pos", "robot_q", "finger_force"):
        if rng.random() < 0.4:
            over[name] = RANDOM[name](rng)
    force = rng.exponential(5000)
    view = view_of([kind], PUBLISHED, force=force, **over)
    # In the course of an episode the link is closed near only while it is closed.
    near = bool(rng.random() < 0.7) and bool(view.signals.closed[0])
    view = replace(view, closed_near=np.array([near]))
    world = view.world
    state = State(
        world.robot_q[0],
        world.robot_qd[0],
        world.tcp_pos[0],
        float(world.joint_q[0]),
        float(view.joint_qd[0]),
        float(view.handle_distance[0]),
        float(view.torso_up[0]),
        bool(view.signals.is_grasped[0]),
        near,
        force,
    )
    return state, view


def as_torch(record: Any) -> Any:
    return map_record(
        lambda x: (
            as_torch(x) if dataclasses.is_dataclass(x) else torch.from_numpy(np.array(x))
        ),
        record,
    )


@pytest.mark.parametrize("cast", [lambda view: view, as_torch], ids=["numpy", "torch"])
@pytest.mark.parametrize(
    ("kind", "original"), [(OPEN, original_open), (CLOSE, original_close)]
)
@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_open_and_close_earn_what_the_original_gives(
    kind: int, original: Any, cast: Any, seed: int
) -> None:
    state, view = drawn(kind, seed)
    scored = DenseReward(PUBLISHED, OPTIONS).score(cast(view))
    assert float(scored.total[0]) == pytest.approx(original(state), abs=1e-11)
    assert float(scored.normaliser[0]) == WHOLE[kind]


def test_the_states_reach_what_differs() -> None:
    """The property above would say little if its states never came to where the two formulas part."""
    ours = {kind: DenseReward(CONFIG) for kind in (OPEN, CLOSE)}
    theirs = DenseReward(PUBLISHED, OPTIONS)
    for kind, wanted in ((OPEN, {"gentle", "progress"}), (CLOSE, {"progress"})):
        differ: set[str] = set()
        for seed in range(300):
            _, view = drawn(kind, seed)
            one = ours[kind].score(view).terms[:, 0]
            two = theirs.score(view).terms[:, 0]
            differ |= {
                name for name, a, b in zip(theirs.names, one, two, strict=True) if a != b
            }
        assert differ == wanted
    backwards = [drawn(OPEN, seed) for seed in range(300)]
    assert any(
        state.still and np.abs(state.qvel[:13]).max() > 0.2 for state, _ in backwards
    )
    assert any(float(view.signals.success[0]) for _, view in backwards)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32), kind=st.sampled_from([PICK, PLACE, NAVIGATE, OPEN, CLOSE])
)
def test_stillness_is_one_sided_where_published(seed: int, kind: int) -> None:
    qvel = np.random.default_rng(seed).normal(0, 0.12, 15) * np.array(
        [0.3] * 3 + [1.0] * 12
    )
    wanted = {
        "published": bool((qvel[3:13] <= 0.2).all() and (qvel[:3] <= 0.05).all()),
        "absolute": bool(
            (np.abs(qvel[3:13]) <= 0.2).all() and (np.abs(qvel[:3]) <= 0.05).all()
        ),
    }
    for stillness, still in wanted.items():
        view = view_of([kind], replace(CONFIG, stillness=stillness), robot_qd=qvel)
        assert bool(view.signals.is_static[0]) is still
    assert wanted["published"] or not wanted["absolute"]


@pytest.mark.parametrize("stillness", ["absolute", "published"])
def test_torch_measures_the_same_stillness(stillness: str) -> None:
    config = replace(CONFIG, stillness=stillness)
    plan = plan_of(OPEN, config=config)
    progress = start(plan, config)
    for joint in range(13):
        qvel = np.zeros((1, 15))
        qvel[0, joint] = -0.3
        world = resting(robot_qd=qvel)
        ours = measure(world, plan, progress, config)
        theirs = measure(to_torch(world), to_torch(plan), to_torch(progress), config)
        assert (
            bool(ours.is_static[0])
            is bool(theirs.is_static[0])
            is (stillness == "published")
        )


def test_normalisers_are_those_of_the_original() -> None:
    for kind, whole in WHOLE.items():
        assert DenseReward(PUBLISHED, OPTIONS).score(
            view_of([kind])
        ).normaliser.tolist() == [whole]
    scaled = RewardOptions({"pick": {"reach": 50.0}}, normaliser="published")
    assert DenseReward(CONFIG, scaled).score(view_of([PICK])).normaliser.tolist() == [
        28.0
    ]


@pytest.mark.parametrize("bad", [{"formula": "publisht"}, {"normaliser": "largest"}])
def test_unknown_options_are_refused(bad: dict[str, Any]) -> None:
    with refused(f"reward {next(iter(bad))}", *bad.values(), expected="published"):
        RewardOptions(**bad)
    with refused("stillness", "absolut", expected="absolute"):
        replace(CONFIG, stillness="absolut")
