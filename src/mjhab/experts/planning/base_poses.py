"""Base poses from which the hand may reach a work place: on free floor, with a line of sight, within the arm's reach.

Lengths [m], angles [rad], world frame. Letters: G hand poses, B base poses.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.boxes import Boxes, nearest_box_distance
from mjhab.core.rotations import wrap
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts.arm import motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.route import drive_steps
from mjhab.experts.planning.workplace import HandGoals, ReachQuery, ReachScene
from mjhab.robots.robot import ArmReach, Footprint

OUT_CLEARANCE_M = 0.03
"""Least clearance of an object on its straight way out of a shelf."""
FAR_BASE_M = 0.96
"""Base poses farther than this from the work, or with little clearance, are used only if there are no others."""
MAX_OVERREACH_M = 0.05
"""Largest distance of the wrist beyond the comfortable reach, see `overreach`. There the arm is fully stretched."""
_BASES = 24
"""Greatest number of base poses that are paired with hand poses."""


def exit_clearance(bases: np.ndarray, scene: ReachScene, drive_in: float) -> np.ndarray:
    """Clearance (B,) [m] of the object, lifted by 2.5 cm, while the base drives straight backwards with it.

    Args:
        bases: (B, 3) base poses at the grasp.
        scene: obstacles and the object.
        drive_in: distance of the drive [m].
    """
    box = scene.target
    half = scene.target.half[0]
    size = float(half.min())
    axes = [
        np.linspace(-h + size, h - size, 1 + int(np.ceil(2 * (h - size) / (1.3 * size))))
        for h in half
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # Lifted, as the hand lifts it before the drive.
    points = box.center[0] + grid @ box.rot[0].T + np.array([0.0, 0.0, 0.025])
    ahead = np.stack(
        [np.cos(bases[:, 2]), np.sin(bases[:, 2]), np.zeros(len(bases))], axis=1
    )
    share = np.linspace(0.0, drive_in, 7)
    moved = points - share[None, :, None, None] * ahead[:, None, None]
    gap = nearest_box_distance(
        moved.reshape(-1, 3), scene.beside.near(box.center[0], 0.9)
    )
    return gap.reshape(len(bases), -1).min(axis=1) - size


def base_poses(view: WorldView, query: ReachQuery) -> tuple[np.ndarray, np.ndarray]:
    """Base poses (B, 3) from which a hand pose may be reached, and the estimated control steps (B,) to drive there."""
    point = query.point
    drive_in = query.drive_in
    r, angle, off = np.meshgrid(
        np.arange(0.5, 1.26, 0.075),
        np.arange(32) * np.pi / 16,
        (-0.35, 0.0, 0.35),
        indexing="ij",
    )
    x = point[0] - r * np.cos(angle)
    y = point[1] - r * np.sin(angle)
    poses = np.stack([x, y, wrap(angle + off)], axis=-1).reshape(-1, 3)
    start = view.base if query.start is None else query.start
    # The present pose saves the drive, whatever its distance and bearing.
    here = start - drive_in * motion.ahead_3d(start[2])
    bearing = np.arctan2(point[1] - here[1], point[0] - here[0])
    poses = np.concatenate(
        [
            poses,
            [start, *([here[0], here[1], bearing + k] for k in (-0.35, 0.0, 0.35))],
        ]
    )
    # The present pose counts as near, whatever its distance: it costs no drive.
    far_off = np.append(r.ravel() > FAR_BASE_M, np.zeros(4, bool))
    cells = planner(view)
    back = poses[:, :2] - drive_in * np.stack(
        [np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1
    )
    far_off |= cells.clearance_at(back) < cells.radius
    good = (
        np.minimum(cells.clearance_at(back), cells.clearance_at(poses[:, :2]))
        >= cells.narrow
    )
    good &= floor_clearance(view.robot.footprint, poses, query.scene.near) > 0.0
    if query.avoid is not None and len(query.avoid):
        gap = np.linalg.norm(
            # 0.3 m per radian: a turn counts as little as it moves the hand.
            (poses[:, None] - query.avoid) * [1.0, 1.0, 0.3],
            axis=2,
        ).min(axis=1)
        good &= gap > 0.10
    # Last, as it costs most.
    good[good] = in_sight(poses[good], point, query.scene.near)
    poses = poses[good]
    back = back[good]
    far_off = far_off[good]
    length = cells.costs(view.base[:2])[cells.grid.cells(back)]
    if query.start is not None:
        # Where the robot cannot drive to stays excluded.
        straight = np.linalg.norm(back - start[:2], axis=1)
        length = np.where(np.isfinite(length), straight, np.inf)
    steps = (
        drive_steps(start, np.concatenate([back, poses[:, 2:]], axis=1), length)
        + 6.0 * drive_in / 0.3
    )
    # All the nearest base poses may be on a side from which no hand pose can be reached.
    reachable = np.isfinite(steps) & (
        overreach(view.robot.reach, poses, query.goals) < MAX_OVERREACH_M
    ).any(axis=1)
    reachable &= ~far_off | query.far | ~(reachable & ~far_off).any()
    return _spread(poses[reachable], steps[reachable])


def given_poses(
    view: WorldView, query: ReachQuery, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The base ``poses`` (B, 3) with free floor that reach a hand pose, and the control steps (B,) of a straight drive
    to them."""
    cells = planner(view)
    here = float(cells.clearance_at(view.base[None, :2])[0])
    back = query.drive_in * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    clearance = np.minimum(
        cells.clearance_at(poses[:, :2]), cells.clearance_at(poses[:, :2] - back)
    )
    near = overreach(view.robot.reach, poses, query.goals).min(axis=1) < MAX_OVERREACH_M
    free = near & (clearance >= min(cells.narrow, here))
    poses = poses[free]
    length = np.linalg.norm(poses[:, :2] - back[free] - view.base[:2], axis=1)
    # As `drive_steps` without turns, and the drive in as in `base_poses`.
    return poses, 20.0 * length / 0.6 + 6.0 * query.drive_in / 0.3


def in_sight(poses: np.ndarray, point: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Whether (B,) no wall or tall piece of furniture is between base poses (B, 2+) and ``point`` (3,)."""
    top = boxes.center[:, 2] + np.einsum("kj,kj->k", np.abs(boxes.rot[:, 2]), boxes.half)
    # What is lower can be reached over.
    tall = boxes.take((top > point[2] + 0.5) & (boxes.half.max(axis=1) > 0.4))
    if not len(poses) or not len(tall):
        return np.ones(len(poses), bool)
    # Without the ends, which lie in the robot and in the furniture that is worked on.
    share = np.linspace(0.1, 0.9, 8)[:, None, None]
    line = poses[:, :2] + share * (point[:2] - poses[:, :2])
    height = np.full((*line.shape[:2], 1), point[2] + 0.15)
    gap = nearest_box_distance(
        np.concatenate([line, height], axis=2).reshape(-1, 3), tall
    )
    return gap.reshape(len(share), len(poses)).min(axis=0) > 0.02


def floor_clearance(footprint: Footprint, poses: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Clearance (B,) [m] between the base at poses (B, 3) and small boxes on the floor, which no map contains: objects
    that fell."""
    # Large boxes are furniture, which the map contains.
    low = boxes.take(
        (boxes.center[:, 2] - boxes.half.max(axis=1) < footprint.top)
        & (boxes.half.max(axis=1) < 0.12)
    )
    if not len(low):
        return np.ones(len(poses))
    gap = np.linalg.norm(poses[:, None, :2] - low.center[:, :2], axis=2) - low.half[
        :, :2
    ].max(axis=1)
    return gap.min(axis=1) - footprint.radius


def _spread(poses: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `_BASES` of the quickest poses that differ from each other by more than 9 cm or 0.3 rad."""
    kept: list[int] = []
    # Stable, so that equal poses keep their order on every machine.
    for i in np.argsort(steps, kind="stable"):
        if len(kept) >= _BASES:
            break
        gap = (poses[kept] - poses[i]) * [1.0, 1.0, 0.3]
        if not kept or np.linalg.norm(gap, axis=1).min() > 0.09:
            kept.append(int(i))
    return poses[kept], steps[kept]


def overreach(reach: ArmReach, bases: np.ndarray, goals: HandGoals) -> np.ndarray:
    """Distance (B, G) [m] of the wrist beyond the comfortable reach of the arm, for base poses (B, 3) and hand poses.

    At 0.05 the arm is fully stretched; negative values are within reach.
    """
    wrist = goals.pos - reach.hand * goals.rot[:, :, 0]
    shoulder = bases[:, :2] + reach.ahead * np.stack(
        [np.cos(bases[:, 2]), np.sin(bases[:, 2])], axis=1
    )
    level = np.linalg.norm(wrist[:, :2] - shoulder[:, None], axis=2) - reach.out
    height = np.maximum(
        np.maximum(reach.low - wrist[:, 2], wrist[:, 2] - reach.high), 0.0
    )
    return np.hypot(np.maximum(level, 0.0), height) - reach.length
