"""Operations on whole data sets: select, count, merge, split."""

from __future__ import annotations

import hashlib
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import UsageError, fault, wrong_value
from mjhab.core.files.locking import WriteLock
from mjhab.core.names import below, check_name
from mjhab.data.select.facts import target_of
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.episode_files import EpisodeEntry
from mjhab.data.store.places import Place, entries, shard_paths
from mjhab.data.store.storage import broken
from mjhab.data.store.writing import write_shard
from mjhab.rollout.records import EpisodeRecord

GROUPINGS: dict[str, Callable[[EpisodeEntry], str]] = {
    "episode": lambda episode: episode.name,
    "home": lambda episode: episode.record.home,
    # By the object or link, so that none of the test split's was seen in training.
    "target": lambda episode: target_of(episode.record),
}
"""Groupings by name: episodes of a group stay together when a data set is split."""


@dataclass
class Selection:
    """Episodes that pass a filter.

    matched, records, runs, digests: location, record, run and content digest of each. of: number of all episodes.
    tainted: number of episodes that were excluded only because they are tainted.
    """

    matched: list[Place] = field(default_factory=list)
    records: list[EpisodeRecord] = field(default_factory=list)
    runs: list[RunInfo] = field(default_factory=list)
    digests: list[str] = field(default_factory=list)
    of: int = 0
    tainted: int = 0

    @property
    def fingerprint(self) -> str:
        """Hash of the names, contents and order of the episodes."""
        lines = (
            f"{name} {digest}\n"
            for (_, name), digest in zip(self.matched, self.digests, strict=True)
        )
        return f"{len(self.matched)} of {hashlib.sha256(''.join(lines).encode()).hexdigest()[:16]}"


def first_of_targets(found: Selection, count: int) -> list[Place]:
    """The ``count`` selected episodes of every target with the lowest indices, in the order of ``found.matched``."""
    taken: Counter[str] = Counter()
    kept: set[Place] = set()
    pairs = zip(found.matched, found.records, strict=True)
    # By index and name, so that the choice does not depend on the order of the files.
    for place, record in sorted(pairs, key=lambda pair: (pair[1].index, pair[0][1])):
        target = target_of(record)
        if taken[target] < count:
            taken[target] += 1
            kept.add(place)
    # In the order of the files, so that each is read once.
    return [place for place in found.matched if place in kept]


def select(
    places: Path | Sequence[Path], where: Filter | None = None, copies: bool = False
) -> Selection:
    """Apply a filter to every episode; without a filter all pass. ``copies``: see `places.episodes`.

    Raises:
        UsageError, DamagedError: see ``open_shard`` and `places.episodes`.
    """
    found = Selection()
    for episode in entries(places, copies):
        found.of += 1
        record = episode.record
        run = episode.run
        if where is None or where(record, run):
            found.matched.append((episode.path, episode.name))
            found.records.append(record)
            found.runs.append(run)
            found.digests.append(episode.digest)
        # Counted, so that a message can say why fewer pass than the filter suggests.
        elif record.taint and not where.lets_taint_in and where.holds(record, run):
            found.tainted += 1
    return found


def nothing_passes() -> UsageError:
    """Make the error for a filter that no episode passes."""
    return UsageError(
        "no episode passes the filter; inspect the data with: mjhab data stats"
    )


def stats(places: Path | Sequence[Path], where: Filter | None = None) -> dict[str, Any]:
    """Statistics of a data set as JSON data: totals, and one row per task, subtask and target.

    Forces are the peak forces of the episodes [N]: median, 95th percentile, maximum.
    """
    paths = shard_paths(places)
    found = select(paths, where)
    rows: dict[tuple[str, str, str], list[EpisodeRecord]] = defaultdict(list)
    for record in found.records:
        target = target_of(record) if record.subtask else "all"
        rows[record.task, record.subtask or "chain", target].append(record)
    # Estimated from the file sizes, because HDF5 does not report the size of a group with its metadata.
    size = sum(path.stat().st_size for path in paths)
    return {
        "shards": len(paths),
        "of": found.of,
        "bytes": size,
        "bytes_per_episode": round(size / found.of) if found.of else 0,
        **_numbers(found.records),
        "rows": [
            {"task": task, "subtask": subtask, "target": target, **_numbers(records)}
            for (task, subtask, target), records in sorted(rows.items())
        ],
    }


def _numbers(records: Sequence[EpisodeRecord]) -> dict[str, Any]:
    labels = Counter(entry.label or "" for record in records for entry in record.subtasks)
    # numpy has no percentile of nothing.
    forces = [record.peak_force for record in records] or [0.0]
    fingers = [record.peak_finger_force for record in records]
    count = max(len(records), 1)
    return {
        "episodes": len(records),
        "steps": sum(record.steps for record in records),
        "success_once": sum(record.success_once for record in records) / count,
        "tainted": sum(bool(record.taint) for record in records),
        "labels": dict(labels.most_common()),
        "max_force": _spread(forces),
        "max_finger_force": _spread([force for force in fingers if force is not None]),
    }


def _spread(forces: Sequence[float]) -> dict[str, float | None]:
    """Median, 95th percentile and largest of forces [N]; None where there is none (older recordings)."""
    if not forces:
        return {"median": None, "p95": None, "max": None}
    return {
        "median": round(float(np.median(forces)), 1),
        "p95": round(float(np.percentile(forces, 95)), 1),
        "max": round(float(np.max(forces)), 1),
    }


@dataclass(frozen=True)
class Merged:
    """Numbers of episodes written, left out by the filter, and repeated (identical copies)."""

    written: int
    left_out: int
    repeated: int


def merge(places: Sequence[Path], out: Path, where: Filter | None = None) -> Merged:
    """Copy the episodes that pass into one shard, which is made or extended. After an interruption it is as before.

    Raises:
        UsageError: ``out`` is or lies in one of the sources; or an episode occurs twice with different contents.
    """
    if any(path.resolve() == out.resolve() for path in shard_paths(places)):
        raise wrong_value("out", str(out), "a new file, not one of the shards to merge")
    check_outside(places, out)
    # Copies are compared below, where a selection would refuse them.
    found = select(places, where, copies=True)
    present = {e.name: e.digest for e in entries(out)} if out.exists() else {}
    digests = dict(present)
    new: list[Place] = []
    for (path, name), digest in zip(found.matched, found.digests, strict=True):
        known = digests.get(name)
        if known is None:
            digests[name] = digest
            new.append((path, name))
        # The same identity with other bytes: one of them was made by other code, and neither can be preferred.
        elif known != digest:
            raise fault(
                f"episode {name} of {path}",
                "differs from one of the same config, seed and index that was "
                "merged before it; leave one of the two sources out.",
            )
    with _writing(out):
        # An identical file is not written again.
        if new or not present:
            write_shard(
                # The new file is beside the old one until it is whole, so that the old one can be a source.
                out,
                {**({out: sorted(present)} if present else {}), **by_file(new)},
            )
    repeated = len(found.matched) - len(new)
    return Merged(len(new), found.of - len(found.matched), repeated)


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    """Lock a file to write.

    Raises:
        UsageError: another process writes it.
        StorageError: the disk is full or broken.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with WriteLock(out):
            yield
    except OSError as error:
        raise broken(out, error) from error


def check_outside(places: Path | Sequence[Path], out: Path) -> None:
    """Refuse to write HDF5 files below a source: later commands would read them as shards of it.

    Raises:
        UsageError: names both.
    """
    for place in [places] if isinstance(places, Path) else places:
        # Resolved, because a link may lead into the source.
        if place.is_dir() and out.resolve().is_relative_to(place.resolve()):
            raise wrong_value(
                "out",
                str(out),
                f"outside of {place}, of which every *.h5 is read as a shard",
            )


def split(
    places: Sequence[Path],
    out: Path,
    parts: Mapping[str, float],
    by: str = "episode",
    seed: int = 0,
) -> dict[str, int]:
    """Divide a data set into shards ``out/<part>.h5``; returns the number of episodes in each.

    Groups (see GROUPINGS) are ordered by a hash of their name and ``seed`` and assigned in turn until each part has its
    share. Groups are never divided, so the shares are approximate if there are few groups.

    Raises:
        UsageError: shares are not positive or their sum exceeds 1; a part has an invalid name or exists; an episode
            occurs twice; or ``out`` lies in a source.
    """
    # 0.7 + 0.2 + 0.1 is a bit more than 1 in binary.
    if not parts or min(parts.values()) <= 0 or ordered_sum(parts.values()) > 1 + 1e-9:
        raise wrong_value("shares", dict(parts), "positive, with a sum of at most 1")
    try:
        targets = {
            name: below(out, f"{check_name('name of a part', name)}.h5") for name in parts
        }
    except ValueError as error:
        raise UsageError(str(error)) from error
    for path in targets.values():
        if path.exists():
            raise fault(path, "exists already; give an empty folder as --out.")
    check_outside(places, out)
    groups: dict[str, list[Place]] = defaultdict(list)
    for episode in entries(places):
        groups[GROUPINGS[by](episode)].append((episode.path, episode.name))
    dealt = deal(groups, parts, seed)
    _write_parts({path: dealt[part] for part, path in targets.items()})
    return {part: len(dealt[part]) for part in parts}


def _write_parts(dealt: Mapping[Path, Sequence[Place]]) -> None:
    """Write shards under hidden names, which no command reads, and rename them when all are complete."""
    hidden = {path: path.with_name(f".{path.name}") for path in dealt}
    try:
        for path, members in dealt.items():
            with _writing(path):
                write_shard(hidden[path], by_file(members))
        for path in dealt:
            # Only when all are whole: a split of which a part is missing would be read as a smaller one.
            os.replace(hidden[path], path)
    finally:
        for path in hidden.values():
            path.unlink(missing_ok=True)


def deal(
    groups: Mapping[str, list[Place]], parts: Mapping[str, float], seed: int
) -> dict[str, list[Place]]:
    order = sorted(
        # A hash, so that a group keeps its place when others are added.
        groups,
        key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest(),
    )
    total = sum(map(len, groups.values()))
    dealt: dict[str, list[Place]] = {part: [] for part in parts}
    waiting = iter(order)
    reached = 0
    due = 0.0
    for part, share in parts.items():
        due += share * total
        # Shares add up before they are rounded, so that no part gets the rounding of all.
        while reached < round(due) and (name := next(waiting, None)) is not None:
            dealt[part] += groups[name]
            reached += len(groups[name])
    return dealt


def by_file(members: Sequence[Place]) -> dict[Path, list[str]]:
    """Names of episodes by their file."""
    files: dict[Path, list[str]] = defaultdict(list)
    for path, name in members:
        files[path].append(name)
    return files
