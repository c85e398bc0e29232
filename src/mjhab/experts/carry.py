"""Ways back to the rest pose, with or without an object in the hand."""

from __future__ import annotations

import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.envs.privileged import WorldView
from mjhab.experts import motion
from mjhab.experts.clearance import RobotSpheres
from mjhab.experts.motion import Motion
from mjhab.experts.reach import surroundings
from mjhab.experts.route import Route, follow, plan_route

Array = np.ndarray
BACK = (0.0, 0.2, 0.4, 0.6, 0.8)
"""How far [m] to drive back while the arm returns."""
SHELF_DEPTH = 0.42
"""How far [m] the base comes straight in with the arm stretched out, to reach into the fridge."""


def grip(opening: float) -> float:
    """Gripper action for a distance between the pads [m]."""
    low, high = motion.LIMITS.gripper
    return float(np.clip(2.0 * (opening / 2 - low) / (high - low) - 1.0, -1.0, 1.0))


def inside_depth(view: WorldView, point: Array) -> float:
    """`SHELF_DEPTH` for a point (3,) on a shelf with something above it, 0 in the open."""
    for place in view.home.receptacles:
        if place.kind == "shelf" and -0.05 < point[2] - place.pos[2] < place.height:
            off = np.abs(place.local(point[:2]))
            if (off < np.array(place.half) + 0.08).all():
                return SHELF_DEPTH
    return 0.0


def drive_in(view: WorldView, goal: Array, *, gripper: float) -> Motion:
    """Drive straight on about to the base pose of the configuration ``goal`` (15,), the arm stretched out as it says.

    Small errors sideways stay: steering would sweep the arm.
    """
    ahead = np.array([np.cos(goal[2]), np.sin(goal[2])])
    way = np.stack([view.q[:2], view.q[:2] + ahead * float((goal[:2] - view.q[:2]) @ ahead)])
    route = Route(way, float(goal[2]), 1, 0.3, goal, 0, 40, 0.0, speed=0.35)
    return (yield from follow(view, route, gripper=gripper))


def held_spheres(view: WorldView, obj: str) -> tuple[Array, Array]:
    """Spheres that fill the box of an object in the hand: centres (H, 3) in the frame of the tool, radii (H,)."""
    pos, rot = motion.tcp(view)
    pose, half = view.object_pose(obj), np.array(view.object_type(obj).half)
    radius = max(float(half.min()), 0.5 * float(np.sort(half)[1]))
    axes = []
    for size in half:
        room = max(size - radius, 0.0)
        axes.append(np.linspace(-room, room, 1 + int(np.ceil(2 * room / (1.3 * radius)))))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    world = pose[:3] + grid @ mat_from_quat(pose[3:]).T
    return (world - pos) @ rot, np.full(len(grid), radius)


def go_home(view: WorldView, obj: str, *, holding: bool = True) -> Motion:
    """Bring the arm to rest, driving back as far as the room around asks for. Returns whether it arrived."""
    gripper = motion.CLOSED if holding else motion.OPEN
    robot = motion.spheres()
    if holding:
        robot = robot.with_held(*held_spheres(view, obj))
    for _ in range(3):
        route = plan_home(view, obj, robot, holding=holding)
        if route is None or (yield from follow(view, route, gripper=gripper, gentle=holding)):
            break
    return (yield from motion.to_rest(view, gripper=gripper, max_steps=60))


def plan_home(view: WorldView, obj: str, robot: RobotSpheres, *, holding: bool) -> Route | None:
    """The quickest way to rest that keeps clear, straight back if need be; else the one with the most room."""
    others, target = surroundings(view, obj, view.tcp_pose[:3])
    boxes = others if holding else type(others).join([others, target])
    now, goal = view.q, motion.rest_goal(view)
    cells = motion.planner(view.home)
    best: Route | None = None
    for back in BACK:
        end = now[:3] - back * np.array([np.cos(now[2]), np.sin(now[2]), 0.0])
        if back and cells.line_clearance(now[:2], end[None, :2])[0] < 0.26:
            break
        route = plan_route(view, end, goal, robot, boxes, margin=0.01, direction=-1, straight=True)
        if route is None:
            continue
        if route.room >= 0.0:
            return route
        if best is None or route.room > best.room:
            best = route
    return best
