"""One home of a render scene with its windows open: holes in the walls where the rasterizer draws panes on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mjhab.render.raster.arrays import PARKED_BELOW
from mjhab.render.render_scene import RenderScene

WALL = "wall"
ON_WALL_M = 0.08
"""A pane hangs on a wall if its middle is at most this far from the face of the wall."""
MIN_PIECE_M = 1e-4
SKYLIGHT_M = 0.6
"""Half the side of a hole in the ceiling [m]."""
FROSTED = 0.25
"""Share of the light of the sky that comes through such a hole: rooms are then as bright as those with windows."""
Rect = tuple[float, float, float, float]
"""u0, v0, u1, v1 in the plane of a wall [m]."""


class Opening(NamedTuple):
    """A hole through which daylight comes.

    Attributes:
        middle: (3,) [m], on the outer face of the wall or the ceiling.
        across, up: (3,) from the middle to its edges [m].
        inward: (3,) unit vector into the room.
        clear: share of the light of the sky that comes through.
    """

    middle: np.ndarray
    across: np.ndarray
    up: np.ndarray
    inward: np.ndarray
    clear: float = 1.0


def one_home(scene: RenderScene, home: int) -> RenderScene:
    """The scene with this home alone, as home 0."""
    rows = slice(home, home + 1)
    fields = (
        *("instance_material", "home_pos", "home_mat", "home_scale"),
        *("light_pos", "light_color"),
    )
    parts = {name: getattr(scene, name)[rows] for name in fields}
    return dataclasses.replace(scene, **parts)


def open_windows(scene: RenderScene) -> tuple[RenderScene, list[Opening]]:
    """Cut the walls of a scene of one home behind its panes of glass, and take these panes away.

    Light that is traced reaches a room through a hole; it would be lost at a pane, since no path finds the sun there.

    Returns:
        The scene, and its windows.
    """
    there = (scene.home_scale[0] != 0.0).all(axis=1) & (scene.instance_body == 0)
    # Parked pieces are in the scene, too.
    there &= scene.home_pos[0, :, 2] > PARKED_BELOW
    material = scene.instance_material[0]
    glass = there & (material >= 0) & (scene.mat_kind[material] == "glass")
    # By name, because walls are boxes like everything else.
    walls = np.flatnonzero(there & (scene.instance_seg == _segment(scene, WALL)))
    panes: list[int] = np.flatnonzero(glass).tolist()
    pieces: list[tuple[int, np.ndarray, np.ndarray]] = []
    opened: dict[int, Opening] = {}
    cut: list[int] = []
    for wall in walls.tolist():
        holes = {pane: hole for pane in panes if (hole := _hole(scene, wall, pane))}
        if not holes:
            continue
        cut.append(wall)
        for pane, hole in holes.items():
            opened[pane] = _opening(scene, wall, pane, hole)
        pieces += [(wall, *box) for box in _remaining(scene, wall, list(holes.values()))]
    if not opened:
        return scene, []
    return _with_pieces(scene, [*cut, *opened], pieces), list(opened.values())


def _opening(scene: RenderScene, wall: int, pane: int, hole: Rect) -> Opening:
    """The hole of a pane in a wall. Panes hang on the side of the room."""
    turn = scene.home_mat[0, wall]
    half = np.abs(scene.home_scale[0, wall])
    across, u, v = _thin(half)
    to_pane = turn[:, across] @ (scene.home_pos[0, pane] - scene.home_pos[0, wall])
    inward = turn[:, across] * (1.0 if to_pane > 0.0 else -1.0)
    u0, v0, u1, v1 = hole
    middle = turn[:, u] * (u0 + u1) / 2 + turn[:, v] * (v0 + v1) / 2
    return Opening(
        scene.home_pos[0, wall] + middle - inward * half[across],
        turn[:, u] * (u1 - u0) / 2,
        turn[:, v] * (v1 - v0) / 2,
        inward,
    )


def skylights(
    lamps: np.ndarray, span: Rect, height: float
) -> tuple[list[Opening], list[Rect]]:
    """Daylight of a home without windows: holes in its ceiling above the lamps.

    Args:
        lamps: positions (L, 3) [m].
        span: of the ceiling.
        height: of the ceiling [m].

    Returns:
        The holes, and the rectangles of the ceiling between them.
    """
    x0, y0, x1, y1 = span
    rects: list[Rect] = []
    for x, y, _ in lamps.tolist():
        rect = (x - SKYLIGHT_M, y - SKYLIGHT_M, x + SKYLIGHT_M, y + SKYLIGHT_M)
        # A hole across the edge of the ceiling could not be cut out of it.
        inside = rect[0] > x0 and rect[1] > y0 and rect[2] < x1 and rect[3] < y1
        # Holes that overlap would let light in twice.
        apart = all(
            abs(x - (r[0] + r[2]) / 2) > 2 * SKYLIGHT_M
            or abs(y - (r[1] + r[3]) / 2) > 2 * SKYLIGHT_M
            for r in rects
        )
        if inside and apart:
            rects.append(rect)
    down = np.array([0.0, 0.0, -1.0])
    holes = [
        Opening(
            np.array([(r[0] + r[2]) / 2, (r[1] + r[3]) / 2, height]),
            np.array([(r[2] - r[0]) / 2, 0.0, 0.0]),
            np.array([0.0, (r[3] - r[1]) / 2, 0.0]),
            down,
            FROSTED,
        )
        for r in rects
    ]
    return holes, without(span, rects)


def without(rect: Rect, holes: Iterable[Rect]) -> list[Rect]:
    """What is left of a rectangle around holes."""
    left = [rect]
    for hole in holes:
        left = [piece for part in left for piece in _around(part, hole)]
    return left


def _segment(scene: RenderScene, name: str) -> int:
    return scene.seg_names.index(name) if name in scene.seg_names else -1


def _thin(half: np.ndarray) -> tuple[int, int, int]:
    """The axis across a wall of these half-extents, and the two in its plane."""
    across = int(half.argmin())
    u, v = (axis for axis in range(3) if axis != across)
    return across, u, v


def _hole(scene: RenderScene, wall: int, pane: int) -> Rect | None:
    """What a pane covers of a wall, in the axes of the wall; None if it does not hang on it."""
    turn = scene.home_mat[0, wall]
    half = np.abs(scene.home_scale[0, wall])
    across, u, v = _thin(half)
    at = turn.T @ (scene.home_pos[0, pane] - scene.home_pos[0, wall])
    # The mesh of a pane is the unit box.
    size = np.abs(turn.T @ scene.home_mat[0, pane]) @ np.abs(scene.home_scale[0, pane])
    # Glass of other shapes, such as a screen that stands, is no pane of this wall.
    flat = size[across] < min(size[u], size[v])
    if not flat or abs(at[across]) > half[across] + ON_WALL_M:
        return None
    low = np.maximum(at - size, -half)
    high = np.minimum(at + size, half)
    if min(high[u] - low[u], high[v] - low[v]) < MIN_PIECE_M:
        return None
    return float(low[u]), float(low[v]), float(high[u]), float(high[v])


def _remaining(
    scene: RenderScene, wall: int, holes: Sequence[Rect]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Middle and half-extents (3,) [m] of the boxes that are left of a wall, in its axes."""
    half = np.abs(scene.home_scale[0, wall])
    _, u, v = _thin(half)
    for u0, v0, u1, v1 in without((-half[u], -half[v], half[u], half[v]), holes):
        middle = np.zeros(3)
        middle[[u, v]] = (u0 + u1) / 2, (v0 + v1) / 2
        size = half.copy()
        size[[u, v]] = (u1 - u0) / 2, (v1 - v0) / 2
        yield middle, size


def _around(rect: Rect, hole: Rect) -> Iterator[Rect]:
    """What is left of a rectangle around a hole: up to four rectangles."""
    u0, v0, u1, v1 = rect
    a0, b0, a1, b1 = (
        max(u0, hole[0]),
        max(v0, hole[1]),
        min(u1, hole[2]),
        min(v1, hole[3]),
    )
    if a0 >= a1 or b0 >= b1:
        yield rect
        return
    parts = ((u0, v0, a0, v1), (a1, v0, u1, v1), (a0, v0, a1, b0), (a0, b1, a1, v1))
    for part in parts:
        if min(part[2] - part[0], part[3] - part[1]) > MIN_PIECE_M:
            yield part


def _with_pieces(
    scene: RenderScene,
    hidden: list[int],
    pieces: list[tuple[int, np.ndarray, np.ndarray]],
) -> RenderScene:
    """The scene without the instances ``hidden``, and with boxes: wall that each is a piece of, middle and half-extents
    in its axes."""
    wall = np.array([row[0] for row in pieces], int)
    middle = np.array([row[1] for row in pieces]).reshape(-1, 3)
    size = np.array([row[2] for row in pieces]).reshape(-1, 3)
    turn = scene.home_mat[0, wall]
    pos = scene.home_pos[0, wall] + np.einsum("nij,nj->ni", turn, middle)
    scale = scene.home_scale.copy()
    # Hidden by its scale: removing instances would change the numbers of all others.
    scale[0, hidden] = 0.0
    copied = {
        name: np.concatenate([getattr(scene, name), getattr(scene, name)[wall]])
        for name in (
            *("instance_mesh", "instance_body", "instance_pos"),
            *("instance_mat", "instance_seg"),
        )
    }
    return dataclasses.replace(
        scene,
        **copied,
        instance_material=np.concatenate(
            [scene.instance_material, scene.instance_material[:, wall]], axis=1
        ),
        home_pos=np.concatenate([scene.home_pos, pos[None]], axis=1),
        home_mat=np.concatenate([scene.home_mat, turn[None]], axis=1),
        home_scale=np.concatenate([scale, size[None]], axis=1),
    )
