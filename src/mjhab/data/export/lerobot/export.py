"""Export to a LeRobot data set, v3.0 or v2.1: tables in parquet, videos in mp4, metadata in meta.

A row holds the observation before an action, the action, and its reward and termination: N rows for N actions. The
state after the last action has no row. Depth and segmentation are stored as columns of integers as in the shard, not as
video, because LeRobot up to 0.4 cannot store them in a video without loss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from mjhab.core.errors import UsageError, unknown_name
from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.export.lerobot.card import card, image_notes
from mjhab.data.export.lerobot.features import (
    ACTION,
    CAMERA_POSE,
    CAMERA_POSE_PATH,
    ENVIRONMENT_STATE,
    FPS,
    IMAGES,
    INTENDED,
    MAPS,
    STATE,
    TELEPORTED,
    Choice,
    Features,
    describe,
    differing,
    film_features,
)
from mjhab.data.export.lerobot.files import VERSIONS, Files, write_json
from mjhab.data.export.lerobot.parts import EpisodeParts, ExportedEpisode, FilmTools
from mjhab.data.export.lerobot.stats import (
    Stats,
    image_stats,
    map_stats,
    sampled,
    vector_stats,
)
from mjhab.data.export.request import ExportRequest
from mjhab.data.export.staging import ExportTarget, whole_folder
from mjhab.data.select.describing import (
    instructions_of,
    navigates_by_teleport,
    teleported_steps,
)
from mjhab.data.select.own_state import split_state
from mjhab.data.select.sets import nothing_passes, select
from mjhab.data.select.until import Until
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.episode_data import last_label
from mjhab.data.store.older.schemas import OLDER_ROBOT
from mjhab.data.store.reading import RecordedEpisode, open_shard

INFO = "meta/info.json"
"""Description of the data set; every LeRobot data set has it."""
CAMERAS = "meta/cameras.json"
"""Calibration of the cameras, see `ObservedRows.calibration`. LeRobot does not read it."""
SEGMENTS = "meta/segments.json"
"""Names of the segmentation ids: the id is the place in the list. LeRobot does not read it."""
ABOUT = "meta/conventions.json"
"""CONVENTIONS. LeRobot does not read it."""


@dataclass(frozen=True)
class Exported:
    """Result of an export. images: names of the videos and depth columns."""

    episodes: int
    frames: int
    images: tuple[str, ...]


def write_lerobot(
    request: ExportRequest,
    films: FilmTools,
    *,
    version: str = "3.0",
    choice: Choice | None = None,
    begin: Callable[[int], Callable[[], object]] | None = None,
) -> Exported:
    """Write the episodes that pass the filter, in order of shard and name, as a LeRobot data set.

    Args:
        request: the episodes and the folder of the data set.
        films: functions that write videos.
        version: of the format, "3.0" or "2.1".
        choice: parts of the episodes to export; None takes all.
        begin: called with the number of episodes; returns a function that is called after each episode.

    Raises:
        UsageError, StorageError: no episode passes the filter, or episodes differ in their features; see
            ``whole_folder``.
        DamagedError: an episode is damaged, or holds numbers that are not finite.
    """
    if version not in VERSIONS:
        raise unknown_name("LeRobot version", version, VERSIONS)
    found = select(request.places, request.where)
    if not found.matched:
        raise nothing_passes()
    choice = choice or Choice()
    Until.parse(choice.until)
    after = begin(len(found.matched)) if begin else None
    job = {
        "format": "lerobot",
        "version": version,
        **vars(choice),
        **films.settings,
        "episodes": found.fingerprint,
    }
    target = ExportTarget(request.out, _foreign, request.overwrite, request.resume)
    with whole_folder(target, job) as staging:
        parts = EpisodeParts(staging.work, FPS, films)
        export = _Export(
            staging.root, VERSIONS[version](staging.root, FPS), parts, choice
        )
        for path, name in found.matched:
            export.add(path, name)
            if after is not None:
                after()
        return export.finish()


def _foreign(folder: Path) -> str:
    """Why a folder is not a LeRobot data set; "" if it is one."""
    return "" if (folder / INFO).is_file() else f"no {INFO}"


@dataclass(frozen=True)
class _Numbers:
    """Indices in the data set of the names in one episode: its task, the subtasks of its plan, its actors."""

    task: int
    subtasks: list[int]
    actors: list[int]


class _Export:
    """State of a running export."""

    def __init__(
        self, root: Path, files: Files, parts: EpisodeParts, choice: Choice
    ) -> None:
        self._root = root
        self._files = files
        self._parts = parts
        self._choice = choice
        self._until = Until.parse(choice.until)
        self._features: Features = {}
        self._robot = OLDER_ROBOT
        self._cameras: Mapping[str, Any] = {}
        self._segments: Sequence[str] = ()
        self._tasks: dict[str, int] = {}
        self._subtasks: dict[str, int] = {}
        self._actors: dict[str, int] = {}
        self._made: list[ExportedEpisode] = []
        self._frames = 0

    def add(self, path: Path, name: str) -> None:
        """Write one episode, unless it is written already."""
        number = len(self._made)
        made = self._parts.made(number)
        if made is None or not self._features:
            with open_shard(path) as shard:
                episode = shard.episode(name)
                refuse_damage(episode)
                features = describe(episode, self._choice)
                self._features = self._features or features
                self._robot = episode.run.robot
                self._cameras = self._cameras or episode.run.layout.get("cameras", {})
                self._name_segments(episode)
                if features != self._features:
                    raise differing(episode, self._features, features)
                made = made or self._make(number, episode)
        self._count(made)
        self._made.append(made)
        self._frames += made.steps

    def _name_segments(self, episode: RecordedEpisode) -> None:
        """Take the names of segmentation ids from the first episode; refuse an episode with other ones."""
        if not any(key.startswith(IMAGES["seg"]) for key in self._features):
            return
        names = list(episode.run.layout.get("segments", ()))
        self._segments = self._segments or names
        if names != self._segments:
            raise UsageError(
                f"segmentation ids of episode {episode.name} of {episode.shard.path} mean other things than in those "
                "before it: it was recorded with other assets. Choose with --where, or leave them out with --no-seg."
            )

    def _count(self, made: ExportedEpisode) -> _Numbers:
        """Indices of the names in an episode; new names get the next free index."""
        return _Numbers(
            self._tasks.setdefault(made.row["tasks"][0], len(self._tasks)),
            [
                self._subtasks.setdefault(text, len(self._subtasks))
                for text in made.subtasks
            ],
            [self._actors.setdefault(name, len(self._actors)) for name in made.actors],
        )

    def _make(self, number: int, episode: RecordedEpisode) -> ExportedEpisode:
        record = episode.record
        words = instructions_of(episode)
        length = self._until.steps(episode.array("reward/success"))
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [words.task],
            "length": length,
        }
        row |= {"source": episode.name, "home": record.home, "label": last_label(record)}
        row["lacks"] = ",".join(episode.lacks)
        conventions = episode.conventions
        row["object_axes"] = conventions.object_axes
        row["joint_angles"] = conventions.joint_angles
        row["navigation"] = "teleport" if navigates_by_teleport(episode) else "drive"
        made = ExportedEpisode(
            row,
            {},
            0,
            {},
            list(words.subtasks),
            list(episode.actors),
            episode.run.licence,
        )
        columns = self._columns(episode, number, self._count(made))
        table = to_table(columns)
        self._parts.add_table(number, table)
        made.stats.update(
            {
                key: _column_stats(values, self._features[key])
                for key, values in columns.items()
            }
        )
        for key in film_features(self._features):
            samples: list[np.ndarray] = []
            camera = key.rpartition(".")[2]
            self._parts.add_film(number, key, _shown(episode, length, camera, samples))
            made.films[key] = int(episode.array(f"images/{camera}/rgb/ends")[length - 1])
            made.stats[key] = image_stats(np.stack(samples))
        made = replace(made, size=table.nbytes)
        self._parts.finish(number, made)
        return made

    def _columns(
        self, episode: RecordedEpisode, number: int, numbers: _Numbers
    ) -> dict[str, np.ndarray]:
        count = self._until.steps(episode.array("reward/success"))
        state = split_state(episode)
        done = np.zeros(count, bool)
        done[-1] = True
        active = np.minimum(
            episode.array("subtasks/active")[:count], len(numbers.subtasks) - 1
        )
        columns = {
            STATE: np.concatenate(list(state.own.values()), axis=1)[:count],
            ACTION: episode.array("actions")[:count],
            INTENDED: episode.array("actions_intended")[:count],
            "next.reward": episode.array("reward/total")[:count].astype(np.float32),
            "next.success": episode.array("reward/success")[:count].astype(bool),
            "next.done": done,
            TELEPORTED: teleported_steps(episode)[:count],
            "subtask_index": np.array(numbers.subtasks, np.int64)[active],
            "actor_index": np.array(numbers.actors, np.int64)[
                episode.array("actor")[:count]
            ],
            "timestamp": (np.arange(count) / FPS).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(self._frames, self._frames + count),
            "task_index": np.full(count, numbers.task),
        }
        if state.task:
            columns[ENVIRONMENT_STATE] = np.concatenate(
                list(state.task.values()), axis=1
            )[:count]
        for camera, output in episode.images:
            if output not in MAPS:
                continue
            key = f"{IMAGES[output]}.{camera}"
            if key in self._features:
                frames = [episode.frame(camera, output, t)[..., 0] for t in range(count)]
                columns[key] = np.stack(frames).astype(MAPS[output])
        for key in self._features:
            if key.startswith(f"{CAMERA_POSE}."):
                path = CAMERA_POSE_PATH.format(key.removeprefix(f"{CAMERA_POSE}."))
                columns[key] = episode.array(path)[:count]
        return columns

    def finish(self) -> Exported:
        """Write the metadata of the data set."""
        self._files.arrange(self._parts, self._made)
        self._files.describe(
            [made.row for made in self._made], [made.stats for made in self._made]
        )
        self._files.write_names("task", list(self._tasks))
        self._files.write_names("subtask", list(self._subtasks))
        self._files.write_names("actor", list(self._actors))
        films = film_features(self._features)
        info = {
            "codebase_version": self._files.version,
            "robot_type": self._robot,
            "total_episodes": len(self._made),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "fps": FPS,
            "splits": {"train": f"0:{len(self._made)}"},
            **self._files.paths,
            "features": self._features,
        }
        if not films:
            info["video_path"] = None
        write_json(self._root / INFO, info)
        notes = self._image_notes()
        write_json(self._root / ABOUT, CONVENTIONS)
        (self._root / "README.md").write_text(
            card(self._robot, self._made, self._until, notes), encoding="utf-8"
        )
        images = [key for key in self._features if key.startswith(tuple(IMAGES.values()))]
        return Exported(len(self._made), self._frames, tuple(images))

    def _image_notes(self) -> str:
        """Write the files about cameras as far as the episodes have them; returns what the card says of the images."""
        files = []
        if self._cameras:
            write_json(self._root / CAMERAS, dict(self._cameras))
            files.append(f"Calibration of the cameras: `{CAMERAS}`.")
        if self._segments:
            write_json(self._root / SEGMENTS, list(self._segments))
            files.append(f"Names of segmentation ids: `{SEGMENTS}`.")
        return image_notes(self._features, files)


def _shown(
    episode: RecordedEpisode, length: int, camera: str, samples: list[np.ndarray]
) -> Iterator[np.ndarray]:
    """The first ``length`` frames of a camera; a sample of them is appended to ``samples`` for the statistics."""
    chosen = sampled(length)
    for t in range(length):
        frame = episode.frame(camera, "rgb", t)
        if t in chosen:
            samples.append(frame)
        yield frame


def _column_stats(values: np.ndarray, feature: dict[str, Any]) -> Stats:
    return map_stats(values) if len(feature["shape"]) > 1 else vector_stats(values)


def to_table(columns: dict[str, np.ndarray]) -> pa.Table:
    """Convert columns (N,), (N, D) or (N, H, W) to a table of numbers, lists of fixed length, or nested lists."""
    return pa.table({key: _array(values) for key, values in columns.items()})


def _array(values: np.ndarray) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    if values.ndim == 1:
        return flat
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    count, height, width = values.shape
    rows = pa.ListArray.from_arrays(
        pa.array(np.arange(count * height + 1, dtype=np.int32) * width), flat
    )
    return pa.ListArray.from_arrays(
        pa.array(np.arange(count + 1, dtype=np.int32) * height), rows
    )
