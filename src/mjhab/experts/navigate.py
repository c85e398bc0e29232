"""The expert that drives to where the next thing is done: no teleport, the arm at rest, its grip kept.

Lengths [m], angles [rad], world frame. Letters: N base poses, H headings, X, Y grid points.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjhab.envs.kinematics import wrap
from mjhab.envs.privileged import TRUNK_LINKS, WorldView
from mjhab.experts import motion
from mjhab.experts.carry import inside_depth
from mjhab.experts.floorplan import Arm, Floorplan, turn_between
from mjhab.experts.lattice import YAWS, Lattice, Leg, length, turns
from mjhab.experts.motion import Motion
from mjhab.experts.navigation import CONTROL_DT
from mjhab.experts.route import BASE_LAG, BLOCKED_FORCE, BLOCKED_STEPS, Pilot

Array = np.ndarray
DISTANCE, NEAREST = 0.95, 0.65
"""How far from its goal the robot would like to stand, so that the hand gets there without much driving."""
WITHIN = 0.12
"""How far inside of the limits of success it shall end, in distance and for the edges of the area."""
FACING = 0.3
"""How far the last heading on the grid may be off the goal; the robot then turns to face it if it has room to."""
BESIDE = 0.5
"""Furniture this near to a goal may be what the goal is on: it hides nothing from the robot."""
SLIMMER = ((0.0, 0.0), (0.015, 0.02), (0.03, 0.05))
"""How much smaller base and arm are taken for, one after the other until there is a way."""
DOOR_MOVED = 0.08
"""Change of a joint [m or rad] after which a way is planned anew."""
NEARLY = 0.5
"""Yaw rate [rad/s] that `Pilot` asks for a tenth of a radian before the end of a turn."""
STUCK_STEPS, STUCK = 15, 0.02
FELT = 0.12
"""Radius of what is assumed where the robot met something unknown."""
SPARE, TOO_CLOSE = 0.02, 5000.0
"""Room a drive should leave, and the seconds per square metre that it costs when there is less."""
SPLITS = 8
"""Most attempts at turning on the spot where curves come too close."""
JOINED_TURN = 2.0
"""Turns up to this may be driven as curves."""


@dataclass(frozen=True)
class Pace:
    """How the base is driven: ``speed`` [m/s], ``rise`` [m/s2] that it gains at most and half of what it loses,
    ``turn`` part of the yaw rate that `Pilot` asks for, ``spin`` [rad/s] and ``jerk`` [rad/s2] its bounds."""

    speed: float = 1.0
    rise: float = 20.0
    turn: float = 1.0
    spin: float = 2.6
    jerk: float = 80.0


BRISK, GENTLE = Pace(), Pace(0.7, 1.5, 0.5, 1.2, 3.0)
"""With an empty hand, and with an object in it that must not slip."""


class Aim(NamedTuple):
    """Where a Navigate leads: to face ``point`` (3,) from about ``distance``, within ``reach``, in ``area`` (4,)."""

    point: Array
    distance: float
    reach: float
    area: Array | None

    @classmethod
    def of(cls, view: WorldView) -> Aim:
        """The aim of the active subtask."""
        subtask = view.subtask
        assert subtask is not None
        point = np.array(subtask.goal_pos)
        distance = DISTANCE + inside_depth(view, point)
        area = view.front_area(subtask.link) if subtask.link else None
        return cls(point, distance, view.config.nav_distance, None if area is None else np.array(area))

    def bearing(self, xy: Array) -> Array:
        """Heading (...,) that faces the goal from ``xy`` (..., 2)."""
        return np.arctan2(self.point[1] - xy[..., 1], self.point[0] - xy[..., 0])

    def allows(self, xy: Array, within: float) -> Array:
        """(...,) bool: near enough and in the area, by ``within`` [m]."""
        good = np.linalg.norm(xy - self.point[:2], axis=-1) <= self.reach - within
        if self.area is not None:
            low, high = self.area[::2] + within, self.area[1::2] - within
            good = good & ((xy >= low) & (xy <= high)).all(axis=-1)
        return good

    def price(self, lattice: Lattice) -> Array:
        """Seconds (H, X, Y) that ending in each node is worth, infinite where it would be no success."""
        xy = lattice.points
        good = self.allows(xy, WITHIN)
        if not good.any():
            good = self.allows(xy, 0.02)
        off = np.abs(wrap(YAWS[:, None, None] - self.bearing(xy)))
        out = np.full(lattice.shape, np.inf)
        far = np.linalg.norm(xy[good] - self.point[:2], axis=-1)
        pay = 4.0 * np.maximum(far - self.distance, 0.0) + 6.0 * np.maximum(NEAREST - far, 0.0)
        pay = pay + 12.0 * (lattice.plan.hidden(xy[good], self.point, BESIDE) > 0.0)
        pay = pay + 3.0 * (lattice.plan.hidden(xy[good], self.point, 0.1) > 0.0)
        room = lattice.room[:, good]
        out[:, good] = np.where(off[:, good] <= FACING, pay + 1.5 * off[:, good], np.inf)
        out[:, good] += 10.0 * np.maximum(0.1 - room, 0.0)
        return out


@dataclass(frozen=True, eq=False)
class Trip:
    """A drive: its legs, how far ahead to steer on each, how fast, expected base poses (T, 3), and the joints of all
    doors and drawers when it was planned."""

    legs: Sequence[Leg]
    lookahead: float
    pace: Pace
    poses: Array
    joints: Array


def navigate(view: WorldView) -> Motion:
    """Drive to the goal of the active Navigate, face it and stand still."""
    subtask = view.subtask
    assert subtask is not None
    held = subtask.obj if subtask.must_hold else ""
    gripper = motion.CLOSED if held else motion.OPEN
    posture = motion.rest_goal(view)
    felt = np.zeros((0, 3))
    aim = Aim.of(view)
    while True:
        trip = plan_trip(view, aim, posture, held, felt)
        if trip is None:
            yield from motion.hold(view, 10, gripper=gripper, goal=posture)
            felt = felt[:0]
            continue
        met = yield from _drive(view, trip, posture, gripper)
        if met is not None:
            felt = np.concatenate([felt, met])
            yield from _back_off(view, posture, gripper, trip)
        elif _arrived(view, aim):
            yield from _stand(view, aim, posture, gripper)


def plan_trip(view: WorldView, aim: Aim, posture: Array, held: str, felt: Array) -> Trip | None:
    """The cheapest way to where the goal is faced, None when there is none.

    Args:
        posture: (15,) of the arm on the way. held: what is in the hand. felt: (B, 3) x, y, radius of what was met.
    """
    arm = Arm.of(view, posture, held)
    whole = Floorplan.of(view, arm, held, felt)
    for base, less in SLIMMER:
        plan = whole.slimmer(base, less)
        lattice = Lattice(plan)
        found = lattice.search(view.q[:3], aim.price(lattice))
        if found is not None:
            return _trip(view, plan, aim, found[1], GENTLE if held else BRISK)
    return None


def _trip(view: WorldView, plan: Floorplan, aim: Aim, legs: list[Leg], pace: Pace) -> Trip:
    """The quickest way to drive legs that keeps the room they have: curves, and turns on the spot where they must be."""
    pose = view.q[:3]
    end, yaw = (legs[-1].points[-1], legs[-1].yaw) if legs else (pose[:2], float(pose[2]))
    last = turn_between(yaw, float(aim.bearing(end)))
    if plan.turning(end, yaw, last) >= 0.0 or not legs:
        legs = [*legs, *turns(end, yaw, last)]
    joints = _joints(view)
    curves = _joined(legs)
    pulled = _pulled(plan, curves)
    asked = min(SPARE, float(plan.room(pose[None])[0]) - 0.03)
    best: tuple[float, Trip] | None = None
    for choice, lookahead in ((pulled, 0.3), (pulled, 0.2), (curves, 0.2), (legs, 0.1)):
        for _ in range(SPLITS):
            poses = _simulate(pose, choice, lookahead, pace)
            room = plan.room(poses)
            lack = max(asked - float(room.min(initial=np.inf)), 0.0)
            cost = CONTROL_DT * len(poses) + TOO_CLOSE * lack**2
            if best is None or cost < best[0]:
                best = (cost, Trip(choice, lookahead, pace, poses, joints))
            if lack == 0.0:
                return best[1]
            split = _split(choice, poses[int(np.argmin(room)), :2])
            if split is None:
                break
            choice = split
    assert best is not None
    return best[1]


def _split(legs: Sequence[Leg], near: Array) -> list[Leg] | None:
    """Legs with a turn on the spot at the curve nearest to a point (2,); None when no curve is left."""
    best: tuple[float, int, int] | None = None
    for i, leg in enumerate(legs):
        for k in range(1, len(leg.points) - 1):
            gap = float(np.linalg.norm(leg.points[k] - near))
            if best is None or gap < best[0]:
                best = (gap, i, k)
    if best is None:
        return None
    _, i, k = best
    leg = legs[i]
    way = leg.points[k + 1] - leg.points[k]
    yaw = float(wrap(np.arctan2(way[1], way[0]) + (0.0 if leg.direction > 0 else np.pi)))
    parts = [Leg(leg.points[: k + 1], leg.direction, yaw), Leg(leg.points[k:], leg.direction, leg.yaw)]
    return [*legs[:i], *parts, *legs[i + 1 :]]


def _joined(legs: Sequence[Leg]) -> list[Leg]:
    """Pieces that go on in the same direction after a moderate turn as one leg with several points."""
    out: list[Leg] = []
    pending: list[Leg] = []
    for leg in legs:
        if not length(leg):
            pending.append(leg)
            continue
        last = out[-1] if out else None
        smooth = last is not None and length(last) and last.direction == leg.direction
        if last is not None and smooth and abs(turn_between(last.yaw, leg.yaw)) < JOINED_TURN and len(pending) < 2:
            out[-1] = Leg(np.concatenate([last.points, leg.points[1:]]), leg.direction, leg.yaw)
        else:
            out += [*pending, leg]
        pending = []
    return out + pending


def _pulled(plan: Floorplan, legs: Sequence[Leg]) -> list[Leg]:
    """Legs without the points that a straight line with as much room (or plenty) makes needless."""
    out = []
    for leg in legs:
        points, kept, i = leg.points, [0], 0
        back = 0.0 if leg.direction > 0 else np.pi
        while i < len(points) - 1:
            j = len(points) - 1
            while j > i + 1 and _line_room(plan, points[[i, j]], back) < min(
                0.08, _line_room(plan, points[i : j + 1], back)
            ):
                j -= 1
            kept.append(j)
            i = j
        out.append(Leg(points[kept], leg.direction, leg.yaw))
    return out


def _line_room(plan: Floorplan, points: Array, back: float) -> float:
    """Least room on straight lines along ``points`` (P, 2), headed along them (``back`` pi: the other way)."""
    poses = []
    for a, b in zip(points, points[1:], strict=False):
        way = b - a
        share = np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(way) / 0.05))[:, None]
        yaw = np.arctan2(way[1], way[0]) + back
        poses.append(np.column_stack([a + share * way, np.full(len(share), yaw)]))
    return float(plan.room(np.concatenate(poses)).min())


class _Driver:
    """Drives the legs of a trip, one after the other; ``leg`` is the present one, None at the end."""

    def __init__(self, legs: Sequence[Leg], lookahead: float, pace: Pace, v: float = 0.0, w: float = 0.0) -> None:
        self._legs, self._lookahead, self._pace = list(legs), lookahead, pace
        self._v, self._w = v, w
        self.leg: Leg | None = None
        self._begin()

    def _begin(self) -> None:
        self.leg = leg = self._legs.pop(0) if self._legs else None
        if leg is not None:
            self._pilot = Pilot(leg.points, leg.yaw, leg.direction, self._lookahead, self._pace.speed)
            self._left = 60 + int(length(leg) / (0.2 * CONTROL_DT))

    def step(self, pose: Array) -> tuple[float, float]:
        """Forward speed and yaw rate for the base at ``pose`` (3,)."""
        v = w = 0.0
        while self.leg is not None:
            v, w, done = self._pilot.step(pose)
            self._left -= 1
            # Only the last leg has to end exactly: a turn on the spot that is nearly done leads into the next one.
            done = done or (bool(self._legs) and v == 0.0 and abs(w) < NEARLY)
            if not done and self._left >= 0:
                break
            self._begin()
            v = w = 0.0
        pace = self._pace
        gain, change = pace.rise * CONTROL_DT, pace.jerk * CONTROL_DT
        self._v = _towards(v, self._v, gain)
        w = float(np.clip(pace.turn * w, -pace.spin, pace.spin))
        self._w = float(np.clip(w, self._w - change, self._w + change))
        return self._v, self._w


def _towards(wish: float, now: float, gain: float) -> float:
    """A speed nearer to the wished one, by ``gain`` where it grows and by twice as much where it falls."""
    up, down = (gain, 2.0 * gain) if now >= 0.0 else (2.0 * gain, gain)
    return float(np.clip(wish, now - down, now + up))


def _simulate(pose: Array, legs: Sequence[Leg], lookahead: float, pace: Pace) -> Array:
    """Base poses (T, 3) that driving the legs should give."""
    pose, speed, rate = pose.copy(), 0.0, 0.0
    share = 1.0 - np.exp(-CONTROL_DT / BASE_LAG)
    poses, driver = [], _Driver(legs, lookahead, pace)
    while driver.leg is not None:
        forward, turn = driver.step(pose)
        speed += share * (forward - speed)
        rate += share * (turn - rate)
        pose = pose + CONTROL_DT * np.array([speed * np.cos(pose[2]), speed * np.sin(pose[2]), rate])
        poses.append(pose)
    return np.array(poses).reshape(-1, 3)


def _drive(view: WorldView, trip: Trip, posture: Array, gripper: float) -> Generator[Array, None, Array | None]:
    """Drive the legs; returns (1, 3) x, y, radius of what was met on the way, None if nothing was.

    It ends early when a door or drawer has moved since the trip was planned.
    """
    pressed, track, tried = 0, [view.q[:3]], 0
    driver = _Driver(trip.legs, trip.lookahead, trip.pace, *_speeds(view))
    while driver.leg is not None:
        leg, (forward, turn) = driver.leg, driver.step(view.q[:3])
        yield motion.action(view, posture, gripper=gripper, drive=(forward, turn))
        track.append(view.q[:3])
        pressed = pressed + 1 if view.link_forces.sum() > BLOCKED_FORCE else 0
        tried = tried + 1 if abs(forward) > 0.05 or abs(turn) > 0.2 else 0
        if pressed >= BLOCKED_STEPS or (tried > STUCK_STEPS and _still(track[-STUCK_STEPS:])):
            return _ahead(view, leg)
        if np.abs(_joints(view) - trip.joints).max(initial=0.0) > DOOR_MOVED:
            return None
    return None


def _speeds(view: WorldView) -> tuple[float, float]:
    """Forward speed and yaw rate of the base."""
    q, qd = view.q, view.qd
    return float(np.cos(q[2]) * qd[0] + np.sin(q[2]) * qd[1]), float(qd[2])


def _still(track: Sequence[Array]) -> bool:
    """Hardly any motion from the first to the last of some poses."""
    moved = track[-1] - track[0]
    return bool(np.abs([*moved[:2], wrap(moved[2])]).max() < STUCK)


def _ahead(view: WorldView, leg: Leg) -> Array:
    """Where something must be that stops the base on a leg: before it, or before the hand."""
    q = view.q
    ahead = leg.direction * np.array([np.cos(q[2]), np.sin(q[2])])
    arm_felt = leg.direction > 0 and view.link_forces[len(TRUNK_LINKS) :].sum() > 0.5 * view.link_forces.sum()
    at = view.tcp_pose[:2] + 0.15 * ahead if arm_felt else q[:2] + (0.3 + FELT) * ahead
    return np.array([[*at, FELT]])


def _back_off(view: WorldView, posture: Array, gripper: float, trip: Trip) -> Motion:
    """Drive a little way back to where the trip came from."""
    q = view.q
    gap = np.linalg.norm(trip.poses[:, :2] - q[:2], axis=1)
    passed = trip.poses[: int(np.argmin(gap)) + 1] if len(gap) else trip.poses
    away = passed[np.linalg.norm(passed[:, :2] - q[:2], axis=1) > 0.2]
    origin = away[-1, :2] if len(away) else q[:2] - 0.2 * np.array([np.cos(q[2]), np.sin(q[2])])
    ahead = float((origin - q[:2]) @ np.array([np.cos(q[2]), np.sin(q[2])]))
    speed, _ = _speeds(view)
    for _ in range(14):
        speed = _towards(float(np.copysign(0.3, ahead)), speed, trip.pace.rise * CONTROL_DT)
        yield motion.action(view, posture, gripper=gripper, drive=(speed, 0.0))
    return True


def _joints(view: WorldView) -> Array:
    """Joint positions of all doors and drawers."""
    return np.array([view.link_q(name) for name in view.home.links])


def _arrived(view: WorldView, aim: Aim) -> bool:
    q = view.q
    facing = abs(float(wrap(aim.bearing(q[:2]) - q[2]))) <= view.config.nav_bearing - 0.05
    return bool(facing and aim.allows(q[:2], 0.0))


def _stand(view: WorldView, aim: Aim, posture: Array, gripper: float) -> Motion:
    """Hold still with the arm at rest for as long as the robot stands right."""
    while _arrived(view, aim):
        yield motion.action(view, posture, gripper=gripper)
    return False
