"""Ways around what straight motions of the arm touch: they are clear, always the same, and looked for within bounds."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from mjhab.core.boxes import Boxes
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base import route
from mjhab.experts.base.follower import BaseTrajectory, PathSegment
from mjhab.experts.base.limits import UNLIMITED
from mjhab.experts.base.route import Route
from mjhab.experts.planning import sampled
from mjhab.experts.planning.arm_paths import Free, arm_path
from mjhab.experts.planning.sampled import clearer, plan_around
from mjhab.experts.planning.workplace import BasePlacement, Blocked, HandGoals, ReachScene
from mjhab.robots.fetch.robot import ROBOT

PAN = 5
"""Column of the shoulder's turn."""

STANDING = BaseTrajectory.of(np.zeros(3), [PathSegment(np.zeros((2, 2)), 1, 0.0)], 0.3)


def turned(pan: float) -> np.ndarray:
    q = ROBOT.rest.copy()
    q[PAN] = pan
    return q


LEFT = turned(0.9)
RIGHT = turned(-0.9)
# A wall that ends at the robot, between where the arm is and where it is to go, with and without a gap at half height.
WALL = Boxes.of(
    [[1.0, 0.0, 2.4], [1.0, 0.0, 0.5]], [[0.65, 0.01, 0.9], [0.65, 0.01, 0.5]]
)
SOLID = Boxes.of([[0.9, 0.0, 1.5]], [[0.65, 0.01, 1.5]])


def free(boxes: Boxes) -> Free:
    return Free.near(ROBOT, LEFT, motion.spheres(ROBOT), boxes)


def view_of(q: np.ndarray) -> WorldView:
    return SimpleNamespace(robot=ROBOT, q=q, base=q[:3], steps_left=200)  # type: ignore[return-value]


def spare(path: np.ndarray, what: Free) -> float:
    """Least room on a way, looked at much closer than the planner does."""
    pieces = [a + np.linspace(0, 1, 60)[:, None] * (b - a) for a, b in pairwise(path)]
    return float(what.spare(np.concatenate(pieces)).min())


def test_arm_goes_around_a_wall_that_the_straight_motion_hits():
    what = free(WALL)
    assert spare(np.stack([LEFT, RIGHT]), what) < -0.03 and not what.edge(LEFT, RIGHT)
    path = arm_path(LEFT, RIGHT, what)
    assert path is not None and len(path) > 2
    assert np.array_equal(path[0], LEFT) and np.array_equal(path[-1], RIGHT)
    assert spare(path, what) > -0.005
    dofs = ik.columns(ROBOT.chain)
    inside = (path >= ROBOT.chain.lower - 1e-9) & (path <= ROBOT.chain.upper + 1e-9)
    assert inside[:, dofs].all() and (np.delete(path - LEFT, dofs, axis=1) == 0.0).all()


def test_a_way_is_the_same_whatever_was_planned_before():
    first = arm_path(LEFT, RIGHT, free(WALL))
    for end in (turned(-0.7), turned(-1.2)):
        assert arm_path(LEFT, end, free(WALL)) is not None
    assert arm_path(LEFT, RIGHT, free(SOLID), rounds=7) is None
    again = arm_path(LEFT, RIGHT, free(WALL))
    assert first is not None and again is not None and first.tobytes() == again.tobytes()


def test_gives_up_after_so_many_rounds(monkeypatch: pytest.MonkeyPatch):
    looked = []
    edge = Free.edge
    monkeypatch.setattr(
        Free, "edge", lambda self, a, b: looked.append(1) or edge(self, a, b)
    )
    assert arm_path(LEFT, RIGHT, free(SOLID), rounds=20) is None
    few = len(looked)
    assert arm_path(LEFT, RIGHT, free(SOLID), rounds=60) is None
    assert 0 < few < len(looked) - few < 20 * 60


def blocked_drive(
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[np.ndarray, np.ndarray, Boxes]:
    """A straight drive between posts that the arm at rest, swung to the side, does not pass."""
    goal = np.array([1.2, 0.0, 0.0])
    path = np.stack([np.zeros(2), goal[:2]])
    poses = np.linspace(np.zeros(3), goal, 30)
    base = BaseTrajectory([PathSegment(path, 1, 0.0)], 0.3, UNLIMITED, poses)
    for module in (sampled, route):
        monkeypatch.setattr(module, "drive_of", lambda *_, **__: base)
    posts = Boxes.of([[0.9, 0.62, 0.9], [0.9, -0.62, 0.9]], [[0.04, 0.04, 0.9]] * 2)
    return goal, np.concatenate([goal, LEFT[3:]]), posts


def test_drives_with_another_posture_where_the_arm_does_not_pass(
    monkeypatch: pytest.MonkeyPatch,
):
    goal, arm, posts = blocked_drive(monkeypatch)
    view = view_of(LEFT)
    robot = motion.spheres(ROBOT)
    straight = route.plan_route(view, goal, arm, robot, posts)
    assert straight is not None and straight.clearance < sampled.MAX_DEFICIT_M
    found = plan_around(view, goal, arm, robot, posts)
    assert (
        found is not None
        and found.via is not None
        and 0 <= found.carried < len(found.via)
    )
    carried = np.repeat(found.via[found.carried][None], 40, axis=0)
    carried[:, :3] = np.linspace(np.zeros(3), goal, 40)
    assert robot.clearance(carried, posts).min() > 0.05
    assert found.lead + 30 <= found.steps and np.array_equal(found.arm, arm)
    again = plan_around(view, goal, arm, robot, posts)
    assert (
        again is not None
        and again.via is not None
        and again.via.tobytes() == found.via.tobytes()
    )


def test_only_where_straight_ways_touch_and_time_is_left(monkeypatch: pytest.MonkeyPatch):
    _, arm, posts = blocked_drive(monkeypatch)
    one = np.zeros((1, 3))
    goals = HandGoals(one, np.eye(3)[None], one, np.zeros(1), np.zeros(1))
    scene = ReachScene(posts, posts.take(np.zeros(0, int)), 0.0, ROBOT)
    blocked = [Blocked(goals, np.zeros(1, int), arm[None], arm[None], scene, 0.0)]
    view = view_of(LEFT)

    def placement(clearance: float) -> tuple[BasePlacement, HandGoals, float]:
        return (
            BasePlacement(0, arm, arm, Route(STANDING, arm, 0, 40, clearance)),
            goals,
            0.0,
        )

    good = placement(0.01)
    bad = placement(-0.07)
    assert clearer(view, good, blocked) is good
    around = clearer(view, bad, blocked)
    assert around is not None and around is not bad and around[0].route.via is not None
    assert clearer(view, None, blocked) is not None and clearer(view, None, []) is None
    view.steps_left = around[0].route.steps + sampled.MIN_TOTAL_STEPS - 1  # type: ignore[misc]
    assert clearer(view, bad, blocked) is bad


def test_ompl_is_loaded_only_when_it_is_needed():
    code = "import sys, mjhab, mjhab.experts.skills.pick; sys.exit('ompl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class Arm:
    """A robot that stands and whose arm and torso do most of what they are told."""

    def __init__(self, q: np.ndarray) -> None:
        self.robot = ROBOT
        self.q = q.copy()
        self.link_forces = np.zeros(1)
        self.passed = [q.copy()]

    @property
    def base(self) -> np.ndarray:
        return self.q[:3]

    def obey(self, action: np.ndarray) -> None:
        self.q = self.q.copy()
        self.q[list(ROBOT.arm_columns)] += 0.4 * ROBOT.limits.joint_delta * action[:7]
        self.q[3] += 0.4 * ROBOT.limits.joint_delta * action[ROBOT.action.torso[0]]
        self.passed.append(self.q)


def test_arm_passes_the_postures_of_a_route_one_after_the_other():
    view = Arm(LEFT)
    low = turned(0.3)
    low[7] = -0.5
    low[9] = 1.3
    via = np.stack([low, turned(-0.3)])
    path = Route(STANDING, RIGHT, 30, 120, 0.0, via=via, carried=0, lead=20)
    drive = route.follow(view, path, gripper=motion.OPEN)  # type: ignore[arg-type]
    arrived = None
    while arrived is None:
        try:
            view.obey(next(drive))
        except StopIteration as end:
            arrived = end.value
    assert arrived
    gaps = np.abs(np.array(view.passed)[:, None] - np.stack([*via, RIGHT])).max(axis=2)
    first = [int(np.argmax(gap < route.PASSED_RAD)) for gap in gaps.T]
    assert (
        0 < first[0] < first[1] < first[2]
        and (gaps[first[0] : 20, 0] < route.PASSED_RAD).all()
    )
    # It starts gently, when the base has arrived as well.
    speed = np.abs(np.diff(np.array(view.passed), axis=0)).max(axis=1)
    for start in (0, path.lead):
        np.testing.assert_allclose(
            speed[start : start + 4] / speed.max(), [0.25, 0.5, 0.75, 1.0], atol=0.01
        )
