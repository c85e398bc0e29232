"""Pick and place by a rule: real episodes, and the property that makes them worth imitating."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts import make_expert
from mjhab.experts.base.ajar import planner
from mjhab.experts.policy import ExpertPolicy
from mjhab.experts.skills import drawer, pick_by_rule, pick_plans, place_by_rule
from mjhab.experts.skills.by_rule import DISTANCES_M
from mjhab.experts.skills.doors import closing
from mjhab.experts.style import StyledView
from mjhab.rollout.loop import rollout
from mjhab.tasks.style import PLAIN, RULE, SEARCH, Styles

BY_RULE = Styles.parse([f"plan={RULE}"])
WORLDS = 4


def build(
    task: str, subtask: str, worlds: int = WORLDS, **options: Any
) -> SequentialTaskEnv:
    return envs.make(
        task=task,
        subtask=subtask,
        num_envs=worlds,
        profile="ms_hab",
        split="train",
        autoreset="disabled",
        threads=1,
        **options,
    )


@lru_cache
def tidy(subtask: str) -> SequentialTaskEnv:
    return build("tidy_house", subtask)


@pytest.mark.parametrize("subtask", ["pick", "place"])
def test_most_episodes_succeed_and_are_recorded_as_by_rule(subtask: str) -> None:
    env = tidy(subtask)
    expert = make_expert(env, BY_RULE)
    records = rollout(env, expert, range(WORLDS), seed=11)
    assert sum(record.success_once for record in records) >= WORLDS - 1
    assert expert.style(0)["plan"] == RULE


@pytest.mark.parametrize("subtask", ["pick", "place"])
def test_what_it_does_hardly_depends_on_what_it_did_before(subtask: str) -> None:
    """An expert that begins in the middle of an episode does what the one does that was there from the start."""

    def difference(styles: Styles) -> float:
        env = tidy(subtask)
        expert = make_expert(env, styles)
        every = np.ones(WORLDS, bool)
        obs, info = env.reset(seed=11)
        expert.reset(every)
        found = []
        for step in range(60):
            actions = expert.act(obs, info)
            if step in (30, 45):
                late: ExpertPolicy = make_expert(env, styles)
                late.reset(every)
                found.append(np.abs(late.act(obs, info) - actions))
            obs, _, _, _, info = env.step(actions)
        return float(np.mean(found))

    by_rule = difference(BY_RULE)
    assert by_rule < 0.1
    assert by_rule < 0.5 * difference(Styles.parse([f"plan={SEARCH}"]))


def test_the_stance_faces_the_object_at_a_fixed_distance() -> None:
    env = tidy("pick")
    env.reset(seed=11)
    for world in range(WORLDS):
        view = env.view(world)
        assert view.subtask is not None
        obj = view.subtask.obj
        found = pick_by_rule.plan(view, obj)
        assert found is not None
        placement, pos, rot = found
        ahead = view.object_pose(obj)[:2] - placement.base[:2]
        assert min(abs(np.linalg.norm(ahead) - d) for d in DISTANCES_M) < 1e-6
        assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(placement.base[2])
        assert np.linalg.norm(pos) < 0.15
        np.testing.assert_allclose(rot @ rot.T, np.eye(3), atol=1e-9)
        assert (
            planner(view, shut=True).clearance_at(placement.base[:2])
            > view.robot.footprint.wide
        )


def stances(
    env: SequentialTaskEnv, plan: str, stance: Callable[[StyledView], np.ndarray]
) -> np.ndarray:
    """Base poses (W, 3) x, y, yaw [m, m, rad] that a plan leads to from the starts of the worlds."""
    found = []
    for world in range(env.num_envs):
        view = StyledView(env, world)
        view.style = replace(PLAIN, plan=plan)
        found.append(stance(view))
    return np.array(found)


def behind_door(view: StyledView) -> np.ndarray:
    path = closing.from_outside(view, view.home.links["fridge/top_door"])
    assert path is not None
    return path.q[0, :3]


def before_drawer(view: StyledView) -> np.ndarray:
    path = drawer._arm_path(view, view.home.links["kitchen_counter/drawer3"])
    assert path is not None
    return path.q[0, :3]


@pytest.mark.parametrize(
    ("subtask", "target", "stance"),
    [
        ("close", "fridge/top_door", behind_door),
        ("open", "kitchen_counter/drawer3", before_drawer),
    ],
)
def test_the_stance_at_furniture_does_not_depend_on_the_start(
    subtask: str, target: str, stance: Callable[[StyledView], np.ndarray]
) -> None:
    env = build("set_table", subtask, 6, target=target, home="builtin_m1_00")
    env.reset(seed=11)
    # Doors and drawers are not open by the same in all starts: the stance goes along with them.
    ruled, searched = (
        np.ptp(stances(env, plan, stance), axis=0) for plan in (RULE, SEARCH)
    )
    assert ruled.max() < 0.1 < 0.5 * searched.max()


def before_shelf(view: StyledView) -> np.ndarray:
    """Relative to the object, which does not lie at the same place in all episodes."""
    assert view.subtask is not None
    obj = view.subtask.obj
    found = pick_plans.plan_pick(view, obj, np.zeros((0, 3)))
    assert found is not None
    place = view.object_pose(obj)
    assert pick_plans.inside_depth(view, place[:3])
    return found[0].at[:3] - np.array([*place[:2], 0.0])


def test_a_shelf_is_entered_straight_where_the_way_is_free() -> None:
    env = build("set_table", "pick", 8, target="013_apple", home="builtin_m1_00")
    env.reset(seed=11)
    ruled, searched = (
        np.unique(
            np.round(stances(env, plan, before_shelf), 2), axis=0, return_counts=True
        )
        for plan in (RULE, SEARCH)
    )
    # The starts nearest to the fridge have no free way to that stance.
    assert ruled[1].max() >= 4 and searched[1].max() == 1
    often = ruled[0][ruled[1].argmax()]
    np.testing.assert_allclose(often[1:], 0.0, atol=0.01)


def test_shelves_are_left_to_the_search() -> None:
    env = build("prepare_groceries", "pick", worlds=1)
    for episode in range(8):
        env.reset(seed=0, options={"episode": [episode]})
        view = env.view(0)
        assert view.subtask is not None
        pose = view.object_pose(view.subtask.obj)
        if pick_by_rule.inside_depth(view, pose[:3]):
            assert pick_by_rule.plan(view, view.subtask.obj) is None
            assert place_by_rule.plan(view, view.subtask.obj, pose[:3]) is None
            return
    raise AssertionError("no episode begins with an object on a shelf")
