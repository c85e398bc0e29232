"""The README of an exported LeRobot data set: what its user must know, and one line that loads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mjhab.core.version import __version__
from mjhab.data.export.columns import state_columns
from mjhab.data.export.conventions import BASE_COLUMN, CONVENTIONS
from mjhab.data.export.lerobot.features import (
    ACTION,
    ENVIRONMENT_STATE,
    FPS,
    IMAGES,
    INTERVENTION,
    LANGUAGE,
    POINTS,
    STATE,
    TELEPORTED,
    Choice,
    Features,
)
from mjhab.data.export.lerobot.parts import ExportedEpisode
from mjhab.data.export.licences import licence_head
from mjhab.data.select.until import Until
from mjhab.data.store.episode_data import RunInfo

_MOST_SENTENCES = 10


@dataclass(frozen=True)
class CardFacts:
    """What a card tells besides the episodes.

    run: of the first episode. features: of the set. actions: name, unit and frame of the entries of an action. choice:
    what was exported. where: filter of the episodes, "" for all. splits: as in info.json. tasks: all sentences.
    """

    run: RunInfo
    features: Features
    actions: Sequence[Mapping[str, Any]]
    choice: Choice
    where: str
    splits: Mapping[str, str]
    tasks: Sequence[str]

    @property
    def control_mode(self) -> str:
        """Control mode of the actions."""
        recorded = self.run.config.get("env", {}).get("control_mode", "")
        return self.choice.actions or str(recorded)


def card(told: CardFacts, made: Sequence[ExportedEpisode], notes: str) -> str:
    """Text of README.md for the episodes ``made``; ``notes`` are about their images, see `image_notes`."""
    # A dict, not a set, keeps the order of the episodes: the same export writes the same card.
    licences = "; ".join(dict.fromkeys(each.licence for each in made))
    parts = [
        _head(licences),
        _summary(told, made),
        _use(),
        _sentences(told),
        _actions(told),
        _states(told),
        "\n\n".join(_remarks(told, made)),
        _film_quality(made),
        notes,
        f"Licence of the assets: {licences}",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _head(licences: str) -> str:
    lines = [
        *licence_head(licences),
        "tags: [LeRobot, mjhab]",
        "task_categories: [robotics]",
        "configs:",
        "- config_name: default",
        "  data_files: data/*/*.parquet",
    ]
    return "\n".join(["---", *lines, "---"])


def _summary(told: CardFacts, made: Sequence[ExportedEpisode]) -> str:
    frames = sum(each.steps for each in made)
    env = told.run.config.get("env", {})
    parts = ", ".join(f"{name} {span}" for name, span in told.splits.items())
    return (
        f"{len(made)} episodes, {frames} frames at {FPS} Hz of a simulated robot ({told.run.robot}) in furnished "
        f"homes, recorded by mjhab {told.run.versions.get('mjhab', '')} (profile `{env.get('profile', '')}`, policy "
        f"`{told.run.policy}`), exported by mjhab {__version__}. "
        f"Episodes: {f'`{told.where}`' if told.where else 'all of the source'}; splits: {parts}."
    )


def _use() -> str:
    return (
        "```python\n"
        "from lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
        'data = LeRobotDataset("USER/NAME", root="FOLDER")\n'
        "```"
    )


def _sentences(told: CardFacts) -> str:
    shown = "\n".join(f"- {text}" for text in told.tasks[:_MOST_SENTENCES])
    more = len(told.tasks) - _MOST_SENTENCES
    return (
        f"{len(told.tasks)} different sentences say what to do (`task`), such as\n\n{shown}"
        + (f"\n- {more} more" if more > 0 else "")
        + "\n\n`meta/episodes` has for each episode all wordings of its sentence (`wordings`) and the skills of who "
        "acted, with first frame and the one after the last (`skills`); `skill_index` tells the skill of a frame."
        + (f" `{LANGUAGE}` has both for LeRobot 0.6." if told.choice.language else "")
    )


def _actions(told: CardFacts) -> str:
    rows = [
        f"| {k} | {each['name']} | {each.get('unit', '')} | {each.get('frame', '')} | {_ends(each)} |"
        for k, each in enumerate(told.actions)
    ]
    heads = ["| | entry | unit | frame | at -1 and 1 |", "|---|---|---|---|---|"]
    return "\n".join(
        [
            f"`{ACTION}` is of control mode `{told.control_mode}`, held for one frame:",
            "",
            *heads,
            *rows,
        ]
    )


def _ends(entry: Mapping[str, Any]) -> str:
    # Runs of older versions tell the names of actions alone.
    if "low" not in entry:
        return ""
    if not entry.get("normalized", True):
        # Such entries are not scaled from -1..1, so that the ends say nothing about a unit.
        return "the unit itself"
    return f"{entry['low']:.4g}, {entry['high']:.4g}"


def _states(told: CardFacts) -> str:
    lines = []
    for key in (STATE, ENVIRONMENT_STATE):
        names = told.features.get(key, {}).get("names") or []
        parts: dict[tuple[str, str], list[str]] = {}
        for each in state_columns(names):
            parts.setdefault((each["unit"], each["frame"]), []).append(
                f"`{each['name']}`"
            )
        for (unit, frame), columns in parts.items():
            about = ", ".join(filter(None, (unit, frame))) or "no unit"
            lines.append(f"- `{key}` [{about}]: {', '.join(columns)}")
    return "\n".join(lines)


def _remarks(told: CardFacts, made: Sequence[ExportedEpisode]) -> list[str]:
    teleported = len([each for each in made if each.row["navigation"] == "teleport"])
    until = Until.parse(told.choice.until)
    about = []
    if ENVIRONMENT_STATE in told.features:
        about.append(
            f"`{STATE}` is proprioception (joints, velocity of the base, tcp pose); `{ENVIRONMENT_STATE}` is "
            "privileged state of the simulation (object, goal, grasp)."
        )
    else:
        about.append(
            f"`{STATE}` holds privileged state of the simulation, too: object, goal, grasp."
        )
    if BASE_COLUMN in told.features:
        about.append(f"`{BASE_COLUMN}`: {CONVENTIONS[BASE_COLUMN]}.")
    if POINTS in told.features:
        about.append(f"`{POINTS}`: points of the cameras: {CONVENTIONS['points']}.")
    if teleported:
        about.append(
            f"In {teleported} of {len(made)} episodes the environment teleported the robot to every goal. "
            f"The frames are marked by `{TELEPORTED}`."
        )
    if corrections := sum(each.interventions for each in made):
        corrected = len([each for each in made if each.interventions])
        about.append(
            f"`{INTERVENTION}` marks the {corrections} frames of {corrected} episodes in which somebody corrected the "
            "policy that acted (HG-DAgger); `actor_index` tells who. Learn from these frames of such episodes, not "
            "from those of the policy."
        )
    if not until.is_whole:
        about.append(
            f"Episodes end {until.hold_steps} control steps after their first success ({until.text})."
        )
    return about


def _film_quality(made: Sequence[ExportedEpisode]) -> str:
    # Only the first episode is measured, and 0 stands for a film that nothing could read back.
    measured = {key: value for each in made for key, value in each.psnr.items() if value}
    if not measured:
        return ""
    told = ", ".join(f"`{key}` {value} dB" for key, value in measured.items())
    return (
        f"Films (H.264, 4:2:0) show the images of the first episode with a peak signal-to-noise ratio of {told}; "
        "colours of small images suffer most. `mjhab export lerobot --colours png` stores them without loss."
    )


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
