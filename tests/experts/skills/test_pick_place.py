"""Pick and place: real episodes from every kind of place, and the parts that plan them."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_rotation_vector
from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.episodes.grasps.candidates import (
    LyingObject,
    ObjectShape,
    PinchOptions,
    grasp_candidates,
)
from mjhab.experts import make_expert
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import held_spheres
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.follower import Follower, PathSegment
from mjhab.experts.base.route import (
    LOOKAHEADS_M,
    LOST_STEPS,
    RouteWish,
    follow,
    plan_route,
)
from mjhab.experts.planning.base_poses import exit_clearance
from mjhab.experts.planning.carry import inside_depth
from mjhab.experts.planning.workplace import ReachScene, surroundings
from mjhab.experts.skills.pick_plans import (
    FREE_OFFSET_M,
    balanced,
    height_below,
    plan_pick,
)
from mjhab.experts.skills.place_goals import Release, hand_goals
from mjhab.robots.fetch.robot import ROBOT
from mjhab.tasks.style import ANY

pick_module = importlib.import_module("mjhab.experts.skills.pick")

UPRIGHT = np.eye(3)


def build(
    task: str, subtask: str, target: str = "", worlds: int = 3
) -> SequentialTaskEnv:
    return envs.make(
        task=task,
        subtask=subtask,
        target=target,
        num_envs=worlds,
        split="train",
        autoreset="disabled",
        threads=1,
    )


@lru_cache
def view_of(task: str, subtask: str, target: str = "", episode: int = 0) -> WorldView:
    """A world at its start; nothing here moves it, so tests share it."""
    env = build(task, subtask, target, worlds=1)
    env.reset(seed=0, options={"episode": [episode]})
    return env.view(0)


def the_object(view: WorldView) -> str:
    assert view.subtask is not None
    return view.subtask.obj


@pytest.mark.parametrize(
    ("task", "subtask", "target"),
    [
        ("tidy_house", "pick", ""),
        ("set_table", "pick", "024_bowl"),
        ("set_table", "pick", "013_apple"),
        ("tidy_house", "place", ""),
        ("prepare_groceries", "place", ""),
    ],
)
def test_expert_succeeds_in_most_episodes(task: str, subtask: str, target: str):
    env = build(task, subtask, target)
    obs, info = env.reset(seed=0, options={"episode": [0, 1, 2]})
    expert = make_expert(env)
    expert.reset(np.ones(3, bool))
    once = np.zeros(3, bool)
    for _ in range(200):
        actions = expert.act(obs, info)
        assert np.isfinite(actions).all() and np.abs(actions).max() <= 1.0 + 1e-6
        obs, reward, _, _, info = env.step(actions)
        once |= reward > 0.5
        if once.all():
            break
    assert once.sum() >= 2, f"{once} of {[e['plan'] for e in info['episode_spec']]}"


def test_bowl_carries_do_not_flicker() -> None:
    # With friction in the contact forces 21 of 23 bowls flickered; measured now: 22 steps, 4 of 6 without any.
    worlds = 6
    env = envs.make(
        task="set_table",
        subtask="place",
        target="024_bowl",
        profile="ms_hab",
        num_envs=worlds,
        split="val",
        autoreset="disabled",
        threads=1,
    )
    expert = make_expert(env)
    fresh = np.ones(worlds, bool)
    obs, info = env.reset(
        seed=0, options={"episode": np.arange(worlds), "reset_mask": fresh}
    )
    expert.reset(fresh)
    held = [info["is_grasped"].copy()]
    while len(held) < env.config.horizon and (held[-1] | ~info["at_goal"]).any():
        obs, _, _, _, info = env.step(expert.act(obs, info))
        held.append(info["is_grasped"].copy())
    # From the first grasp to the last, which is the release at the goal.
    carries = [np.trim_zeros(column) for column in np.array(held).T]
    steps = sum(len(carry) for carry in carries)
    lost = [int((~carry).sum()) for carry in carries]
    assert all(len(carry) > 20 for carry in carries)
    assert sum(lost) <= 0.10 * steps and lost.count(0) >= worlds // 2, lost


def drive(
    segment: PathSegment, lookahead: float, pose: np.ndarray, steps: int = 300
) -> tuple[np.ndarray, int]:
    """An ideal unicycle under a follower: where it ends and after how many steps."""
    follower = Follower([segment], lookahead)
    for step in range(steps):
        forward, turn = follower.step(pose)
        if follower.arrived:
            return pose, step
        pose = pose + 0.05 * np.array(
            [forward * np.cos(pose[2]), forward * np.sin(pose[2]), turn]
        )
    return pose, steps


@pytest.mark.parametrize("lookahead", LOOKAHEADS_M)
@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
def test_follower_ends_near_the_goal_with_its_heading(lookahead: float, yaw: float):
    path = np.array([[0.0, 0.0], [0.8, 0.0], [1.2, 0.6]])
    pose, steps = drive(PathSegment(path, 1, yaw), lookahead, np.array([0.0, 0.0, 0.4]))
    assert np.linalg.norm(pose[:2] - path[-1]) < 0.06
    assert abs((pose[2] - yaw + np.pi) % (2 * np.pi) - np.pi) < 0.06
    assert steps < 160


def test_follower_drives_straight_back():
    back = PathSegment(np.array([[0.0, 0.0], [-0.6, 0.0]]), -1, 0.0)
    pose, steps = drive(back, 0.3, np.zeros(3))
    np.testing.assert_allclose(pose, [-0.6, 0.0, 0.0], atol=0.03)
    assert steps < 40


@pytest.mark.parametrize(
    ("shape", "rot", "height"),
    [
        (ObjectShape("box", (0.02, 0.04, 0.1)), UPRIGHT, 0.1),
        (
            ObjectShape("box", (0.02, 0.04, 0.1)),
            mat_from_rotation_vector(np.array([[np.pi / 2, 0.0, 0.0]]))[0],
            0.04,
        ),
        (
            ObjectShape("cylinder", (0.03, 0.03, 0.05)),
            mat_from_rotation_vector(np.array([[0.0, np.pi / 4, 0.0]]))[0],
            0.08 / np.sqrt(2),
        ),
        (
            ObjectShape("sphere", (0.04, 0.04, 0.04)),
            mat_from_rotation_vector(np.array([[0.3, 0.7, 0.1]]))[0],
            0.04,
        ),
    ],
)
def test_height_below_centre(shape: ObjectShape, rot: np.ndarray, height: float):
    assert height_below(shape, rot) == pytest.approx(height)


def test_gripper_action_for_an_opening():
    assert motion.gripper_at(ROBOT, 0.10) == pytest.approx(1.0) and motion.gripper_at(
        ROBOT, -0.02
    ) == pytest.approx(-1.0)
    assert motion.gripper_at(ROBOT, 0.04) == pytest.approx(0.0)


def test_plan_of_a_pick_is_clear_of_the_furniture():
    view = view_of("tidy_house", "pick", episode=1)
    obj = the_object(view)
    found = plan_pick(view, obj, np.zeros((0, 3)))
    assert found is not None
    placement, goals, _ = found
    near, target = surroundings(view, obj, view.object_pose(obj)[:3])
    assert (
        motion.spheres(ROBOT).clearance(
            placement.pre[None], type(near).join([near, target])
        )[0]
        > 0.0
    )
    pos, rot = ROBOT.chain.tip_pose(placement.at[None])
    np.testing.assert_allclose(pos[0], goals.pos[placement.goal], atol=0.01)
    np.testing.assert_allclose(rot[0], goals.rot[placement.goal], atol=0.1)
    assert planner(view, shut=True).clearance_at(placement.at[:2]) >= 0.27


def test_failed_base_poses_are_avoided():
    view = view_of("tidy_house", "pick", episode=1)
    first = plan_pick(view, the_object(view), np.zeros((0, 3)))
    assert first is not None
    second = plan_pick(view, the_object(view), first[0].at[None, :3])
    assert second is not None
    assert np.linalg.norm((first[0].at[:3] - second[0].at[:3]) * [1.0, 1.0, 0.3]) > 0.1


def test_fridge_shelf_asks_to_come_straight_in():
    view = view_of("set_table", "pick", "013_apple")
    point = view.object_pose(the_object(view))[:3]
    assert inside_depth(view, point) > 0.3
    assert inside_depth(view, view.q[:3]) == 0.0


def test_way_out_of_a_shelf_keeps_the_object_off_the_walls():
    half = np.array([0.04, 0.04, 0.05])
    eye = np.eye(3)[None]
    target = Boxes(np.array([[0.5, 0.0, 1.05]]), half[None], eye)
    wall = Boxes(np.array([[0.3, 0.12, 1.1]]), np.array([[0.4, 0.01, 0.5]]), eye)
    bases = np.array([[-0.3, 0.0, 0.0], [-0.2, 0.2, -0.35], [-0.2, -0.2, 0.35]])
    straight, towards, away = exit_clearance(
        bases, ReachScene(wall, target, 1.0, ROBOT), 0.42
    )
    assert straight == pytest.approx(0.07, abs=0.005)
    assert towards < 0.0 < away


def test_grasps_on_a_shelf_come_from_its_open_side():
    shape = ObjectShape("box", (0.05, 0.03, 0.08))
    pose = np.array([0.0, 0.0, 1.08])
    found = [
        grasp_candidates(
            LyingObject.of(shape, np.append(pose, np.array([1.0, 0.0, 0.0, 0.0])), 1.0),
            options=options,
        )
        for options in (
            PinchOptions(),
            PinchOptions(inward=(1.0, 0.0), shallower=(0.0, 0.02)),
        )
    ]
    assert found[0].rot[:, 0, 0].min() < -0.25
    assert len(found[1]) and found[1].rot[:, 0, 0].min() > -0.26


def test_hand_goals_put_the_object_upright_at_the_goal():
    view = view_of("tidy_house", "place", episode=1)
    obj = the_object(view)
    assert view.subtask is not None
    goal = np.array(view.subtask.goal_pos)
    goals = hand_goals(view, obj, goal, Release(shelf=False, any_side=False))
    tcp, rot = motion.tcp(view)
    offset = rot.T @ (view.object_pose(obj)[:3] - tcp)
    centres = goals.pos + goals.rot @ offset
    # What leans is let go beside the place where it comes to rest.
    leans = np.linalg.norm(centres[:, :2] - goal[:2], axis=1) > 0.10 + 1e-9
    assert goals.score[leans].max(initial=-np.inf) < goals.score[~leans].max() - 0.2
    assert (
        np.linalg.norm(centres[goals.score > -1e-9, :2] - goal[:2], axis=1).max() < 1e-9
    )
    assert (centres[:, 2] > goal[2]).all() and np.abs(
        centres[goals.score > -1e-9, 2] - goal[2]
    ).max() < 0.02


def test_spheres_of_a_held_object_stay_with_it():
    view = view_of("tidy_house", "place", episode=1)
    obj = the_object(view)
    local, radius = held_spheres(view, obj)
    tcp, rot = motion.tcp(view)
    far = np.linalg.norm(tcp + local @ rot.T - view.object_pose(obj)[:3], axis=1)
    assert far.max() <= np.linalg.norm(view.object_type(obj).half) and (radius > 0).all()


def test_route_keeps_room_and_ends_at_the_goal():
    view = view_of("tidy_house", "pick", episode=1)
    cells = np.argwhere(planner(view).clearance > 0.6)
    free = planner(view).origin + (cells + 0.5) * planner(view).cell
    spot = free[np.argmin(np.abs(np.linalg.norm(free - view.q[:2], axis=1) - 1.0))]
    near, target = surroundings(view, the_object(view), np.array([*spot, 1.0]))
    rest = motion.rest_goal(view)
    route = plan_route(
        view,
        np.array([*spot, 0.0]),
        rest,
        motion.spheres(ROBOT),
        type(near).join([near, target]),
    )
    assert route is not None
    np.testing.assert_allclose(route.segment.points[-1], spot)
    assert route.steps < 200


def test_grasps_beside_the_centre_come_last():
    centre = np.array([0.0, 0.0, 0.1])
    found = grasp_candidates(
        LyingObject.of(
            ObjectShape("box", (0.1, 0.03, 0.1)),
            np.append(centre, np.array([1.0, 0.0, 0.0, 0.0])),
            0.0,
        )
    )

    ordered = balanced(found, centre)
    before, after = (
        np.abs(np.einsum("gj,gj->g", centre - g.pos, g.rot[:, :, 2]))
        for g in (found, ordered)
    )
    assert len(ordered) == len(found) and (np.diff(ordered.score) <= 0.0).all()
    assert after[:10].max() <= FREE_OFFSET_M < before.max()
    assert after[:40].mean() < before[:40].mean()


def test_a_drive_ends_when_the_object_is_lost():
    view = view_of("tidy_house", "pick")
    boxes, _ = surroundings(view, the_object(view), view.tcp_pose[:3])
    ahead = view.q[:3] + np.array([np.cos(view.q[2]), np.sin(view.q[2]), 0.0])
    route = plan_route(
        view, ahead, view.q, motion.spheres(ROBOT), boxes, RouteWish(straight=True)
    )
    assert route is not None and route.steps > 2 * LOST_STEPS
    # The hand is empty.
    drive_with = follow(view, route, gripper=motion.CLOSED, held=the_object(view))
    assert len(list(drive_with)) == LOST_STEPS


def test_place_picks_up_again_what_it_lost():
    env = envs.make(
        task="tidy_house",
        subtask="place",
        num_envs=1,
        split="train",
        autoreset="disabled",
        threads=1,
        horizon=350,
    )
    obs, info = env.reset(seed=0, options={"episode": [1]})
    expert = make_expert(env)
    expert.reset(np.ones(1, bool))
    obj = the_object(env.view(0))
    height = np.inf
    for step in range(350):
        actions = expert.act(obs, info)
        if 10 <= step < 16:
            actions[:, 7] = motion.OPEN
        obs, reward, _, _, info = env.step(actions)
        height = min(height, float(env.view(0).object_pose(obj)[2]))
        if reward[0] > 0.5:
            break
    assert height < 0.1 and reward[0] > 0.5


def test_a_grasp_out_of_reach_from_where_the_base_stays_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    placement = SimpleNamespace(at=np.zeros(6))
    plans: list[int] = []

    def plan(view: object, obj: str, failed: np.ndarray, *rest: object) -> object:
        plans.append(len(failed))
        assert len(plans) < 10, "plans again and again within one control step"
        return None if len(failed) else (placement, None, 0.0)

    def at_once(*args: object, **options: object) -> Iterator[np.ndarray]:
        yield from ()

    def hold(*args: object, **options: object) -> Iterator[np.ndarray]:
        yield np.zeros(13)

    monkeypatch.setattr(pick_module, "plan_pick", plan)
    monkeypatch.setattr(pick_module, "_take", at_once)
    monkeypatch.setattr(pick_module, "_let_go", at_once)
    monkeypatch.setattr(pick_module, "style_of", lambda view: SimpleNamespace(grasp=ANY))
    monkeypatch.setattr(pick_module.motion, "hold", hold)
    view: Any = SimpleNamespace(steps_left=0, finger_forces=lambda obj: np.zeros(2))
    assert next(pick_module.pick_up(view, "024_bowl_:0000")).shape == (13,)
    assert plans == [0, 0, 1]


@pytest.mark.parametrize("task", ["tidy_house", "prepare_groceries"])
def test_what_another_policy_has_grasped_is_carried_home(task: str):
    """In the open and in the fridge: the expert takes over ten control steps after the grasp."""
    env = build(task, "pick", worlds=1)
    expert = make_expert(env)
    obs, info = env.reset(seed=0, options={"episode": [0]})
    expert.reset(np.ones(1, bool))
    view = env.view(0)
    since = 0
    ended = False
    while not ended:
        obs, _, terminated, truncated, info = env.step(expert.act(obs, info))
        ended = bool(terminated[0] or truncated[0])
        since += bool(since or view.signal("is_grasped"))
        if since == 10:
            expert.reset(np.ones(1, bool))
        assert since <= 10 or view.signal("is_grasped")
    assert since > 10 and info["success"][0]
