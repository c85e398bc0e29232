"""How Push is done: the closed hand comes down behind the object and sweeps it to its goal."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np

from mjhab.core.rotations import frame_from_axes
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.route import drive_to
from mjhab.experts.phases import phase

STAND_OFF_M = 0.75
DRIVE_FROM_M = 0.9
"""How far from the middle of the way the base stops; it drives only if it is further away than the second."""
TILT_RAD = 0.5
"""The fingers point so far outwards, away from the base: so they reach further."""
GAP_M = 0.03
"""Room between the fingers and the object before the sweep."""
FLOOR_GAP_M = 0.012
LIFT_M = 0.12
"""How high over the table the hand comes and goes."""
NEAR_ENOUGH_M = 0.06
STROKES = 3
SWEEP_SPEED = 0.15
TRAVEL_SPEED = 0.4
"""Of the hand [m/s]."""

Script = Generator[np.ndarray, None, Any]


def push(view: WorldView) -> Script:
    """Push the active subtask's object into its zone and go home; again while it is short of it."""
    subtask = view.subtask
    assert subtask is not None
    goal = np.array(subtask.goal_pos)
    yield from come_near(view, (view.object_pose(subtask.obj)[:2] + goal[:2]) / 2)
    for _ in range(STROKES):
        if np.linalg.norm(view.object_pose(subtask.obj)[:2] - goal[:2]) < NEAR_ENOUGH_M:
            break
        yield from stroke(view, subtask.obj, goal)
    yield from motion.to_rest(view, gripper=motion.CLOSED)
    return (yield from motion.stay_at_rest(view, gripper=motion.CLOSED))


def come_near(view: WorldView, middle: np.ndarray) -> Script:
    """Drive to where object and goal are in reach, unless they are."""
    here = view.base[:2]
    if np.linalg.norm(here - middle) <= DRIVE_FROM_M:
        return
    floor = planner(view, shut=True)
    angles = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    ring = middle + STAND_OFF_M * np.column_stack([np.cos(angles), np.sin(angles)])
    for spot in sorted(ring, key=lambda xy: float(np.linalg.norm(xy - here))):
        if floor.plan(here, spot) is not None:
            toward = middle - spot
            pose = np.array([*spot, np.arctan2(toward[1], toward[0])])
            yield from drive_to(view, pose, gripper=motion.CLOSED)
            return


@phase("sweep the object")
def stroke(view: WorldView, obj: str, goal: np.ndarray) -> Script:
    """One sweep from behind the object to its goal."""
    pos = view.object_pose(obj)[:3]
    half = np.array(view.object_type(obj).half)
    hand = view.robot.gripper
    offset = (goal - pos)[:2]
    ahead = np.array([*(offset / np.linalg.norm(offset)), 0.0])
    rot = hand_rotation(view, pos, ahead)
    height = pos[2] - half[2] + hand.finger[0] + FLOOR_GAP_M
    behind = float(np.hypot(half[0], half[1])) + hand.finger[1]
    begin = np.array([*(pos - (behind + GAP_M) * ahead)[:2], height])
    end = np.array([*(goal - behind * ahead)[:2], height])
    lift = np.array([0.0, 0.0, LIFT_M])
    for point, speed, steps in (
        (begin + lift, TRAVEL_SPEED, 50),
        (begin, TRAVEL_SPEED, 20),
        (end, SWEEP_SPEED, 50),
        (end + lift, TRAVEL_SPEED, 10),
    ):
        yield from motion.move_tcp(
            view,
            motion.HandMove(
                pos=point, rot=rot, gripper=motion.CLOSED, speed=speed, max_steps=steps
            ),
        )


def hand_rotation(view: WorldView, pos: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of the hand: fingers down and outwards, both of them across the way ``ahead`` (3,)."""
    outwards = pos[:2] - view.base[:2]
    outwards = outwards / np.linalg.norm(outwards)
    approach = np.array([*(np.sin(TILT_RAD) * outwards), -np.cos(TILT_RAD)])
    aside = np.array([-ahead[1], ahead[0], 0.0])
    _, rot = motion.tcp(view)
    if aside @ rot[:, 1] < 0:
        aside = -aside
    aside = aside - (aside @ approach) * approach
    return frame_from_axes(approach, aside / np.linalg.norm(aside))
