"""Carrying an object to its place: what a drive is expected to be is what it is, and every side is thought of."""

from __future__ import annotations

import importlib
import itertools
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_quat, wrap
from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.episodes.grasps.candidates import LyingObject, ObjectShape, grasp_candidates
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import CORNER_RADIUS_M, held_spheres, holds
from mjhab.experts.base.follower import BaseTrajectory, PathSegment
from mjhab.experts.base.limits import FIRM, UNLIMITED, CommandLimits
from mjhab.experts.base.route import (
    Route,
    RouteWish,
    _swept,
    arm_gone,
    drive_of,
    follow,
    plan_route,
    torso_gone,
)
from mjhab.experts.planning.base_poses import (
    FAR_BASE_M,
    MAX_OVERREACH_M,
    base_poses,
    overreach,
)
from mjhab.experts.planning.workplace import ReachQuery, ReachScene, surroundings
from mjhab.experts.skills.pick_plans import LOW_SHELF_OPTIONS, SHELF_OPTIONS
from mjhab.experts.skills.place import DROP_HEIGHTS_M, place
from mjhab.experts.skills.place_goals import Release, hand_goals
from mjhab.robots.fetch.robot import ROBOT

route_module = importlib.import_module("mjhab.experts.base.route")
place_module = importlib.import_module("mjhab.experts.skills.place")


def place_env(episode: int, target: str = "") -> SequentialTaskEnv:
    env = envs.make(
        task="tidy_house",
        subtask="place",
        target=target,
        num_envs=1,
        split="train",
        autoreset="disabled",
        threads=1,
    )
    env.reset(seed=0, options={"episode": [episode]})
    return env


def goal_of(view: WorldView) -> tuple[str, np.ndarray]:
    assert view.subtask is not None
    return view.subtask.obj, np.array(view.subtask.goal_pos)


@pytest.mark.parametrize("gone", [arm_gone, torso_gone])
@pytest.mark.parametrize("far", [0.05, 0.3, 1.5])
def test_arm_and_torso_start_slowly_and_arrive(gone, far: float):
    share = gone(far, 0.1)
    steps = np.diff(share)
    assert share[0] == 0.0 and share[-1] == 1.0 and (steps >= 0.0).all()
    if far > 0.2:
        assert steps[0] < 0.5 * steps[4]
    np.testing.assert_array_equal(gone(0.0, 0.1), [1.0])


def test_a_drive_with_an_object_goes_as_expected():
    env = place_env(1)
    view = env.view(0)
    obj, _ = goal_of(view)
    arm = ROBOT.rest.copy()
    arm[
        [ROBOT.joints.index("torso_lift_joint"), ROBOT.joints.index("elbow_flex_joint")]
    ] -= [
        0.2,
        0.5,
    ]
    arm[13:] = view.q[13:]
    goal = view.q[:3] - [0.2 * np.cos(view.q[2]), 0.2 * np.sin(view.q[2]), -0.4]
    base = drive_of(view, goal, RouteWish(direction=-1, straight=True, limits=FIRM))
    assert base is not None
    expected = _swept(ROBOT, view.q, base.poses, arm, 0)
    route = Route(base, arm, 0, len(expected), 0.0)
    real = [view.q]
    for action in islice(
        follow(view, route, gripper=motion.CLOSED, held=obj), len(expected) - 1
    ):
        env.step(action[None])
        real.append(view.q)
    assert holds(view, obj) and len(real) > 20
    off = np.abs(np.array(real) - expected[: len(real)])
    assert off[:, :2].max() < 0.02 and off[:, 2].max() < 0.08
    # The torso swings a little beyond its goal.
    assert (
        off[:10, 3].max() < 0.02
        and off[:, 3].max() < 0.08
        and off[:, list(ROBOT.arm_columns)].max() < 0.05
    )


def test_a_bend_is_driven_as_expected():
    env = place_env(1)
    view = env.view(0)
    obj, _ = goal_of(view)
    ahead = np.array([np.cos(view.q[2]), np.sin(view.q[2])])
    left = np.array([-np.sin(view.q[2]), np.cos(view.q[2])])
    here = view.q[:2]
    path = np.stack([here, here - 0.3 * ahead, here - 0.6 * ahead - 0.4 * left])
    yaw = float(np.arctan2(*(-0.3 * ahead - 0.4 * left)[::-1]))
    base = BaseTrajectory.of(view.q[:3], [PathSegment(path, 1, yaw)], 0.3, FIRM)
    poses = base.poses
    route = Route(base, view.q, 0, len(poses), 0.0)
    real = [view.q[:3]]
    for action in islice(
        follow(view, route, gripper=motion.CLOSED, held=obj), len(poses) - 1
    ):
        env.step(action[None])
        real.append(view.q[:3])
    off = np.array(real) - poses[: len(real)]
    # It turns by more than half a turn, and slides on in the bends.
    assert np.ptp(poses[:, 2]) > 2.0 and len(real) > 30
    assert (
        np.linalg.norm(off[:, :2], axis=1).max() < 0.02
        and np.abs(wrap(off[:, 2])).max() < 0.1
    )


def test_a_drive_with_something_in_the_hand_that_grazes_furniture_is_tight(
    monkeypatch: pytest.MonkeyPatch,
):
    view = place_env(1).view(0)
    boxes = Boxes.of(np.zeros((0, 3)), np.zeros((0, 3)))
    ahead = view.q[:3] + 0.5 * np.array([np.cos(view.q[2]), np.sin(view.q[2]), 0.0])

    def clearance(middle: float, limits: CommandLimits) -> float:
        def clearance(at: np.ndarray) -> np.ndarray:
            ends = (np.linalg.norm(at - view.q[:2], axis=1) < 0.1) | (
                np.linalg.norm(at - ahead[:2], axis=1) < 0.1
            )
            return np.where(ends, 0.4, middle)

        cells = SimpleNamespace(
            clearance_at=clearance, plan=lambda *_: np.stack([view.q[:2], ahead[:2]])
        )
        monkeypatch.setattr(route_module, "planner", lambda _: cells)
        found = plan_route(
            view,
            ahead,
            view.q,
            motion.arm_spheres(ROBOT),
            boxes,
            RouteWish(limits=limits),
        )
        assert found is not None and found.base.limits is limits
        return found.clearance

    assert clearance(0.4, FIRM) >= 0.0 and clearance(0.2, UNLIMITED) >= 0.0
    assert clearance(0.2, FIRM) == pytest.approx(0.2 - ROBOT.footprint.narrow)


def test_nothing_of_the_trunk_counts_on_the_way_of_an_arm():
    arm = motion.arm_spheres(ROBOT)
    whole = motion.spheres(ROBOT)
    links = {arm.chain.links[i] for i in arm.link}
    assert not links & set(ROBOT.trunk_links) and links < {
        whole.chain.links[i] for i in whole.link
    }
    # It stays above the base, which the map of the floor keeps clear.
    chain = ROBOT.chain_with(ROBOT.trunk_links)
    frames = chain.forward(ROBOT.rest[None])
    reach = dict.fromkeys(ROBOT.trunk_links, 0.0)
    for link in ROBOT.trunk_links:
        at = chain.links.index(link)
        for geom in ROBOT.body.collision[link]:
            half = (
                geom.size
                if geom.shape == "box"
                else (geom.size[0] / np.sqrt(2.0),) * 2 + (geom.size[1],)
            )
            corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
            turn = frames.rot[0, at] @ mat_from_quat(np.array(geom.quat, float))
            spots = (
                frames.pos[0, at]
                + frames.rot[0, at] @ np.array(geom.pos, float)
                + corners @ turn.T
            )
            reach[link] = max(
                reach[link],
                float(np.linalg.norm(spots[:, :2] - ROBOT.rest[:2], axis=1).max()),
            )
    assert max(reach.values()) < reach["base_link"] + 0.02
    np.testing.assert_array_equal(
        arm.self_clearance(ROBOT.rest[None]), whole.self_clearance(ROBOT.rest[None])
    )


def test_spheres_reach_into_the_corners_of_a_held_box():
    view = place_env(0, "003_cracker_box").view(0)
    obj, _ = goal_of(view)
    half = np.array(view.object_type(obj).half)
    assert view.object_shape(obj).kind == "box"
    pose = view.object_pose(obj)
    (tcp, rot) = motion.tcp(view)
    corners = (
        pose[:3]
        + (half * [[1, 1, 1], [-1, 1, -1], [1, -1, -1]]) @ mat_from_quat(pose[3:]).T
    )
    local, radius = held_spheres(view, obj)
    gap = np.linalg.norm(corners[:, None] - (tcp + local @ rot.T), axis=2) - radius
    assert gap.min(axis=1).max() < CORNER_RADIUS_M


def test_bases_are_only_where_something_can_be_reached():
    view = place_env(1).view(0)
    obj, goal = goal_of(view)
    near, _ = surroundings(view, obj, goal)
    scene = ReachScene(
        near,
        near.take(np.zeros(0, np.int64)),
        float(goal[2]),
        ROBOT,
        held_spheres(view, obj),
    )
    goals = hand_goals(view, obj, goal, Release(shelf=False, any_side=False))
    # Only what is put down half a metre further away counts.
    away = goals.pos + 0.5 * np.array([np.cos(view.q[2]), np.sin(view.q[2]), 0.0])
    shifted = type(goals)(away, goals.rot, goals.pre, goals.opening, goals.score)
    for wanted, far in itertools.product((goals, shifted), (False, True)):
        query = ReachQuery(point=goal, goals=wanted, scene=scene, far=far)
        bases, steps = base_poses(view, query)
        assert len(bases) and np.isfinite(steps).all()
        assert (overreach(ROBOT.reach, bases, wanted).min(axis=1) < MAX_OVERREACH_M).all()
    # Far off only where there is no other way, or to save one.
    near_by = base_poses(view, ReachQuery(point=goal, goals=goals, scene=scene))
    anywhere = base_poses(
        view, ReachQuery(point=goal, goals=goals, scene=scene, far=True)
    )
    moved = np.linalg.norm(near_by[0][:, :2] - view.q[:2], axis=1) > 1e-9
    assert (
        moved.any()
        and np.linalg.norm(near_by[0][moved, :2] - goal[:2], axis=1).max()
        <= FAR_BASE_M + 1e-9
    )
    assert np.linalg.norm(anywhere[0][:, :2] - goal[:2], axis=1).max() > FAR_BASE_M
    assert anywhere[1].min() <= near_by[1].min()


def test_place_looks_at_every_way_before_it_waits(monkeypatch: pytest.MonkeyPatch):
    view = place_env(1).view(0)
    asked = []
    monkeypatch.setattr(place_module, "plan_place", lambda *args: asked.append(args[3]))
    next(place(view))
    # In its place, then in a hurry and on any side, then from above.
    assert [(each.number, each.drop, each.fast) for each in asked] == [
        (0, 0.0, False),
        (1, 0.0, True),
        (2, 0.0, True),
        (3, DROP_HEIGHTS_M[1], True),
        (4, DROP_HEIGHTS_M[2], True),
    ]


def test_a_bowl_under_a_shelf_is_taken_from_the_front():
    bowl = ObjectShape("bowl", (0.081, 0.081, 0.028))
    low = Boxes.of([[0.0, 0.0, 0.362]], [[0.4, 0.4, 0.01]], [np.eye(3)])
    pos = np.array([0.0, 0.0, 0.028])
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    found = [
        grasp_candidates(
            LyingObject.of(bowl, np.append(pos, quat), 0.0),
            neighbours=low,
            options=replace(options, inward=(1.0, 0.0)),
        )
        for options in (SHELF_OPTIONS, LOW_SHELF_OPTIONS)
    ]
    assert not len(found[0]) and len(found[1])
    # The hand leans towards where it comes from.
    assert found[1].rot[:, 0, 0].max() > 0.5
