"""Planner and follower: ways keep clear of obstacles, and a simulated base arrives where it should."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from mjhab.core.rotations import wrap
from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.base.follower import SPEED_LAG_S, YAW_LAG_S, Follower, PathSegment
from mjhab.experts.base.navigation import FloorClearance, Planner
from tests.refusals import refused

ORIGIN = np.array([-4.0, -3.0])
CELL = 0.05


def rooms(seed: int) -> np.ndarray:
    """Clearances (160, 120) of two rooms joined by a doorway of 0.8 m, with some furniture."""
    rng = np.random.default_rng(seed)
    taken = np.zeros((160, 120), dtype=bool)
    taken[[0, -1]] = taken[:, [0, -1]] = True
    taken[80, :50] = taken[80, 66:] = True
    for _ in range(8):
        x = rng.integers(5, 150)
        y = rng.integers(5, 110)
        if not 60 < x < 96:
            taken[x : x + rng.integers(3, 15), y : y + rng.integers(3, 15)] = True
    return clearances(~taken)


def clearances(free: np.ndarray) -> np.ndarray:
    return np.asarray(distance_transform_edt(free)) * CELL


def free_points(clearance: np.ndarray, seed: int, count: int) -> np.ndarray:
    cells = np.argwhere(clearance > 0.34)
    picked = cells[np.random.default_rng(seed).integers(len(cells), size=count)]
    return ORIGIN + (picked + 0.5) * CELL


def drive(
    follower: Follower, pose: np.ndarray, steps: int = 900
) -> tuple[int, np.ndarray]:
    """Simulate a base whose speeds follow commands with a lag; returns the steps used (-1: too many) and the track."""
    pose = np.array(pose, dtype=float)
    speed = 0.0
    rate = 0.0
    track = []
    faster = 1 - np.exp(-0.01 / SPEED_LAG_S)
    turning = 1 - np.exp(-0.01 / YAW_LAG_S)
    for step in range(steps):
        track.append(pose.copy())
        forward, turn = follower.step(pose)
        if follower.arrived:
            return step, np.array(track)
        for _ in range(round(STEP_SECONDS / 0.01)):
            speed += faster * (forward - speed)
            rate += turning * (turn - rate)
            pose += 0.01 * np.array(
                [speed * np.cos(pose[2]), speed * np.sin(pose[2]), rate]
            )
    return -1, np.array(track)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_planned_ways_are_clear_and_driven_to_the_goal(seed, yaw, final):
    clearance = rooms(seed)
    planner = Planner(FloorClearance(ORIGIN, CELL, clearance))
    start, goal = free_points(clearance, seed, 2)
    path = planner.plan(start, goal)
    if path is None:
        return
    np.testing.assert_allclose(path[[0, -1]], [start, goal])
    for a, b in pairwise(path):
        assert planner.line_clearance(a, b[None])[0] >= planner.radius - 1e-9
    steps, track = drive(
        Follower([PathSegment(path, 1, final)], 0.2), np.array([*start, yaw])
    )
    assert steps >= 0
    assert np.linalg.norm(track[-1, :2] - goal) <= 0.05
    assert abs(wrap(track[-1, 2] - final)) <= 0.1
    assert planner.clearance_at(track[:, :2]).min() >= planner.radius - 0.1


def test_ways_lead_through_the_doorway_and_keep_to_its_middle():
    planner = Planner(FloorClearance(ORIGIN, CELL, clearances(_only_the_wall())))
    path = planner.plan(np.array([-2.0, 2.0]), np.array([2.0, 2.0]))
    assert path is not None
    crossing = np.interp(0.025, path[:, 0], path[:, 1])
    assert abs(crossing - (-3.0 + 58 * CELL)) < 0.1
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() >= 4.0


def _only_the_wall() -> np.ndarray:
    free = np.ones((160, 120), dtype=bool)
    free[80, :50] = free[80, 66:] = False
    return free


def test_closed_rooms_and_blocked_ends():
    free = np.ones((160, 120), dtype=bool)
    free[80] = False
    planner = Planner(FloorClearance(ORIGIN, CELL, clearances(free)))
    assert planner.plan(np.array([-2.0, 0.0]), np.array([2.0, 0.0])) is None
    path = planner.plan(np.array([-0.1, 0.0]), np.array([-0.05, 1.0]))
    assert path is not None
    np.testing.assert_allclose(path[0], [-0.1, 0.0])
    assert planner.clearance_at(path[-1]) >= planner.radius
    with refused(said="clearance"):
        Planner(FloorClearance(ORIGIN, CELL, np.full((5, 5), 0.1)))


def test_narrow_cells_are_passed_only_where_there_is_no_other_way():
    clearance = np.full((30, 30), 0.5)
    clearance[15] = 0.0
    clearance[15, 3] = 0.28
    start = np.array([0.25, 1.95])
    goal = np.array([2.75, 1.95])
    assert (
        Planner(FloorClearance((0.0, 0.0), 0.1, clearance), radius=0.29).plan(start, goal)
        is None
    )
    narrow = Planner(FloorClearance((0.0, 0.0), 0.1, clearance), radius=0.29, narrow=0.27)
    path = narrow.plan(start, goal)
    assert path is not None and path[:, 1].min() == pytest.approx(0.35, abs=0.06)
    clearance[15, 29] = 0.3
    path = Planner(
        FloorClearance((0.0, 0.0), 0.1, clearance), radius=0.29, narrow=0.27
    ).plan(start, goal)
    assert path is not None and path[:, 1].min() > 1.8


def test_costs_to_the_nearest_of_some_cells():
    planner = Planner(FloorClearance((0.0, 0.0), 0.1, np.full((30, 30), 1.0)))
    goals = np.zeros((30, 30), bool)
    goals[2, 5] = goals[25, 5] = True
    cost = planner.costs_to(goals)
    assert cost[2, 5] == cost[25, 5] == 0.0
    assert cost[5, 5] == pytest.approx(0.3) and cost[24, 5] == pytest.approx(0.1)
