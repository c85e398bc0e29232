"""What opening and closing a door have in common: which motion, how fast along its arc, and when it is stuck.

Lengths [m], angles [rad], world frame. Letters: K way points of a motion, N and M configurations, J joints.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.joints import BASE
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.planning import approach, link_motions
from mjhab.experts.planning.link_motions import Frame, LinkMotions
from mjhab.experts.planning.link_path import LinkPath
from mjhab.robots.robot import Robot

Motion = motion.Motion
MOTIONS_TRIED = 16
"""Number of motions whose clearance is checked."""
CLEAR_M = 0.01
"""Clearance of the robot from walls and furniture along a motion that counts as free."""
MAX_SWING_RAD = 0.045
"""Largest change of the commanded door angle per control step."""
MAX_LAG_STEPS = 12
"""Control steps for which the door may lag behind the end of the path before the motion gives up."""
JAMMED_FORCE_N = 300.0
JAMMED_STEPS = 2
"""Sum of the contact forces on the robot's links with which a motion is given up after so many more control steps."""
ARC_STEPS = 110
"""Control steps after which a motion along the arc is given up: little more than half of a subtask's."""
AJAR_SHARE = 0.009
"""Share of the range above which a door is pushed again."""
COAST_TIME_S = 1.4
"""A released door decelerates by (speed + COAST_STOP_RAD_S) / COAST_TIME_S. Both constants follow from inertia, damping
and friction ("ours") of the doors of the built-in homes, and predict how far a released door swings. With the published
damping and friction it swings on until it is shut, and is released later than it could be."""
COAST_STOP_RAD_S = 0.5
"""See `COAST_TIME_S`."""
COAST_SPARE_RAD = 0.1
"""A door is released when it will swing this much farther than needed; a much faster door bounces open again."""
AT_REST_RAD = 0.002
"""Largest motion per control step of a door at rest."""
PRESS_STEPS = 2
"""Control steps for which a closed door must be at rest."""
ENTER_STEP_M = 0.04
"""Motion of the hand per control step on the line behind the door."""


@dataclass(frozen=True)
class HandEntry:
    """A straight motion of the hand to its place behind a door.

    Attributes:
        in_line: distance of the hand beside its line up to which it moves forward at full speed [m].
        entered: distance from the end of the line at which the hand has arrived [m].
        steps: greatest number of control steps.
    """

    in_line: float
    entered: float
    steps: int


@dataclass
class Hitch:
    """Tells when a motion along the arc of a door is stuck: it jams, or the door stays behind the end of the path."""

    jammed: int = 0
    late: int = 0

    def stops(self, view: WorldView, at_end: bool) -> bool:
        """Whether to give up in this control step; ``at_end``: the hand aims at the end of the path."""
        # A single hard step is an impact, after which the motion can go on; only a lasting force is a jam.
        self.jammed = self.jammed + 1 if view.link_forces.sum() > JAMMED_FORCE_N else 0
        self.late = self.late + 1 if at_end else 0
        return self.jammed > JAMMED_STEPS or self.late > MAX_LAG_STEPS


def arc_step(path: LinkPath, angle: float, swing: float, joint_step: float) -> float:
    """Change of the door angle [rad] per control step that the arm's joints can follow at ``angle``.

    Args:
        path: configurations along the door's arc.
        angle: door angle [rad].
        swing: largest change, negative while the door closes [rad].
        joint_step: motion of an arm joint per control step [rad].
    """
    # Over a longer piece of the arc than one step, because the path is piecewise linear and its slope jumps at way
    # points.
    ahead = float(np.copysign(0.1, swing))
    motions = np.abs(path.at(angle + ahead) - path.at(angle))
    fastest = float(motions[list(path.robot.arm_columns)].max())
    # The arm may stand still over a piece that the base does alone: without the bound this divides by 0.
    return min(abs(swing), 0.1 * joint_step / max(fastest, 1e-6))


def reachable(
    view: WorldView,
    link: JointedLink,
    found: LinkMotions,
    angles: np.ndarray,
    back: float = 0.0,
    clear: float | None = None,
) -> LinkPath | None:
    """Select the motion that is reached first among those whose whole motion is collision-free in this home.

    Args:
        view: the world.
        link: the door.
        found: motions in the plan frame.
        angles: (K,) door angles of their way points [rad].
        back: length of the hand's straight line to the first way point; 0 for none.
        clear: clearance that tells free motions in a narrow place, to which the route does not lead: it ends before the
            straight line. None: it is `CLEAR_M`, and a drive forwards may end at the first way point.

    Returns:
        The motion in the world, with the route to it; None if there is none.
    """
    goals, _ = link_motions.rank(view, Frame.of(link), found)
    walls = Boxes.join([view.home.boxes, view.link_boxes((link.id,))])
    # Neighbours collide alike: variety finds a free motion with fewer checks.
    goals = goals[_distinct(goals[:, 0, :3])[:MOTIONS_TRIED]]
    spheres = motion.spheres(view.robot)
    least = CLEAR_M if clear is None else clear
    free = np.array([g for g in goals if spheres.clearance(g, walls).min() > least])
    if not len(free):
        return None
    # The route ends before the edge of the door: from there the hand goes straight in.
    before = withdrawn(view.robot, free[:, 0], back) if back > 0 else None
    ends = free[:, 0] if clear is None or before is None else before
    best = approach.best_route(view, ends, before, link if back > 0 else None)
    return None if best is None else LinkPath(view.robot, free[best[0]], angles, best[1])


def _distinct(base: np.ndarray) -> np.ndarray:
    """Indices of the first base pose (N, 3) in every grid cell of 0.1 m, 0.1 m, 0.2 rad, in ascending order."""
    # The first of each cell is the best one, because the poses come in the order of their rank.
    _, first = np.unique(np.round(base / [0.1, 0.1, 0.2]), axis=0, return_index=True)
    return np.sort(first)


def withdrawn(body: Robot, q: np.ndarray, back: float) -> np.ndarray:
    """Configurations ``q`` (M, J) with the hand moved back by ``back`` along its axis; unchanged where that fails."""
    robot = body.chain
    pos, rot = robot.tip_pose(q)
    found = ik.solve(
        robot,
        ik.TipGoals(pos - back * rot[:, :, 0], rot, ik.columns(robot), q[0]),
        q[:, None],
        # Without a pull to the rest posture: the solution shall stay on the branch that it starts from.
        options=ik.Options(iterations=25, rest_gain=0.0),
    )
    # A solution far off is another branch, to which no straight line leads.
    near = np.abs(found.q[:, 0, BASE.stop :] - q[:, BASE.stop :]).max(axis=1) < 1.2
    good = (
        found.ok[:, 0]
        & near
        & (
            motion.spheres(body).self_clearance(found.q[:, 0])
            > link_motions.SELF_CLEARANCE_M
        )
    )
    return np.where(good[:, None], found.q[:, 0], q)


def from_angle(
    body: Robot, found: LinkMotions, angles: np.ndarray, start: float
) -> tuple[LinkMotions, np.ndarray]:
    """Cut closing motions so that they start at the door angle ``start``; returns them and their angles.

    Motions that start at a smaller angle stay as they are.
    """
    # The angles of a closing motion descend, and searchsorted needs ascending values.
    k = int(np.searchsorted(-angles, -min(start, angles[0])))
    if k == 0:
        return found, angles
    share = (angles[k - 1] - start) / (angles[k - 1] - angles[k])
    first = (1.0 - share) * found.q[:, k - 1] + share * found.q[:, k]
    robot = body.chain
    steps = ik.travel_steps(robot, body.rest, first, ik.columns(robot))
    q = np.concatenate([first[:, None], found.q[:, k:]], axis=1)
    return LinkMotions(q, steps, found.back), np.append(start, angles[k:])


def straight_in(view: WorldView, path: LinkPath, entry: HandEntry) -> Motion:
    """Move the hand straight along its axis to the beginning of a path, behind the edge of an open door.

    The hand moves forward only while it is close to its line: with an error of the base pose it would hit the edge.
    Returns whether it arrived.
    """
    robot = view.robot.chain
    wish = path.q[0]
    pos, rot = path.hand_at(float(path.values[0]))
    for _ in range(entry.steps):
        here, turn = motion.tcp(view)
        back = float((pos - here) @ rot[:, 0])
        aside = pos - here - back * rot[:, 0]
        off = float(np.linalg.norm(aside))
        if back < entry.entered:
            return True
        # Full speed within the tolerance, none beyond twice of it: a threshold alone would make the hand jerk.
        slow = float(np.clip(2.0 - off / entry.in_line, 0.0, 1.0))
        ahead = min(back, ENTER_STEP_M) * slow
        goal = here + ahead * rot[:, 0] + min(1.0, ENTER_STEP_M / max(off, 1e-9)) * aside
        aim_rot = ik.straight_line(
            here[None], pos[None], turn[None], rot[None], 1.0, 0.1
        )[1]
        yield motion.hand_action(
            view,
            ik.TipGoals(goal[None], aim_rot, ik.columns(robot), wish, "approach"),
            gripper=motion.CLOSED,
            # The base still settles on its way point, which is what puts the hand beside its line.
            drive=approach.base_towards(view, wish),
            rest_gain=0.1,
        )
    return False


def coasts(speed: float) -> float:
    """Angle [rad] by which a released door swings on at a closing speed [rad/s], see `COAST_TIME_S`."""
    # The first step has no angle before it, so that its speed is infinite.
    if not 0.0 < speed < np.inf:
        return 0.0
    return COAST_TIME_S * (
        speed - COAST_STOP_RAD_S * float(np.log1p(speed / COAST_STOP_RAD_S))
    )
