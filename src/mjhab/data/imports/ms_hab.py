"""Import of MS-HAB data files (HDF5 trajectories with a JSON file, mshab/envs/wrappers/record.py) into shards.

Datasets that such a file lacks are listed in `RunInfo.absent`: simulator states, so the episodes cannot be replayed or
rendered, and the signals that labels are computed from. Filters, statistics, reports, exports and training windows work
as for other episodes.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.conventions.names import OBJECT_AXES, SCAN_AXES
from mjhab.core.errors import fault, wrong_value
from mjhab.core.files.reading import parse_json, read_bytes, reason
from mjhab.data.imports.ms_hab_layout import (
    ACTIONS,
    CONTROL_MODE,
    ENV,
    SCANNED_YAWS,
    SOURCE_TYPE,
    TRAJECTORY,
    check_episode,
    check_file,
    from_verbose,
)
from mjhab.data.imports.ms_hab_trajectory import trajectory_arrays, trajectory_ending
from mjhab.data.imports.origin import Origin
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.hdf5 import UNREADABLE, group, read_attributes
from mjhab.data.store.older.object_axes import shown_objects
from mjhab.data.store.older.schemas import OLDER_SCANNED
from mjhab.data.store.run_entries import SCAN_YAWS
from mjhab.data.store.schema import FORMAT
from mjhab.data.store.shard import ShardWriter
from mjhab.rollout.records import EpisodeRecord, PlanEntry, SubtaskRecord
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

ABSENT = (
    "states/initial",
    "states/qpos",
    "states/qvel",
    "signals/checks",
    "signals/forces",
    "signals/taint",
    "subtasks/checks",
    "reward/terms",
)
"""Datasets of the shard schema that the files lack."""
ARRAYS = ("actions", "terminated", "truncated", "success", "fail", "rewards")
GROUPS = ("obs/agent", "obs/extra")
"""Datasets and groups that every trajectory must hold."""
LINKS = {"fridge": "fridge/top_door", "kitchen_counter": "kitchen_counter/drawer3"}
"""The link of each piece of furniture that MS-HAB opens and closes (mshab/utils/gen/gen_task_plans.py)."""


@dataclass(frozen=True)
class Imported:
    """Result of an import. present: number of episodes that the shard already had. absent: datasets they lack."""

    episodes: int
    frames: int
    present: int
    shard: Path
    absent: tuple[str, ...] = ABSENT


def import_ms_hab(
    path: Path,
    out: Path,
    origin: Origin | None = None,
    begin: Callable[[int], Callable[[], object]] | None = None,
) -> Imported:
    """Write the trajectories of an MS-HAB file into the shard ``out/<task>/<subtask>/<name>.h5``.

    Existing episodes are skipped, so the same call continues an interrupted import.

    Args:
        path: the HDF5 file; its JSON file lies in the same folder, as name.json.
        out: a folder for shards.
        origin: task and split of the episodes.
        begin: called with the number of trajectories; returns a function that is called after each.

    Raises:
        UsageError: it is not an MS-HAB file, or lacks required keys.
        StorageError: the disk is full or broken.
    """
    source = _Source.read(path, origin or Origin())
    shard = out / source.task / source.subtask / path.name
    if shard.resolve() == path.resolve():
        raise wrong_value(
            "out", str(out), f"a folder whose shard does not overwrite {path}"
        )
    after = begin(len(source.trajectories)) if begin else None
    written = frames = present = 0
    run = source.run()
    indices = source.indices()
    try:
        with h5py.File(path, "r") as file, ShardWriter(shard) as writer:
            for metadata, index in zip(source.trajectories, indices, strict=True):
                # Looked up before the arrays are read, so that a resumed import reads only what is new.
                if writer.has(run, _seed(metadata), index):
                    present += 1
                else:
                    data = source.episode(file, metadata, index, run)
                    writer.append(data)
                    written += 1
                    frames += data.record.steps
                if after is not None:
                    after()
    # h5py raises at the first damaged chunk, which may be in the middle of the file.
    except UNREADABLE as error:
        raise fault(path, f"cannot be read as data of MS-HAB: {reason(error)}") from error
    return Imported(written, frames, present, shard)


@dataclass(frozen=True)
class _Source:
    """A file and its JSON metadata. header: of the whole file. trajectories: of each trajectory."""

    path: Path
    header: Mapping[str, Any]
    trajectories: Sequence[Mapping[str, Any]]
    task: str
    subtask: str
    split: str
    digest: str

    @classmethod
    def read(cls, path: Path, origin: Origin) -> _Source:
        _check_file(path)
        beside = path.with_suffix(".json")
        if not beside.is_file():
            raise fault(
                path, f"has no {beside.name} beside it, which describes its trajectories."
            )
        text = read_bytes(beside)
        try:
            header = parse_json(text)
        except ValueError as error:
            raise fault(beside, f"not valid JSON: {error}") from error
        if not isinstance(header, Mapping) or not isinstance(
            header.get("episodes"), list
        ):
            raise fault(
                beside,
                "has no list 'episodes'; give a file as MS-HAB's generator writes it.",
            )
        trajectories = header["episodes"]
        try:
            check_file(header)
            for number, each in enumerate(trajectories):
                check_episode(number, each)
        except ValueError as error:
            raise fault(beside, str(error)) from error
        # The list may have another order than the trajectories.
        trajectories = sorted(trajectories, key=lambda each: each["episode_id"])
        subtask = _subtask(path, header)
        return cls(
            path,
            header,
            trajectories,
            _task(path, origin),
            subtask,
            origin.split,
            # The JSON is small and differs wherever episodes do; hashing the HDF5 would read GB.
            hashlib.sha256(text).hexdigest()[:16],
        )

    @property
    def is_ours(self) -> bool:
        """Whether mjhab's exporter wrote the file."""
        return self.header.get("source_type") == SOURCE_TYPE

    def run(self) -> RunInfo:
        """Description of the run that made the episodes, as far as the file has it."""
        made = next(iter(self._runs()), {})
        name = (
            made.get("config", {}).get("policy", {}).get("name") if self.is_ours else None
        )
        policy = name or f"ms_hab {self.header.get('source_type', '')}".strip().lower()
        place = f"{self.task}/{self.subtask}/{self.path.stem}"
        return RunInfo(
            config={
                "env": self._env(),
                "policy": {"name": policy},
                "imported": {"from": "ms_hab", "file": place, "json": self.digest},
            },
            options={
                "source_type": self.header.get("source_type"),
                "source_desc": self.header.get("source_desc"),
                "object_axes": self._axes(),
            },
            versions=dict(made.get("versions", {})),
            layout=self._layout(),
            assets=str(made.get("assets", "replica_cad")),
            licence=str(made.get("licence", "unknown: see the source of the data")),
            absent=ABSENT,
        )

    def _runs(self) -> list[Mapping[str, Any]]:
        """The runs of a file that mjhab exported; empty for a file of MS-HAB."""
        return list(self.header.get("runs", {}).values()) if self.is_ours else []

    def _axes(self) -> str:
        """Axes of the poses of objects in the shard: those that the environment of the episodes observes."""
        if not self.is_ours:
            return SCAN_AXES
        axes = {run.get("options", {}).get("object_axes", "") for run in self._runs()}
        # Runs of one file that disagree cannot be told apart by episode.
        if len(axes) == 1 and axes <= {OBJECT_AXES, SCAN_AXES}:
            return str(axes.pop())
        is_scanned = all(
            each.get("object_axes") == SCAN_AXES for each in self.trajectories
        )
        older = self._env().get("profile") == OLDER_SCANNED
        return SCAN_AXES if older and is_scanned else OBJECT_AXES

    def _control_mode(self) -> str:
        modes = (
            each["control_mode"] for each in self.trajectories if each.get("control_mode")
        )
        return str(next(modes, CONTROL_MODE))

    def _env(self) -> dict[str, Any]:
        """Options of the environment of the episodes: those that all runs of an export share, or MS-HAB's own."""
        envs = [run.get("config", {}).get("env", {}) for run in self._runs()]
        if envs:
            first, *others = envs
            known = {
                name: value
                for name, value in first.items()
                # What the runs disagree on would be wrong for some of the episodes.
                if all(name in env and env[name] == value for env in others)
            }
        else:
            known = ENV
        own = {
            "task": self.task,
            "subtask": self.subtask,
            "control_mode": self._control_mode(),
        }
        return {**known, **own}

    def _layout(self) -> dict[str, Any]:
        """Headings of scans, and names of the actions if the file has them or its control mode is MS-HAB's."""
        runs = self._runs()
        if runs:
            layout = runs[0].get("layout", {})
            return {key: layout[key] for key in ("actions", SCAN_YAWS) if key in layout}
        yaws = {SCAN_YAWS: SCANNED_YAWS}
        has_names = self._control_mode() == CONTROL_MODE
        return {"actions": list(ACTIONS), **yaws} if has_names else yaws

    def indices(self) -> list[int]:
        """Indices of the episodes: the recorded ones if the file has them and they are unique, else their numbers."""
        indices = [
            int(each.get("episode_index", each["episode_id"]))
            for each in self.trajectories
        ]
        names = {
            (_seed(each), index)
            for each, index in zip(self.trajectories, indices, strict=True)
        }
        return (
            indices
            if len(names) == len(indices)
            else [int(each["episode_id"]) for each in self.trajectories]
        )

    def episode(
        self, file: h5py.File, metadata: Mapping[str, Any], index: int, run: RunInfo
    ) -> EpisodeData:
        """One trajectory as an episode."""
        name = f"{TRAJECTORY}{metadata['episode_id']}"
        if name not in file:
            raise fault(
                self.path,
                f"has no {name}, which {self.path.with_suffix('.json').name} lists.",
            )
        trajectory = group(file, name)
        missing = [key for key in (*ARRAYS, *GROUPS) if key not in trajectory]
        if missing:
            raise fault(
                self.path,
                f"{name} has no {', '.join(missing)}; it has {', '.join(trajectory)}.",
            )
        arrays, columns = trajectory_arrays(trajectory, self._turn(metadata, run))
        steps = len(arrays["actions"])
        # A JSON beside another HDF5 has labels of other episodes.
        if steps != int(metadata["elapsed_steps"]) or steps < 1:
            raise fault(
                self.path,
                f"{name} has {steps} actions, and the JSON says {metadata['elapsed_steps']} steps.",
            )
        names = run.layout.get("actions")
        if names is not None and arrays["actions"].shape[1] != len(names):
            raise fault(
                self.path,
                f"{name} has actions of {arrays['actions'].shape[1]} numbers; {self._control_mode()} has "
                f"{len(names)} ({', '.join(names)}). Give data of the robot {ENV['robot']!r}.",
            )
        # What the file says is checked as it is where a shard is read: names become parts of paths.
        record = EpisodeRecord.from_dict(self._record(metadata, index, arrays).to_dict())
        ending = str(metadata.get("ending") or trajectory_ending(trajectory))
        actors = tuple(str(actor) for actor in metadata.get("actors", ()))
        return EpisodeData(record, run, "", ending, arrays, columns, actors)

    def _turn(self, metadata: Mapping[str, Any], run: RunInfo) -> float:
        """Yaw [rad] from the axes of the object's pose in the file to those in the shard."""
        have = (
            str(metadata.get("object_axes", OBJECT_AXES)) if self.is_ours else SCAN_AXES
        )
        want = run.options["object_axes"]
        if have == want:
            return 0.0
        (shown,) = shown_objects((PlanEntry(self.subtask, self._target(metadata)),))
        yaw = float(run.layout.get(SCAN_YAWS, {}).get(shown, 0.0))
        # The yaw leads from our axes to those of the scan.
        return yaw if want == SCAN_AXES else -yaw

    def _record(
        self, metadata: Mapping[str, Any], index: int, arrays: Mapping[str, np.ndarray]
    ) -> EpisodeRecord:
        success = arrays["reward/success"].astype(bool)
        steps = len(arrays["actions"])
        events, force = from_verbose(metadata["events_verbose"], steps)
        label = metadata["label"] or None
        # Recorded episodes round their forces so, and filters compare them.
        peak = round(max(force), 3)
        # Summed in the order of the steps, so that the last bit is that of a recording.
        total = round(ordered_sum(force), 3)
        target = self._target(metadata)
        # MS-HAB's labels follow its published rules, which are mjhab's legacy labels.
        legacy = metadata.get("legacy_label", None if self.is_ours else label)
        subtask = SubtaskRecord(
            index=0,
            kind=self.subtask,
            target=target,
            label=label,
            legacy_label=legacy,
            success_once=bool(success.any()),
            success_at_end=bool(success[-1]),
            start_step=0,
            end_step=steps,
            peak_force=peak,
            cumulative_force=total,
            events=events,
        )
        return EpisodeRecord(
            seed=_seed(metadata),
            index=index,
            home=str(
                metadata.get("home") or f"build_config_{metadata.get('build_config_idx')}"
            ),
            task=self.task,
            split=str(metadata.get("split") or self.split),
            subtask=self.subtask,
            plan=(PlanEntry(self.subtask, target),),
            subtasks=(subtask,),
            success_once=subtask.success_once,
            success_at_end=subtask.success_at_end,
            # MS-HAB ends an episode with its failure, so that it can only stand last.
            fail=bool(arrays["reward/fail"][-1]),
            steps=steps,
            completed=int(subtask.success_once),
            events=events,
            peak_force=peak,
            cumulative_force=total,
            force=force,
            taint=(),
            spawn_fallback=False,
            final_state="",
        )

    def _target(self, metadata: Mapping[str, Any]) -> str:
        furniture = str(metadata.get("articulation_type") or "")
        return str(
            metadata.get("target") or LINKS.get(furniture, furniture) or self.path.stem
        )


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise fault(
            path,
            "does not exist or is not a file; give a file of MS-HAB's data set, such as 024_bowl.h5.",
        )
    try:
        with h5py.File(path, "r") as file:
            names = list(file)
            is_shard = str(read_attributes(file).get("format")) == FORMAT
    except UNREADABLE as error:
        raise fault(path, f"not an HDF5 file: {reason(error)}") from error
    if is_shard:
        raise fault(path, "a shard of mjhab already; there is nothing to import.")
    if not any(name.startswith(TRAJECTORY) for name in names):
        raise fault(
            path,
            f"has no groups {TRAJECTORY}0, {TRAJECTORY}1, ... as the files of MS-HAB's data set have. It has: "
            f"{', '.join(names[:6]) or 'nothing'}.",
        )


def _task(path: Path, origin: Origin) -> str:
    """The task of a file; MS-HAB names the folder above the subtask's folder after it."""
    # Resolved, since a relative path may have no folder above.
    folder = path.resolve().parent.parent.name
    if origin.task is None and folder not in TASKS:
        raise fault(
            path,
            "does not lie in a folder <task>/<subtask>, and the file itself does not say its task; give --task "
            f"({', '.join(TASKS)}).",
        )
    return origin.task or folder


def _subtask(path: Path, header: Mapping[str, Any]) -> str:
    env = str((header.get("env_info") or {}).get("env_id", ""))
    found = re.match(r"(\w+?)SubtaskTrain", env)
    kind = found[1].lower() if found else path.resolve().parent.name
    if kind not in SUBTASKS:
        valid = ", ".join(f"{name.capitalize()}SubtaskTrain-v0" for name in SUBTASKS)
        raise fault(
            path,
            f"of {env or 'an environment it does not name'}. Files of one subtask can be imported ({valid}); "
            "those of whole chains do not say which subtask was active when.",
        )
    return kind


def _seed(metadata: Mapping[str, Any]) -> int:
    """The seed of an episode; vectorized environments write one per world, all equal."""
    seed = metadata.get("episode_seed", 0)
    return int(np.ravel(seed)[0]) if np.size(seed) else 0
