"""Pictures of whole homes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.errors import unknown_name
from mjhab.layout.layout import Layout
from mjhab.render.home_scene import HomeRenderer
from mjhab.render.pictures.viewpoint import Viewpoint, cameras_of, floor_of, plan_of
from mjhab.render.raster.rasterizer import NICE
from mjhab.scenes.freespace import free_map
from mjhab.scenes.shading import Shading
from mjhab.scenes.spec import Home, Pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import parked_robot_qpos

VIEWS = ("top", "plan", "inside")
TOP_FOVY = 0.8
INSIDE_FOVY = 1.2
"""Vertical fields of view [rad]."""
INSIDE_HEIGHT_M = 1.9
LOOKED_AT_M = 0.7
"""Heights of the camera of the view "inside", and of what it looks at."""
EYE_ROOM_M = 0.25
"""Distance of this camera from walls and tall furniture."""


def render_homes(
    pack: Pack,
    homes: Sequence[str],
    view: str | Viewpoint = "top",
    width: int = 960,
    height: int = 720,
    shading: Shading | None = None,
) -> Iterator[np.ndarray]:
    """Draw homes one after the other, without objects, the robot parked; the scene is built once.

    Args:
        pack: has the homes.
        homes: their names.
        view: one of `VIEWS`, or a place of the camera.
        width, height: of the images [px].
        shading: options of the path tracer; None takes the rasterizer.

    Returns:
        Images (height, width, 3) uint8 sRGB.

    Raises:
        UsageError: unknown home or view, or there is no path tracer.
    """
    known = {home.name: home for home in pack.homes}
    for name in homes:
        if name not in known:
            raise unknown_name("home", name, known)
    if isinstance(view, str) and view not in VIEWS:
        raise unknown_name("view", view, VIEWS)
    # Without objects: where they are depends on an episode.
    sim = CpuSimulator(Layout(pack, ()), 1, 1)
    renderer = HomeRenderer(sim, shading=shading)
    return (
        _picture(
            renderer,
            sim,
            _viewpoint(renderer, known[name], view, width, height),
            name,
            (width, height),
        )
        for name in homes
    )


def _viewpoint(
    renderer: HomeRenderer,
    home: Home,
    view: str | Viewpoint,
    width: int,
    height: int,
) -> Viewpoint:
    if isinstance(view, Viewpoint):
        return view
    if view == "plan":
        return plan_of(home, width, height)
    if view == "top":
        return from_top(home, width, height)
    return from_inside(home, renderer.layout.pack, renderer.follow.tall(home.name))


def _picture(
    renderer: HomeRenderer,
    sim: CpuSimulator,
    view: Viewpoint,
    home: str,
    size: tuple[int, int],
) -> np.ndarray:
    model = sim.model(home)
    data = mujoco.MjData(model)
    data.qpos[sim.addresses.robot_q] = parked_robot_qpos(renderer.layout.robot)
    # Poses are all that a picture needs.
    mujoco.mj_kinematics(model, data)
    images = renderer.render(
        renderer.home_numbers([home]),
        data.xpos[None],
        data.xmat.reshape(1, -1, 3, 3),
        cameras_of([view], *size),
        ("rgb",),
        NICE,
    )
    return images["rgb"][0, 0]


def from_top(home: Home, width: int, height: int) -> Viewpoint:
    """Where a whole floor is seen from above, in perspective; turned as a plan, see `viewpoint.plan_of`."""
    center, size, up = floor_of(home, width, height)
    fit = max(size[1], size[0] * height / width) / 2 * 1.15
    high = 2.6 + fit / np.tan(TOP_FOVY / 2)
    # Slightly from the side of the viewer, so that fronts are seen.
    eye = center - 0.18 * fit * np.array(up) + np.array([0.0, 0.0, high])
    return Viewpoint(eye, center, TOP_FOVY)


def from_inside(home: Home, pack: Pack, tall: Boxes) -> Viewpoint:
    """The corner of a room from which most of the furniture of the home is in sight.

    Of places on the free floor far from the middle of their surroundings the one is taken that sees the most pieces of
    furniture and the most floor, nearer ones counting more; it looks at the middle of what it sees.

    Args:
        home: the home.
        pack: has its furniture.
        tall: what can hide things, see `FollowCamera.tall`.
    """
    # Coarse cells: places of a camera need no more, and all pairs are compared.
    fmap = free_map(home, pack, cell=0.25)
    floor = fmap.to_xy(np.argwhere(fmap.navigable(0.2)))
    rim = _rim(floor)
    places = rim[:: max(1, len(rim) // 40)]
    spots = np.column_stack([floor[::10], np.full(len(floor[::10]), 0.4)])
    things = np.array([p.pos for p in (*home.props, *home.articulations)]).reshape(-1, 3)
    marks = np.concatenate([spots, things + np.array([0.0, 0.0, 0.6])])
    worth = np.concatenate(
        [
            # Floor and furniture by their shares, whatever the size of a home.
            np.full(len(spots), 1.0 / len(spots)),
            np.full(len(things), 2.0 / max(1, len(things))),
        ]
    )
    best, looked_at, most = places[0], floor.mean(axis=0), -1.0
    for xy in places:
        eye = np.append(xy, INSIDE_HEIGHT_M)
        if len(tall) and sphere_box_distance(eye[None], tall).min() < EYE_ROOM_M:
            continue
        target, value = _best_aim(eye, marks, worth * _in_sight(eye, marks, tall))
        if value > most:
            best, looked_at, most = xy, target, value
    return Viewpoint(
        np.append(best, INSIDE_HEIGHT_M),
        np.append(looked_at[:2], LOOKED_AT_M),
        INSIDE_FOVY,
    )


def _rim(floor: np.ndarray) -> np.ndarray:
    """Of places (n, 2) on a floor those (m, 2) with the fewest others within 1 m: corners and edges of rooms."""
    near = (np.linalg.norm(floor[:, None] - floor[None], axis=2) < 1.0).sum(axis=1)
    return floor[np.argsort(near, kind="stable")[: max(1, len(floor) // 3)]]


def _in_sight(eye: np.ndarray, marks: np.ndarray, tall: Boxes) -> np.ndarray:
    """How much of marks (n, 3) is seen from a place (3,), 0..1: nothing behind tall things, less of what is far."""
    share = np.linspace(0.02, 0.8, 16)[:, None]
    away = np.linalg.norm(marks - eye, axis=1)
    far = np.clip(1.6 - away / 5.0, 0.1, 1.0) * (away > 0.8)
    if not len(tall):
        return far
    rays = (eye + share[:, None] * (marks - eye)).reshape(-1, 3)
    free = (sphere_box_distance(rays, tall) > 0.02).all(axis=1)
    return far * free.reshape(len(share), -1).all(axis=0)


def _best_aim(
    eye: np.ndarray, marks: np.ndarray, worth: np.ndarray
) -> tuple[np.ndarray, float]:
    """The direction with the most worth (n,) of marks (n, 3) in the picture: a point (3,) there, and that worth."""
    aside = np.arctan2(marks[:, 1] - eye[1], marks[:, 0] - eye[0])
    turns = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    off = np.abs((aside[None] - turns[:, None] + np.pi) % (2 * np.pi) - np.pi)
    value = (worth[None] * (off < 0.45 * INSIDE_FOVY * 4 / 3)).sum(axis=1)
    turn = turns[int(value.argmax())]
    ahead = np.array([np.cos(turn), np.sin(turn), 0.0])
    return eye + 2.5 * ahead, float(value.max())
