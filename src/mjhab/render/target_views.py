"""Views from the places of a robot's cameras, turned to a target and narrowed to it: relative depth, and colours.

A handle of 2 cm is a pixel of a whole image of 32 px, and a few of 255 levels of its depth; here it is a fifth of the
image and a quarter of the levels. Such a view shows nothing that the robot's camera does not see from the same place:
pixels outside of its image stay empty, and so does the whole view where the target is outside. Letters: n views.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np

from mjhab.core.conventions.images import COLOURS, RGB, TARGET_DEPTH, TARGET_RGB
from mjhab.render.cameras import Cameras
from mjhab.render.home_scene import (
    ROBOT_LEVEL_ERROR,
    BodyPoses,
    CameraChange,
    HomeRenderer,
    ViewChange,
    is_sane,
)

FOV = 0.5
"""Field of view [rad] of both sides."""
RANGE_SHARE = 0.25
"""Depths that differ from the target's distance by more than this share of it are told no further."""
MIDDLE = 128
REACH = 127
"""Byte of the target's distance, and how far the bytes of the nearest and farthest depths that are told are from it."""
UNSEEN = 0
"""Byte of what is not seen; what is seen has at least 1."""
NEAREST_M = 0.05
"""A target nearer than this to the camera counts as outside of its image."""
_DRAWN = {TARGET_DEPTH: "depth", TARGET_RGB: RGB}
"""What is drawn for an output."""


class PerturbedViews(NamedTuple):
    """What perturbs views of targets in W worlds.

    Attributes:
        change: of the robot's cameras.
        needs: images that are drawn for ``picture`` besides colours.
        picture: changes colours in place, given a world, images (n, height, width, ...) by name, orientations
            (n, 3, 3) and focal lengths (n,) [px] of its views.
    """

    change: ViewChange
    needs: Collection[str]
    picture: Callable[[int, dict[str, np.ndarray], np.ndarray, np.ndarray], None]


def target_views(
    renderer: HomeRenderer,
    state: BodyPoses,
    homes: Sequence[str],
    target: np.ndarray,
    size: tuple[int, int],
    cameras: Sequence[str],
    outputs: Sequence[str] = (TARGET_DEPTH,),
    perturbed: PerturbedViews | None = None,
) -> dict[str, np.ndarray]:
    """Draw the views of all worlds and cameras.

    Args:
        renderer: of the layout.
        state: poses of the bodies.
        homes: (W,) names of the worlds' homes.
        target: (W, 3) in the world [m].
        size: (height, width) of the views, and of the robot's images beside them [px].
        cameras: names of C robot cameras.
        outputs: any of TARGET_OUTPUTS.
        perturbed: what perturbs the views, if something does. Cameras that differ from their mounts are turned and
            narrowed as from where they should be, so that the target is beside the middle of the views.

    Returns:
        By output "target_depth" (W, C, height, width), see `relative_bytes`, and "target_rgb" (W, C, height, width, 3),
        both uint8; UNSEEN where the robot's camera sees nothing.
    """
    height, width = size
    shape = (len(homes), len(cameras), *size)
    views = {
        output: np.full((*shape, 3) if output in COLOURS else shape, UNSEEN, np.uint8)
        for output in outputs
    }
    pos, mat = renderer.camera_poses(state, cameras)
    # In float64, because whether a target is in an image must not depend on the simulator's precision.
    pos, mat = np.asarray(pos, np.float64), np.asarray(mat, np.float64)
    to_target = target[:, None] - pos
    fovy = np.broadcast_to(renderer.fields_of_view(cameras), to_target.shape[:2])
    aspect = width / height
    seen = in_image(_in_frame(mat, to_target), fovy, aspect)
    seen &= _norm(to_target) >= NEAREST_M
    # Poses of diverged worlds must not reach the kernels.
    seen &= is_sane(state.body_pos, state.body_mat)[:, None]
    worlds, columns = np.nonzero(seen)
    if not len(worlds):
        return views
    own = mat[worlds, columns]
    look, distance = turned(pos[worlds, columns], own, target[worlds])
    # Columns of ``look`` are axes in the world; those of the relative rotation are axes in the robot's camera.
    relative = np.stack([_in_frame(own, look[:, :, k]) for k in range(3)], axis=2)
    eye, wide = pos[worlds, columns], np.full(len(worlds), FOV)
    if perturbed is not None and (mounts := perturbed.change.mounts) is not None:
        one = CameraChange(*(part[worlds, columns][:, None] for part in mounts))
        moved = one.applied(eye[:, None], own[:, None], wide[:, None])
        eye, moved_own, wide = (part[:, 0] for part in moved)
        look = moved_own @ relative
    turned_to = Cameras(
        eye[:, None], look[:, None], wide[:, None], width, height, ROBOT_LEVEL_ERROR
    )
    drawn = _drawn(renderer, state, homes, worlds, turned_to, outputs, perturbed)
    pixels = _sums(relative[:, None, None], rays(size)[None])
    known = in_image(pixels, fovy[worlds, columns][:, None, None], aspect)
    for output in outputs:
        image = drawn[_DRAWN[output]]
        if output == TARGET_DEPTH:
            image = relative_bytes(image, distance)
        mask = known[..., None] if output in COLOURS else known
        views[output][worlds, columns] = np.where(mask, image, np.uint8(UNSEEN))
    return views


def _drawn(
    renderer: HomeRenderer,
    state: BodyPoses,
    homes: Sequence[str],
    worlds: np.ndarray,
    views: Cameras,
    outputs: Sequence[str],
    perturbed: PerturbedViews | None,
) -> dict[str, np.ndarray]:
    """Images (n, height, width, ...) by their names of n views in the worlds (n,), colours perturbed."""
    names = dict.fromkeys(_DRAWN[output] for output in outputs)
    looks = None
    if perturbed is not None:
        looks = perturbed.change.looks
        names |= dict.fromkeys(perturbed.needs if RGB in names else ())
    images = renderer.render(
        renderer.home_numbers(homes)[worlds],
        state.body_pos[worlds],
        state.body_mat[worlds],
        views,
        tuple(names),
        looks=None if looks is None else looks[worlds],
    )
    drawn = {name: image[:, 0] for name, image in images.items()}
    if perturbed is not None and RGB in names:
        focal = 0.5 * views.height / np.tan(0.5 * np.asarray(views.fovy)[:, 0])
        for world in np.unique(worlds).tolist():
            rows = worlds == world
            # Copies: depth has its noise as bytes.
            mine = {name: image[rows] for name, image in drawn.items()}
            perturbed.picture(world, mine, views.mat[rows, 0], focal[rows])
            drawn[RGB][rows] = mine[RGB]
    return drawn


def turned(
    pos: np.ndarray, mat: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn cameras to targets, with the vertical of their images as it was.

    Args:
        pos, mat: (n, 3) [m], (n, 3, 3) cameras in the world; columns x right, y up, z backwards.
        target: (n, 3) in the world, in front of the cameras and not in their place [m].

    Returns:
        Orientations (n, 3, 3), and distances (n,) [m].
    """
    back = pos - target
    distance = _norm(back)
    back = back / distance[:, None]
    # By the camera's own vertical, so that the view tilts with the head as its image does.
    right = np.cross(mat[:, :, 1], back)
    right = right / _norm(right)[:, None]
    return np.stack([right, np.cross(back, right), back], axis=2), distance


def in_image(points: np.ndarray, fovy: np.ndarray, aspect: float) -> np.ndarray:
    """Whether points (..., 3) in the frames of cameras (x right, y up, z backwards) are in their images.

    Args:
        points: of any length, as directions too.
        fovy: (...) vertical fields of view [rad], or of a shape that broadcasts.
        aspect: width of the images by their height.

    Returns:
        (...) bool.
    """
    half = np.tan(0.5 * fovy) * -points[..., 2]
    return (
        (half > 0.0)
        & (np.abs(points[..., 1]) <= half)
        & (np.abs(points[..., 0]) <= aspect * half)
    )


def rays(size: tuple[int, int]) -> np.ndarray:
    """Directions (height, width, 3) of the pixels of a view in its frame."""
    height, width = size
    focal = 0.5 * height / np.tan(0.5 * FOV)
    x = (np.arange(width) + 0.5 - 0.5 * width) / focal
    y = (0.5 * height - np.arange(height) - 0.5) / focal
    grid = np.stack(np.meshgrid(x, y), axis=2)
    return np.concatenate([grid, np.full((height, width, 1), -1.0)], axis=2)


def relative_bytes(depth: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Depth relative to a target: 128 at its distance, 255 a quarter of it nearer, 1 a quarter farther.

    Args:
        depth: (n, height, width) [m] along the optical axis, 0 where nothing is hit.
        distance: (n,) of the targets [m].

    Returns:
        (n, height, width) uint8; UNSEEN where nothing is hit.
    """
    far = distance[:, None, None]
    level = MIDDLE + REACH * (far - depth) / (RANGE_SHARE * far)
    told = np.clip(np.rint(level), MIDDLE - REACH, MIDDLE + REACH).astype(np.uint8)
    # Depth 0 is the sky.
    return np.where(depth > 0.0, told, np.uint8(UNSEEN))


def _in_frame(mat: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of the world in the frames (..., 3, 3) whose columns are axes in the world."""
    return _sums(np.swapaxes(mat, -1, -2), vectors)


def _sums(mat: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Products of matrices and vectors; the order of sums is fixed, so that their number does not matter."""
    x, y, z = (vectors[..., None, k] for k in range(3))
    return mat[..., 0] * x + mat[..., 1] * y + mat[..., 2] * z


def _norm(vectors: np.ndarray) -> np.ndarray:
    x, y, z = (vectors[..., k] for k in range(3))
    return np.sqrt(x * x + y * y + z * z)
