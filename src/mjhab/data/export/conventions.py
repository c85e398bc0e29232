"""Axes, units and orders of the numbers in exports; every export says them in its own metadata."""

from __future__ import annotations

BASE_COLUMN = "base_velocity"
"""Column of the velocity of the base, where the state lacks it. It is none of the observations: LeRobot takes features
that begin with "observation." for state, and MS-HAB's scripts join all of theirs."""
CONVENTIONS: dict[str, str] = {
    "world": "metres, z up, right-handed; a home's floor is at z = 0",
    "quaternion": "w, x, y, z; those in observations have w >= 0",
    "camera": "x right, y up, z backwards: the camera looks along -z (OpenGL, MuJoCo)",
    "camera_pose": "cam2world_gl, 4 x 4, of every frame: p_world = pose @ p_camera, in the axes of 'camera'",
    "mount": "'pos' [m] and 'quat' of a camera are where it is fixed to 'body', a link of the robot: "
    "p_body = R(quat) @ p_camera + pos, in the axes of 'camera'",
    "intrinsic": "3 x 3 [px], in the axes of OpenCV (x right, y down, z forward: those of 'camera' with y and z turned "
    "round): column u = fx * x / z + cx, row v = fy * y / z + cy from the upper left corner of the image; centres of "
    "pixels are at + 0.5",
    "depth": "mm along the optical axis (z of OpenCV), 0 where nothing is hit",
    "points": "x, y, z [m] in the frame of the robot's base link (x forward, y left, z up), then red, green, blue in "
    "0..1",
    BASE_COLUMN: "of the base in its own frame: forward, left [m/s], turning rate [rad/s]",
    "segmentation": "id of what a pixel shows; its name is at that place in the list of segments, 0 is background",
}
"""What a reader has to know of the numbers, by topic."""
