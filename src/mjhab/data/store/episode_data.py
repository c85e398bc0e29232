"""A finished episode in memory, ready for a shard, and the encoding of JSON data as bytes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjhab.core.files.reading import parse_json
from mjhab.data.store.older.schemas import OLDER_ROBOT
from mjhab.data.store.run_entries import check_entries
from mjhab.data.store.schema import ENDINGS, VERSION, column_widths, problems
from mjhab.rollout.records import EpisodeRecord

_ARRAY = "__array__"
_ARRAY_KINDS = "biuf"
"""Kinds of numpy arrays in JSON data: truths and numbers."""


@dataclass(frozen=True)
class RunInfo:
    """Provenance of an episode, as JSON data. (config, seed, index) identifies an episode.

    config: options of environment and policy that determine an episode together with its seed and index; numbers of
    worlds and threads are not among them. options: those that affect only images and rewards. versions: of engine and
    libraries. commit: of the source, "" if unknown, with "+changes" if files were modified. machine: processor and
    system; bit-exact replay may need the same ones. layout: names and sizes that define the columns of states.
    assets, licence: the asset pack and its licence.
    absent: paths of datasets that the episodes lack because their source had none (imported data).
    """

    config: dict[str, Any]
    options: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    commit: str = ""
    machine: str = ""
    layout: dict[str, Any] = field(default_factory=dict)
    assets: str = "builtin"
    licence: str = ""
    absent: Sequence[str] = ()

    @classmethod
    def from_dict(cls, values: Any) -> RunInfo:
        """Read JSON data; entries that later versions may add are left out.

        Raises:
            ValueError: it is no object, has no config, or an entry has another type than mjhab writes.
        """
        check_entries(values)
        return cls(
            **{name: values[name] for name in cls.__dataclass_fields__ if name in values}
        )

    @property
    def robot(self) -> str:
        """Name of the robot; shards that name none are of `OLDER_ROBOT`."""
        return str(self.layout.get("robot") or OLDER_ROBOT)

    @property
    def config_id(self) -> str:
        """Hash of the config, 8 hexadecimal digits."""
        return _hash(self.config)[:8]

    @property
    def id(self) -> str:
        """Name of the run in a shard, a hash of all fields."""
        return run_id(vars(self))

    @property
    def policy(self) -> str:
        """Name of the policy that acted."""
        return str(self.config.get("policy", {}).get("name", "unknown"))

    def episode_name(self, seed: int, index: int) -> str:
        """Name of the group of an episode."""
        return f"{self.config_id}-{seed}-{index:07d}"


def run_id(values: Mapping[str, Any]) -> str:
    """Name of a run in a shard: a hash of the fields of a `RunInfo` and of any further entries."""
    return f"{_hash(values['config'])[:8]}-{_hash(dict(values))[:8]}"


@dataclass(frozen=True)
class EpisodeData:
    """An episode to store in a shard.

    arrays: every dataset by its path, without ``record``. columns: names of a dataset's columns; "name:n" stands for n
    columns. model: hash of the compiled home. ending: see `schema.ATTRIBUTES`. actors: names that the dataset ``actor``
    indexes; without any, the policy of the run. schema: version of the datasets.

    Raises:
        ValueError: the datasets do not fit the schema or the layout of the run, e.g. not N+1 states for N actions,
            another width of actions, or numbers that are not finite.
    """

    record: EpisodeRecord
    run: RunInfo
    model: str
    ending: str
    arrays: Mapping[str, np.ndarray]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    actors: tuple[str, ...] = ()
    schema: int = VERSION

    def __post_init__(self) -> None:
        if not self.actors:
            # The class is frozen.
            object.__setattr__(self, "actors", (self.run.policy,))
        # The record is encoded when it is written; the schema only asks that it is there.
        arrays = {**self.arrays, "record": np.zeros(1, np.uint8)}
        widths = column_widths(self.run.layout, self.columns)
        wrong = problems(
            arrays,
            self.record.steps,
            schema=self.schema,
            widths=widths,
            absent=self.run.absent,
        )
        wrong = wrong or unnamed_actors(arrays, self.actors)
        wrong += record_problems(self.record)
        wrong += ending_problems(self.ending)
        if wrong:
            raise ValueError(
                f"episode {self.record.index} does not fit the schema: {'; '.join(wrong)}"
            )

    @property
    def name(self) -> str:
        """Name of its group."""
        return self.run.episode_name(self.record.seed, self.record.index)


def unnamed_actors(arrays: Mapping[str, np.ndarray], actors: Sequence[str]) -> list[str]:
    """Describe problems of the dataset ``actor``: an index without a name; empty if there are none."""
    actor = arrays.get("actor", np.zeros(0, np.uint8))
    if not actor.size or int(actor.max()) < len(actors):
        return []
    return [
        f"actor has the number {int(actor.max())}, and there are {len(actors)} names of actors"
    ]


def record_problems(record: EpisodeRecord) -> list[str]:
    """Describe problems of the numbers in a record; empty if there are none."""
    found = []
    if len(record.force) != record.steps:
        found.append(
            f"its record has {len(record.force)} forces, not {record.steps}, one per control step"
        )
    forces = [*record.force, record.peak_force, record.cumulative_force]
    forces += [
        force
        for entry in record.subtasks
        for force in (entry.peak_force, entry.cumulative_force)
    ]
    # JSON has no inf or nan, and filters compare forces.
    if not np.isfinite(forces).all():
        found.append("its record has forces that are not finite")
    for entry in record.subtasks:
        if not 0 <= entry.index < len(record.plan):
            found.append(
                f"its record has subtask {entry.index} of a plan of {len(record.plan)}"
            )
        if not 0 <= entry.start_step <= entry.end_step <= record.steps:
            found.append(
                f"its record has a subtask from step {entry.start_step} to {entry.end_step} of {record.steps}"
            )
    return found


def ending_problems(ending: str) -> list[str]:
    """Describe an ending that is not one of `schema.ENDINGS`; empty if it is one."""
    if ending in ENDINGS:
        return []
    return [f"it ended by {ending[:60]!r}; endings are {', '.join(ENDINGS)}"]


def last_label(record: EpisodeRecord) -> str:
    """Label of the last subtask that ended, "" if none did."""
    return (record.subtasks[-1].label or "") if record.subtasks else ""


def style_text(record: EpisodeRecord) -> str:
    """How the expert was asked to act, as the text of an attribute; "" if nothing was asked."""
    return json.dumps(record.style) if record.style else ""


def episode_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes of all datasets of an episode, including its record."""
    digest = hashlib.sha256()
    # Sorted, because HDF5 may list datasets in another order than they were written.
    for path in sorted(arrays):
        array = np.ascontiguousarray(arrays[path])
        # Type and shape too: equal bytes may be other numbers.
        digest.update(f"{path} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.data)
    return digest.hexdigest()


def record_bytes(record: EpisodeRecord) -> np.ndarray:
    """Encode a record as JSON, (n,) uint8, without the wall time, so that equal episodes have equal bytes."""
    return to_bytes({**record.to_dict(), "seconds": 0.0})


def to_bytes(value: Any) -> np.ndarray:
    """Encode nested dicts and lists of JSON data and numpy arrays as JSON, (n,) uint8, without loss."""
    return np.frombuffer(
        json.dumps(value, default=_plain, separators=(",", ":")).encode(), np.uint8
    )


def from_bytes(data: np.ndarray | bytes) -> Any:
    """Decode the bytes of ``to_bytes``; tuples become lists.

    Raises:
        ValueError: the bytes are not JSON.
    """
    if isinstance(data, np.ndarray):
        if data.dtype != np.uint8:
            raise ValueError(f"JSON data are bytes, not {data.dtype}")
        data = data.tobytes()
    # The hook is called for every object, and records have no arrays to restore.
    return parse_json(data, _restore if _ARRAY.encode() in data else None)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {
            _ARRAY: value.dtype.str,
            "shape": list(value.shape),
            "data": value.ravel().tolist(),
        }
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be kept in a file: {value!r}")


def _restore(value: dict[str, Any]) -> Any:
    if _ARRAY not in value:
        return value
    try:
        dtype = np.dtype(value[_ARRAY])
        # Objects, texts and structures are not among what `to_bytes` writes.
        if dtype.kind not in _ARRAY_KINDS:
            raise ValueError(f"an array holds truths or numbers, not {dtype}")
        return np.array(value["data"], dtype).reshape(value["shape"])
    except (KeyError, TypeError, OverflowError, IndexError, SyntaxError) as error:
        raise ValueError(f"an array is not what was written ({error})") from error


def _hash(value: Any) -> str:
    # Sorted, so that the order in which options were given does not matter.
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
