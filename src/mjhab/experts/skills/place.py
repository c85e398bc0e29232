"""Script of Place by a search: onto open surfaces, or into furniture such as a fridge.

Lengths [m], angles [rad], world frame. Letters: N attempts, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.core.rotations import mat_from_quat, mat_from_rotation_vector
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.pinch import ObjectShape
from mjhab.experts.arm import motion
from mjhab.experts.arm.held import held_spheres, holds
from mjhab.experts.arm.motion import Motion
from mjhab.experts.base.limits import limits_for
from mjhab.experts.base.route import follow
from mjhab.experts.phases import phase
from mjhab.experts.planning.carry import (
    ReachIn,
    drive_in,
    go_home,
    inside_depth,
)
from mjhab.experts.planning.reach import hand_clearance, placements, settle_reach
from mjhab.experts.planning.release import (
    TIGHT_PLAY_M,
    away_speed,
    drawn_back,
    let_go_width,
    play,
    tipped,
)
from mjhab.experts.planning.sampled import Found, clearer
from mjhab.experts.planning.workplace import (
    CLEARANCES_M,
    BasePlacement,
    Blocked,
    HandGoals,
    ReachQuery,
    Scene,
    surroundings,
)
from mjhab.experts.skills.pick import pick_up
from mjhab.experts.skills.pick_plans import height_below
from mjhab.experts.style import style_of, wait_for
from mjhab.tasks.style import DROP as DROP_IT

DROP_HEIGHT_M = 0.006
"""Height above the surface at which an object is released."""
ABOVE_M = 0.10
"""Height above the release pose at which the straight downward motion begins."""
SHELF_ABOVE_M = 0.035
"""The same on a shelf."""
YAWS = 16
SHELF_YAWS = 8
OFFSETS = ((0.0, 0.0), (0.05, 0.0), (0.10, 0.0))
LAST_OFFSETS = (*OFFSETS, (0.125, 0.0))
SHELF_OFFSETS = (
    *OFFSETS,
    (0.05, 0.05),
    (0.05, -0.05),
    (0.0, 0.06),
    (0.0, -0.06),
    (0.08, 0.06),
    (0.08, -0.06),
)
"""Candidate offsets of the object from its goal, towards the robot and to its side; success allows 0.15.
`LAST_OFFSETS` are for later attempts."""
TILTS = (0.0, 0.3)
BALL_TILTS = (0.0, 0.35, 0.7, 1.0)
SHELF_TILTS = (0.0, 0.35, 0.6, 0.85, 1.1)
"""Candidate tilts of the held object [rad]: a tilted hand reaches further and fits under a shelf."""
HAND_CLEARANCE_M = -0.008
"""Least clearance of the hand; negative because the shapes that model it are up to 8 mm too large."""
HAND_NEARER_M = 0.014
"""Difference between the least clearances of arm and hand above the release pose."""
OFF_PRICE_PER_M = 6.0
"""Score lost per metre beside the goal."""
LEAN_PRICE = 2.5
"""Score lost per radian of tilt at the release under a shelf."""
LAID_PRICE = 2.6
"""Score lost when the object is placed on another side; round objects then roll or fall over."""
STUCK_FACTOR = 3.0
"""Factor on the loss by tilt where the fingers can hardly open: the tilted object stays between them and falls when the
hand retreats."""
MAX_BESIDE_M = 0.09
"""Greatest accepted deviation from the release position when the arm does not reach it from the present base pose."""
GOAL_SHARE = 0.87
"""Share of the goal tolerance within which the object must come to rest after it has tipped over."""
MAX_DEFICIT_M = -0.01
"""Routes with less ``clearance`` than this (negative: a deficit) may shake the object loose: others are tried first."""
AFTER_STEPS = 35
"""Control steps to put an object down and to retreat."""
INSIDE_AFTER_STEPS = 70
"""The same where the base first has to drive straight in."""
HOME_WEIGHT = 0.6
"""Weight of the control steps back to rest, relative to those to the goal."""
DROP_HEIGHTS_M = (0.0, 0.05, 0.12)
"""Heights from which an object is dropped on open surfaces, in this order, where it cannot be put down."""
SOFT_START = (0.25, 0.5, 0.75)
"""Speeds of the arm in its first control steps: a jerk can shake out an object at the fingertips."""
MAX_ATTEMPTS = 20
"""Plans after which a Place gives up; more than fit into its time."""
CAREFUL_PLANS = 2
"""Plans that are compared with another one if they are too slow or their routes too close to obstacles."""
WAIT_STEPS = 60
"""Control steps of waiting once all release poses have failed."""


@phase("place")
def place(view: WorldView) -> Motion:
    """Place the held object at the goal of the active subtask and return to rest; pick it up again if it is lost."""
    subtask = view.subtask
    assert subtask is not None
    obj = subtask.obj
    goal = np.array(subtask.goal_pos)
    while True:
        if holds(view, obj):
            yield from _bring(view, obj, goal)
        elif not view.signal("at_goal"):
            # The object was lost on the way: pick it up again.
            yield from pick_up(view, obj, keep=False)
            continue
        yield from go_home(view, obj, holding=False)
        yield from _rest(view)


@phase("bring the object to its goal")
def _bring(view: WorldView, obj: str, goal: np.ndarray) -> Motion:
    """Place the held object at ``goal`` (3,) [m]. Returns whether the hand has released it."""
    search = _PlaceSearch(view, obj, goal)
    while search.number < MAX_ATTEMPTS:
        if not holds(view, obj):
            return True
        found = search.next()
        if found is None:
            if search.exhausted:
                yield from _wait(view)
            continue
        (placement, goals, depth) = found
        if (yield from _put(view, obj, placement, goals, depth)):
            return True
        search.failed = np.concatenate([search.failed, placement.at[None, BASE]])
    return False


class _PlaceSearch:
    """Successive plans for one object: first carefully, then in fast mode, then from greater heights.

    Attributes:
        number: plans made before.
        failed: (N, 3) base poses from which attempts have failed.
    """

    def __init__(self, view: WorldView, obj: str, goal: np.ndarray) -> None:
        self.number = 0
        self.failed = np.zeros((0, 3))
        self._view = view
        self._obj = obj
        self._goal = goal
        self._fast = False
        self._nothing = 0
        """Searches without a result."""
        # On open surfaces every drop height is tried; inside furniture, failed base poses are tried once more.
        self._rounds = 2 if inside_depth(view, goal) else len(DROP_HEIGHTS_M)

    @property
    def exhausted(self) -> bool:
        """Whether everything has been tried without a result."""
        return self._nothing >= self._rounds

    def next(self) -> Found | None:
        """The best plan that is found; None if none is, and the next call searches differently."""
        best: Found | None = None
        enough = (True, MAX_DEFICIT_M)
        while True:
            found = self._plan()
            if found is not None and (
                best is None or _worth(self._view, found) > _worth(self._view, best)
            ):
                best = found
            self.number += 1
            # The first plans are cheap to improve on: nothing has failed yet.
            if self.number > CAREFUL_PLANS or (
                best is not None and _worth(self._view, best) >= enough
            ):
                break
            self._fast = True
        if best is None:
            self.failed = self.failed[:0]
            self._nothing += 1
        else:
            self._fast = False
        return best

    def _plan(self) -> Found | None:
        """One plan from the height of the style, or from the present one of `DROP_HEIGHTS_M`."""
        style = style_of(self._view)
        drop = DROP_HEIGHTS_M[self._nothing % len(DROP_HEIGHTS_M)]
        heights = (style.drop_height, 0.0) if style.release == DROP_IT else (drop,)
        for height in heights:
            attempt = Attempt(self.number, self.failed, height, self._fast)
            found = plan_place(self._view, self._obj, self._goal, attempt)
            if found is not None:
                return found
        return None


@phase("wait with the object in the hand")
def _wait(view: WorldView) -> Motion:
    """Hold still: what is in the way may move."""
    return (yield from motion.hold(view, WAIT_STEPS, gripper=motion.CLOSED))


def _worth(view: WorldView, found: Found) -> tuple[bool, float]:
    """Rank of a plan: whether it leaves enough time to return to rest, and the clearance of its route [m]."""
    placement, _, depth = found
    after = (INSIDE_AFTER_STEPS if depth else AFTER_STEPS) + float(
        motion.steps_home(view.robot, placement.at)
    )
    return placement.route.steps + after <= view.steps_left, placement.route.clearance


@phase("rest beside the placed object")
def _rest(view: WorldView) -> Motion:
    """Stay at rest with an open hand while the object is at its goal. Returns when it has left it."""
    goal = motion.rest_goal(view)
    off = 0
    while off < 4:
        yield motion.action(view, goal, gripper=motion.OPEN)
        off = 0 if view.signal("at_goal") else off + 1
    return False


@dataclass(frozen=True, eq=False)
class Attempt:
    """One attempt to place an object.

    Attributes:
        number: number of attempts before it.
        failed: (N, 3) base poses from which attempts have failed.
        drop: height above an open surface from which the object is dropped [m].
        fast: drive faster and to nearer base placements, because time or clearance is short.
    """

    number: int
    failed: np.ndarray
    drop: float = 0.0
    fast: bool = False


@dataclass(frozen=True)
class Release:
    """Constraints on release poses.

    Attributes:
        shelf: there is a board above: also tilt the hand, and begin the downward motion lower.
        any_side: the object may be placed on any of its sides.
        drop: height from which it is dropped [m].
    """

    shelf: bool
    any_side: bool
    drop: float = 0.0


def plan_place(
    view: WorldView, obj: str, goal: np.ndarray, attempt: Attempt
) -> Found | None:
    """Plan how to place an object near ``goal`` (3,) [m].

    Returns:
        Base placement, the hand poses that it refers to, and the length of the straight drive in [m]; None if none.
    """
    near, _ = surroundings(view, obj, goal)
    support = float(goal[2]) - view.object_type(obj).half[2]
    scene = Scene(
        near,
        near.take(np.zeros(0, np.int64)),
        support,
        view.robot,
        held_spheres(view, obj),
        limits_for(view, attempt.fast),
    )
    depth = inside_depth(view, goal)
    # Under a shelf the object often fits only on another side or tilted.
    late = attempt.number > 1
    inside = depth > 0.0
    release = Release(inside, inside or late, 0.0 if depth else attempt.drop)
    goals = clear_hand_goals(view, obj, goal, near, release)
    if not len(goals) and not depth:
        # A place that is no shelf can still have a board above it.
        goals = clear_hand_goals(
            view, obj, goal, near, Release(shelf=True, any_side=True)
        )
    blocked: list[Blocked] = []
    query = ReachQuery(
        point=goal,
        goals=goals,
        scene=scene,
        drive_in=depth,
        avoid=attempt.failed,
        clearance=CLEARANCES_M[min(attempt.number, 2)],
        nearer=HAND_NEARER_M,
        far=attempt.fast,
        home=HOME_WEIGHT,
    )
    found = placements(view, query, blocked)
    return clearer(view, (found[0], goals, depth) if found else None, blocked)


def clear_hand_goals(
    view: WorldView, obj: str, goal: np.ndarray, near: Boxes, release: Release
) -> HandGoals:
    """Those of the `hand_goals` at which the hand is clear of the boxes ``near``."""
    goals = hand_goals(view, obj, goal, release)
    return goals.take(
        np.flatnonzero(
            hand_clearance(view.robot.gripper, goals, near.near(goal, 0.8))
            > HAND_CLEARANCE_M
        )
    )


def hand_goals(
    view: WorldView, obj: str, goal: np.ndarray, release: Release
) -> HandGoals:
    """Compute hand poses that release the held object near its goal, from its present pose relative to the hand.

    Args:
        view: the world.
        obj: name of the held object.
        goal: (3,) goal of the object's centre [m].
        release: constraints.

    Returns:
        Hand poses with scores: less for tilted objects, other sides, and distance from the goal.
    """
    shape = view.object_shape(obj)
    tcp, hand = motion.tcp(view)
    pose = view.object_pose(obj)
    turn = hand.T @ mat_from_quat(pose[3:])
    offset = hand.T @ (pose[:3] - tcp)
    floor = float(goal[2]) - shape.half[2]
    max_off = GOAL_SHARE * view.config.goal_tol
    spots = _spots(view, goal, release)
    pos = []
    rot = []
    score = []
    for stand, price in _orientations(view, shape, goal, release):
        low = height_below(shape, stand)
        tips = tipped(shape, stand)
        for spot in spots:
            # The release position is chosen such that the object comes to rest at the spot after it has tipped over.
            if np.linalg.norm(np.array([*spot, floor + low + tips[2]]) - goal) > max_off:
                continue
            height = floor + low + max(DROP_HEIGHT_M, release.drop)
            rot.append(stand @ turn.T)
            pos.append(np.array([*(spot - tips[:2]), height]) - rot[-1] @ offset)
            off = float(np.linalg.norm(spot - goal[:2]))
            score.append(price - OFF_PRICE_PER_M * off)
    at = np.array(pos)
    pre = at + np.array([0.0, 0.0, SHELF_ABOVE_M if release.shelf else ABOVE_M])
    width = np.full(len(at), 2.0 * float(view.q[view.robot.columns.fingers].mean()))
    return HandGoals(at, np.array(rot), pre, width, np.array(score))


def _aside(view: WorldView, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Level unit vectors (2,) from ``goal`` (3,) towards the robot, and to its side."""
    back = view.base[:2] - goal[:2]
    back = back / max(float(np.linalg.norm(back)), 1e-6)
    return back, np.array([-back[1], back[0]])


def _spots(view: WorldView, goal: np.ndarray, release: Release) -> list[np.ndarray]:
    """Positions (2,) on the goal's surface where the object may be released; the goal itself comes first."""
    back, aside = _aside(view, goal)
    offsets = LAST_OFFSETS if release.any_side else OFFSETS
    offsets = SHELF_OFFSETS if release.shelf else offsets
    spots = [goal[:2] + near * back + left * aside for near, left in offsets]
    return [spots[0], *(spot for spot in spots[1:] if _on_surface(view, goal, spot))]


def _orientations(
    view: WorldView, shape: ObjectShape, goal: np.ndarray, release: Release
) -> Iterator[tuple[np.ndarray, float]]:
    """Orientations (3, 3) of the object at its release, with their score: sides, turned about, then tilted."""
    count = SHELF_YAWS if release.shelf else YAWS
    yaws = np.arange(count) * 2 * np.pi / count
    turns = mat_from_rotation_vector(yaws[:, None] * np.array([0.0, 0.0, 1.0]))
    tilts = BALL_TILTS if shape.kind == "sphere" else TILTS
    tilts = np.array(SHELF_TILTS if release.shelf else tilts)
    _, aside = _aside(view, goal)
    leans = mat_from_rotation_vector(tilts[:, None] * np.array([*aside, 0.0]))
    upset = _tilt_price(view, shape, release.shelf)
    leaning = list(zip(tilts, leans, strict=True))
    for (side, price), about, (tilt, lean) in itertools.product(
        _sides(release.any_side), turns, leaning
    ):
        yield lean @ (about @ side), -price - upset * float(tilt)


def _tilt_price(view: WorldView, shape: ObjectShape, shelf: bool) -> float:
    """Score that a hand pose loses per radian that the object is tilted: tall ones fall over when they are released."""
    if shape.kind == "sphere":
        return 0.2
    price = LEAN_PRICE if shelf else 2.0 + 2.0 * shape.half[2] / min(shape.half)
    return price * (STUCK_FACTOR if play(view) < TIGHT_PLAY_M else 1.0)


def _sides(every: bool) -> list[tuple[np.ndarray, float]]:
    """Rotations (3, 3) of an object onto its sides, with the score they lose: upright, with ``every`` all."""
    sides = [(np.eye(3), 0.0)]
    if every:
        half = np.pi / 2
        for axis in (
            (half, 0, 0),
            (-half, 0, 0),
            (0, half, 0),
            (0, -half, 0),
            (2 * half, 0, 0),
        ):
            sides.append(
                (mat_from_rotation_vector(np.array([axis], float))[0], LAID_PRICE)
            )
    return sides


def _on_surface(view: WorldView, goal: np.ndarray, xy: np.ndarray) -> bool:
    """Whether ``xy`` (2,) lies on the receptacle that ``goal`` (3,) is on."""
    for place in view.home.receptacles:
        level = -0.05 < goal[2] - place.pos[2] < 0.25
        if level and (np.abs(place.local(goal[:2])) < np.array(place.half)).all():
            return bool((np.abs(place.local(xy)) < np.array(place.half) - 0.02).all())
    return False


@phase("put the object down")
def _put(
    view: WorldView, obj: str, placement: BasePlacement, goals: HandGoals, depth: float
) -> Motion:
    """Drive to the base placement, lower the object, release it, retreat. Returns whether it is released."""
    pos = goals.pos[placement.goal]
    rot = goals.rot[placement.goal]
    pre = goals.pre[placement.goal]
    closed = motion.CLOSED
    yield from follow(view, placement.route, gripper=closed, held=obj)
    if not holds(view, obj):
        return False
    if depth:
        boxes, _ = surroundings(view, obj, pos)
        yield from drive_in(view, ReachIn(placement.pre, pre, rot), boxes, gripper=closed)
    joints = settle_reach(view, placement, np.stack([pre, pos]), rot)
    if joints is None:
        # The release pose is out of reach from here: use the planned posture, which deviates as the base does.
        joints, (pos, pre), rot = _beside(view, placement, goals)
        if np.linalg.norm(pos - goals.pos[placement.goal]) > MAX_BESIDE_M:
            return False
    for speed in SOFT_START:
        yield from motion.move_joints(
            view, joints[0], gripper=closed, tolerance=0.04, max_steps=1, speed=speed
        )
    yield from motion.move_joints(
        view, joints[0], gripper=closed, tolerance=0.04, max_steps=20
    )
    near = motion.HandMove(
        pos=pre,
        rot=rot,
        gripper=closed,
        rest=joints[1],
        tolerance=0.015,
        max_steps=20,
        torso=False,
    )
    yield from motion.move_tcp(view, near)
    down = replace(near, pos=pos, speed=0.2, tolerance=0.005, max_steps=25)
    yield from motion.move_tcp(view, down)
    until = wait_for(view, motion.is_quiet)
    yield from motion.still_tcp(view, pos, rot, gripper=closed, steps=2, until=until)
    opening = motion.gripper_at(view.robot, let_go_width(view, obj, pos, rot))
    speed = away_speed(view)
    until = wait_for(view, motion.has_opened(opening))
    yield from motion.still_tcp(view, pos, rot, gripper=opening, steps=5, until=until)
    for back in (drawn_back(view, obj, pos, rot, joints[0]), pre):
        away = motion.HandMove(
            pos=back,
            rot=rot,
            gripper=opening,
            rest=joints[0],
            speed=speed,
            tolerance=0.02,
            max_steps=14,
            torso=False,
        )
        yield from motion.move_tcp(view, away)
        if not holds(view, obj):
            return True
    # Wide objects can still touch the open fingers: at the goal they count as released.
    return bool(view.signal("at_goal"))


def _beside(
    view: WorldView, placement: BasePlacement, goals: HandGoals
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Planned arm postures at the present base pose, for a base that stands beside its base placement.

    Returns:
        Configurations (2, J) above and at the release pose; tcp positions (2, 3) at and above it, in this order; and
        the tcp rotation (3, 3) at the release pose.
    """
    q = np.stack([placement.pre, placement.at])
    q[:, BASE] = view.base
    chain = view.robot.chain
    frames = chain.forward(q)
    tip = chain.tip_index
    return q, frames.pos[::-1, tip], frames.rot[1, tip]
