"""Observation modes, keys of observations, and the cameras and image sizes that are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.conventions.images import TARGET_OUTPUTS
from mjhab.core.errors import shown, unknown_name, wrong_value
from mjhab.core.typed.bounds import bound_of
from mjhab.robots.robot import Robot

STATE_KEY = "state"
PROPRIOCEPTION = "proprioception"
DRAWN_OUTPUTS = ("depth", "rgb", "seg")
"""Images of the robot's cameras that a renderer draws."""
CAMERA_OUTPUTS = (*DRAWN_OUTPUTS, *TARGET_OUTPUTS)
POINTCLOUD = "pointcloud"
OBS_MODES: dict[str, tuple[str, ...]] = {
    "state": (),
    PROPRIOCEPTION: (),
    "depth": ("depth",),
    "rgb": ("rgb",),
    "rgbd": ("depth", "rgb"),
    "seg": ("seg",),
    **{output: (output,) for output in TARGET_OUTPUTS},
    POINTCLOUD: (POINTCLOUD,),
}
"""Observation modes and the images that each adds to the state. Modes can be combined by "+", as in "rgbd+seg".
"proprioception" reduces the state to what the robot's own sensors measure, as in "proprioception+rgbd"."""
MODES_ELSEWHERE = {
    "segmentation": "Here it is 'seg', as in 'rgbd+seg'.",
    "state_dict": "Here 'state' has the state and its parts; obs_keys='nested' makes nested dicts of them.",
    "sensor_data": "Here images are named: 'rgbd', or several joined by '+'.",
    "none": "Here the smallest one is 'proprioception'.",
}
"""Observation modes of ManiSkill and MS-HAB, and what they are here."""
MIN_SIZE = 8
"""Smallest image side [px]."""


def camera_key(camera: str, output: str) -> str:
    """Key of one camera image in the observation."""
    return f"sensor_data/{camera}/{output}"


def image_output(key: str) -> str:
    """What kind of image a flat observation key names, one of CAMERA_OUTPUTS; "" for everything else."""
    folder, _, output = key.rpartition("/")
    is_image = folder.startswith("sensor_data/") and output in CAMERA_OUTPUTS
    return output if is_image else ""


def param_key(camera: str, param: str) -> str:
    """Key of one parameter of a camera in the observation."""
    return f"sensor_param/{camera}/{param}"


def mode_outputs(mode: str) -> tuple[str, ...]:
    """List the images that an observation mode adds to the state, e.g. "rgbd+seg" -> ("depth", "rgb", "seg").

    Raises:
        UsageError: a part that is no mode.
    """
    # The usual slip, for which a list of modes would say nothing.
    if "," in mode:
        raise wrong_value(
            "obs_mode",
            mode,
            f"parts joined by '+', not by a comma: {shown(mode.replace(',', '+'))}",
        )
    wanted = set[str]()
    for part in mode.split("+"):
        if part not in OBS_MODES:
            raise unknown_name("observation mode", part, OBS_MODES, MODES_ELSEWHERE)
        wanted.update(OBS_MODES[part])
    # In one order, whatever the order of the words.
    return tuple(name for name in (*CAMERA_OUTPUTS, POINTCLOUD) if name in wanted)


def own_state_only(mode: str) -> bool:
    """Whether an observation mode hides what no sensor of the robot measures: object, goal and grasp."""
    return PROPRIOCEPTION in mode.split("+")


def camera_names(robot: Robot, cameras: str | Sequence[str]) -> tuple[str, ...]:
    """Names of cameras of a robot, checked, each once, in the order given.

    Raises:
        UsageError: a name that is no camera, or none at all.
    """
    # Each once: two images under one key would overwrite each other.
    names = (cameras,) if isinstance(cameras, str) else tuple(dict.fromkeys(cameras))
    for name in names:
        robot.camera(name)
    if not names:
        raise wrong_value(
            "cameras", "none", f"at least one of {', '.join(robot.camera_names)}"
        )
    return names


def image_size(size: int | Sequence[int]) -> tuple[int, int]:
    """Convert an image size, one number or (height, width), to (height, width) [px].

    Raises:
        UsageError: not whole numbers, not one or two of them, below MIN_SIZE, or above the range of "camera_size".
    """
    most = round(bound_of(EnvConfig, "camera_size").most)
    sides = tuple(size) if isinstance(size, Sequence) else (size, size)
    if len(sides) != 2 or any(
        not isinstance(side, int | np.integer) or not MIN_SIZE <= side <= most
        for side in sides
    ):
        raise wrong_value(
            "camera size",
            size,
            f"one whole number or (height, width), each {MIN_SIZE} to {most}",
        )
    return int(sides[0]), int(sides[1])
