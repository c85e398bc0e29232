"""Export to a LeRobot data set, v3.0 or v2.1: tables in parquet, videos in mp4, metadata in meta.

A row holds the observation before an action, the action, and its reward and termination: N rows for N actions. The
state after the last action has no row. Depth and segmentation are stored as columns of integers as in the shard, not as
video, because LeRobot cannot store them in a video without loss.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.files.checksums import KEY, README, list_files
from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.export.lerobot.card import CardFacts, card, image_notes
from mjhab.data.export.lerobot.features import (
    FPS,
    IMAGES,
    INTERVENTION,
    LANGUAGE,
    Choice,
    Features,
    describe,
    differing,
    film_features,
)
from mjhab.data.export.lerobot.files import VERSIONS, Files, write_json
from mjhab.data.export.lerobot.parts import EpisodeParts, ExportedEpisode, FilmTools
from mjhab.data.export.lerobot.rows import RowNumbers, rows_of, segments_text, to_table
from mjhab.data.export.lerobot.stats import (
    Stats,
    image_stats,
    map_stats,
    sampled,
    vector_stats,
)
from mjhab.data.export.outside import Outside
from mjhab.data.export.request import ExportRequest
from mjhab.data.export.staging import ExportTarget, whole_folder
from mjhab.data.select.clouds import CHANNELS
from mjhab.data.select.describing import (
    instructions_of,
    navigates_by_teleport,
)
from mjhab.data.select.sets import Selection, nothing_passes, select
from mjhab.data.select.until import Until
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.episode_data import RunInfo, last_label
from mjhab.data.store.places import Place
from mjhab.data.store.reading import RecordedEpisode, open_shard

INFO = "meta/info.json"
"""Description of the data set; every LeRobot data set has it."""
CAMERAS = "meta/cameras.json"
"""Calibration of the cameras, see `ObservedRows.calibration`. LeRobot does not read it."""
SEGMENTS = "meta/segments.json"
"""Names of the segmentation ids: the id is the place in the list. LeRobot does not read it."""
ABOUT = "meta/conventions.json"
"""CONVENTIONS. LeRobot does not read it."""
LIST = "meta/files.json"
"""Size and SHA-256 of every file, for ``mjhab dataset check`` and ``push``. LeRobot does not read it."""


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
    outside: Outside | None = None,
    begin: Callable[[int], Callable[[], object]] | None = None,
) -> Exported:
    """Write the episodes that pass the filter, in order of shard and name, as a LeRobot data set.

    Args:
        request: the episodes and the folder of the data set.
        films: functions that write videos.
        version: of the format, "3.0" or "2.1".
        choice: parts of the episodes to export; None takes all.
        outside: what robots and their controllers tell; None for what needs neither.
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
    # A wrong text fails here, before a folder is made, and not at the first episode.
    Until.parse(choice.until)
    after = begin(len(found.matched)) if begin else None
    # What a resumed export compares: all that changes a byte of the result.
    job = {
        "format": "lerobot",
        "version": version,
        **vars(choice),
        **films.settings,
        "episodes": found.fingerprint,
    }
    order = _by_split(found, choice.held_out)
    target = ExportTarget(request.out, _foreign, request.overwrite, request.resume)
    with whole_folder(target, job) as staging:
        parts = EpisodeParts(staging.work, FPS, films)
        export = _Export(
            staging.root,
            VERSIONS[version](staging.root, FPS),
            parts,
            (choice, outside or Outside()),
        )
        for path, name in order:
            export.add(path, name)
            if after is not None:
                after()
        where = request.where.text if request.where else ""
        return export.finish(len(order) - _held_out(found, choice.held_out), where)


def _by_split(found: Selection, held_out: Sequence[str]) -> list[Place]:
    """The episodes of the split train in their order, then those of val, whose homes are held out."""
    pairs = list(zip(found.matched, found.records, strict=True))
    # LeRobot's splits are ranges of episode numbers, so each split must be one run of episodes.
    parts = [
        [p for p, r in pairs if (r.home in held_out) == val] for val in (False, True)
    ]
    return [*parts[0], *parts[1]]


def _held_out(found: Selection, held_out: Sequence[str]) -> int:
    """Number of episodes of the split val."""
    return len([record for record in found.records if record.home in held_out])


def _foreign(folder: Path) -> str:
    """Why a folder is not a LeRobot data set; "" if it is one."""
    return "" if (folder / INFO).is_file() else f"no {INFO}"


class _Export:
    """State of a running export."""

    def __init__(
        self,
        root: Path,
        files: Files,
        parts: EpisodeParts,
        asked: tuple[Choice, Outside],
    ) -> None:
        self._root = root
        self._files = files
        self._parts = parts
        self._asked = asked
        self._choice, self._outside = asked
        self._until = Until.parse(self._choice.until)
        self._features: Features = {}
        self._run: RunInfo | None = None
        self._cameras: Mapping[str, Any] = {}
        self._segments: Sequence[str] = ()
        self._tasks: dict[str, int] = {}
        self._subtasks: dict[str, int] = {}
        self._actors: dict[str, int] = {}
        # LeRobot's readers want an index in every frame: 0 stands for no skill told.
        self._skills: dict[str, int] = {"": 0}
        self._made: list[ExportedEpisode] = []
        self._frames = 0

    def add(self, path: Path, name: str) -> None:
        """Write one episode, unless it is written already."""
        number = len(self._made)
        made = self._parts.made(number)
        # The first episode is opened even if it is written: only its file tells the features of the set.
        if made is None or not self._features:
            with open_shard(path) as shard:
                episode = shard.episode(name)
                refuse_damage(episode)
                # Every episode opened is compared, since a table of LeRobot has one schema for all its files.
                features = describe(episode, *self._asked)
                self._features = self._features or features
                self._run = self._run or episode.run
                self._cameras = self._cameras or episode.run.layout.get("cameras", {})
                self._name_segments(episode)
                if features != self._features:
                    raise differing(episode, self._features, features)
                # Segments and features are checked first, so that a refused episode leaves no part behind.
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

    def _count(self, made: ExportedEpisode) -> RowNumbers:
        """Indices of the names in an episode; new names get the next free index."""
        for name in made.skills:
            self._skills.setdefault(name, len(self._skills))
        return RowNumbers(
            made.row["episode_index"],
            self._frames,
            self._tasks.setdefault(made.row["tasks"][0], len(self._tasks)),
            [
                self._subtasks.setdefault(text, len(self._subtasks))
                for text in made.subtasks
            ],
            [self._actors.setdefault(name, len(self._actors)) for name in made.actors],
            self._skills,
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
        told = episode.annotations
        row["skills"] = segments_text(told, length)
        row["wordings"] = json.dumps(told.wordings, ensure_ascii=False)
        made = ExportedEpisode(
            row,
            {},
            0,
            {},
            list(words.subtasks),
            list(episode.actors),
            episode.run.licence,
            [each.skill for each in told.skills],
        )
        numbers = self._count(made)
        columns = rows_of(episode, length, numbers, self._features, self._asked)
        table = to_table(columns)
        self._parts.add_table(number, table)
        made.stats.update(
            {
                key: _column_stats(values)
                for key, values in columns.items()
                if key != LANGUAGE
            }
        )
        for key in film_features(self._features):
            samples: list[np.ndarray] = []
            camera = key.rpartition(".")[2]
            frames = _shown(episode, length, camera, samples)
            made.films[key] = self._parts.add_film(number, key, frames)
            made.stats[key] = image_stats(np.stack(samples))
            # Reading a film back costs as much as writing it; one episode tells the quality of the encoder.
            if number == 0:
                wanted = [episode.frame(camera, "rgb", t) for t in range(length)]
                made.psnr.update({key: psnr(wanted, self._parts.shown(number, key))})
        # Counted before the columns are freed: the card sums them without opening a table again.
        corrections = int(columns[INTERVENTION].sum())
        made = replace(made, size=table.nbytes, interventions=corrections)
        # Last, because this file is what a resumed export takes as proof of the films and the table.
        self._parts.finish(number, made)
        return made

    def finish(self, training: int, where: str) -> Exported:
        """Write the metadata of the data set; the first ``training`` episodes are the split train."""
        assert self._run is not None, "an export has an episode"
        # First, because it adds the places of the files to the rows that the next line writes.
        self._files.arrange(self._parts, self._made)
        self._files.describe(
            [made.row for made in self._made], [made.stats for made in self._made]
        )
        self._files.write_names("task", list(self._tasks))
        self._files.write_names("subtask", list(self._subtasks))
        self._files.write_names("actor", list(self._actors))
        self._files.write_names("skill", list(self._skills))
        films = film_features(self._features)
        splits = {"train": f"0:{training}"}
        if training < len(self._made):
            splits["val"] = f"{training}:{len(self._made)}"
        info = {
            "codebase_version": self._files.version,
            "robot_type": self._run.robot,
            "total_episodes": len(self._made),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "fps": FPS,
            "splits": splits,
            **self._files.paths,
            "features": self._features,
        }
        # LeRobot writes null here for a set without films.
        if not films:
            info["video_path"] = None
        write_json(self._root / INFO, info)
        notes = self._image_notes()
        write_json(self._root / ABOUT, CONVENTIONS)
        told = CardFacts(
            self._run,
            self._features,
            self._outside.columns(self._run, self._choice.actions),
            self._choice,
            where,
            splits,
            list(self._tasks),
        )
        text = card(told, self._made, notes)
        (self._root / README).write_text(text, encoding="utf-8")
        # Last, when every other file is there; it cannot hold its own hash.
        files = list_files(self._root, frozenset({LIST}))
        write_json(self._root / LIST, {KEY: files})
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
        # A sample of the frames is enough for means per channel, and all of them would not fit in memory.
        if t in chosen:
            samples.append(frame)
        yield frame


def _column_stats(values: Any) -> Stats:
    if not isinstance(values, np.ndarray):
        chosen = sampled(len(values))
        return image_stats(np.stack([values[t] for t in sorted(chosen)]))
    # Numbers and vectors have statistics per column; maps and clouds have too many of them.
    if values.ndim < 3:
        return vector_stats(values)
    if values.shape[2] == len(CHANNELS):
        stats = vector_stats(values.reshape(-1, len(CHANNELS)))
        # LeRobot counts frames, and the statistics were made over points.
        return {**stats, "count": np.array([len(values)])}
    return map_stats(values)


def psnr(wanted: Sequence[np.ndarray], shown: Iterable[np.ndarray]) -> float:
    """How well a film shows images (H, W, 3) uint8, as a peak signal-to-noise ratio [dB]; 0 if none is shown."""
    height, width = wanted[0].shape[:2]
    errors = [
        np.square(image.astype(np.float64) - frame[:height, :width]).mean()
        # Films of odd size have a row or a column more, and nothing is shown where nothing reads films.
        for image, frame in zip(wanted, shown, strict=False)
    ]
    if not errors:
        return 0.0
    # The floor keeps a film without any loss finite.
    return round(float(10 * np.log10(255**2 / max(np.mean(errors), 1e-9))), 1)
