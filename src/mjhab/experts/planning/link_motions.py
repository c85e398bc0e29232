"""Base poses and arm configurations for a drawer or door, searched once per piece of furniture and kept in the cache.

All poses are in the frame of the furniture ("plan frame"): origin on the floor below the link's origin at joint
position 0, +x outward. Furniture is the same in every home, so that the results of a search can be kept; a home only
decides which of the motions are on free floor. Letters: N motions, K way points, Q joint columns, R configurations.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.boxes import Boxes
from mjhab.core.files.cache import cache_dir, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.core.rotations import wrap
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.experts.arm import ik, motion
from mjhab.experts.base.ajar import planner
from mjhab.experts.base.route import LINK_GUESS, drive_steps
from mjhab.experts.style import follows_rule
from mjhab.robots.kinematics import Chain
from mjhab.robots.robot import Robot

SELF_CLEARANCE_M = 0.02
"""Least distance of forearm and hand to the trunk."""
BOX_CLEARANCE_M = 0.02
"""Least distance of arm and trunk to obstacles; the hand is not checked."""
MAX_JUMP_RAD = 0.7
"""Largest change of a joint between two way points."""
COMFORT_CLEARANCE_M = 0.36
"""Clearance that the base should have there."""
SEEDS_FOLLOWED = 3
"""Solutions at the first way point that are followed along each base path."""


@dataclass(frozen=True, eq=False)
class LinkMotions:
    """N alternative motions of base and arm that open or close a link.

    Attributes:
        q: (N, K, Q) configurations at the K way points, base columns in the plan frame.
        steps: (N,) control steps that the arm needs from rest to the first way point.
        back: (N,) control steps that it needs from the last way point to rest.
    """

    q: np.ndarray
    steps: np.ndarray
    back: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    @staticmethod
    def join(parts: Sequence[LinkMotions]) -> LinkMotions:
        """The motions of several sets with the same number of way points."""
        return LinkMotions(
            *(
                np.concatenate([getattr(p, k) for p in parts])
                for k in ("q", "steps", "back")
            )
        )

    def shifted(self, along: float) -> LinkMotions:
        """The same motions for furniture that is displaced outward by ``along`` [m]."""
        moved = self.q.copy()
        moved[:, :, 0] += along
        return LinkMotions(moved, self.steps, self.back)


@dataclass(frozen=True, eq=False)
class Frame:
    """The plan frame of a link in the world: ``origin`` (2,) [m], ``yaw`` [rad]."""

    origin: np.ndarray
    yaw: float

    @classmethod
    def of(cls, link: JointedLink) -> Frame:
        """The plan frame of a link of a home."""
        return cls(
            link.origin[:2].copy(), float(np.arctan2(link.rot[1, 0], link.rot[0, 0]))
        )

    def point(self, xy: np.ndarray) -> np.ndarray:
        """Plan frame points (..., 2) in the world."""
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return self.origin + np.stack(
            [c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1
        )

    def base(self, q: np.ndarray) -> np.ndarray:
        """Configurations (..., Q) or base poses (..., 3) with the base columns moved to the world."""
        return np.concatenate(
            [
                self.point(q[..., BASE_XY]),
                wrap(q[..., [BASE_YAW]] + self.yaw),
                q[..., BASE.stop :],
            ],
            axis=-1,
        )


_FOUND: dict[tuple[Robot, Hashable, float, str], LinkMotions] = {}


def cached(
    robot: Robot,
    link: JointedLink,
    job: str,
    search: Callable[[Robot, JointedLink], LinkMotions],
) -> LinkMotions:
    """The motions of a job on a link, searched for on first use with the link in its plan frame, and kept on disk."""
    height = float(link.origin[2])
    # By value and not by name: copies of a cupboard in all homes share one search.
    key = (robot, link.spec, height, job)
    if key not in _FOUND:
        plain = JointedLink(link.id, link.spec, np.array([0.0, 0.0, height]), np.eye(3))
        path = cache_dir() / "link_motions" / f"{_digest(robot, plain, job)}.npz"
        found = _read(path)
        if found is None:
            found = search(robot, plain)
            _write(path, found)
        _FOUND[key] = found
    return _FOUND[key]


def _digest(robot: Robot, link: JointedLink, job: str) -> str:
    """Hash of what the motions depend on: robot, link and job, the code of the search and its arithmetic."""
    digest = hashlib.sha256(
        code_digest("core", "robots", "envs.parts.world_view", "experts")
        + arithmetic_digest()
    )
    digest.update(robot.digest)
    digest.update(repr((robot.reach, robot.arm_links)).encode())
    digest.update(repr((link.spec, float(link.origin[2]), job)).encode())
    return digest.hexdigest()[:24]


def _read(path: Path) -> LinkMotions | None:
    """Motions of a cache file; None when there is none or it cannot be read: they are then searched for anew."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return LinkMotions(arrays["q"], arrays["steps"], arrays["back"])
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile):
        return None


def _write(path: Path, found: LinkMotions) -> None:
    """Keep motions in a cache file."""
    arrays = {"q": found.q, "steps": found.steps, "back": found.back}
    write_cached(
        path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays)
    )


def hand(forward: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """Gripper rotations (..., 3, 3) that point ``forward`` (..., 3) with the fingers' line along ``closing``."""
    x = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    y = closing - x * np.sum(x * closing, axis=-1, keepdims=True)
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def seeds(robot: Robot, count: int, number: int = 0) -> np.ndarray:
    """Start configurations (count, Q) around the rest pose, the same on every call."""
    rest = robot.rest.copy()
    rest[BASE] = 0.0
    dofs = ik.columns(robot.chain)
    return ik.random_seeds(robot.chain, rest, dofs, count, np.random.default_rng(number))


@dataclass(frozen=True, eq=False)
class HandPaths:
    """N paths of K way points of the hand, with the base below it.

    Attributes:
        base: (N, K, 3) base poses in the plan frame.
        pos: (N, K, 3) positions of the hand.
        rot: (N, K, 3, 3) rotations of the hand.
        mode: which part of the orientation counts.
    """

    base: np.ndarray
    pos: np.ndarray
    rot: np.ndarray
    mode: ik.Mode = "pose"


def track(
    body: Robot,
    paths: HandPaths,
    boxes: Sequence[Boxes] | None = None,
    *,
    tries: int = 12,
) -> LinkMotions:
    """Arm motions along way points while the base moves, for many paths at once.

    Args:
        body: the robot.
        paths: of base and hand.
        boxes: obstacles at every way point.
        tries: seeds for the first way point.

    Returns:
        The motions that reach every way point, for each path the one the arm gets to soonest from rest.
    """
    first, row = _first_configurations(body, paths, tries)
    # Cheap tests first: what collides at the first way point is not followed.
    path, row = _drop([first], row, _clear(body, first, boxes[0] if boxes else None))
    for k in range(1, paths.base.shape[1]):
        if not len(row):
            break
        following, reached = _next_configurations(body, paths, k, path[-1], row)
        path, row = _drop([*path, following], row, reached)
        path, row = _drop(path, row, _clear(body, path[-1], boxes[k] if boxes else None))
    if not len(row):
        return LinkMotions(
            np.zeros((0, paths.base.shape[1], body.chain.size)), np.zeros(0), np.zeros(0)
        )
    return _soonest(body, path, row)


def _first_configurations(
    body: Robot, paths: HandPaths, tries: int
) -> tuple[np.ndarray, np.ndarray]:
    """Configurations (R, Q) at the first way point, the `SEEDS_FOLLOWED` soonest reached ones of every path, and the
    path (R,) that each belongs to."""
    robot = body.chain
    dofs = ik.columns(robot)
    rest = body.rest.copy()
    start = np.repeat(seeds(body, tries)[None], len(paths.base), axis=0)
    start[:, :, BASE] = paths.base[:, None, 0]
    found = ik.solve(
        robot,
        ik.TipGoals(paths.pos[:, 0], paths.rot[:, 0], dofs, rest, paths.mode),
        start,
    )
    q = ik.unwind(robot, found.q, rest).reshape(-1, robot.size)
    row = np.repeat(np.arange(len(paths.base)), tries)
    # Exactly: unwinding may have moved the yaw by whole turns.
    q[:, BASE] = paths.base[row, 0]
    ok = found.ok.reshape(-1)
    q = q[ok]
    row = row[ok]
    keep = _quickest(row, ik.travel_steps(robot, rest, q, dofs), SEEDS_FOLLOWED)
    return q[keep], row[keep]


def _next_configurations(
    body: Robot, paths: HandPaths, k: int, before: np.ndarray, row: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Configurations (R, Q) at way point ``k``, from those at the way point before it, and whether (R,) each reaches
    it without a jump."""
    now = before.copy()
    now[:, BASE] = paths.base[row, k]
    goals = ik.TipGoals(
        paths.pos[row, k],
        paths.rot[row, k],
        ik.columns(body.chain),
        body.rest.copy(),
        paths.mode,
    )
    # From the last way point a few iterations are enough, and no pull to rest leads off the path.
    options = ik.Options(iterations=15, rest_gain=0.0)
    step = ik.solve(body.chain, goals, now[:, None], options)
    q = step.q[:, 0]
    # A large change between near way points is another branch of the inverse kinematics, which the arm cannot follow.
    jump = np.abs(q[:, BASE.stop :] - now[:, BASE.stop :]).max(axis=1, initial=0.0)
    return q, step.ok[:, 0] & (jump < MAX_JUMP_RAD)


def _soonest(body: Robot, path: list[np.ndarray], row: np.ndarray) -> LinkMotions:
    """Of every path the motion (K times (R, Q)) with the least steps from and to rest."""
    robot = body.chain
    dofs = ik.columns(robot)
    travel = ik.travel_steps(robot, body.rest, path[0], dofs)
    back = ik.travel_steps(robot, body.rest, path[-1], dofs)
    # Sorted by path and then by steps, so that the first of each path is its best.
    order = np.lexsort((travel + back, row))
    _, first = np.unique(row[order], return_index=True)
    chosen = order[first]
    return LinkMotions(np.stack(path, axis=1)[chosen], travel[chosen], back[chosen])


def _quickest(row: np.ndarray, travel: np.ndarray, count: int) -> np.ndarray:
    """Which of the seeds (R,) are among the ``count`` quickest, by ``travel`` (R,), of their base path ``row`` (R,)."""
    order = np.lexsort((travel, row))
    place = np.arange(len(row)) - np.searchsorted(row[order], row[order])
    keep = np.zeros(len(row), dtype=bool)
    keep[order] = place < count
    return keep


def _drop(
    path: list[np.ndarray], row: np.ndarray, keep: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    return [p[keep] for p in path], row[keep]


def _clear(robot: Robot, q: np.ndarray, boxes: Boxes | None) -> np.ndarray:
    """Which configurations (N, Q) keep the arm clear of the trunk, and arm and trunk of the boxes."""
    if not len(q):
        return np.zeros(0, dtype=bool)
    whole = motion.spheres(robot)
    keep = whole.self_clearance(q) > SELF_CLEARANCE_M
    if boxes is not None:
        keep &= whole.only(robot.arm_links).clearance(q, boxes) > BOX_CLEARANCE_M
    return keep


def motion_steps(robot: Chain, q: np.ndarray) -> np.ndarray:
    """Control steps (N,) the arm needs along the way points of configurations (N, K, Q)."""
    dofs = ik.columns(robot)
    share = np.abs(np.diff(q, axis=1))[..., dofs] / ik.step_limits(robot)[dofs]
    return share.max(axis=2).sum(axis=1)


def rank(
    view: WorldView, frame: Frame, placements: LinkMotions, also: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The motions with free floor, the ones soonest reached first; by the rule wherever the robot is.

    Args:
        also: (N, P, 2) more places the base passes through, plan frame.

    Returns:
        Configurations (M, K, Q) with the base columns in the world, and the estimated steps (M,) to get there.
    """
    places = (
        placements.q[:, :, BASE_XY]
        if also is None
        else np.concatenate([placements.q[:, :, BASE_XY], also], axis=1)
    )
    clearance = (
        planner(view, shut=True)
        .clearance_at(frame.point(places))
        .min(axis=1, initial=np.inf)
    )
    steps = placements.steps
    if not follows_rule(view):
        first = frame.base(placements.q[:, 0])
        steps = np.maximum(
            steps, drive_steps(view.base, first[:, BASE], guess=LINK_GUESS)
        )
    cost = (
        steps
        + motion_steps(view.robot.chain, placements.q)
        + placements.back
        # A decimetre that lacks costs 30 control steps.
        + 300.0 * np.maximum(COMFORT_CLEARANCE_M - clearance, 0.0)
    )
    order = np.argsort(cost, kind="stable")
    order = order[clearance[order] >= view.robot.footprint.radius]
    return frame.base(placements.q[order]), cost[order]
