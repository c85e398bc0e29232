"""Closing a door that stands open at a wall, with no room for a hand on the outside of it.

The robot stands before the free edge of the door. The closed fingers, upright, reach past the edge by their tips, so
that their narrow side lies between door and wall, and pull the edge out. From then on they are behind the door and push
it shut as a hand does that came from the outside.

Lengths [m], angles [rad], plan frame (`planning.link_motions.Frame`). Letters: K way points of a motion.

Numbers that name no source were chosen by hand on homes of ``v3_sc3`` with other seeds than that of the tables.
"""

from __future__ import annotations

import functools

import numpy as np

from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import motion
from mjhab.experts.phases import phase
from mjhab.experts.planning import link_motions
from mjhab.experts.planning.link_motions import LinkMotions
from mjhab.experts.planning.link_path import LinkPath
from mjhab.experts.skills.doors import motions
from mjhab.experts.skills.doors.arc import HandEntry, from_angle, reachable, straight_in
from mjhab.robots.robot import Robot

Motion = motion.Motion
BEHIND_WAY_M = 0.2
"""Length of the straight line of the hand to the edge."""
ENTRY = HandEntry(in_line=0.006, entered=0.012, steps=30)
"""The hand's motion on this line: the fingers have 7 mm to the door, and are 30 mm past its edge in the end."""
AHEAD_RAD = 0.01
"""Angle between the door and the door angle at which the hand's path begins: 7 mm at the edge of the widest door."""
PAST_EDGE_M = 0.03
"""Length of the fingers behind the edge; they are 62 mm long up to the palm."""
LEAN_RAD = 2.2
"""Angle between the fingers and the inward normal of the door at the wall: they lean by 0.63 rad to it. Of spheres
around the hand the wall keeps 14 mm in ``v3_sc3`` and 24 mm at the wrist in ``builtin_m3_20``; with 2.0, where the palm
is nearer than the tips, 10 and 8 mm; with 2.3, 12 and 30 mm."""
CLEAR_M = (0.01, 0.003)
"""Clearances from the wall that are tried in turn. A door that swung open leans on it by its handle: in ``v3_sc3`` at
1.752 to 1.760 rad, where the wall keeps 9 to 5 mm from the spheres around the hand."""
SHUT_YAW_RAD = 0.4
"""Yaw of the hand at the closed door, see `motions.PUSH_YAWS_RAD`."""
ANGLE_STEP_RAD = 0.05
"""Motions are cached per angle of the door, rounded up to a multiple: it limits the number of searches."""


@phase("reach past the edge of the door", "approach")
def reach_past(view: WorldView, path: LinkPath) -> Motion:
    """Move the fingertips between a wall and the edge of the door that stands at it. Returns whether they arrived."""
    return (yield from straight_in(view, path, ENTRY))


def from_edge(view: WorldView, link: JointedLink) -> LinkPath | None:
    """The motion that pulls the edge of a door from the wall and pushes the door shut; None if there is none."""
    now = view.link_q(link.id)
    angle = ANGLE_STEP_RAD * float(np.ceil((now + AHEAD_RAD) / ANGLE_STEP_RAD))
    search = functools.partial(edge_motions, angle=angle)
    # The key names the angle that the search was made for, as motions for another one begin elsewhere.
    found = link_motions.cached(view.robot, link, f"edge {angle:.2f}", search)
    found, angles = from_angle(view.robot, found, edge_angles(angle), now + AHEAD_RAD)
    # The motion with more room comes first: close to the wall an error of the base pose means a contact.
    for clear in CLEAR_M:
        path = reachable(view, link, found, angles, BEHIND_WAY_M, clear)
        if path is not None:
            return path
    return None


def edge_angles(angle: float) -> np.ndarray:
    """Door angles (11,) [rad] of the way points of `edge_motions`, from ``angle`` to the closed door."""
    return np.append(np.linspace(angle, 0.0, 10), -motions.PRESS_PAST_RAD)


def edge_motions(robot: Robot, link: JointedLink, angle: float) -> LinkMotions:
    """Find motions that push a door shut from an angle [rad], with the fingertips past its free edge at first."""
    angles = edge_angles(angle)
    # Clipped, because the last way point lies beyond the closed door.
    share = np.clip(1.0 - angles / angle, 0.0, 1.0)
    first = angle - LEAN_RAD
    yaw = first + (SHUT_YAW_RAD - first) * share
    m = motions.hand_side(link)
    base = motions.line(
        np.arange(1.1, 1.9, 0.1),
        m * np.arange(-0.9, 0.21, 0.1),
        m * np.array([-0.9, -0.6, -0.3, 0.0, 0.3, 0.6]),
        (-0.6, -0.4, -0.2, 0.0),
        share,
    )
    pos = _hand_positions(robot, link, angles, angles - yaw)
    forward = -np.stack([np.cos(yaw), m * np.sin(yaw), 0.0 * yaw], axis=-1)
    found = []
    # The fingers are symmetric: upside down the wrist may have room where it has none upright.
    for up in (1.0, -1.0):
        rot = link_motions.hand(forward, np.array([0.0, 0.0, up]))
        hands = motions.HandPath(pos, rot, angles)
        found.append(motions.search(robot, link, base, hands, tries=5))
    return LinkMotions.join(found)


def _hand_positions(
    robot: Robot, link: JointedLink, angles: np.ndarray, lag: np.ndarray
) -> np.ndarray:
    """Positions (K, 3) of the tcp at which upright fingers touch the door, at the edge or with their tips.

    ``lag`` (K,): angles between the fingers and the inward normal of the door.
    """
    m = motions.hand_side(link)
    low, high = motions.panel(link)
    face = high[0]
    edge = float(np.abs([low[1], high[1]]).max())
    tip, side = robot.gripper.finger
    handle = link.handle
    top = handle.pos[2] + handle.half_length + motions.ABOVE_BAR_M
    out = np.stack([np.cos(angles), m * np.sin(angles)], axis=-1)
    along = np.stack([np.sin(angles), -m * np.cos(angles)], axis=-1)
    c, s = np.cos(lag), np.sin(lag)
    back = tip - PAST_EDGE_M
    # Leaning to the wall, the side of the fingers touches the edge; else their tips touch the face.
    leans = lag > np.pi / 2
    off = np.where(leans, side * s + back * c, tip * c + side * s + motions.TOUCH_M)
    beyond = np.where(leans, back * s - side * c, back)
    xy = (face + off)[:, None] * out + (edge + beyond)[:, None] * along
    return np.c_[xy, np.full(len(xy), float(link.origin[2]) + top)]
