"""The rows of an episode in a LeRobot data set: a column per feature that is no film."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from mjhab.data.export.conventions import BASE_COLUMN
from mjhab.data.export.lerobot.features import (
    ACTION,
    CAMERA_POSE,
    CAMERA_POSE_PATH,
    ENVIRONMENT_STATE,
    FPS,
    IMAGES,
    INTENDED,
    INTERVENTION,
    LANGUAGE,
    MAPS,
    POINTS,
    SKILL,
    STATE,
    TELEPORTED,
    Choice,
    Features,
    state_parts,
)
from mjhab.data.export.outside import Outside
from mjhab.data.select.clouds import Clouds
from mjhab.data.select.describing import teleported_steps
from mjhab.data.select.interventions import intervention_steps
from mjhab.data.select.own_state import base_velocity
from mjhab.data.store.annotations import Annotations
from mjhab.data.store.reading import RecordedEpisode


@dataclass(frozen=True)
class RowNumbers:
    """Indices in the data set of the names in one episode: its task, the subtasks of its plan, its actors, its skills;
    its own, and that of its first row."""

    episode: int
    first: int
    task: int
    subtasks: Sequence[int]
    actors: Sequence[int]
    skills: Mapping[str, int]


def rows_of(
    episode: RecordedEpisode,
    count: int,
    numbers: RowNumbers,
    features: Features,
    asked: tuple[Choice, Outside],
) -> dict[str, Any]:
    """Columns (count, ...) of an episode by feature; of LANGUAGE a list per row.

    Args:
        episode: the episode.
        count: number of its rows.
        numbers: of its names.
        features: see `describe`.
        asked: what to export, and what other packages tell.
    """
    choice, outside = asked
    own, task = state_parts(episode, choice)
    done = np.zeros(count, bool)
    # An exported episode ends where it was cut, also where the simulation went on.
    done[-1] = True
    # The pointer is one past the plan once the plan is finished.
    active = np.minimum(
        episode.array("subtasks/active")[:count], len(numbers.subtasks) - 1
    )
    actions, intended = outside.actions(episode, choice.actions)
    columns: dict[str, Any] = {
        STATE: np.concatenate(list(own.values()), axis=1)[:count],
        ACTION: actions[:count],
        INTENDED: intended[:count],
        "next.reward": episode.array("reward/total")[:count].astype(np.float32),
        "next.success": episode.array("reward/success")[:count].astype(bool),
        "next.done": done,
        TELEPORTED: teleported_steps(episode)[:count],
        INTERVENTION: intervention_steps(episode)[:count],
        "subtask_index": np.array(numbers.subtasks, np.int64)[active],
        "actor_index": np.array(numbers.actors, np.int64)[episode.array("actor")[:count]],
        SKILL: _skill_column(episode.annotations, count, numbers.skills),
        "timestamp": (np.arange(count) / FPS).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, numbers.episode),
        "index": np.arange(numbers.first, numbers.first + count),
        "task_index": np.full(count, numbers.task),
    }
    if task:
        columns[ENVIRONMENT_STATE] = np.concatenate(list(task.values()), axis=1)[:count]
    columns |= _seen(episode, count, features)
    if BASE_COLUMN in features:
        columns[BASE_COLUMN] = base_velocity(episode)[:count]
    if POINTS in features:
        clouds = Clouds(episode, choice.points, outside.base_height(episode.run))
        columns[POINTS] = np.stack([clouds.at(t) for t in range(count)])
    if LANGUAGE in features:
        # LeRobot reads the persistent column from any frame, so that every row repeats it.
        columns[LANGUAGE] = [language_rows(episode.annotations, count)] * count
    return columns


def _skill_column(told: Annotations, count: int, skills: Mapping[str, int]) -> np.ndarray:
    column = np.full(count, skills[""], np.int64)
    for each in told.skills:
        # Slices clip at the end of a cut episode by themselves.
        column[each.start : each.end] = skills[each.skill]
    return column


def _seen(episode: RecordedEpisode, count: int, features: Features) -> dict[str, Any]:
    """Columns of depth and segmentation, of colour images that are no films, and of poses of the cameras."""
    columns: dict[str, Any] = {}
    for camera, output in episode.images:
        key = f"{IMAGES.get(output)}.{camera}"
        if key not in features:
            continue
        if output in MAPS:
            # The only channel goes: LeRobot's maps are (H, W).
            frames = [episode.frame(camera, output, t)[..., 0] for t in range(count)]
            columns[key] = np.stack(frames).astype(MAPS[output])
        elif features[key]["dtype"] == "image":
            columns[key] = [episode.frame(camera, output, t) for t in range(count)]
    for key in features:
        if key.startswith(f"{CAMERA_POSE}."):
            path = CAMERA_POSE_PATH.format(key.removeprefix(f"{CAMERA_POSE}."))
            columns[key] = episode.array(path)[:count]
    return columns


def language_rows(told: Annotations, count: int) -> list[dict[str, Any]]:
    """Rows of LeRobot's column of persistent language (0.6: lerobot/datasets/language.py): other wordings of the task
    at the start (style "task_aug"), and every skill from the frame on in which it begins (style "subtask")."""

    def row(style: str, content: str, frame: int) -> dict[str, Any]:
        return {
            # LeRobot's chat templates take the task as the user's turn and steps as the assistant's.
            "role": "user" if style == "task_aug" else "assistant",
            "content": content,
            "style": style,
            "timestamp": frame / FPS,
            "camera": None,
            "tool_calls": None,
        }

    # Of a chain each subtask has its own wordings, and none of them asks for the whole.
    wordings = told.wordings[0] if len(told.wordings) == 1 else ()
    return [
        *(row("task_aug", text, 0) for text in wordings),
        *(
            row("subtask", each.phases[-1] if each.phases else each.skill, each.start)
            for each in told.skills
            if each.start < count and each.skill
        ),
    ]


def segments_text(told: Annotations, count: int) -> str:
    """The skills of an episode as JSON: [[skill, phase, first frame, frame after the last], ...]."""
    return json.dumps(
        [
            [
                each.skill,
                each.phases[-1] if each.phases else "",
                each.start,
                min(each.end, count),
            ]
            for each in told.skills
            if each.start < count
        ]
    )


def to_table(columns: Mapping[str, Any]) -> pa.Table:
    """Convert columns to a table: arrays (N,), (N, D) or (N, H, W) to numbers, lists of fixed length, or nested lists;
    lists of images to encoded ones, and those of language to structures."""
    arrays = {
        key: _array(values)
        if isinstance(values, np.ndarray)
        else _language(values)
        if key == LANGUAGE
        else _pictures(values)
        for key, values in columns.items()
    }
    return pa.table(arrays)


def _array(values: np.ndarray) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    if values.ndim == 1:
        return flat
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    count, height, width = values.shape
    rows = pa.ListArray.from_arrays(
        # Offsets of a ListArray are int32 in Arrow.
        pa.array(np.arange(count * height + 1, dtype=np.int32) * width),
        flat,
    )
    return pa.ListArray.from_arrays(
        pa.array(np.arange(count + 1, dtype=np.int32) * height), rows
    )


def _pictures(frames: Sequence[np.ndarray]) -> pa.Array:
    """Images as Hugging Face's `datasets` stores them in tables: encoded, without a path."""
    from mjhab.data.store.images import ImageFormat, encode

    rows = [
        # PNG, because a user who asked for images and not for films wants no loss.
        {"bytes": encode(frame, "rgb", ImageFormat("png")), "path": None}
        for frame in frames
    ]
    return pa.array(rows, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))


def _language(rows: Sequence[Sequence[Mapping[str, Any]]]) -> pa.Array:
    """Lists of structures with the types of LeRobot's lerobot/datasets/language.py; nothing calls a tool."""
    flat = [each for row in rows for each in row]
    kinds = {"timestamp": pa.float32(), "tool_calls": pa.list_(pa.json_())}
    order = ("role", "content", "style", "timestamp", "camera", "tool_calls")
    fields = [
        pa.field(name, kinds.get(name, pa.string()), name not in ("role", "timestamp"))
        for name in order
    ]
    columns = [
        pa.nulls(len(flat), field.type)
        if field.name == "tool_calls"
        else pa.array([each[field.name] for each in flat], field.type)
        for field in fields
    ]
    ends = np.cumsum([0, *(len(row) for row in rows)])
    structures = pa.StructArray.from_arrays(columns, fields=fields)
    return pa.ListArray.from_arrays(pa.array(ends, pa.int32()), structures)
