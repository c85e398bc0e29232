"""The README of an exported LeRobot data set."""

from __future__ import annotations

from collections.abc import Sequence

from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.export.lerobot.features import (
    ENVIRONMENT_STATE,
    FPS,
    IMAGES,
    STATE,
    TELEPORTED,
    Features,
)
from mjhab.data.export.lerobot.parts import ExportedEpisode
from mjhab.data.select.until import Until


def card(robot: str, made: Sequence[ExportedEpisode], until: Until, notes: str) -> str:
    """Text of README.md for the episodes ``made``; ``notes`` are about their images, see `image_notes`."""
    licences = dict.fromkeys(each.licence for each in made)
    frames = sum(each.steps for each in made)
    teleported = sum(each.row["navigation"] == "teleport" for each in made)
    about = [
        f"`{STATE}` is proprioception (joints, velocity of the base, tcp pose); `{ENVIRONMENT_STATE}` is privileged "
        "state of the simulation (object, goal, grasp)."
    ]
    about.append(notes)
    if teleported:
        about.append(
            f"In {teleported} of {len(made)} episodes the environment teleported the robot to every goal. "
            f"The frames are marked by `{TELEPORTED}`."
        )
    if not until.is_whole:
        about.append(
            f"Episodes end {until.hold_steps} control steps after their first success ({until.text})."
        )
    lines = [
        "---",
        "tags: [LeRobot, mjhab]",
        "task_categories: [robotics]",
        "configs:",
        "- config_name: default",
        "  data_files: data/*/*.parquet",
        "---",
        "",
        f"{len(made)} episodes, {frames} frames at {FPS} Hz of a simulated "
        f"robot ({robot}) in furnished homes, recorded by mjhab.",
        "",
        *(line for text in about if text for line in (text, "")),
        "Assets: " + "; ".join(licences),
        "",
    ]
    return "\n".join(lines)


def image_notes(features: Features, files: Sequence[str]) -> str:
    """What a user of the images has to know, after sentences about ``files``; "" without images."""
    if not any(key.startswith(tuple(IMAGES.values())) for key in features):
        return ""
    topics = (
        "camera",
        "camera_pose",
        "mount",
        "intrinsic",
        "depth",
        "segmentation",
        "quaternion",
    )
    lines = [f"- {topic}: {CONVENTIONS[topic]}" for topic in topics]
    return "\n".join([" ".join([*files, "Conventions:"]), "", *lines])
