"""Rows of the robot's cameras: images, their parameters, and point clouds. Letters: W worlds, C cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from mjhab.core.arrays import Array, constant, count, device_of, empty, namespace, zeros
from mjhab.core.conventions.images import (
    COLOURS,
    RGB,
    TARGET_DEPTH,
    TARGET_RGB,
    channels_of,
)
from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.envs.observations.entry import CameraInputs, ObsEntry
from mjhab.envs.observations.modes import (
    CAMERA_OUTPUTS,
    POINTCLOUD,
    camera_key,
    param_key,
)
from mjhab.robots.robot import Robot

DEPTH_SCALE = 1000.0
"""Depth images are int16 millimetres, 0 where nothing is hit."""
DEPTH_MAX = int(np.iinfo(np.int16).max)


def intrinsic_matrix(robot: Robot, camera: str, size: tuple[int, int]) -> np.ndarray:
    """(3, 3) float64 pinhole matrix [px] of a camera at (height, width); pixel centres lie at + 0.5."""
    height, width = size
    fovy = robot.camera(camera).fovy
    # From the height, as MuJoCo's field of view is vertical.
    focal = 0.5 * height / np.tan(0.5 * fovy)
    return np.array(
        [[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]
    )


def camera_table(
    robot: Robot, outputs: Sequence[str], cameras: Sequence[str], size: tuple[int, int]
) -> tuple[ObsEntry, ...]:
    """Make the rows of the cameras.

    Args:
        robot: the robot.
        outputs: images and point clouds, see `mode_outputs`; without any there are no rows.
        cameras: names of the robot's cameras.
        size: (height, width) of the images [px].
    """
    rows: list[ObsEntry] = []
    for c, camera in enumerate(cameras if outputs else ()):
        rows += [
            _image_row(c, camera, output, size)
            for output in outputs
            if output in CAMERA_OUTPUTS
        ]
        rows += _param_rows(c, camera)
    if POINTCLOUD in outputs:
        rows += _cloud_rows(robot, len(cameras) * size[0] * size[1])
    return tuple(rows)


def _image_row(index: int, camera: str, output: str, size: tuple[int, int]) -> ObsEntry:
    compute = partial(_image, index=index, output=output)
    key = camera_key(camera, output)
    frame = "image, rows from the top"
    view = "view of 0.5 rad, rows from the top"
    if output == RGB:
        return ObsEntry(
            key, (*size, 3), "sRGB", frame, compute, "colour", np.uint8, 0, 255
        )
    if output == TARGET_RGB:
        meaning = (
            "view from the camera's place to the target of the active subtask: colour, 0 where the camera "
            "sees nothing"
        )
        return ObsEntry(key, (*size, 3), "sRGB", view, compute, meaning, np.uint8, 0, 255)
    if output == "depth":
        meaning = "distance along the optical axis, 0 where nothing is hit"
        return ObsEntry(
            key, (*size, 1), "mm", frame, compute, meaning, np.int16, 0, DEPTH_MAX
        )
    if output == TARGET_DEPTH:
        meaning = (
            "view from the camera's place to the target of the active subtask: 128 at its distance, 255 and 1 a "
            "quarter of it nearer and farther, 0 where the camera sees nothing"
        )
        unit = "1/508 of the distance"
        return ObsEntry(key, (*size, 1), unit, view, compute, meaning, np.uint8, 0, 255)
    meaning = "segmentation id, see `segmentation_names`; 0 where nothing is hit"
    most = np.iinfo(np.int32).max
    return ObsEntry(key, (*size, 1), "id", frame, compute, meaning, np.int32, 0, most)


def _param_rows(index: int, camera: str) -> list[ObsEntry]:
    def row(
        name: str,
        shape: tuple[int, ...],
        unit: str,
        frame: str,
        compute: Callable,
        meaning: str,
    ) -> ObsEntry:
        return ObsEntry(
            param_key(camera, name),
            shape,
            unit,
            frame,
            partial(compute, index=index),
            meaning,
        )

    return [
        row(
            "intrinsic_cv",
            (3, 3),
            "px",
            "camera: x right, y down, z forward",
            _intrinsic_cv,
            "pinhole matrix; pixel centres lie at + 0.5",
        ),
        row(
            "extrinsic_cv",
            (3, 4),
            "m",
            "camera: x right, y down, z forward",
            _extrinsic_cv,
            "world to camera",
        ),
        row(
            "cam2world_gl",
            (4, 4),
            "m",
            "world",
            _cam2world_gl,
            "camera (x right, y up, z backwards) to world",
        ),
    ]


def _cloud_rows(robot: Robot, points: int) -> list[ObsEntry]:
    most = np.iinfo(np.int32).max
    order = "of every pixel: cameras in the order asked for, rows from the top"
    return [
        ObsEntry(
            f"{POINTCLOUD}/xyz",
            (points, 3),
            "m",
            robot.base_link,
            _cloud_xyz,
            f"position {order}; zero where nothing is hit (seg 0)",
        ),
        ObsEntry(
            f"{POINTCLOUD}/rgb",
            (points, 3),
            "sRGB",
            "-",
            partial(_cloud_image, output="rgb"),
            f"colour {order}",
            np.uint8,
            0,
            255,
        ),
        ObsEntry(
            f"{POINTCLOUD}/seg",
            (points, 1),
            "id",
            "-",
            partial(_cloud_image, output="seg"),
            f"segmentation id {order}",
            np.int32,
            0,
            most,
        ),
    ]


def _image(views: CameraInputs, index: int, output: str) -> Array:
    images = views.images[output]
    if output in COLOURS:
        return images[:, index]
    if output in ("seg", TARGET_DEPTH):
        return images[:, index, ..., None]
    return _millimetres(images, index)[..., None]


def _millimetres(images: Array, index: int) -> Array:
    """Depth of one camera as int16 [mm], from the images (W, C, h, w) [m] of all."""
    if isinstance(images, np.ndarray):
        from mjhab.core.kernels.integers import (
            scaled_int16,
        )  # loads numba, as drawing has

        worlds, _, height, width = images.shape
        found = np.empty((worlds, height, width), np.int16)
        # Kernels are compiled for contiguous arrays.
        whole = np.ascontiguousarray(images)
        scaled_int16(whole, index, np.float32(DEPTH_SCALE), np.float32(DEPTH_MAX), found)
        return found
    xp = namespace(images)
    mm = images[:, index] * DEPTH_SCALE
    # Into the same memory: images of many worlds are the largest arrays of a step.
    xp.round(mm, out=mm)
    # Before the conversion, which would wrap around.
    xp.minimum(mm, constant((float(DEPTH_MAX),), mm), out=mm)
    return xp.astype(mm, xp.int16)


def _intrinsic_cv(views: CameraInputs, index: int) -> Array:
    xp = namespace(views.intrinsic)
    return xp.tile(xp.astype(views.intrinsic[index], xp.float32), (len(views.pos), 1, 1))


def _extrinsic_cv(views: CameraInputs, index: int) -> Array:
    xp = namespace(views.mat)
    # The transpose is the inverse of a rotation.
    rot = xp.permute_dims(_turned(views.mat[:, index]), (0, 2, 1))
    move = -xp.einsum("wij,wj->wi", rot, views.pos[:, index])
    return xp.astype(xp.concat([rot, move[..., None]], axis=2), xp.float32)


def _turned(mat: Array) -> Array:
    """Convert camera rotations (..., 3, 3) from MuJoCo's axes to OpenCV's: y and z are reversed."""
    return mat * constant((1.0, -1.0, -1.0), mat)


def _cam2world_gl(views: CameraInputs, index: int) -> Array:
    xp = namespace(views.mat)
    out = xp.zeros((len(views.pos), 4, 4), dtype=xp.float32, device=device_of(views.mat))
    out[:, :3, :3] = views.mat[:, index]
    out[:, :3, 3] = views.pos[:, index]
    out[:, 3, 3] = 1.0
    return out


def _cloud_xyz(views: CameraInputs) -> Array:
    depth = views.images["depth"]
    xp = namespace(depth)
    f32 = namespace(depth).float32
    yaw = views.base[:, BASE_YAW]
    c = xp.cos(yaw)
    s = xp.sin(yaw)
    zero = zeros(yaw.shape, yaw)
    to_base = xp.stack(
        [
            xp.stack([c, s, zero]),
            xp.stack([-s, c, zero]),
            xp.stack([zero, zero, zero + 1.0]),
        ]
    )
    to_base = xp.permute_dims(to_base, (2, 0, 1))
    # At the height of the base link, as poses in the state are.
    origin = xp.concat(
        [views.base[:, BASE_XY], zero[:, None] + views.robot.base_height], axis=1
    )
    rot = to_base[:, None] @ views.mat
    pos = xp.einsum("wij,wcj->wci", to_base, views.pos - origin[:, None])
    # Points in the camera (x right, y down, z forward) and 1, all 0 where nothing is hit, times a 4x3 matrix.
    seen = empty((*depth.shape, 4), depth)
    # The middle of a pixel.
    col = count(depth.shape[3], depth) + 0.5
    row = count(depth.shape[2], depth)[:, None] + 0.5
    for k, matrix in enumerate(views.intrinsic):
        seen[:, k, ..., 0] = depth[:, k] * xp.astype(
            (col - matrix[0, 2]) / matrix[0, 0], f32
        )
        seen[:, k, ..., 1] = depth[:, k] * xp.astype(
            (row - matrix[1, 2]) / matrix[1, 1], f32
        )
    seen[..., 2] = depth
    # 0 takes the translation away, so that nothing is where nothing is hit.
    seen[..., 3] = depth > 0.0
    move = xp.concat(
        [xp.permute_dims(_turned(rot), (0, 1, 3, 2)), pos[:, :, None]], axis=2
    )
    # One matrix product for all pixels: in float32, as the points are told.
    points = xp.reshape(seen, (*depth.shape[:2], -1, 4)) @ xp.astype(move, f32)
    return xp.reshape(points, (len(depth), -1, 3))


def _cloud_image(views: CameraInputs, output: str) -> Array:
    image = views.images[output]
    return image.reshape(len(image), -1, channels_of(output))
