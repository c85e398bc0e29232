"""Export to the format of MS-HAB's data set, for its behaviour cloning and diffusion policy scripts.

The files are ``<out>/<task>/<subtask>/<target>.h5`` with a ``.json`` each, as mshab/envs/wrappers/record.py writes
them. MS-HAB's scripts concatenate the members of ``obs/agent`` and then ``obs/extra`` in the order of the HDF5 groups,
so these keep the order of mjhab's ``obs/state``. They train on ``actions``, the executed actions. ``actions_intended``
and ``actor`` (an index into "actors" of the ``.json``) are additional datasets. The pose of the object is in the axes
of its scan ("object_axes" of the ``.json``: "scan"), except for runs of older versions, which lack them ("object").
The ``.json`` lists successful episodes first; "episode_id" is the number of the trajectory.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
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
from mjhab.core.conventions.names import OBJECT_AXES, SCAN_AXES
from mjhab.core.errors import UsageError
from mjhab.core.files.reading import read_json_object
from mjhab.core.names import below
from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.export.request import ExportRequest
from mjhab.data.export.staging import ExportTarget, whole_folder
from mjhab.data.imports.ms_hab_layout import (
    SOURCE_TYPE,
    TRAJECTORY,
    TRUTHS,
    to_events,
    to_verbose,
)
from mjhab.data.select.describing import navigates_by_teleport, teleported_steps
from mjhab.data.select.facts import target_of
from mjhab.data.select.sets import check_outside, nothing_passes, select
from mjhab.data.select.until import Until
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.episode_data import last_label
from mjhab.data.store.hdf5 import drop_unfinished, new_file
from mjhab.data.store.hdf5 import group as subgroup
from mjhab.data.store.older.schemas import OBJECT_POSE
from mjhab.data.store.places import Place
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.rollout.records import EpisodeRecord

CHAIN = "sequential_task"
"""Name of the folder of whole chains."""
_OF_MANISKILL = {own: name for name, own in AS_MANISKILL.items()}
_GZIP = 5
"""Compression level of images, as in MS-HAB."""


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
) -> ManiSkillSet:
    """Write the episodes that pass the filter as trajectory files, atomically in one folder.

    Args:
        request: the episodes and the folder, which corresponds to MS-HAB's rearrange-dataset. MS-HAB keeps one label
            per subtask, see `query.PRESETS`.
        until: end of the exported part of each episode; None exports whole episodes.
        begin: called with the number of episodes; returns a function that is called after each episode.

    Raises:
        UsageError, StorageError: no episode passes; the folder lies in a source; see ``whole_folder``.
        DamagedError: an episode is damaged, or holds numbers that are not finite.
    """
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
    job = {"format": "maniskill", "episodes": found.fingerprint, "until": until.text}
    frames = without = 0
    with whole_folder(target, job) as staging:
        for place, members in files.items():
            file = _File(below(staging.root, place), until)
            file.write(members, after)
            frames += file.frames
            without += file.without_depth
    return ManiSkillSet(
        len(found.matched), frames, tuple(request.out / place for place in files), without
    )


def place_of(record: EpisodeRecord) -> Path:
    """File of an episode: task/subtask/target.h5; for a link the target is its piece of furniture."""
    if not record.subtask:
        return Path(record.task, CHAIN, "all.h5")
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


class _File:
    """A trajectory file; one that an interrupted export has finished stays as it is."""

    def __init__(self, path: Path, until: Until) -> None:
        self._path = path
        self._until = until
        self._episodes: list[dict[str, Any]] = []
        self._runs: dict[str, Any] = {}
        self.frames = self.without_depth = 0

    def write(self, members: Sequence[Place], after: Callable[[], object] | None) -> None:
        """Write the episodes as trajectories 0, 1, ..., and the JSON file; ``after`` is called after each."""
        if self._path.exists():
            self._add_all(members, None, after)
        else:
            self._path.parent.mkdir(parents=True, exist_ok=True)
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
                steps = self._until.steps(episode.array("reward/success"))
                if file is not None:
                    group = file.create_group(f"{TRAJECTORY}{number}", track_order=True)
                    _put(group, episode, steps)
                self._episodes.append(_episode_info(number, episode, steps))
                self._runs.setdefault(episode.run.id, vars(episode.run))
                self.frames += steps
                self.without_depth += not any(
                    output == "depth" for _, output in episode.images
                )
            if after is not None:
                after()

    def _describe(self) -> None:
        """Write the JSON file with the metadata of the trajectories."""
        env = next(iter(self._runs.values()))["config"].get("env", {})
        subtask = env.get("subtask")
        value = {
            "env_info": {
                "env_id": f"{subtask.capitalize()}SubtaskTrain-v0"
                if subtask
                else "SequentialTask-v0",
                "env_kwargs": env,
                "max_episode_steps": max(
                    each["elapsed_steps"] for each in self._episodes
                ),
            },
            "commit_info": {"mjhab": [run["commit"] for run in self._runs.values()]},
            "source_type": SOURCE_TYPE,
            "source_desc": "recorded by mjhab (MuJoCo), not by ManiSkill",
            "conventions": CONVENTIONS,
            "runs": self._runs,
            # ManiSkillTrajectoryDataset(success_only=True) cannot begin with an episode that it leaves out.
            "episodes": sorted(self._episodes, key=lambda each: not each["success"]),
        }
        self._path.with_suffix(".json").write_text(
            json.dumps(value, indent=2), encoding="utf-8"
        )


def _put(group: h5py.Group, episode: RecordedEpisode, steps: int) -> None:
    """Fill the group of a trajectory with the first ``steps`` control steps of an episode."""
    obs = group.create_group("obs", track_order=True)
    for key, values in _observations(episode, steps + 1):
        *folders, last = key.split("/")
        parent = obs
        for folder in folders:
            if folder not in parent:
                parent.create_group(folder, track_order=True)
            parent = subgroup(parent, folder)
        squeeze = (
            {"compression": "gzip", "compression_opts": _GZIP}
            if folders[:1] == ["sensor_data"]
            else {}
        )
        parent.create_dataset(last, data=values, **squeeze)
    ends = np.zeros(steps, bool)
    ends[-1] = True
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
    group["is_teleported"] = teleported_steps(episode)[:steps]


def _control_mode(episode: RecordedEpisode) -> str:
    """Control mode of the run of an episode."""
    env = episode.run.config.get("env", {})
    return env.get("control_mode", "pd_joint_delta_pos")


def _turned_hand(episode: RecordedEpisode, actions: np.ndarray) -> np.ndarray:
    """Actions (T, A) with which ManiSkill's controller of the same name turns the hand as ours has."""
    if _control_mode(episode) not in AS_MANISKILL:
        return actions
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
            values.astype(bool).reshape(-1)
            if key.rpartition("/")[2] in TRUTHS
            else values,
        )
    for path in episode.paths:
        if path.startswith("obs/sensor_param/"):
            yield path.removeprefix("obs/"), episode.array(path)[:rows]
    for camera, output in sorted(
        episode.images, key=lambda image: (not image[0].endswith("_head"), image)
    ):
        frames = [episode.frame(camera, output, t) for t in range(rows)]
        yield f"sensor_data/{camera}/{output}", np.stack(frames)


def _yaws_to_turn(episode: RecordedEpisode) -> np.ndarray | None:
    """(N+1,) headings [rad] by which the pose of the object is still to be turned; None if it is not."""
    has_ours = episode.conventions.object_axes == OBJECT_AXES
    return episode.scan_yaws if has_ours else None


def _axes_of(episode: RecordedEpisode) -> str:
    """Axes of the pose of the object in an exported episode."""
    is_ours = episode.conventions.object_axes == OBJECT_AXES
    return OBJECT_AXES if is_ours and episode.scan_yaws is None else SCAN_AXES


def _episode_info(number: int, episode: RecordedEpisode, steps: int) -> dict[str, Any]:
    """Metadata of the first ``steps`` control steps of an episode; labels are those of all of it."""
    record = episode.record
    events = [event for event in record.events if event[0] <= steps]
    link = target_of(record).rpartition("/")[0]
    info = {
        "episode_id": number,
        "episode_seed": [record.seed],
        # Indices into MS-HAB's asset files have no counterpart; home and index identify the episode.
        **dict.fromkeys(
            (
                "build_config_idx",
                "task_plan_idx",
                "init_config_idx",
                "spawn_selection_idx",
            )
        ),
        "home": record.home,
        "episode_index": record.index,
        "control_mode": _OF_MANISKILL.get(_control_mode(episode), _control_mode(episode)),
        "elapsed_steps": steps,
        "navigation": "teleport" if navigates_by_teleport(episode) else "drive",
        "actors": list(episode.actors),
        "lacks": list(episode.lacks),
        "object_axes": _axes_of(episode),
        "joint_angles": episode.conventions.joint_angles,
        "label": last_label(record),
        "legacy_label": record.subtasks[-1].legacy_label if record.subtasks else None,
        "target": record.subtasks[-1].target
        if record.subtasks
        else record.plan[0].target,
        "split": record.split,
        "ending": str(episode.attributes["ending"]),
        "events": to_events(record.subtask, events)
        if record.subtask
        else [name for _, name in events],
        "events_verbose": to_verbose(events, record.force[:steps]),
        "articulation_type": link or None,
        "reset_kwargs": {},
        "success_once": record.success_once,
        "success_at_end": record.success_at_end,
        "fail": record.fail,
        **(_outcome_at(episode, steps) if steps < episode.steps else {}),
    }
    # ManiSkill's readers filter by it: whether the episode is successful in the end.
    return {**info, "success": info["success_at_end"]}


def _outcome_at(episode: RecordedEpisode, steps: int) -> dict[str, Any]:
    """Outcome of an episode that is cut after ``steps`` control steps."""
    success = episode.array("reward/success")[:steps].astype(bool)
    return {
        "ending": "cut",
        "success_once": bool(success.any()),
        "success_at_end": bool(success[-1]),
        "fail": bool(episode.array("reward/fail")[steps - 1]),
    }
