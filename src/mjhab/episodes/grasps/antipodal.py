"""Antipodal grasps of objects of any shape: pairs of surface points whose normals are in the pads' friction cones.

Points are sampled on the surface of the object's convex collision pieces. From each, rays inside the friction cone are
cast through the object; the point where a ray leaves it is the opposite contact. A pair is kept if the surface normal
there is also within the friction cone, if the gripper opens wide enough, if rays to the outside find room for a finger
on both sides, and if a hand that comes straight along the direction of approach does not touch the object.

Frame of the object, lengths [m]. Letters: N samples, R rays, K pieces, M grasps, P points of the surface.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from trimesh.sample import sample_surface

from mjhab.core.arithmetic.elementary import arccos
from mjhab.core.rotations import frame_from_axes
from mjhab.core.seeding import stream
from mjhab.episodes.grasps.pinch import SurfaceGrasps
from mjhab.episodes.grasps.spread import farthest_points
from mjhab.robots.model import PAD_FRICTION
from mjhab.robots.parts import Gripper
from mjhab.robots.registry import robot_named
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.spec import ObjectType

SAMPLES = 600
"""Points sampled on the surface as first contacts."""
RAYS_PER_SAMPLE = 3
"""Rays cast from each sample: one along the normal, the others random in the friction cone."""
PAIRS_KEPT = 160
"""Pairs of contacts for which approaches are searched, spread over the object."""
APPROACHES = 16
"""Directions of approach around the closing line of each pair."""
CONTACT_DEPTHS_M = (-0.006, 0.006, 0.018)
"""Positions of the contact along the fingers relative to the tcp, positive towards the tips; deepest grasp first."""
GRASPS_KEPT = 192
"""Most grasps per object, spread over positions, approaches and closing lines."""
SURFACE_POINTS = 3000
"""Points sampled on the surface to test contact with hand and fingers."""
APPROACH_LENGTH_M = 0.12
"""Length of the straight approach on which hand and fingers must not touch the object."""
CLEARANCE_M = 0.002
"""Least gap between the object and hand and open fingers."""
MIN_PLAY_M = 0.006
"""Least gap between each open finger and the object; arms have position errors of a few millimetres."""
MAX_PLAY_M = 0.018
"""Largest gap between each open finger and the object, as for other shapes (half of `Options.spread`)."""
MAX_SLANT_RAD = np.radians(24.0)
"""Largest half-angle of the friction cone: 0.8 of the angle that MS-HAB's grasp test allows
(`stable.STEADY_SHARE`)."""
_PROBE_M = 1e-3
"""Distance outside of a sampled point at which no other piece may be."""
_JOIN_M = 2e-4
"""Gap below which two pieces count as one body."""
_PATCH_DEPTH_M = 1e-3
"""Largest distance of a surface point from the pad's plane to count as contact area."""
_POSITION_SCALE_M = 0.03
"""Distance of grasps that counts as much as 1 rad between their approaches, when grasps are spread."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A union of convex pieces: ``planes`` (F, 4) of each piece with outward normals, and the surface mesh."""

    planes: tuple[np.ndarray, ...]
    surface: trimesh.Trimesh

    @staticmethod
    def of(kind: ObjectType, meshes: Mapping[str, object]) -> Solid:
        """Make the solid of an object type's collision pieces; curved primitives become circumscribed prisms."""
        # Collision geometry and not what is seen: the pads meet the former.
        hulls = [ConvexHull(outline(geom, meshes)) for geom in kind.collision]
        surfaces = [trimesh.Trimesh(h.points, h.simplices).convex_hull for h in hulls]
        surface = trimesh.util.concatenate(surfaces)
        assert isinstance(surface, trimesh.Trimesh)
        return Solid(
            # Facets are triangles: those of one side have the same plane, but for rounding.
            tuple(np.unique(h.equations.round(9), axis=0) for h in hulls),
            surface,
        )

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return (N,) bool: points (N, 3) that are inside of a piece."""
        found = np.zeros(len(points), bool)
        for planes in self.planes:
            found |= np.all(points @ planes[:, :3].T + planes[:, 3] < 0.0, axis=1)
        return found

    def cross(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersect rays from ``origins`` (R, 3) along unit vectors ``directions`` (R, 3) with the K pieces.

        Returns:
            Distances (R, K) of entry and of exit, (inf, -inf) for pieces that a ray misses; outward normals
            (R, K, 3) of the exit faces.
        """
        enter = np.full((len(origins), len(self.planes)), np.inf)
        leave = np.full(enter.shape, -np.inf)
        normal = np.zeros((*enter.shape, 3))
        for k, planes in enumerate(self.planes):
            rate = directions @ planes[:, :3].T
            height = origins @ planes[:, :3].T + planes[:, 3]
            # Rays parallel to a plane divide by 0; they are masked below.
            with np.errstate(divide="ignore", invalid="ignore"):
                at = -height / rate
            low = np.where(rate < -1e-9, at, -np.inf).max(axis=1)
            far = np.where(rate > 1e-9, at, np.inf)
            high = far.min(axis=1)
            # A ray parallel to a plane and outside of it misses the piece, whatever the other planes say.
            hit = (low <= high) & ~np.any(
                (np.abs(rate) <= 1e-9) & (height > 1e-9), axis=1
            )
            enter[:, k] = np.where(hit, low, np.inf)
            leave[:, k] = np.where(hit, high, -np.inf)
            normal[:, k] = planes[far.argmin(axis=1), :3]
        return enter, leave, normal


def surface_grasps(
    kind: ObjectType,
    meshes: Mapping[str, object],
    gripper: Gripper | None = None,
    friction: float = PAD_FRICTION[0],
) -> SurfaceGrasps:
    """Return antipodal grasps of an object type, the same for the same arguments.

    Args:
        kind: the object type; its collision pieces are used.
        meshes: meshes by name.
        gripper: sizes of the gripper; None for the default robot's.
        friction: coefficient of sliding friction between pads and object.

    Returns:
        At most `GRASPS_KEPT` grasps; none if the object is too wide for the gripper everywhere.
    """
    gripper = gripper or robot_named().gripper
    # A stream per type, so that grasps do not depend on which types were searched before.
    rng = stream(0, "antipodal grasps", kind.name)
    solid = Solid.of(kind, meshes)
    pairs = _contact_pairs(solid, gripper, friction, rng)
    if not len(pairs):
        return pairs
    pairs = pairs.take(farthest_points(pairs.contact / _POSITION_SCALE_M, PAIRS_KEPT))
    points = np.asarray(sample_surface(solid.surface, SURFACE_POINTS, seed=rng)[0])
    points = points[~solid.inside(points)]
    grasps = _approachable(pairs, points, solid.surface.area / SURFACE_POINTS, gripper)
    features = np.concatenate(
        [grasps.pos / _POSITION_SCALE_M, grasps.approach, grasps.closing], axis=1
    )
    return grasps.take(farthest_points(features, GRASPS_KEPT))


def _contact_pairs(
    solid: Solid, gripper: Gripper, friction: float, rng: np.random.Generator
) -> SurfaceGrasps:
    """Return pairs of contacts; their ``pos``, ``approach`` and ``patch`` are placeholders."""
    sampled = sample_surface(solid.surface, SAMPLES, seed=rng)
    origins = np.repeat(np.asarray(sampled[0]), RAYS_PER_SAMPLE, axis=0)
    normals = np.repeat(solid.surface.face_normals[sampled[1]], RAYS_PER_SAMPLE, axis=0)
    cone = min(math.atan(friction), MAX_SLANT_RAD)
    directions = -_within_cone(normals, cone, rng)
    # The ray along the normal is always tried: opposite sides of a box are met by no other.
    directions[::RAYS_PER_SAMPLE] = -normals[::RAYS_PER_SAMPLE]
    # Pieces overlap: a point on one of them may be within another, where no finger comes.
    outer = ~solid.inside(origins + _PROBE_M * normals)
    origins = origins[outer]
    normals = normals[outer]
    directions = directions[outer]
    width, last_normal, behind = _through(solid, origins, directions)
    _, _, before = _through(solid, origins, -directions)
    first = arccos(np.clip(-np.einsum("rj,rj->r", directions, normals), -1.0, 1.0))
    second = arccos(np.clip(np.einsum("rj,rj->r", directions, last_normal), -1.0, 1.0))
    slant = np.maximum(first, second)
    room = np.minimum(before, behind)
    play = np.minimum(room - gripper.thickness - CLEARANCE_M, MAX_PLAY_M)
    by_hand = (gripper.opening - width) / 2
    good = (
        (slant <= cone)
        & (width <= gripper.usable)
        & (play >= np.minimum(MIN_PLAY_M, by_hand))
    )
    # The fingers cannot open wider than the hand does.
    play = np.minimum(play, by_hand)
    middle = origins + 0.5 * width[:, None] * directions
    most_open = width + 2 * play
    none = np.zeros(len(directions))
    found = SurfaceGrasps(
        middle, directions, directions, middle, width, most_open, slant, none
    )
    return found.take(np.flatnonzero(good)[np.argsort(slant[good], kind="stable")])


def _within_cone(axes: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Sample unit vectors (R, 3), uniform in cones of half-angle ``angle`` [rad] around unit axes (R, 3)."""
    cosine = rng.uniform(np.cos(angle), 1.0, len(axes))
    turn = rng.uniform(-np.pi, np.pi, len(axes))
    # The axis that is farthest from parallel, so that the cross product is not near 0.
    side = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    u = np.cross(axes, side)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axes, u)
    sine = np.sqrt(1.0 - cosine**2)
    across = np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
    return cosine[:, None] * axes + sine[:, None] * across


def _through(
    solid: Solid, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cast rays from the surface through the body that they enter.

    Returns:
        Distance (R,) to the exit from the body, 0 if a ray enters none; outward normal (R, 3) there; free distance (R,)
        from there to the next body.
    """
    enter, leave, normal = solid.cross(origins, directions)
    end = np.zeros(len(origins))
    last = np.zeros((len(origins), 3))
    # A ray passes from one joined piece into the next: at most once through each.
    for _ in range(enter.shape[1]):
        joined = (enter <= end[:, None] + _JOIN_M) & (leave > end[:, None] + _JOIN_M)
        far = np.where(joined, leave, -np.inf)
        k = far.argmax(axis=1)
        rows = np.flatnonzero(joined.any(axis=1))
        if not len(rows):
            break
        end[rows] = far[rows, k[rows]]
        last[rows] = normal[rows, k[rows]]
    beyond = np.where(enter > end[:, None], enter, np.inf).min(axis=1)
    return end, last, beyond - end


def _approachable(
    pairs: SurfaceGrasps, points: np.ndarray, point_area: float, gripper: Gripper
) -> SurfaceGrasps:
    """Return the grasps of pairs of contacts for all approaches on which the hand does not touch ``points`` (P, 3)."""
    parts = [
        _approaches(pairs.take(np.array([k])), points, point_area, gripper)
        for k in range(len(pairs))
    ]
    names = SurfaceGrasps.__dataclass_fields__
    return SurfaceGrasps(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _approaches(
    pair: SurfaceGrasps, points: np.ndarray, point_area: float, gripper: Gripper
) -> SurfaceGrasps:
    """Return the grasps of one pair of contacts: for each approach the deepest one without collision."""
    closing = pair.closing[0]
    start = np.cross(closing, np.eye(3)[np.argmin(np.abs(closing))])
    start /= np.linalg.norm(start, axis=-1)
    angle = np.arange(APPROACHES) * 2 * np.pi / APPROACHES
    directions = np.cos(angle)[:, None] * start + np.sin(angle)[:, None] * np.cross(
        closing, start
    )
    frames = frame_from_axes(directions, np.broadcast_to(closing, directions.shape))
    local = np.einsum("pj,ajk->apk", points - pair.contact[0], frames)
    found = np.full(APPROACHES, np.nan)
    patch = np.zeros(APPROACHES)
    # The deepest comes first and is kept, since it holds best.
    for depth in CONTACT_DEPTHS_M:
        shifted = local + np.array([depth, 0.0, 0.0])
        free = ~_touches(shifted, float(pair.most_open[0]), gripper)
        fresh = free & np.isnan(found)
        found[fresh] = depth
        pressed = _pressed(shifted[fresh], float(pair.width[0]), gripper)
        # A length, to be comparable with the measure of other pinches.
        patch[fresh] = np.sqrt(point_area * pressed)
    rows = np.flatnonzero(~np.isnan(found))
    return SurfaceGrasps(
        pos=pair.contact - found[rows, None] * directions[rows],
        approach=directions[rows],
        closing=np.repeat(pair.closing, len(rows), axis=0),
        contact=np.repeat(pair.contact, len(rows), axis=0),
        width=np.repeat(pair.width, len(rows)),
        most_open=np.repeat(pair.most_open, len(rows)),
        slant=np.repeat(pair.slant, len(rows)),
        patch=patch[rows],
    )


def _touches(local: np.ndarray, opening: float, gripper: Gripper) -> np.ndarray:
    """Return (A,) bool: points (A, P, 3), gripper frame, touch the open hand or its straight approach."""
    x = local[..., 0]
    y = np.abs(local[..., 1])
    z = np.abs(local[..., 2])
    tip = gripper.finger[0] + CLEARANCE_M
    fingers = (x < tip) & (x > -APPROACH_LENGTH_M) & (z < gripper.finger[1] + CLEARANCE_M)
    fingers &= (y > opening / 2) & (y < opening / 2 + gripper.thickness + CLEARANCE_M)
    palm = (x < gripper.palm_x[1] + CLEARANCE_M) & (
        x > gripper.palm_x[0] - APPROACH_LENGTH_M
    )
    palm &= (y < gripper.palm_half[0] + CLEARANCE_M) & (
        z < gripper.palm_half[1] + CLEARANCE_M
    )
    return np.asarray((fingers | palm).any(axis=1))


def _pressed(local: np.ndarray, width: float, gripper: Gripper) -> np.ndarray:
    """Return (A,): number of points (A, P, 3), gripper frame, in contact with a pad, of the pad with fewer."""
    on_pad = (np.abs(local[..., 0]) < gripper.finger[0]) & (
        np.abs(local[..., 2]) < gripper.finger[1]
    )
    sides = [
        (on_pad & (np.abs(local[..., 1] - side * width / 2) < _PATCH_DEPTH_M)).sum(axis=1)
        for side in (-1.0, 1.0)
    ]
    return np.minimum(*sides)
