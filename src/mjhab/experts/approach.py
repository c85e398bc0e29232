"""Motions that drawers and doors have in common: getting to a stance, taking a handle, letting go."""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.envs.privileged import JointedLink, WorldView
from mjhab.experts import motion
from mjhab.experts.kinematics import wrap
from mjhab.experts.route import Route, follow, plan_route

Array = np.ndarray
Motion = motion.Motion
ROUTES_TRIED = 4
"""Stances whose way is looked at before the roomiest is taken."""


def obstacles(view: WorldView) -> Boxes:
    """Everything the robot should not touch on its way: walls, furniture, links as they are now."""
    return Boxes.join([motion.as_boxes(view.home.boxes), motion.as_boxes(view.link_boxes())])


def best_route(view: WorldView, goals: Array) -> tuple[int, Route] | None:
    """The first of some configurations (M, 15), most wanted first, that can be reached without touching anything.

    Returns:
        Its index and the way there; where none is free, the one with the most room; None when there is no way.
    """
    boxes = obstacles(view)
    best: tuple[int, Route] | None = None
    for i, goal in enumerate(goals[:ROUTES_TRIED]):
        found = plan_route(view, goal[:3], goal, motion.spheres(), boxes)
        if found is None:
            continue
        if best is None or found.room > best[1].room:
            best = (i, found)
        if found.room > 0.0:
            break
    return best


def go(view: WorldView, route: Route, gripper: float) -> Motion:
    """Bring base and arm to the end of a route."""
    return (yield from follow(view, route, gripper=gripper))


def creep(view: WorldView, posture: Array, heading: float, speed: float, gripper: float) -> Array:
    """One action: drive at ``speed`` [m/s] along ``heading``, the arm held."""
    turn = float(np.clip(3.0 * wrap(heading - view.q[2]), -0.5, 0.5))
    return motion.action(view, posture, gripper=gripper, drive=(speed, turn))


def let_go(view: WorldView, way: float, speed: float = 0.4) -> Motion:
    """Open the hand, then back away [m] from what it held."""
    posture = view.q
    yield from motion.hold(view, 4, gripper=motion.OPEN, goal=posture)
    return (yield from retreat(view, posture, way, speed))


def retreat(view: WorldView, posture: Array, way: float, speed: float = 0.4) -> Motion:
    """Drive ``way`` [m] backwards, the arm going to ``posture``."""
    start, heading = view.q[:2], float(view.q[2])
    for _ in range(30):
        if np.linalg.norm(view.q[:2] - start) >= way:
            return True
        yield creep(view, posture, heading, -speed, motion.OPEN)
    return False


def take(view: WorldView, link: JointedLink, rot: Array, posture: Array) -> Motion:
    """Put the open hand straight onto the handle and close it. Returns whether both fingers press."""
    handle, _, _ = link.handle_pose(view.link_q(link.id))
    yield from motion.move_tcp(view, handle, rot, gripper=motion.OPEN, speed=0.3, max_steps=30, rest=posture)
    return (yield from motion.close_fingers(view, link.id))
