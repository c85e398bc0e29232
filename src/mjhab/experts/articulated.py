"""Experts that open and close the drawer and the fridge door of SetTable."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from mjhab.envs.privileged import JointedLink, WorldView
from mjhab.experts import motion, reach
from mjhab.experts.kinematics import wrap

Array = np.ndarray
Motion = motion.Motion
PRE_GRASP = 0.09
"""Distance from which the open hand goes straight onto a handle [m]."""


def open_link(view: WorldView) -> Motion:
    """Open the active subtask's link and return to rest."""
    subtask = view.subtask
    assert subtask is not None
    link = view.home.links[subtask.link]
    work = open_drawer if link.spec.joint == "slide" else open_drawer
    yield from work(view, link)
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))


def close_link(view: WorldView) -> Motion:
    """Close the active subtask's link and return to rest."""
    subtask = view.subtask
    assert subtask is not None
    link = view.home.links[subtask.link]
    work = close_drawer if link.spec.joint == "slide" else close_drawer
    yield from work(view, link)
    return (yield from motion.stay_at_rest(view, gripper=motion.OPEN))


# -- drawer --------------------------------------------------------------------------------------------------------

_STANCES: dict[tuple[str, str], reach.Stances] = {}


def _cached(link: JointedLink, job: str, search: Callable[[JointedLink], reach.Stances]) -> reach.Stances:
    key = (link.id, job)
    if key not in _STANCES:
        _STANCES[key] = search(reach.local(link))
    return _STANCES[key]


def _square(handle: Array, near: Array, side: Array) -> Array:
    """Base poses (N, 3) that face the furniture squarely, ``near`` before a handle and ``side`` beside it."""
    x, y = np.meshgrid(handle[0] + near, handle[1] + side, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, np.pi)], axis=1)


def _pull_stances(link: JointedLink) -> reach.Stances:
    """Before the closed drawer: hand before the handle, then on it, fingers above and below the bar."""
    handle, _, out = link.handle_pose(0.0)
    base = _square(handle, np.arange(0.62, 0.96, 0.04), np.linspace(-0.24, 0.24, 9))
    boxes = [link.boxes(0.0), link.boxes(0.0)]
    found = []
    for up in (1.0, -1.0):
        rot = reach.hand(-out, np.array([0.0, 0.0, up]))
        found.append(_on_handle(base, handle, out, rot, boxes))
    return _joined(found)


def _on_handle(base: Array, handle: Array, out: Array, rot: Array, boxes: list) -> reach.Stances:
    n = len(base)
    pos = np.stack([handle + PRE_GRASP * out, handle])
    return reach.track(
        np.repeat(base[:, None], 2, axis=1), np.broadcast_to(pos, (n, 2, 3)), np.broadcast_to(rot, (n, 2, 3, 3)), boxes
    )


def _joined(parts: list[reach.Stances]) -> reach.Stances:
    return reach.Stances(np.concatenate([p.q for p in parts]), np.concatenate([p.steps for p in parts]))


def open_drawer(view: WorldView, link: JointedLink) -> Motion:
    """Grasp the bar, back up with it, let go and return to rest."""
    frame = reach.Frame.of(link)
    goal = 0.95 * link.range[1]
    while view.steps_left > 20 and view.link_q(link.id) < 0.92 * link.range[1]:
        yield from _take_handle(view, link, frame)
        yield from _back_up(view, link, goal)
        yield from _let_go(view, 0.08)
    return (yield from motion.to_rest(view, gripper=motion.OPEN))


def _take_handle(view: WorldView, link: JointedLink, frame: reach.Frame) -> Motion:
    stances = _cached(link, "pull", _pull_stances)
    travel = link.range[1] - link.range[0]
    ends = stances.q[:, 0, :2] + np.array([travel + 0.05, 0.0])
    chosen = reach.choose(view, frame, stances, ends[:, None])
    if chosen is None:
        return False
    before = chosen[0][0]
    yield from _go(view, before, motion.OPEN)
    q = view.link_q(link.id)
    handle, _, out = link.handle_pose(q)
    rot = reach.hand(-out, np.array([0.0, 0.0, 1.0 if _is_up(before) else -1.0]))
    yield from motion.move_tcp(view, handle, rot, gripper=motion.OPEN, speed=0.3, max_steps=30, rest=chosen[0][1])
    return (yield from motion.close_fingers(view, link.id))


def _is_up(q: Array) -> bool:
    _, rot = motion.chain().tip_pose(q)
    return bool(rot[0, 2, 1] > 0)


def _go(view: WorldView, goal: Array, gripper: float, max_steps: int = 110) -> Motion:
    """Bring base and arm to a configuration together."""
    yield from motion.drive_to(view, goal[:3], gripper=gripper, arm=goal, max_steps=max_steps)
    return (yield from motion.move_joints(view, goal, gripper=gripper, tolerance=0.06, max_steps=60))


def _back_up(view: WorldView, link: JointedLink, goal: float, speed: float = 0.45) -> Motion:
    """Drive backwards with the arm held until the link has moved to ``goal``; False when the handle slips away."""
    posture, heading = view.q, float(view.q[2])
    last, still = view.link_q(link.id), 0
    for _ in range(60):
        now = view.link_q(link.id)
        if now >= goal:
            return True
        still = still + 1 if now - last < 0.002 else 0
        if still > 8:
            return False
        last = now
        v = min(speed, 0.06 + 3.0 * (goal - now))
        w = float(np.clip(3.0 * wrap(heading - view.q[2]), -0.5, 0.5))
        yield motion.action(view, posture, gripper=motion.CLOSED, drive=(-v, w))
    return False


def _let_go(view: WorldView, way: float) -> Motion:
    """Open the hand, then back away from what it held."""
    posture = view.q
    yield from motion.hold(view, 4, gripper=motion.OPEN, goal=posture)
    start = view.q[:2]
    for _ in range(25):
        if np.linalg.norm(view.q[:2] - start) >= way:
            break
        yield motion.action(view, posture, gripper=motion.OPEN, drive=(-0.4, 0.0))
    return True


def close_drawer(view: WorldView, link: JointedLink) -> Motion:
    """Push the handle with the closed fingers by driving forward."""
    frame = reach.Frame.of(link)
    goal = link.range[0] + 0.004 * (link.range[1] - link.range[0])
    while view.steps_left > 20 and view.link_q(link.id) > goal:
        stances = _cached(link, "push", _push_stances)
        shift = np.zeros(stances.q.shape[-1])
        shift[0] = view.link_q(link.id)
        moved = reach.Stances(stances.q + shift, stances.steps)
        chosen = reach.choose(view, frame, moved, stances.q[:, :1, :2])
        if chosen is None:
            return False
        yield from _go(view, chosen[0][0], motion.CLOSED)
        yield from _push_forward(view, link, goal)
        yield from _let_go(view, 0.08)
    return (yield from motion.to_rest(view, gripper=motion.OPEN))


@lru_cache(maxsize=1)
def _unused() -> None:
    return None


def _push_stances(link: JointedLink) -> reach.Stances:
    """Before the handle of the closed drawer (a drawer that is open moves everything along): the fist at the bar."""
    handle, _, out = link.handle_pose(0.0)
    base = _square(handle, np.arange(0.58, 0.92, 0.04), np.linspace(-0.24, 0.24, 9))
    n = len(base)
    pos = np.stack([handle + 0.10 * out, handle + 0.04 * out])
    rot = reach.hand(-out, np.array([0.0, 0.0, 1.0]))
    return reach.track(
        np.repeat(base[:, None], 2, axis=1), np.broadcast_to(pos, (n, 2, 3)), np.broadcast_to(rot, (n, 2, 3, 3)),
        [link.boxes(0.0), link.boxes(0.0)], mode="approach",
    )  # fmt: skip


def _push_forward(view: WorldView, link: JointedLink, goal: float, speed: float = 0.45) -> Motion:
    posture, heading = view.q, float(view.q[2])
    for _ in range(70):
        now = view.link_q(link.id)
        if now <= goal:
            return True
        v = min(speed, 0.05 + 3.0 * (now - goal))
        w = float(np.clip(3.0 * wrap(heading - view.q[2]), -0.5, 0.5))
        yield motion.action(view, posture, gripper=motion.CLOSED, drive=(v, w))
    return False
