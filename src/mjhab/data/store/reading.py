"""Reading shards and the episodes in them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mjhab.core.conventions.names import OBJECT_AXES, SCAN_AXES, Conventions
from mjhab.core.errors import UsageError, fault, unknown_name
from mjhab.core.files.reading import parse_json, reason
from mjhab.core.names import check_name
from mjhab.data.store.annotations import ANNOTATIONS, Annotations
from mjhab.data.store.episode_data import (
    RunInfo,
    from_bytes,
    record_problems,
)
from mjhab.data.store.hdf5 import (
    UNREADABLE,
    check_format,
    content,
    dataset,
    dataset_paths,
    group,
    read_arrays,
    read_attributes,
    stated_length,
    unreadable,
)
from mjhab.data.store.images import MAX_FRAME_BYTES, camera_output, decode
from mjhab.data.store.older.journal import refuse_journal
from mjhab.data.store.older.object_axes import headings
from mjhab.data.store.older.schemas import (
    OLDER_AXES,
    POSES,
    STAND_INS,
    canonical_poses,
    is_turned,
    stand_in,
    turned_poses,
)
from mjhab.data.store.schema import (
    ATTRIBUTE_TYPES,
    COLUMNS,
    EPISODES,
    FIELDS,
    NEEDED_ATTRIBUTES,
    RUNS,
    TERMINAL,
    DamagedError,
    checks_by_name,
)
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.label_state import History


class RecordedEpisode:
    """One recorded episode; arrays are read on access.

    After its shard is closed, every access opens the file again.
    """

    def __init__(self, shard: Shard, name: str) -> None:
        self.shard = shard
        self.name = name
        with self._telling():
            self._group = shard.open_group(name)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Keep the group open, and convert h5py's errors about damage to messages with a remedy."""
        with ExitStack() as stack:
            # h5py's objects are false once their file is closed.
            if not self._group:
                self.shard = stack.enter_context(open_shard(self.shard.path))
                # Stays set after this: the next access sees that it is closed again.
                self._group = self.shard.episode(self.name)._group
            with self._telling():
                yield

    @contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except UNREADABLE as error:
            raise DamagedError(
                f"episode {self.name} of {self.shard.path} cannot be read ({type(error).__name__}: {reason(error)}). "
                f"See what is wrong with: mjhab data check {self.shard.path}"
            ) from error

    @functools.cached_property
    def record(self) -> EpisodeRecord:
        """Identity, plan, labels, events, forces."""
        with self.reading():
            record = EpisodeRecord.from_dict(
                from_bytes(content(dataset(self._group, "record")))
            )
            wrong = record_problems(record)
            if wrong:
                raise ValueError("; ".join(wrong))
            return record

    @property
    def run(self) -> RunInfo:
        """The run that made it: config, versions, layout."""
        with self.reading():
            return self.shard.run(self.attributes["run"])

    @property
    def run_data(self) -> dict[str, Any]:
        """JSON data of the run that made it, with what later versions added."""
        with self.reading():
            return self.shard.run_data(self.attributes["run"])

    @functools.cached_property
    def attributes(self) -> dict[str, Any]:
        """The attributes of its group, see `schema.ATTRIBUTES`; each has its type."""
        with self.reading():
            attributes = read_attributes(self._group)
            for name, kind in ATTRIBUTE_TYPES.items():
                if name in attributes and not isinstance(attributes[name], kind):
                    shown = str(attributes[name])[:60]
                    raise ValueError(
                        f"attribute {name!r} must be {kind.__name__}, not {shown!r}"
                    )
            missing = [name for name in NEEDED_ATTRIBUTES if name not in attributes]
            if missing:
                raise ValueError(f"it has no attribute {', '.join(missing)}")
            return attributes

    @property
    def steps(self) -> int:
        """Number N of control steps."""
        return int(self.attributes["steps"])

    @property
    def terminated(self) -> bool:
        """Whether the environment returned "terminated" in the last step; otherwise the episode was truncated."""
        return str(self.attributes["ending"]) in TERMINAL

    @property
    def schema(self) -> int:
        """Schema version that it was recorded in."""
        return int(self.attributes.get("schema", 1))

    @property
    def lacks(self) -> tuple[str, ...]:
        """Datasets that its older schema lacks and that ``array`` derives from others.

        A missing ``actions_intended`` equals the executed actions; a missing ``actor`` is the policy of the run.
        """
        with self.reading():
            return tuple(
                f.path
                for f in FIELDS
                if f.since > self.schema and f.path not in self._group
            )

    @property
    def actors(self) -> tuple[str, ...]:
        """Names that ``array("actor")`` indexes."""
        names = self.attributes.get("actors")
        if names is None:
            return (self.run.policy,)
        with self.reading():
            actors = parse_json(names)
            if not isinstance(actors, list) or not all(
                isinstance(name, str) for name in actors
            ):
                raise ValueError(
                    f"attribute 'actors' must be a list of texts, not {names[:60]!r}"
                )
            return tuple(actors)

    @property
    def annotations(self) -> Annotations:
        """Skills and wordings; empty where none were recorded."""
        if ANNOTATIONS not in self.paths:
            return Annotations()
        data = self.array(ANNOTATIONS)
        with self.reading():
            return Annotations.from_array(data, self.steps)

    @property
    def nbytes(self) -> int:
        """Size of its data in the file without HDF5's metadata [bytes]."""
        with self.reading():
            return sum(
                dataset(self._group, path).id.get_storage_size() for path in self.paths
            )

    def initial(self) -> dict[str, Any]:
        """The state after the reset, for ``env.set_state``.

        Raises:
            DamagedError: it is not what a recorder writes.
        """
        data = self.array("states/initial")
        with self.reading():
            state = from_bytes(data)
            for name in ("qpos", "qvel"):
                if not isinstance(state["sim"][name], np.ndarray):
                    raise ValueError(f"states/initial has no array {name}")
            return state

    def copy_to(self, parent: h5py.Group) -> None:
        """Copy it unchanged into a group of another file."""
        with self.reading():
            parent.copy(self._group, parent, self.name)

    @property
    def paths(self) -> list[str]:
        """Paths of its datasets."""
        with self.reading():
            return dataset_paths(self._group)

    def array(self, path: str) -> np.ndarray:
        """One dataset by its path in the schema, e.g. "actions" (N, A) or "states/qpos" (N+1, nq).

        Raises:
            UsageError: it was not recorded.
        """
        with self.reading():
            if path in self._group:
                return self._as_of_now(path, content(dataset(self._group, path)))
        # Before absent and unknown names: older schemas lack some by rule and not by damage.
        if path in self.lacks:
            return stand_in(path, self.array(STAND_INS[path]))
        if path in self.run.absent:
            raise UsageError(
                f"episode {self.name} was imported from data without {path}. Its source lacks "
                f"{', '.join(self.run.absent)}, so it cannot be simulated again, rendered or relabelled."
            )
        if path.startswith("states/"):
            raise UsageError(
                f"episode {self.name} was recorded without states: {path} is not there, and nothing can be rendered "
                "from it. Record it again with states: `mjhab generate` without --no-states, same seed and index."
            )
        raise unknown_name("dataset", path, self.paths)

    def _as_of_now(self, path: str, array: np.ndarray) -> np.ndarray:
        """Convert a dataset to the present schema."""
        if self.schema > OLDER_AXES or not path.startswith("obs/"):
            return array
        key = path.removeprefix("obs/")
        if path == "obs/state":
            columns = self.columns(path)
        elif key in POSES:
            columns = {key: array.shape[1]}
        else:
            return array
        if self.schema < 2:
            array = canonical_poses(array, columns)
        yaws = self.scan_yaws
        if yaws is not None and is_turned(self.run.config, self.run.options):
            array = turned_poses(array, columns, yaws)
        return array

    @property
    def conventions(self) -> Conventions:
        """How its observations tell poses of objects and angles of joints, as ``array`` gives them.

        Poses in our axes that were recorded in profile "ms_hab" before schema 3 are given in those of the scans, which
        the profile observes now, unless the run does not hold their headings.
        """
        run = self.run
        conventions = Conventions.of({**run.config.get("env", {}), **run.options})
        if self.schema <= OLDER_AXES and is_turned(run.config, run.options):
            axes = OBJECT_AXES if self.scan_yaws is None else SCAN_AXES
            return dataclasses.replace(conventions, object_axes=axes)
        return conventions

    @property
    def scan_yaws(self) -> np.ndarray | None:
        """(N+1,) heading [rad] of the scan of the observed object in every state; None if its run does not tell."""
        active = self.array("subtasks/active")
        with self.reading():
            return headings(self.run.layout, self.record.plan, active)

    def columns(self, path: str) -> dict[str, int]:
        """Column names of a two-dimensional dataset, with the number of columns of each name (0 for a plain column)."""
        split = [name.rpartition(":") for name in self._column_names(path)]
        with self.reading():
            return {head or tail: int(tail) if head else 0 for head, _, tail in split}

    def _column_names(self, path: str) -> list[str]:
        with self.reading():
            attributes = read_attributes(dataset(self._group, path))
        return [name for name in str(attributes.get(COLUMNS, "")).split(",") if name]

    def table(self, path: str) -> dict[str, np.ndarray]:
        """A two-dimensional dataset by column name, e.g. "signals/checks": (N+1,) each, or (N+1, n) for n columns."""
        array = self.array(path)
        at = 0
        table = {}
        for name, width in self.columns(path).items():
            with self.reading():
                table[name] = array[:, at : at + width] if width else array[:, at]
            at += width or 1
        return table

    def observation(self, key: str) -> np.ndarray:
        """One observation (N+1, ...) by its key in the environment; images are decoded.

        Raises:
            UsageError: it was not recorded.
        """
        with self.reading():
            if f"obs/{key}" in self._group:
                return self.array(f"obs/{key}")
            parts = self.table("obs/state")
            if key in parts:
                return parts[key]
            camera, output = camera_output(key)
            if camera:
                return np.stack(
                    [self.frame(camera, output, t) for t in range(self.steps + 1)]
                )
        raise unknown_name(
            "observation",
            key,
            [*parts, *(p[4:] for p in self.paths if p.startswith("obs/"))],
        )

    @property
    def images(self) -> list[tuple[str, str]]:
        """(camera, output) of the images stored with it."""
        parts = [path.split("/") for path in self.paths]
        found = [
            (part[1], part[2])
            for part in parts
            if part[0] == "images" and part[-1] == "ends"
        ]
        with self.reading():
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
        with self.reading():
            if place not in self._group:
                raise self._no_images(camera, output)
            ends = dataset(self._group, f"{place}/ends")
            if ends.dtype.kind != "i":
                raise ValueError(f"{place}/ends is {ends.dtype}, not int64")
            start = int(ends[t - 1]) if t else 0
            end = int(ends[t])
            # Damaged ends could ask for the rest of the file, or for a slice from its end.
            if not 0 <= start < end <= start + MAX_FRAME_BYTES:
                raise ValueError(f"frame {t} of {place} is from byte {start} to {end}")
            return decode(
                dataset(self._group, f"{place}/bytes")[start:end].tobytes(), output
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

        With these, frames can be read without HDF5 and decoded by `images.decode`. None if the dataset is not
        contiguous; `frame` still reads them.

        Raises:
            UsageError: no such image was recorded.
        """
        with self.reading():
            # Refuses damaged ends, which the caller will read with no check.
            self.frame(camera, output, 0)
            place = f"images/{camera}/{output}"
            offset = dataset(self._group, f"{place}/bytes").id.get_offset()
            # HDF5 gives no offset for data in chunks or in a header.
            if offset is None:
                return None
            return int(offset), dataset(self._group, f"{place}/ends")[()]

    def history(self, k: int) -> tuple[int, History]:
        """Plan index of the k-th subtask that was reached, and its signals for `tasks.labelling.labels`.

        Signals are bool (T+1, 1), where T is the number of the subtask's control steps.
        """
        steps = self.array("subtasks/step")
        before = self.array("subtasks/checks")
        rows = self.array("signals/checks")
        numbers = self.array("subtasks/index")
        with self.reading():
            starts = [*steps.tolist(), self.steps]
            first = before[k : k + 1]
            # Row 0 is from the subtask's own view of its first state, which the step before saw with another
            # target.
            checks = np.concatenate([first, rows[starts[k] + 1 : starts[k + 1] + 1]])
            fields = checks_by_name(checks)
            return int(numbers[k]), History(
                **{n: fields[n] for n in History.__dataclass_fields__}
            )

    def contents(self) -> tuple[dict[str, np.ndarray], dict[str, list[str]]]:
        """All datasets by path as they are stored, whatever their schema, and the names of the columns of each."""
        with self.reading():
            arrays = read_arrays(self._group)
            return arrays, {path: self._column_names(path) for path in arrays}


class Shard:
    """A shard open for reading; a context manager. Make one with `open_shard`.

    ``names``: of the episodes, in order of config, seed and index.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._runs: dict[str, RunInfo] = {}
        try:
            stated_length(path)
            # Before h5py opens it: half-changed metadata can crash it.
            refuse_journal(path)
            # Network file systems refuse HDF5's locks, and files are replaced as a whole and never changed.
            self.file = h5py.File(path, "r", locking=False)
            check_format(self.file, path)
            self._episodes = group(self.file, EPISODES)
            # HDF5's order depends on how the file was made.
            self.names = sorted(map(str, self._episodes))
            # A set, because shards hold many thousand names and each access looks one up.
            self._known = frozenset(self.names)
        except UNREADABLE as error:
            self.close()
            raise unreadable(path, error) from error
        except BaseException:
            self.close()
            raise

    @functools.cached_property
    def data_of_runs(self) -> dict[str, dict[str, Any]]:
        """JSON data of each run by name, without those that cannot be read; those of later versions may have more
        entries than a `RunInfo`."""
        runs = group(self.file, RUNS)
        found: dict[str, dict[str, Any]] = {}
        for name in map(str, runs):
            # An episode of a run that cannot be read says so; the others do not need it.
            with suppress(*UNREADABLE):
                found[name] = from_bytes(content(dataset(runs, name)))
        return found

    def run_data(self, name: str) -> dict[str, Any]:
        """JSON data of a run, by its name.

        Raises:
            ValueError: it is missing or cannot be read.
        """
        if name not in self.data_of_runs:
            raise ValueError(f"what made it (its run {name}) is missing or damaged")
        return self.data_of_runs[name]

    def run(self, name: str) -> RunInfo:
        """A run that made episodes, by its name.

        Raises:
            ValueError: it is missing or not what was written.
        """
        if name not in self._runs:
            self._runs[name] = RunInfo.from_dict(self.run_data(name))
        return self._runs[name]

    @functools.cached_property
    def runs(self) -> dict[str, RunInfo]:
        """The runs that made the episodes, by name, without those that are damaged."""
        found: dict[str, RunInfo] = {}
        for name in self.data_of_runs:
            with suppress(ValueError):
                found[name] = self.run(name)
        return found

    def episode(self, name: str) -> RecordedEpisode:
        """One episode by its name.

        Raises:
            UsageError: there is none of that name.
        """
        if name not in self._known:
            raise unknown_name(f"episode in {self.path}", name, self.names[:20])
        return RecordedEpisode(self, name)

    def open_group(self, name: str) -> h5py.Group:
        """The HDF5 group of an episode in ``names``.

        Raises:
            ValueError: it lies in another file.
        """
        # A soft or external link could lead into any file of this machine.
        if not isinstance(self._episodes.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"the episode {name} lies in another file")
        return group(self._episodes, name)

    def __iter__(self) -> Iterator[RecordedEpisode]:
        return (RecordedEpisode(self, name) for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def close(self) -> None:
        """Close the file. Its episodes open it again whenever they are read."""
        if hasattr(self, "file"):
            self.file.close()

    def __enter__(self) -> Shard:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def open_shard(path: Path | str) -> Shard:
    """Open a shard for reading.

    Raises:
        UsageError: the file does not exist, or its schema version is not supported.
        DamagedError: it is not an HDF5 file, not a shard, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise fault(path, "does not exist or is no file; give a shard (*.h5).")
    return Shard(path)
