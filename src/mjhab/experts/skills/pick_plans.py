"""Plans of Pick: which grasp of an object, from which base pose, and how far the base drives straight into a shelf.

Lengths [m], world frame. Letters: A base poses that did not work, G grasps.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjhab.core.boxes import Boxes
from mjhab.core.rotations import mat_from_quat
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.grasps.candidates import (
    Grasps,
    LyingObject,
    ObjectShape,
    PinchOptions,
    grasp_candidates,
)
from mjhab.experts.arm import motion
from mjhab.experts.planning.carry import (
    SHELF_DEPTH_M,
    inside_depth,
    shelf_start,
)
from mjhab.experts.planning.reach import hand_clearance, placements
from mjhab.experts.planning.sampled import clearer
from mjhab.experts.planning.workplace import (
    CLEARANCES_M,
    BasePlacement,
    Blocked,
    HandGoals,
    ReachQuery,
    ReachScene,
    surroundings,
)
from mjhab.experts.skills.nudge_plans import in_steps
from mjhab.experts.style import of_kind
from mjhab.tasks.style import ANY

MAX_GOALS = 60
FREE_OFFSET_M = 0.015
"""Lateral distance of the object's centre from the pads without a cost. With a larger one its weight turns the object
between the pads, and it slips out when something pushes it from above."""
OFFSET_PRICE_PER_M = 15.0
"""Score lost per metre beyond `FREE_OFFSET_M`."""
GRASP_CLEARANCES_M = ((0.010, -0.008, 0.0), (0.0, -0.02, 0.010), (-0.004, -0.03, 0.014))
"""Required clearances [m] of the first, second and third search: between gripper and neighbours; on a shelf between
hand with wrist and neighbours (the spheres of the wrist are up to 8 mm too large); and the reduction of the arm's
clearance that applies to the hand."""
OPTIONS = PinchOptions(
    palm_gap=0.012, floor_gap=0.008, least_clear_m=GRASP_CLEARANCES_M[-1][0]
)
# On a shelf there is little room: more directions around the object, a short approach, and boxes nearly as wide as the
# hand opens. Below a low board no approach from above is possible: bowls are grasped by the rim from the front.
SHELF_OPTIONS = replace(
    OPTIONS,
    fan=36,
    shallower=(0.0, 0.02),
    retreat=0.06,
    cells=31,
    scant=150.0,
    slants=(0.12, 0.24, 0.34, 0.43),
)
LOW_SHELF_OPTIONS = replace(SHELF_OPTIONS, leans=(0.4, 0.6, 0.8))
SHELF_BLUNT_M = 0.004
"""Length of the tips of the pads that does not count as contact on a shelf."""
INSIDE_DISTANCES_M = (0.0, 0.1, 0.2, SHELF_DEPTH_M)
"""Distances that the base may drive straight into the shelf after a push."""
AHEAD_M = np.arange(0.0, 0.17, 0.04)
"""Distances straight ahead of where the base stands after a push, from which a grasp is tried first."""
AHEAD_DISTANCES_M = (0.0, 0.12, 0.2, 0.3)
"""Distances of the straight drive to these."""
_HOME_WEIGHT = 0.8
"""Weight of the control steps from the grasp back to rest after a push, when few are left."""


def plan_pick(
    view: WorldView, obj: str, failed: np.ndarray, attempt: int = 0, wish: str = ANY
) -> tuple[BasePlacement, HandGoals, float] | None:
    """Plan a grasp of an object.

    Args:
        view: world to plan in.
        obj: name of the object.
        failed: (A, 3) base poses from which earlier attempts failed.
        attempt: number of earlier attempts; later ones accept less clearance.
        wish: kind of grasp, see `tasks.style.Style.grasp`.

    Returns:
        Base placement, the grasps to which its ``goal`` refers, and the distance of the straight drive at the end [m];
        None if no grasp can be reached.
    """
    pose = view.object_pose(obj)
    scene = scene_of(view, obj)
    depth = inside_depth(view, pose[:3])
    around = scene.beside.near(pose[:3], 0.5)
    start = shelf_start(view, pose[:3])
    every = _grasps_of(view, obj, scene, around, bool(depth))
    every = balanced(of_kind(every, wish), pose[:3])
    # On open surfaces the clearance of the fingers is enough; below a board the wrist is what collides.
    clearance = hand_clearance(view.robot.gripper, every, around) if depth else None
    best = None
    tried = 0
    blocked: list[Blocked] = []
    # The strictest search is only worth its time once.
    for asked, hand, nearer in GRASP_CLEARANCES_M[min(attempt, 1) :]:
        keep = every.clear >= asked
        grasps = every.take(
            np.flatnonzero(keep if clearance is None else keep & (clearance > hand))
        )
        # With less clearance no grasp has been added.
        if len(grasps) <= tried:
            continue
        tried = len(grasps)
        goals = _diverse(grasps)
        for back in _distances_in(depth, attempt):
            query = ReachQuery(
                point=pose[:3],
                goals=goals,
                scene=scene,
                drive_in=back,
                avoid=failed,
                clearance=CLEARANCES_M[min(attempt, 2)],
                nearer=nearer,
                start=start,
            )
            found = placements(view, query, blocked)
            if found and (
                # Among grasps of one search clearance decides: a route that collides may not arrive at all.
                best is None or found[0].route.clearance > best[0].route.clearance
            ):
                best = found[0], goals, back
            if best is not None and (not depth or best[0].route.clearance >= 0.0):
                return clearer(view, best, blocked)
    return clearer(view, best, blocked)


def _grasps_of(
    view: WorldView, obj: str, scene: ReachScene, around: Boxes, inside: bool
) -> Grasps:
    """Grasps of an object, which is ``inside`` of furniture or on it, with the boxes ``around`` it."""
    shape, pose = view.object_shape(obj), view.object_pose(obj)
    if inside:
        start = shelf_start(view, pose[:3])
        return shelf_grasps(
            shape,
            pose,
            scene,
            direction_from(view.base if start is None else start, pose),
            around,
            GRASP_CLEARANCES_M[-1][0],
        )
    return grasp_candidates(
        LyingObject.of(shape, pose, scene.support_z),
        neighbours=around,
        gripper=view.robot.gripper,
        options=OPTIONS,
    )


def shelf_grasps(
    shape: ObjectShape,
    pose: np.ndarray,
    scene: ReachScene,
    inward: tuple[float, float],
    around: Boxes,
    clear: float,
) -> Grasps:
    """Grasps of an object on a shelf, best first.

    Args:
        shape: of the object.
        pose: (7,) of the object.
        scene: obstacles, and the robot with its gripper.
        inward: unit vector into the shelf.
        around: boxes that the gripper must not touch.
        clear: least clearance to them [m].
    """
    hand = scene.body.gripper
    gripper = replace(hand, usable=hand.shelf_usable, blunt=SHELF_BLUNT_M)
    for options in (SHELF_OPTIONS, LOW_SHELF_OPTIONS):
        found = grasp_candidates(
            LyingObject.of(shape, pose, scene.support_z),
            neighbours=around,
            options=replace(options, inward=inward, least_clear_m=clear),
            gripper=gripper,
        )
        # The flatter approaches only suit a rim.
        if len(found) or shape.kind != "bowl":
            break
    return found


def plan_inside(
    view: WorldView, obj: str, failed: np.ndarray
) -> tuple[BasePlacement, HandGoals, float] | None:
    """Like `plan_pick` for an object on a shelf after a push: the grasp with the fewest control steps until the arm is
    at rest again."""
    pose = view.object_pose(obj)
    scene = scene_of(view, obj)
    around = scene.beside.near(pose[:3], 0.5)
    every = balanced(_grasps_of(view, obj, scene, around, inside=True), pose[:3])
    clearance = hand_clearance(view.robot.gripper, every, around)
    best = None
    yaw = view.base[2]
    ahead = view.base + AHEAD_M[:, None] * motion.ahead_3d(yaw)
    for (asked, hand, nearer), arm in zip(GRASP_CLEARANCES_M, CLEARANCES_M, strict=True):
        rows = np.flatnonzero((every.clear >= asked) & (clearance > hand))
        if not len(rows):
            continue
        goals = _diverse(every.take(rows))
        # Straight ahead first: no turn is needed, and the base stands right after its push.
        for bases, distances in ((ahead, AHEAD_DISTANCES_M), (None, INSIDE_DISTANCES_M)):
            for back in distances:
                query = ReachQuery(
                    point=pose[:3],
                    goals=goals,
                    scene=scene,
                    drive_in=back,
                    avoid=failed,
                    clearance=arm,
                    nearer=nearer,
                    home=_HOME_WEIGHT,
                    bases=bases,
                )
                for placement in placements(view, query):
                    found = placement, goals, back
                    if best is None or _cost(view, found) < _cost(view, best):
                        best = found
            if best is not None and best[0].route.clearance >= 0.0:
                return best
    return best


def _cost(view: WorldView, found: tuple[BasePlacement, HandGoals, float]) -> float:
    """Control steps of a plan of `plan_inside`, much more if its route lacks clearance."""
    placement, _, back = found
    steps = placement.route.steps + in_steps(back)
    home = _HOME_WEIGHT * float(motion.steps_home(view.robot, placement.at))
    # A centimetre of deficit outweighs any number of control steps of an episode.
    return steps + home + 1e4 * max(-placement.route.clearance, 0.0)


def balanced(grasps: Grasps, centre: np.ndarray) -> Grasps:
    """Grasps with scores reduced by the lateral distance of the object's ``centre`` (3,) from the pads, best first."""
    aside = np.abs(np.einsum("gj,gj->g", centre - grasps.pos, grasps.rot[:, :, 2]))
    score = grasps.score - OFFSET_PRICE_PER_M * np.maximum(aside - FREE_OFFSET_M, 0.0)
    # Stable, so that mirrored grasps with equal scores keep their order on every machine.
    return replace(grasps, score=score).take(np.argsort(-score, kind="stable"))


def scene_of(view: WorldView, obj: str) -> ReachScene:
    """Obstacles around an object that is not held."""
    pose = view.object_pose(obj)
    shape = view.object_shape(obj)
    near, target = surroundings(view, obj, pose[:3])
    support = float(pose[2]) - height_below(shape, mat_from_quat(pose[3:]))
    return ReachScene(near, target, support, view.robot)


def direction_from(base: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Level unit vector from a base pose (3,) to an object at ``pose`` (7,)."""
    toward = pose[:2] - base[:2]
    # The object may be right above the base, where there is no direction.
    x, y = toward / max(float(np.linalg.norm(toward)), 1e-6)
    return float(x), float(y)


def _distances_in(depth: float, attempt: int) -> tuple[float, ...]:
    """Distances [m] of the straight drive to try, in order; later attempts begin with none, which is quicker."""
    if not depth:
        return (0.0,)
    # The first attempt has the time to come straight in, which keeps the arm clear of the sides.
    return (0.0, depth) if attempt else (depth, 0.0)


def height_below(shape: ObjectShape, rot: np.ndarray) -> float:
    """Distance [m] from the centre of an object with rotation ``rot`` (3, 3) down to its lowest point."""
    up = np.abs(rot[2])
    half = np.array(shape.half)
    if shape.kind in ("box", "mesh"):
        return float(up @ half)
    if shape.kind == "sphere":
        return float(half.max())
    return float(half[0] * np.hypot(up[0], up[1]) + half[2] * up[2])


def _diverse(grasps: Grasps) -> HandGoals:
    """At most `MAX_GOALS` of the best grasps, each more than 2.5 cm or 0.3 rad from the others."""
    kept: list[int] = []
    # Equal grasps fail alike: a few that differ cover more.
    for i in range(min(len(grasps), 600)):
        if len(kept) >= MAX_GOALS:
            break
        turn = np.einsum("gij,ij->g", grasps.rot[kept], grasps.rot[i])
        shift = np.linalg.norm(grasps.pos[kept] - grasps.pos[i], axis=1)
        if not kept or ((turn < 1.0 + 2.0 * np.cos(0.3)) | (shift > 0.025)).all():
            kept.append(i)
    g = grasps.take(np.array(kept))
    return HandGoals(g.pos, g.rot, g.pre, g.opening, g.score)
