"""Reading shards and folders of shards."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5r

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.files.locking import is_written
from mjhab.core.names import check_name
from mjhab.data.store.episode_data import (
    RunInfo,
    episode_digest,
    from_bytes,
    record_problems,
    run_id,
    unnamed_actors,
)
from mjhab.data.store.hdf5 import (
    check_format,
    dataset,
    dataset_paths,
    group,
    read_arrays,
    read_attributes,
)
from mjhab.data.store.images import decode
from mjhab.data.store.journal import Overlay, committed_length, read_journal
from mjhab.data.store.locking import quiet
from mjhab.data.store.older import POSES, STAND_INS, canonical_poses, stand_in
from mjhab.data.store.schema import (
    COLUMNS,
    EPISODES,
    FIELDS,
    RUNS,
    TERMINAL,
    DamagedError,
    checks_by_name,
    column_widths,
    problems,
)
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.labelling.state import History

BROKEN = (OSError, RuntimeError, ValueError, KeyError)
"""What h5py raises over a damaged file."""


def shard_paths(places: Path | Sequence[Path]) -> list[Path]:
    """Shards among files and in folders (and folders in them), in order of their names.

    Raises:
        UsageError: a place that does not exist, or a folder without shards.
    """
    found: list[Path] = []
    for place in [places] if isinstance(places, Path) else places:
        if place.is_dir():
            inside = sorted(path for path in place.rglob("*.h5") if not path.name.startswith("."))
            if not inside:
                raise UsageError(f"no shards (*.h5) in {place} or the folders in it.")
            found += inside
        elif place.is_file():
            found.append(place)
        else:
            raise UsageError(f"{place} does not exist; give a shard (*.h5) or a folder of shards.")
    return list(dict.fromkeys(found))


class Episode:
    """One recorded episode; arrays are read when they are asked for.

    Once its shard is closed, the file is opened again for each reading.
    """

    def __init__(self, shard: Shard, name: str) -> None:
        self.shard = shard
        self.name = name
        with self._telling():
            self._group = shard.open_group(name)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Have the group open, and turn what h5py says about damage into what the user can do about it."""
        with ExitStack() as stack:
            if not self._group:
                self.shard = stack.enter_context(open_shard(self.shard.path))
                self._group = self.shard.episode(self.name)._group
            with self._telling():
                yield

    @contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
            raise DamagedError(
                f"episode {self.name} of {self.shard.path} cannot be read ({type(error).__name__}: {error}). See what "
                f"is wrong with: mjhab data check {self.shard.path}"
            ) from error

    @functools.cached_property
    def record(self) -> EpisodeRecord:
        """Identity, plan, labels, events, forces."""
        with self._reading():
            return EpisodeRecord.from_dict(from_bytes(dataset(self._group, "record")[()]))

    @property
    def run(self) -> RunInfo:
        """What made it: config, versions, layout."""
        with self._reading():
            return self.shard.runs[str(self.attributes["run"])]

    @functools.cached_property
    def attributes(self) -> dict[str, Any]:
        """The attributes of its group, see `schema.ATTRIBUTES`."""
        with self._reading():
            return read_attributes(self._group)

    @property
    def steps(self) -> int:
        """Number N of control steps."""
        return int(self.attributes["steps"])

    @property
    def terminated(self) -> bool:
        """Whether the environment said "terminated" in the last step; otherwise the episode was truncated."""
        return str(self.attributes["ending"]) in TERMINAL

    @property
    def schema(self) -> int:
        """Version of the schema that it was recorded in."""
        return int(self.attributes.get("schema", 1))

    @property
    def lacks(self) -> tuple[str, ...]:
        """Datasets that its older schema does not have: ``array`` gives what stands in for them.

        Without ``actions_intended`` the executed actions are taken for intended; without ``actor`` the policy of the
        run has acted all the time.
        """
        with self._reading():
            return tuple(
                f.path for f in FIELDS if f.since > self.schema and f.path not in self._group
            )

    @property
    def actors(self) -> tuple[str, ...]:
        """Names that the numbers of ``array("actor")`` stand for."""
        names = self.attributes.get("actors")
        return (self.run.policy,) if names is None else tuple(json.loads(names))

    @property
    def nbytes(self) -> int:
        """Bytes that its data takes in the file, without HDF5's own bookkeeping."""
        with self._reading():
            return sum(dataset(self._group, path).id.get_storage_size() for path in self.paths)

    def initial(self) -> dict[str, Any]:
        """The state after the reset, for ``env.set_state``."""
        return from_bytes(self.array("states/initial"))

    def copy_to(self, parent: h5py.Group) -> None:
        """Copy it as it is into a group of another file."""
        with self._reading():
            parent.copy(self._group, parent, self.name)

    @property
    def paths(self) -> list[str]:
        """Paths of its datasets."""
        with self._reading():
            return dataset_paths(self._group)

    def array(self, path: str) -> np.ndarray:
        """One dataset by its path in the schema, e.g. "actions" (N, A) or "states/qpos" (N+1, nq).

        Raises:
            UsageError: it was not recorded.
        """
        with self._reading():
            if path in self._group:
                return self._as_of_now(path, dataset(self._group, path)[()])
        if path in self.lacks:
            return stand_in(path, self.array(STAND_INS[path]))
        if path in self.run.absent:
            raise UsageError(
                f"episode {self.name} was imported from data without it: {path} is not there. Its source lacks "
                f"{', '.join(self.run.absent)}, so it can neither be simulated again nor rendered nor labelled anew."
            )
        if path.startswith("states/"):
            raise UsageError(
                f"episode {self.name} was recorded without states: {path} is not there, and nothing can be rendered "
                "from it. Record it again with states: `mjhab generate` without --no-states, same seed and index."
            )
        raise unknown_name("dataset", path, self.paths)

    def _as_of_now(self, path: str, array: np.ndarray) -> np.ndarray:
        """A dataset as the present schema has it."""
        if self.schema >= 2:
            return array
        if path == "obs/state":
            return canonical_poses(array, self.columns(path))
        key = path.removeprefix("obs/")
        return canonical_poses(array, {key: array.shape[1]}) if key in POSES else array

    def columns(self, path: str) -> dict[str, int]:
        """Names of the columns of a two-dimensional dataset, and how many columns each name stands for."""
        split = [name.rpartition(":") for name in self._column_names(path)]
        return {head or tail: int(tail) if head else 0 for head, _, tail in split}

    def _column_names(self, path: str) -> list[str]:
        with self._reading():
            told = read_attributes(dataset(self._group, path))
        return [name for name in str(told.get(COLUMNS, "")).split(",") if name]

    def table(self, path: str) -> dict[str, np.ndarray]:
        """A two-dimensional dataset as its columns, e.g. "signals/checks": (N+1,) each, or (N+1, n) for n columns."""
        array = self.array(path)
        at = 0
        table = {}
        for name, width in self.columns(path).items():
            table[name] = array[:, at : at + width] if width else array[:, at]
            at += width or 1
        return table

    def observation(self, key: str) -> np.ndarray:
        """One observation (N+1, ...) by its key in the environment; images are decoded.

        Raises:
            UsageError: it was not recorded.
        """
        with self._reading():
            if f"obs/{key}" in self._group:
                return self.array(f"obs/{key}")
            parts = self.table("obs/state")
            if key in parts:
                return parts[key]
            camera, output = _camera_output(key)
            if camera:
                return np.stack([self.frame(camera, output, t) for t in range(self.steps + 1)])
        raise unknown_name(
            "observation", key, [*parts, *(p[4:] for p in self.paths if p.startswith("obs/"))]
        )

    @property
    def images(self) -> list[tuple[str, str]]:
        """(camera, output) of the images stored with it."""
        parts = [path.split("/") for path in self.paths]
        found = [(part[1], part[2]) for part in parts if part[0] == "images" and part[-1] == "ends"]
        with self._reading():
            for camera, output in found:
                check_name("camera", camera)
                check_name("output of a camera", output)
        return found

    def frame(self, camera: str, output: str, t: int) -> np.ndarray:
        """The image of state t, 0 to N: rgb (H, W, 3) uint8, depth (H, W, 1) int16 mm, seg (H, W, 1) int32.

        Raises:
            UsageError: no such image was recorded.
        """
        place = f"images/{camera}/{output}"
        with self._reading():
            if place not in self._group:
                raise self._no_images(camera, output)
            ends = dataset(self._group, f"{place}/ends")
            start = int(ends[t - 1]) if t else 0
            return decode(
                dataset(self._group, f"{place}/bytes")[start : int(ends[t])].tobytes(), output
            )

    def _no_images(self, camera: str, output: str) -> UsageError:
        had = ", ".join(f"{c} {o}" for c, o in self.images) or "none"
        how = "`mjhab replay --render` draws them from its states."
        if "states/qpos" in self.run.absent:
            how = "It was imported from data without states to draw them from."
        elif "states/qpos" not in self.paths:
            how = "It was recorded without states to draw them from; record it again: `mjhab generate --images`."
        return UsageError(
            f"episode {self.name} has no {output} images of {camera} (it has: {had}). {how}"
        )

    def frame_places(self, camera: str, output: str) -> tuple[int, np.ndarray] | None:
        """Offset of the first frame in the file and ends (N+1,) of all frames from there on [bytes].

        For those who read many single frames without HDF5, see `images.decode`. None if a journal or a layout that is
        not contiguous stands in between: then `frame` reads them all the same.

        Raises:
            UsageError: no such image was recorded.
        """
        with self._reading():
            self.frame(camera, output, 0)
            place = f"images/{camera}/{output}"
            offset = dataset(self._group, f"{place}/bytes").id.get_offset()
            if offset is None or self.shard.journalled:
                return None
            return int(offset), dataset(self._group, f"{place}/ends")[()]

    def history(self, k: int) -> tuple[int, History]:
        """Index in the plan of the k-th subtask that was reached, and its signals for `tasks.labelling.labels`.

        Signals are bool of shape (T+1, 1), T the control steps of the subtask.
        """
        starts = [*self.array("subtasks/step").tolist(), self.steps]
        first = self.array("subtasks/checks")[k : k + 1]
        checks = np.concatenate(
            [first, self.array("signals/checks")[starts[k] + 1 : starts[k + 1] + 1]]
        )
        fields = checks_by_name(checks)
        return int(self.array("subtasks/index")[k]), History(
            **{n: fields[n] for n in History.__dataclass_fields__}
        )

    def problems(self) -> list[str]:
        """What is wrong with it, in words: parts that are missing or do not fit, or bytes that have changed."""
        with self._reading():
            arrays = read_arrays(self._group)
            widths = column_widths(
                self.run.layout, {path: self._column_names(path) for path in arrays}
            )
            wrong = problems(
                arrays,
                self.steps,
                others=True,
                schema=self.schema,
                widths=widths,
                absent=self.run.absent,
            )
            wrong = wrong or unnamed_actors(arrays, self.actors)
            if not wrong and episode_digest(arrays) != self.attributes["digest"]:
                wrong.append("its bytes are not those that were written (digest)")
            return wrong or self._record_problems()

    def _record_problems(self) -> list[str]:
        wrong = record_problems(self.record)
        if self.record.steps != self.steps:
            wrong.append(f"its record has {self.record.steps} steps, its group {self.steps}")
        name = str(self.attributes["run"])
        if run_id(self.shard.told[name]) != name:
            wrong.append("what made it (its run) is not what was written")
        if self.run.episode_name(self.record.seed, self.record.index) != self.name:
            wrong.append(
                f"its record is that of episode {self.record.index} of seed {self.record.seed}"
            )
        return wrong

    def refuse_damage(self) -> None:
        """Read all of it and go on only if nothing is wrong with it: for what makes other files of it.

        Raises:
            DamagedError: says what is wrong.
        """
        wrong = self.problems()
        if wrong:
            raise DamagedError(
                f"episode {self.name} of {self.shard.path} is damaged: {'; '.join(wrong)}. Nothing is made of it; "
                f"`mjhab data repair {self.shard.path}` leaves it out."
            )


class Shard:
    """A shard open for reading; a context manager. Make one with `open_shard`.

    ``names``: of the episodes, in order of config, seed and index.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = -1
        try:
            with quiet(path):
                self.file = self._open()
                check_format(self.file, path)
                self._read_index()
        except BROKEN as error:
            self.close()
            raise _unreadable(path, error) from error
        except BaseException:
            self.close()
            raise

    def _read_index(self) -> None:
        """Read all that a writer changes, so that nothing leads there later: where episodes lie, and the runs."""
        index = group(self.file, EPISODES)
        self._places = {
            str(name): h5r.create(index.id, str(name).encode(), h5r.OBJECT) for name in index
        }
        self.names = sorted(self._places)
        with suppress(*BROKEN):
            _ = self.told  # of a damaged one, whoever asks hears of it

    def _open(self) -> h5py.File:
        committed_length(self.path)
        journal = read_journal(self.path)
        if journal is None:
            return h5py.File(self.path, "r", locking=False)
        # A writer was killed while it put the last episode in place: look at the file as it will be.
        self._fd = os.open(self.path, os.O_RDONLY)
        return h5py.File(Overlay(self._fd, journal.after, journal.pages), "r")

    @property
    def journalled(self) -> bool:
        """Whether a part of it is in a journal beside the file."""
        return self._fd >= 0

    @functools.cached_property
    def told(self) -> dict[str, dict[str, Any]]:
        """What the file tells of each run, by name; a later version may tell more than a `RunInfo` holds."""
        runs = group(self.file, RUNS)
        return {str(name): from_bytes(dataset(runs, str(name))[()]) for name in runs}

    @functools.cached_property
    def runs(self) -> dict[str, RunInfo]:
        """What made the episodes, by name."""
        known = RunInfo.__dataclass_fields__
        return {
            name: RunInfo(**{k: v for k, v in run.items() if k in known})
            for name, run in self.told.items()
        }

    def episode(self, name: str) -> Episode:
        """One episode by its name.

        Raises:
            UsageError: there is none of that name.
        """
        if name not in self._places:
            raise unknown_name(f"episode in {self.path}", name, self.names[:20])
        return Episode(self, name)

    def open_group(self, name: str) -> h5py.Group:
        """The group of an episode of ``names``, found without the index."""
        return group(self.file, self._places[name])

    def problems(self, name: str) -> list[str]:
        """What is wrong with an episode, in words; it may be damaged beyond opening."""
        try:
            return Episode(self, name).problems()
        except DamagedError as error:
            cause = error.__cause__ or error
            return [f"cannot be read ({type(cause).__name__}: {cause})"]

    def __iter__(self) -> Iterator[Episode]:
        return (Episode(self, name) for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def close(self) -> None:
        """Close the file. Its episodes open it again whenever they are read."""
        if hasattr(self, "file"):
            self.file.close()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> Shard:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def open_shard(path: Path | str) -> Shard:
    """Open a shard for reading, also while another process appends to it: it shows what was there when it was opened.

    Raises:
        UsageError: there is no such file, or it is of another schema version.
        DamagedError: not an HDF5 file, a foreign one, or a damaged one.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"{path} does not exist or is no file; give a shard (*.h5).")
    return Shard(path)


def episodes(places: Path | Sequence[Path]) -> Iterator[Episode]:
    """Every episode of shards and folders. They may be kept: once the next shard is reached, each reading of an episode
    of the one before opens that file again."""
    for path in shard_paths(places):
        with open_shard(path) as shard:
            yield from shard


def _camera_output(key: str) -> tuple[str, str]:
    parts = key.split("/")
    return (parts[1], parts[2]) if len(parts) == 3 and parts[0] == "sensor_data" else ("", "")


def _unreadable(path: Path, error: Exception) -> DamagedError:
    if is_written(path):
        return DamagedError(f"{path} is being written at this moment; try again.")
    there = path.stat().st_size
    whole = committed_length(path)
    if there < whole:
        return DamagedError(
            f"{path} cannot be read: it is cut off, {there:,} of its {whole:,} bytes are there. Copy it again from "
            f"where it came from, or save the episodes that are whole: mjhab data repair {path}"
        )
    return DamagedError(f"{path} cannot be read: {error}. Try: mjhab data repair {path}")
