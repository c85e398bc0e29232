"""Export to the format of MS-HAB's data set, for its behaviour cloning and diffusion policy scripts.

The files are ``<out>/<task>/<subtask>/<target>.h5`` with a ``.json`` each, as mshab/envs/wrappers/record.py writes
them. MS-HAB's scripts concatenate the members of ``obs/agent`` and then ``obs/extra`` in the order of the HDF5 groups,
so these keep the order of mjhab's ``obs/state``. They train on ``actions``, the executed actions. ``actions_intended``,
``actor`` (an index into "actors" of the ``.json``), ``intervention``, ``base_velocity`` and, on demand,
``obs/pointcloud`` are additional datasets, ``env_states`` and ``info`` those of `maniskill_states`. The pose of the
object is in the axes of its scan ("object_axes" of the ``.json``: "scan"), except for runs of older versions, which
lack them ("object").
The ``.json`` lists successful episodes first; "episode_id" is the number of the trajectory.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.core.conventions.changes import to_scan_axes
from mjhab.core.conventions.hand_turns import (
    AS_MANISKILL,
    TURN_COLUMNS,
    turns_for_maniskill,
)
from mjhab.core.conventions.names import OBJECT_AXES
from mjhab.core.errors import UsageError
from mjhab.core.files.reading import read_json_object
from mjhab.core.names import below
from mjhab.data.export.conventions import BASE_COLUMN
from mjhab.data.export.maniskill_json import control_mode, episode_info, file_info
from mjhab.data.export.maniskill_states import Roots, env_states, infos, no_roots
from mjhab.data.export.outside import Outside
from mjhab.data.export.request import ExportRequest
from mjhab.data.export.staging import ExportTarget, whole_folder
from mjhab.data.imports.ms_hab_layout import (
    SOURCE_TYPE,
    TRAJECTORY,
    TRUTHS,
)
from mjhab.data.select.clouds import Clouds
from mjhab.data.select.describing import teleported_steps
from mjhab.data.select.facts import target_of
from mjhab.data.select.interventions import intervention_steps
from mjhab.data.select.own_state import base_velocity, tells_base_velocity
from mjhab.data.select.sets import check_outside, nothing_passes, select
from mjhab.data.select.until import Until
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.hdf5 import drop_unfinished, new_file
from mjhab.data.store.hdf5 import group as subgroup
from mjhab.data.store.older.schemas import OBJECT_POSE
from mjhab.data.store.places import Place
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

CHAIN = "sequential_task"
"""Name of the folder of whole chains."""
_OF_MANISKILL = {own: name for name, own in AS_MANISKILL.items()}
_GZIP = 5
"""Compression level of images, as in MS-HAB."""
POINTS = "pointcloud"
"""Points (T+1, P, 6) of the observations, see `clouds.CHANNELS`; MS-HAB's scripts do not read them."""


@dataclass(frozen=True)
class ManiSkillSet:
    """Result of an export. without_depth: number of episodes without depth images; MS-HAB's scripts cannot use them."""

    episodes: int
    frames: int
    files: tuple[Path, ...]
    without_depth: int


def write_maniskill(
    request: ExportRequest,
    *,
    until: Until | None = None,
    begin: Callable[[int], Callable[[], object]] | None = None,
    roots: Roots = no_roots,
    points: int = 0,
    outside: Outside | None = None,
) -> ManiSkillSet:
    """Write the episodes that pass the filter as trajectory files, atomically in one folder.

    Args:
        request: the episodes and the folder, which corresponds to MS-HAB's rearrange-dataset. MS-HAB keeps one label
            per subtask, see `query.PRESETS`.
        until: end of the exported part of each episode; None exports whole episodes.
        begin: called with the number of episodes; returns a function that is called after each episode.
        roots: where robot and furniture stand.
        points: number of points of a cloud, 0 for none.
        outside: what other packages tell.

    Raises:
        UsageError, StorageError: no episode passes; the folder lies in a source; an episode lacks images of which
            points are made; see ``whole_folder``.
        DamagedError: an episode is damaged, or holds numbers that are not finite.
    """
    # An output inside the source would be read as a source by the next export.
    check_outside(request.places, request.out)
    found = select(request.places, request.where)
    if not found.matched:
        raise nothing_passes()
    after = begin(len(found.matched)) if begin else None
    files: dict[Path, list[Place]] = defaultdict(list)
    for member, record in zip(found.matched, found.records, strict=True):
        files[place_of(record)].append(member)
    target = ExportTarget(request.out, _foreign, request.overwrite, request.resume)
    until = until or Until()
    job = {
        "format": "maniskill",
        "episodes": found.fingerprint,
        "until": until.text,
        "points": points,
    }
    asked = _Asked(until, roots, points, outside or Outside())
    frames = without = 0
    with whole_folder(target, job) as staging:
        for place, members in files.items():
            file = _File(below(staging.root, place), asked)
            file.write(members, after)
            frames += file.frames
            without += file.without_depth
    return ManiSkillSet(
        len(found.matched), frames, tuple(request.out / place for place in files), without
    )


def place_of(record: EpisodeRecord) -> Path:
    """File of an episode: task/subtask/target.h5; for a link the target is its piece of furniture.

    MS-HAB has one file for all drives.
    """
    if not record.subtask:
        return Path(record.task, CHAIN, "all.h5")
    if SUBTASKS[record.subtask].about == "way":
        return Path(record.task, record.subtask, "all.h5")
    target = target_of(record)
    return Path(record.task, record.subtask, f"{target.rpartition('/')[0] or target}.h5")


def _foreign(folder: Path) -> str:
    """Why a folder is not an export of `write_maniskill`; "" if it is one.

    Shards and MS-HAB's own data may lie in the same folders under the same names.
    """
    files = sorted(folder.rglob("*.h5"))
    others = (path for path in files if not _is_exported(path))
    other = next(others, None)
    if other is not None:
        return f"{other.relative_to(folder)} is not of one"
    return "" if files else "no trajectory files"


def _is_exported(path: Path) -> bool:
    """Whether the JSON file beside an HDF5 file describes it as a trajectory file of mjhab."""
    try:
        metadata = read_json_object(path.with_suffix(".json"))
    except UsageError:
        return False
    return metadata.get("source_type") == SOURCE_TYPE


@dataclass(frozen=True)
class _Asked:
    """What to write of every episode; see `write_maniskill`."""

    until: Until
    roots: Roots
    points: int
    outside: Outside


class _File:
    """A trajectory file; one that an interrupted export has finished stays as it is."""

    def __init__(self, path: Path, asked: _Asked) -> None:
        self._path = path
        self._asked = asked
        self._episodes: list[dict[str, Any]] = []
        self._runs: dict[str, Any] = {}
        self.frames = self.without_depth = 0

    def write(self, members: Sequence[Place], after: Callable[[], object] | None) -> None:
        """Write the episodes as trajectories 0, 1, ..., and the JSON file; ``after`` is called after each."""
        # Files appear under their name once they are whole, so that this one needs only its JSON again.
        if self._path.exists():
            self._add_all(members, None, after)
        else:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # A killed export left its file under a temporary name beside it.
            drop_unfinished(self._path.parent, self._path.stem)
            with new_file(self._path, {}) as file:
                self._add_all(members, file, after)
        self._describe()

    def _add_all(
        self,
        members: Sequence[Place],
        file: h5py.File | None,
        after: Callable[[], object] | None,
    ) -> None:
        for number, (path, name) in enumerate(members):
            with open_shard(path) as shard:
                episode = shard.episode(name)
                refuse_damage(episode)
                steps = self._asked.until.steps(episode.array("reward/success"))
                if file is not None:
                    # MS-HAB's scripts concatenate the state in the order of the file, and h5py sorts by name
                    # without it.
                    group = file.create_group(f"{TRAJECTORY}{number}", track_order=True)
                    _put(group, episode, steps)
                    self._put_clouds(group, episode, steps + 1)
                    places = self._asked.roots(episode.run, episode.record.home)
                    states = env_states(episode, steps + 1, places)
                    _put_tree(group, "env_states", states.items())
                    told = infos(episode, steps + 1, places)
                    _put_tree(group, "info", told.items())
                self._episodes.append(episode_info(number, episode, steps))
                # Episodes of one run repeat its description, which the file holds once.
                self._runs.setdefault(episode.run.id, vars(episode.run))
                self.frames += steps
                self.without_depth += not any(
                    output == "depth" for _, output in episode.images
                )
            if after is not None:
                after()

    def _put_clouds(self, group: h5py.Group, episode: RecordedEpisode, rows: int) -> None:
        if not self._asked.points:
            return
        height = self._asked.outside.base_height(episode.run)
        clouds = Clouds(episode, self._asked.points, height)
        subgroup(group, "obs")[POINTS] = np.stack([clouds.at(t) for t in range(rows)])

    def _describe(self) -> None:
        """Write the JSON file with the metadata of the trajectories."""
        value = file_info(self._runs, self._episodes)
        self._path.with_suffix(".json").write_text(
            json.dumps(value, indent=2), encoding="utf-8"
        )


def _put(group: h5py.Group, episode: RecordedEpisode, steps: int) -> None:
    """Fill the group of a trajectory with the first ``steps`` control steps of an episode."""
    _put_tree(group, "obs", _observations(episode, steps + 1))
    ends = np.zeros(steps, bool)
    ends[-1] = True
    # An episode that is cut before its end was stopped by the export, not by the environment.
    terminated = episode.terminated and steps == episode.steps
    for name in ("actions", "actions_intended"):
        group[name] = _turned_hand(episode, episode.array(name)[:steps]).astype(
            np.float32
        )
    group["actor"] = episode.array("actor")[:steps]
    group["terminated"] = ends & terminated
    group["truncated"] = ends & (not terminated)
    group["success"] = episode.array("reward/success")[:steps].astype(bool)
    group["fail"] = episode.array("reward/fail")[:steps].astype(bool)
    group["rewards"] = episode.array("reward/total")[:steps].astype(np.float32)
    group["intervention"] = intervention_steps(episode)[:steps]
    group["is_teleported"] = teleported_steps(episode)[:steps]
    if tells_base_velocity(episode):
        group[BASE_COLUMN] = base_velocity(episode)[: steps + 1]


def _put_tree(
    group: h5py.Group, name: str, values: Iterable[tuple[str, np.ndarray]]
) -> None:
    """Write arrays by their paths into a group of that name, in order; images are compressed."""
    # The group is made with the first array, so that an episode without such values leaves no empty group.
    top = None
    for key, array in values:
        *folders, last = key.split("/")
        top = parent = top or group.create_group(name, track_order=True)
        for folder in folders:
            if folder not in parent:
                parent.create_group(folder, track_order=True)
            parent = subgroup(parent, folder)
        squeeze = (
            # As ManiSkill's recorder does, which compresses images alone.
            {"compression": "gzip", "compression_opts": _GZIP}
            if folders[:1] == ["sensor_data"]
            else {}
        )
        parent.create_dataset(last, data=array, **squeeze)


def _turned_hand(episode: RecordedEpisode, actions: np.ndarray) -> np.ndarray:
    """Actions (T, A) with which ManiSkill's controller of the same name turns the hand as ours has."""
    if control_mode(episode) not in AS_MANISKILL:
        return actions
    # Turns are composed as quaternions, which lose a digit in float32.
    turned = actions.astype(np.float64)
    turned[:, TURN_COLUMNS] = turns_for_maniskill(turned[:, TURN_COLUMNS])
    return turned


def _observations(
    episode: RecordedEpisode, rows: int
) -> Iterator[tuple[str, np.ndarray]]:
    """Pairs of observation key and array (rows, ...): the parts of the state in order, then camera images."""
    yaws = _yaws_to_turn(episode)
    for key, whole in episode.table("obs/state").items():
        values = whole[:rows]
        if key == OBJECT_POSE and yaws is not None:
            values = to_scan_axes(values, yaws[:rows])
        yield (
            key,
            # MS-HAB stores truths without an axis of columns.
            values.astype(bool).reshape(-1)
            if key.rpartition("/")[2] in TRUTHS
            else values,
        )
    for path in episode.paths:
        if path.startswith("obs/sensor_param/"):
            yield path.removeprefix("obs/"), episode.array(path)[:rows]
    for camera, output in sorted(
        # MS-HAB's networks stack the cameras in the order of the file: head first.
        episode.images,
        key=lambda image: (not image[0].endswith("_head"), image),
    ):
        frames = [episode.frame(camera, output, t) for t in range(rows)]
        yield f"sensor_data/{camera}/{output}", np.stack(frames)


def _yaws_to_turn(episode: RecordedEpisode) -> np.ndarray | None:
    """(N+1,) headings [rad] by which the pose of the object is still to be turned; None if it is not."""
    has_ours = episode.conventions.object_axes == OBJECT_AXES
    return episode.scan_yaws if has_ours else None
