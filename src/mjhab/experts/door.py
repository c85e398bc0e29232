"""Opening and closing a hinged door: the hand follows the door's arc while the base drives along."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.envs.privileged import BoxArrays, JointedLink, WorldView
from mjhab.experts import approach, ik, motion, stances
from mjhab.experts.navigation import CONTROL_DT
from mjhab.experts.stances import Frame, Stances

Array = np.ndarray
Motion = motion.Motion
OPEN_TO = 0.775
"""Share of the range to pull to; 0.75 counts as open."""
PRE_GRASP = 0.11
"""Distance from which the open hand goes straight onto the bar [m]."""
AROUND, LOOSE = 0.045, 0.03
"""Room [m] beside the bar in a hand that goes around it or frees it; opened wide, the inner finger would push the door.
"""
ABOVE_MIDDLE = 0.13
"""Height over the middle of the bar at which it is taken, nearer to where the hand rests [m]."""
THICK = 0.035
"""Thickness of a bar that the hand must take squarely and that hardly turns between the pads [m]."""
SHUT = 0.006
"""Share of the range at which a door is left as closed; 0.01 counts."""
PRESS_AHEAD, PRESS_PAST = 0.16, 0.02
"""How far from an open door the hand starts, and how far beyond the closed one it aims [rad]."""
BEHIND = 0.25
"""Way the hand goes straight in behind an open door [m]."""
ABOVE_BAR = 0.08
"""Height over the end of the bar at which the door is pushed [m]."""
FROM_EDGE = 0.06
"""Least distance from the free edge of the door at which it is pushed [m]."""
HALF_OPEN = 0.95
"""Share of the range up to which the hand need not start as far behind the door as for a wide open one."""
STANCES_TRIED = 16
"""Stances whose surroundings are looked at."""
JOINT_RATE = 0.037
"""Joint motion per control step at which the hand leads the door [rad]."""
SWING = 0.045
"""Most the hand's aim moves along the door's arc per control step [rad]."""
LATE = 12
"""Control steps the door may lag behind the end of the path before the hand gives up."""
AT_REST = 0.002
"""Most a door at rest moves per control step [rad]."""
PRESS_STEPS = 2
"""Control steps for which a closed door has to rest."""
JAMMED = 300.0
"""Contact force on the arm with which a motion is given up [N]."""
TIP, FINGER_SIDE = 0.031, 0.0144
"""Fingertip before the tool centre and half-width of the closed fingers [m]."""


def open_door(view: WorldView, link: JointedLink) -> Motion:
    """Grasp the bar, follow its arc, let go and return to rest; anew after a slip."""
    enough = 0.76 * link.range[1]
    while view.steps_left > 40 and view.link_q(link.id) < enough:
        path = _reachable(view, link, stances.cached(link, "pull", _pull_stances), _pull_angles(link))
        if path is None:
            return False
        around, loose = (motion.gripper_at(link.handle.thickness + room) for room in (AROUND, LOOSE))
        yield from approach.go(view, path.route, around)
        rot = path.hand_at(path.angles[1])[1]
        if (yield from approach.take(view, link, rot, path.q[1], height=path.height, gripper=around)):
            yield from _follow_arc(view, link, path, OPEN_TO * link.range[1], motion.CLOSED)
        yield from approach.let_go(view, 0.12, gripper=loose)
    return (yield from approach.fold(view))


def close_door(view: WorldView, link: JointedLink) -> Motion:
    """Reach behind the door and push it shut along its arc."""
    closed = SHUT * link.range[1]
    while view.steps_left > 40 and view.link_q(link.id) > closed:
        start = view.link_q(link.id) + PRESS_AHEAD
        half = start < HALF_OPEN * link.range[1]
        search = _push_half_open if half else _push_open
        angles = _push_angles(link, half)
        found, angles = _from_angle(stances.cached(link, search.__name__, search), angles, min(start, angles[0]))
        path = _reachable(view, link, found, angles, BEHIND)
        if path is None:
            return False
        yield from approach.go(view, path.route, motion.CLOSED)
        yield from motion.move_joints(view, path.q[0], gripper=motion.CLOSED, tolerance=0.25, max_steps=25)
        if _inward(link):
            yield from _behind_edge(view, path)
        yield from _follow_arc(view, link, path, closed, motion.CLOSED)
        yield from approach.retreat(view, 0.06)
    return (yield from approach.fold(view))


@dataclass(frozen=True, eq=False)
class ArcPath:
    """Configurations ``q`` (K, 15) for door angles ``angles`` (K,) (monotonic), and the way to the first one.

    The hand's pose comes from the configurations, relative to where the base should be: no frames to keep."""

    q: Array
    angles: Array
    route: approach.Route

    def at(self, angle: float) -> Array:
        """Configuration (15,) at a door angle."""
        order = np.argsort(self.angles)
        x = self.angles[order]
        return np.array([np.interp(angle, x, column) for column in self.q[order].T])

    def hand_at(self, angle: float) -> tuple[Array, Array]:
        """Hand position (3,) and rotation (3, 3) in the world at a door angle."""
        pos, rot = motion.chain().tip_pose(self.at(angle))
        return pos[0], rot[0]

    @property
    def height(self) -> float:
        """Height of the hand [m]."""
        return float(self.hand_at(self.angles[-1])[0][2])


def _follow_arc(view: WorldView, link: JointedLink, path: ArcPath, goal: float, gripper: float) -> Motion:
    """Move hand and base along the path until the door is at ``goal``; False when the hand loses the door."""
    way = 1.0 if goal > view.link_q(link.id) else -1.0
    aim, end = float(path.angles[1 if way > 0 else 0]), float(path.angles[-1])
    last, late, pressed, done = np.inf, 0, 0, 0
    for _ in range(110):
        now = view.link_q(link.id)
        # A door that was thrown shut may swing back.
        there = way * (goal - now) <= 0 and (way > 0 or abs(now - last) < AT_REST)
        done, last = done + 1 if there else 0, now
        if done > (0 if way > 0 else PRESS_STEPS):
            return True
        pressed = pressed + 1 if view.link_forces.sum() > JAMMED else 0
        if pressed > 2:
            return False
        pace = _pace(path, aim, way)
        if way < 0:
            pace = min(pace, 0.012 + 0.1 * max(aim, 0.0))
        lead = 0.3 if way > 0 else PRESS_AHEAD + 0.15
        if way * (aim - now) < lead:
            aim += way * pace
        aim = min(aim, end) if way > 0 else max(aim, end)
        late = late + 1 if aim == end else 0
        if late > LATE:
            return False
        if way > 0 and not view.finger_forces(link.id).any() and now < 0.9 * goal and _far(view, link, path):
            return False
        yield _arc_action(view, path, aim, way * pace, gripper)
    return False


def _behind_edge(view: WorldView, path: ArcPath) -> Motion:
    """Bring the hand to the beginning of a path: with the base not quite in place it might meet the door's edge."""
    pos, rot = path.hand_at(float(path.angles[0]))
    return (
        yield from motion.move_tcp(
            view, pos, rot, gripper=motion.CLOSED, speed=0.8, tolerance=0.05, angle_tolerance=0.5, max_steps=8,
            rest=path.q[0], mode="approach",
        )
    )  # fmt: skip


def _far(view: WorldView, link: JointedLink, path: ArcPath) -> bool:
    handle = link.handle_pose(view.link_q(link.id))[0]
    return bool(np.linalg.norm(motion.tcp(view)[0][:2] - handle[:2]) > 0.06)


def _pace(path: ArcPath, angle: float, way: float) -> float:
    """Door motion per control step that the arm's joints can follow [rad]."""
    here, there = path.at(angle), path.at(angle + way * 0.1)
    most = float(np.abs(there - here)[list(motion.ARM_JOINTS)].max())
    return min(SWING, 0.1 * JOINT_RATE / max(most, 1e-6))


def _arc_action(view: WorldView, path: ArcPath, aim: float, step: float, gripper: float) -> Array:
    wish = path.at(aim)
    pos, rot = path.hand_at(aim)
    q = view.q
    ahead = (path.at(aim + step)[:2] - wish[:2]) @ np.array([np.cos(q[2]), np.sin(q[2])])
    v, w = approach.base_towards(view, wish, float(ahead) / CONTROL_DT)
    base_next = approach.next_base(view, v, w)
    robot = motion.chain()
    here, _ = motion.tcp(view)
    lead = pos - here
    pos = here + lead * min(1.0, 0.08 / max(float(np.linalg.norm(lead)), 1e-9))
    delta = ik.servo(robot, q, pos[None], rot[None], ik.columns(robot), rest=wish, base_next=base_next, rest_gain=0.1)[
        0
    ]
    return motion.action(view, q + delta / motion.ARM_DELAY, gripper=gripper, drive=(v, w))


def _reachable(view: WorldView, link: JointedLink, found: Stances, angles: Array, back: float = 0.0) -> ArcPath | None:
    """The soonest reached stance whose whole motion has room in this home; ``back`` [m]: how far from its beginning the
    hand comes straight in."""
    goals, _ = stances.rank(view, Frame.of(link), found)
    walls = Boxes.join([motion.as_boxes(view.home.boxes), motion.as_boxes(view.link_boxes((link.id,)))])
    goals = goals[_distinct(goals[:, 0, :3])[:STANCES_TRIED]]
    free = np.array([g for g in goals if motion.spheres().clearance(g, walls).min() > 0.01])
    if not len(free):
        return None
    before = _withdrawn(free[:, 0], back) if back > 0 else None
    best = approach.best_route(view, free[:, 0], before, link if back > 0 else None)
    return None if best is None else ArcPath(free[best[0]], angles, best[1])


def _distinct(base: Array) -> Array:
    """Indices of the first of every group of like base poses (N, 3), in order."""
    _, first = np.unique(np.round(base / [0.1, 0.1, 0.2]), axis=0, return_index=True)
    return np.sort(first)


def _withdrawn(q: Array, back: float) -> Array:
    """Configurations (M, Q) with the hand drawn back along its own axis, where the arm can do that."""
    robot = motion.chain()
    pos, rot = robot.tip_pose(q)
    found = ik.solve(
        robot, pos - back * rot[:, :, 0], rot, q[:, None], ik.columns(robot), rest=q[0],
        options=ik.Options(iterations=25, rest_gain=0.0),
    )  # fmt: skip
    near = np.abs(found.q[:, 0, 3:] - q[:, 3:]).max(axis=1) < 1.2
    good = found.ok[:, 0] & near & (motion.spheres().self_clearance(found.q[:, 0]) > stances.SELF_MARGIN)
    return np.where(good[:, None], found.q[:, 0], q)


def _from_angle(found: Stances, angles: Array, start: float) -> tuple[Stances, Array]:
    """What is left of the motions when they begin at the door angle ``start``, and the angles of what is left."""
    k = int(np.searchsorted(-angles, -start))
    if k == 0:
        return found, angles
    share = (angles[k - 1] - start) / (angles[k - 1] - angles[k])
    first = (1.0 - share) * found.q[:, k - 1] + share * found.q[:, k]
    robot = motion.chain()
    steps = ik.travel_steps(robot, stances.REST_QPOS, first, ik.columns(robot))
    q = np.concatenate([first[:, None], found.q[:, k:]], axis=1)
    return Stances(q, steps, found.back), np.append(start, angles[k:])


# -- searches in the plan frame ------------------------------------------------------------------------------------


def _pull_angles(link: JointedLink) -> Array:
    return np.append(-0.01, np.linspace(0.0, (OPEN_TO + 0.03) * link.range[1], 9))


def _push_angles(link: JointedLink, half: bool) -> Array:
    first = (HALF_OPEN * link.range[1]) if half else link.range[1] + PRESS_AHEAD
    return np.append(np.linspace(first, 0.0, 10), -PRESS_PAST)


def _hand_side(link: JointedLink) -> float:
    """1 for a door with its bar at negative y, to the left as seen from outside, for which the searches are written
    down; -1 for its mirror image."""
    return -float(np.sign(link.handle.pos[1]))


def _inward(link: JointedLink) -> float:
    """Way along y [m] from the bar to where the door is pushed: 0 unless the bar is at the door's very edge."""
    m, (low, high) = _hand_side(link), _panel(link)
    edge = (low if m > 0 else high)[1]
    lack = FROM_EDGE - abs(edge - link.handle.pos[1])
    return m * lack if lack > 0.001 else 0.0


def _line(
    near: Array, side: Array, headings: Iterable[float], ways: tuple[float, ...], share: Array
) -> Array:  # fmt: skip
    """Base paths (N, K, 3): from points of a grid backwards along a heading, ``share`` (K,) of the way."""
    out = []
    for x, y, heading, way in product(near, side, headings, ways):
        back = np.array([np.cos(heading), np.sin(heading)]) * way
        out.append(np.c_[np.array([x, y]) + share[:, None] * back, np.full(len(share), np.pi + heading)])
    return np.array(out)


def _in_reach(base: Array, hands: Array) -> Array:
    """Base paths (N, K, 3) whose shoulder is at a workable distance of the hands (K, 3) all the way."""
    yaw = base[..., 2]
    shoulder = base[..., :2] + 0.15 * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    far = np.linalg.norm(shoulder - hands[None, :, :2], axis=-1)
    return (far.max(axis=1) < 0.95) & (far.min(axis=1) > 0.35)


def _panel(link: JointedLink) -> tuple[Array, Array]:
    """Least and greatest corner (3,) of the closed door without its bar and shelves."""
    boxes = link.boxes(0.0)
    k = int(np.argmax(boxes.half.prod(axis=1)))
    reach = np.abs(boxes.rot[k]) @ boxes.half[k]
    return boxes.center[k] - reach, boxes.center[k] + reach


def _carcass(link: JointedLink) -> BoxArrays:
    low, high = _panel(link)
    middle = np.array([low[0] - 0.006 - 0.31, (low[1] + high[1]) / 2, 0.975])
    return BoxArrays(middle[None], np.array([[0.31, (high[1] - low[1]) / 2, 0.975]]), np.eye(3)[None])


def _with_door(link: JointedLink, angle: float) -> BoxArrays:
    parts = (_carcass(link), link.boxes(max(angle, 0.0)))
    return BoxArrays(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("center", "half", "rot")))


def _level(yaw: Array) -> Array:
    """Hands (K, 3, 3) that point level against the directions ``yaw`` (K,), fingers side by side."""
    forward = -np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=-1)
    return stances.hand(forward, np.stack([-forward[:, 1], forward[:, 0], 0.0 * yaw], axis=-1))


def _search(
    link: JointedLink, base: Array, pos: Array, rot: Array, angles: Array, tries: int, mode: ik.Mode = "pose"
) -> Stances:  # fmt: skip
    base = base[_in_reach(base, pos)]
    n = len(base)
    return stances.track(
        base, np.broadcast_to(pos, (n, *pos.shape)), np.broadcast_to(rot, (n, *rot.shape)),
        [_with_door(link, float(a)) for a in angles], tries=tries, mode=mode,
    )  # fmt: skip


def _pull_stances(link: JointedLink) -> Stances:
    """Hand before the bar, on it, and along its arc. The hand turns less than the door: the pads let the bar turn."""
    angles = _pull_angles(link)
    grip = np.array([link.handle_pose(max(a, 0.0))[0] for a in angles])
    grip[:, 2] += ABOVE_MIDDLE
    share = np.clip(angles / angles[-1], 0.0, 1.0)
    m = _hand_side(link)
    thick = link.handle.thickness > THICK
    headings = m * np.array([0.6, 0.9, 1.2, 1.5] if thick else [0.3, 0.6, 0.9])
    ways = (0.5, 0.65, 0.8, 0.95) if thick else (0.4, 0.6)
    base = _line(np.arange(0.8, 1.25, 0.1), m * np.arange(-0.85, 0.15, 0.15), headings, ways, share)
    found = []
    for first, last in ((0.0, 0.6), (0.0, 1.2), (0.15, 0.7)) if thick else ((0.4, 0.6), (0.8, 0.7)):
        yaw = m * (first + (last - first) * share)
        pos = grip.copy()
        pos[0] += PRE_GRASP * np.array([np.cos(yaw[0]), np.sin(yaw[0]), 0.0])
        found.append(_search(link, base, pos, _level(yaw), angles, tries=5))
    return Stances.join(found)


def _push_open(link: JointedLink) -> Stances:
    return _push_stances(link, _push_angles(link, half=False))


def _push_half_open(link: JointedLink) -> Stances:
    return _push_stances(link, _push_angles(link, half=True))


def _push_stances(link: JointedLink, angles: Array) -> Stances:
    """The closed fingers on the outside of the door above its bar, from behind the open door to the closed one."""
    share = np.clip(1.0 - angles / angles[0], 0.0, 1.0)
    ways = (-1.0, -0.8, -0.6, -0.4)
    m = _hand_side(link)
    headings = m * np.array([0.3, 0.6, 0.9])
    base = _line(np.arange(0.9, 1.7, 0.1), m * np.arange(-0.1, 1.05, 0.1), headings, ways, share)
    handle, face, inward = link.handle, _panel(link)[1][0], _inward(link)
    found = []
    for first, last in ((0.0, 0.0), (0.0, 0.4), (0.5, 0.4)):
        yaw = first + (last - first) * share
        lag = angles - yaw
        gap = face + TIP * np.abs(np.cos(lag)) + FINGER_SIDE * np.abs(np.sin(lag)) - handle.pos[0]
        pos = []
        for angle, more in zip(angles, gap, strict=True):
            at, bar, out = link.handle_pose(float(angle))
            across = np.array([-out[1], out[0], 0.0])
            pos.append(at + more * out + inward * across + (handle.half_length + ABOVE_BAR) * bar)
        found.append(_search(link, base, np.array(pos), _level(m * yaw), angles, tries=5, mode="approach"))
    return Stances.join(found)
