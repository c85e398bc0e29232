"""Hand poses that release a held object near its goal: beside it, on other sides, tilted.

Lengths [m], angles [rad], world frame.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_quat, mat_from_rotation_vector
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.pinch import ObjectShape
from mjhab.experts.arm import motion
from mjhab.experts.planning.reach import hand_clearance
from mjhab.experts.planning.release import (
    TIGHT_PLAY_M,
    play,
    tipped,
)
from mjhab.experts.planning.workplace import (
    HandGoals,
)
from mjhab.experts.skills.pick_plans import height_below

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
OFF_PRICE_PER_M = 6.0
"""Score lost per metre beside the goal."""
LEAN_PRICE = 2.5
"""Score lost per radian of tilt at the release under a shelf."""
LAID_PRICE = 2.6
"""Score lost when the object is placed on another side; round objects then roll or fall over."""
STUCK_FACTOR = 3.0
"""Factor on the loss by tilt where the fingers can hardly open: the tilted object stays between them and falls when the
hand retreats."""
GOAL_SHARE = 0.87
"""Share of the goal tolerance within which the object must come to rest after it has tipped over."""


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
    # The fingers are around the object: their present width is the one to check.
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
    # The goal itself is kept in any case: the environment sampled it, whatever the map of surfaces says.
    return [spots[0], *(spot for spot in spots[1:] if _on_surface(view, goal, spot))]


def _orientations(
    view: WorldView, shape: ObjectShape, goal: np.ndarray, release: Release
) -> Iterator[tuple[np.ndarray, float]]:
    """Orientations (3, 3) of the object at its release, with their score: sides, turned about, then tilted."""
    count = SHELF_YAWS if release.shelf else YAWS
    # Without the end point, which is the same as the first.
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
        # A ball has no side to fall on: hardly any price, so that the arm can choose.
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
        # The goal is the centre of the object, up to half of the tallest object above its surface.
        level = -0.05 < goal[2] - place.pos[2] < 0.25
        if level and (np.abs(place.local(goal[:2])) < np.array(place.half)).all():
            # A margin at the edge, because an object that is let go of may tip a little.
            return bool((np.abs(place.local(xy)) < np.array(place.half) - 0.02).all())
    return False
