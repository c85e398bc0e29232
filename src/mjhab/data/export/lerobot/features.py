"""The features of a LeRobot data set: the names of its columns and videos, and what an episode has of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError, fault
from mjhab.core.timing import STEP_SECONDS
from mjhab.data.export.conventions import BASE_COLUMN
from mjhab.data.export.outside import Outside
from mjhab.data.select.clouds import CHANNELS
from mjhab.data.select.describing import state_names
from mjhab.data.select.own_state import BASE_VELOCITY, split_state, tells_base_velocity
from mjhab.data.store.reading import RecordedEpisode

FPS = round(1 / STEP_SECONDS)
STATE = "observation.state"
"""Proprioception: joints, velocity of the base, tcp pose."""
# LeRobot's policies feed this key to the network on its own, as state that sensors do not give.
ENVIRONMENT_STATE = "observation.environment_state"
"""Privileged state: object, goal, grasp. A policy for a real robot must not use it."""
TELEPORTED = "is_teleported"
INTERVENTION = "intervention"
"""Whether a policy was corrected, with the name that LeRobot's own collection of corrections gives it."""
IMAGES = {
    "rgb": "observation.images",
    "depth": "observation.depth",
    "seg": "observation.segmentation",
}
"""Image output of an episode to the features that hold it, one per camera."""
MAPS = {"depth": "int16", "seg": "int32"}
"""Image output to its type, of those that are stored in columns (N, H, W)."""
CAMERA_POSE = "camera_pose"
"""Poses (N, 4, 4) of a camera, see CONVENTIONS. Not "observation.", because LeRobot takes such features for state."""
CAMERA_POSE_PATH = "obs/sensor_param/{}/cam2world_gl"
"""Path in a shard of the recorded poses (N+1, 4, 4) of a camera."""
ACTION = "action"
INTENDED = "intended_action"
"""Not "action.intended", because LeRobot treats every feature whose name starts with "action" as policy output."""
SKILL = "skill_index"
"""What who acted was doing; names in meta/skills, 0 where it does not tell."""
POINTS = "observation.pointcloud"
"""Points (N, P, 6) with colours, see `clouds.CHANNELS`."""
LANGUAGE = "language_persistent"
"""Wordings and skills as LeRobot 0.6 reads them; older versions cannot load a set that has it."""
OWN = "own"
RECORDED = "recorded"
"""What STATE holds: what the robot's own sensors tell (OWN), or all that was recorded, such as MS-HAB's 42 numbers."""
FILM = "film"
PNG = "png"
COLOURS = (FILM, PNG)
"""How colour images are stored: in films, or one by one without loss."""
Features = dict[str, dict[str, Any]]
"""Description of every column and video in info.json: dtype, shape, names."""


@dataclass(frozen=True)
class Choice:
    """Which parts of an episode to export: rgb images as videos, depth images and segmentation as columns, if recorded.

    until: end of the exported part, see `Until.parse`. colours: one of COLOURS. points: number of points of a cloud, 0
    for none. state: OWN or RECORDED. actions: control mode that actions are converted to, "" for that of the recording.
    language: whether there is LANGUAGE. held_out: homes whose episodes are the split "val".
    """

    rgb: bool = True
    depth: bool = True
    seg: bool = True
    until: str = ""
    colours: str = FILM
    points: int = 0
    state: str = OWN
    actions: str = ""
    language: bool = False
    held_out: tuple[str, ...] = ()


def state_parts(
    episode: RecordedEpisode, choice: Choice
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Parts (N+1, n) of STATE and of ENVIRONMENT_STATE by observation key."""
    if choice.state == RECORDED:
        parts = episode.table("obs/state") or {"state": episode.array("obs/state")}
        return {key: rows.reshape(len(rows), -1) for key, rows in parts.items()}, {}
    state = split_state(episode)
    return state.own, state.task


def describe(
    episode: RecordedEpisode, choice: Choice, outside: Outside | None = None
) -> Features:
    """The features of an episode by their LeRobot names."""
    own, task = state_parts(episode, choice)
    outside = outside or Outside()
    action_size = outside.actions(episode, choice.actions)[0].shape[1]
    names = [str(each["name"]) for each in outside.columns(episode.run, choice.actions)]
    action = _feature(
        # Entries of several numbers, or a mode without names, must not name the wrong columns.
        "float32",
        (action_size,),
        names if len(names) == action_size else None,
    )
    features: Features = {
        STATE: _state_feature(own, episode),
        ACTION: action,
        INTENDED: dict(action),
        "next.reward": _feature("float32"),
        "next.success": _feature("bool"),
        "next.done": _feature("bool"),
        TELEPORTED: _feature("bool"),
        INTERVENTION: _feature("bool"),
        "subtask_index": _feature("int64"),
        "actor_index": _feature("int64"),
        SKILL: _feature("int64"),
        "timestamp": _feature("float32"),
        **{
            key: _feature("int64")
            for key in ("frame_index", "episode_index", "index", "task_index")
        },
    }
    if task:
        features[ENVIRONMENT_STATE] = _state_feature(task, episode)
    if BASE_VELOCITY not in own and tells_base_velocity(episode):
        features[BASE_COLUMN] = _feature("float32", (3,), ["forward", "left", "yaw"])
    if choice.points:
        features[POINTS] = _feature(
            "float32", (choice.points, len(CHANNELS)), ["point", "channel"]
        )
    if choice.language:
        features[LANGUAGE] = _feature("language")
    chosen = [
        (camera, output)
        for camera, output in episode.images
        if output in IMAGES and getattr(choice, output)
    ]
    for camera, output in chosen:
        # Sizes of images are read from a frame, since cameras of one episode may differ in size.
        height, width = episode.frame(camera, output, 0).shape[:2]
        key = f"{IMAGES[output]}.{camera}"
        if output in MAPS:
            features[key] = _feature(MAPS[output], (height, width), ["height", "width"])
        elif choice.colours == PNG:
            shape = (height, width, 3)
            features[key] = _feature("image", shape, ["height", "width", "channels"])
        else:
            features[key] = _film_feature(height, width)
    paths = set(episode.paths)
    for camera in dict.fromkeys(camera for camera, _ in chosen):
        # Cameras of the scene have no pose per frame: their calibration says it once.
        if CAMERA_POSE_PATH.format(camera) in paths:
            features[f"{CAMERA_POSE}.{camera}"] = _feature(
                "float32", (4, 4), ["row", "column"]
            )
    return features


def _feature(
    dtype: str, shape: tuple[int, ...] = (1,), names: list[str] | None = None
) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "names": names}


def _state_feature(
    parts: Mapping[str, np.ndarray], episode: RecordedEpisode
) -> dict[str, Any]:
    """The feature of concatenated state observations (N+1, n), with a name per column."""
    widths = {key: values.shape[1] for key, values in parts.items()}
    return _feature(
        "float32", (sum(widths.values()),), state_names(widths, episode.run.layout)
    )


def _film_feature(height: int, width: int) -> dict[str, Any]:
    # 4:2:0 video needs even sides; the film writer repeats a row or a column.
    height = height + height % 2
    width = width + width % 2
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": FPS,
        "video.channels": 3,
        "has_audio": False,
    }
    return {
        **_feature("video", (height, width, 3), ["height", "width", "channels"]),
        "info": info,
    }


def film_features(features: Features) -> list[str]:
    """Names of the features that are videos."""
    return [key for key, feature in features.items() if feature["dtype"] == "video"]


def differing(episode: RecordedEpisode, first: Features, other: Features) -> UsageError:
    """Make the error for an episode whose features differ from those of the first one."""
    names = [key for key in {**first, **other} if first.get(key) != other.get(key)]
    return fault(
        f"episode {episode.name} of {episode.shard.path}",
        f"differs from the ones before it in {', '.join(names)}; a data "
        "set needs the same in all. Choose with --where, or leave images out with --no-rgb, --no-depth and --no-seg.",
    )
