"""Data sets of demonstrations that can be published, made by one command; see `make_dataset`.

demonstrations/<row>/      the episodes that pass the filter, as ``mjhab generate`` records them, packed into shards
failures/<row>.h5          what was tried before the last of them and failed
recoveries/<row>.h5        what was tried and succeeded, but is no demonstration: after a mishap
splits.json, dataset.json  which homes are held out; what is in the set, with the hash of every file
README.md                  the card
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.files.checksums import README
from mjhab.core.files.reading import read_json_object
from mjhab.core.files.run_folder import RunFolder, write_text
from mjhab.data.record.job import TRIED, Standing, read_tried
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import deal, merge, select
from mjhab.data.store.episode_files import EPISODE_FOLDER
from mjhab.data.store.packing import pack
from mjhab.data.store.places import entries, has_shards
from mjhab.evaluation.generate import recorded_value, run_generation
from mjhab.evaluation.publishing.about import (
    ABOUT,
    MAKING,
    SPLITS_FILE,
    SUBSETS,
    describe,
)
from mjhab.evaluation.publishing.card import card
from mjhab.evaluation.publishing.spec import DEMONSTRATIONS, REST, DatasetSpec
from mjhab.evaluation.score.manifest import ScoreRow

CLOCK = ".clock.json"
"""How long the set has taken, over all starts, and which rows are complete."""
VAL = "val"


class SetFolder(RunFolder):
    """The folder of a data set that is made."""

    CONFIG_FILE = MAKING
    RESUMES = False
    FREE_KEYS = frozenset({"per_target", "rows", "episodes", "held_out"})
    WORK = ("*.h5",)


@dataclass(frozen=True)
class MadeDataset:
    """A data set. path: its folder. about: what dataset.json tells; empty while it is not complete.

    short: rows with fewer demonstrations than asked for: how many there are, and how many episodes were tried.
    """

    path: Path
    about: Mapping[str, Any]
    short: Mapping[str, tuple[int, int]]


class _Clock:
    """Time that a set has taken [h], kept in its folder."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / CLOCK
        self.told: dict[str, Any] = {"hours": 0.0, "cpu_hours": 0.0, "rows": {}}
        if self._path.exists():
            self.told |= read_json_object(self._path)
        self._begun = time.perf_counter(), _cpu_seconds()

    def save(self) -> None:
        """Add the time since the last call. Workers on other machines of a Ray cluster have no part in CPU time."""
        now = time.perf_counter(), _cpu_seconds()
        for key, before, after in zip(
            ("hours", "cpu_hours"), self._begun, now, strict=True
        ):
            self.told[key] += (after - before) / 3600
        # Each call adds the time since the last one, so that a kill loses little.
        self._begun = now
        write_text(self._path, json.dumps(self.told))


def _cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended [s]."""
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system


def make_dataset(track: str, *, out: Path | str, **options: Any) -> MadeDataset:
    """Make a data set of demonstrations of a track, as ``mjhab dataset make`` does.

    >>> import mjhab
    >>> made = mjhab.make_dataset(
    ...     "ms_hab_7", rows=("set_table.close.kitchen_counter-drawer3",), per_target=1,
    ...     keep="not success", policy="zero", images="none", out="sets/none",
    ... )
    >>> made.about["episodes"], made.short
    (1, {})

    Args:
        track: "ms_hab_7" or "table1".
        out: folder of the set.
        **options: fields of `DatasetSpec`, and of `EnvConfig` for the homes.

    Raises:
        UsageError: an option is unknown or invalid, or the folder holds other data.
        StorageError: the disk is full; the same call continues.
        MjhabError: a worker failed.
    """
    return run_making(DatasetSpec.of(track, out=out, **options))


def run_making(
    spec: DatasetSpec,
    tell: Callable[[ScoreRow, Standing], object] = lambda row, now: None,
    stopped: Callable[[], bool] = bool,
) -> MadeDataset:
    """Make a data set, or go on with one. What is in it depends neither on workers nor on interruptions.

    Args:
        spec: the set.
        tell: called with the row and its counts whenever they change.
        stopped: as of `run_generation`; the set is then not complete.

    Raises:
        UsageError, StorageError, MjhabError: see `make_dataset`.
    """
    # The command goes on by itself, so that there is no --resume to forget.
    begun = (spec.out / SetFolder.CONFIG_FILE).is_file()
    short: dict[str, tuple[int, int]] = {}
    with SetFolder.open(spec.out, _config(spec), resume=begun):
        clock = _Clock(spec.out)
        for name, row in spec.chosen().items():
            # A larger quota opens finished rows again.
            if clock.told["rows"].get(name) == spec.per_target:
                continue
            made = run_generation(
                spec.generation(row), lambda now, row=row: tell(row, now), stopped
            )
            clock.save()
            if not made.standing.complete:
                return MadeDataset(spec.out, {}, {})
            _divide(spec, row)
            if made.is_short:
                short[name] = made.standing.kept, made.standing.tried
            else:
                clock.told["rows"][name] = spec.per_target
            clock.save()
        # Only when all rows are divided: until then it holds what the next start needs.
        shutil.rmtree(spec.out / REST, ignore_errors=True)
        return MadeDataset(spec.out, _finish(spec, clock), short)


def _config(spec: DatasetSpec) -> dict[str, Any]:
    asked = spec.asked
    kept = ("track", "keep", "until", "failures", "images", "camera_size", "rgb")
    config = {name: getattr(spec, name) for name in (*kept, *sorted(SetFolder.FREE_KEYS))}
    if spec.recoveries:
        config["recoveries"] = spec.recoveries
    config |= {"policy": str(spec.policy), "style": list(spec.style)}
    named = ("profile", "assets", "seed", "randomise")
    return config | {name: recorded_value(asked, name) for name in named}


def _divide(spec: DatasetSpec, row: ScoreRow) -> None:
    """Put what is no demonstration of a row into its subsets, and pack the demonstrations.

    Which episodes were tried after the last demonstration depends on the number of workers: they are dropped, and
    a set that is made larger tries them again.
    """
    folder = spec.folder(row)
    last = max((entry.record.index for entry in entries(folder)), default=-1)
    rest = spec.rest(row)
    if has_shards(rest):
        for subset, filter_text in SUBSETS.items():
            where = Filter(f"{filter_text} and index <= {last}")
            # A shard without episodes would be refused by its readers.
            if select([rest], where).matched:
                merge([rest], spec.out / subset / f"{row.name}.h5", where)
    if spec.failures:
        tried = [
            outcome for outcome in read_tried(folder / TRIED) if outcome.index <= last
        ]
        lines = (json.dumps(each.to_dict(), separators=(",", ":")) for each in tried)
        write_text(folder / TRIED, "".join(f"{line}\n" for line in lines))
    shutil.rmtree(rest, ignore_errors=True)
    if (folder / EPISODE_FOLDER).is_dir():
        pack(folder, spec.shard_mb)


def _finish(spec: DatasetSpec, clock: _Clock) -> dict[str, Any]:
    """Write splits, description and card of a set whose rows are complete; returns the description."""
    splits = _splits(spec.out / DEMONSTRATIONS, spec.held_out)
    write_text(spec.out / SPLITS_FILE, json.dumps(splits, indent=2) + "\n")
    about = describe(spec, splits, clock.told)
    write_text(spec.out / ABOUT, json.dumps(about, indent=2) + "\n")
    write_text(spec.out / README, card(about))
    return about


def _splits(folder: Path, held_out: float) -> dict[str, Any]:
    """Homes and numbers of episodes of the splits train and val: no home is in both.

    Homes of the benchmark's own splits val and test are in neither, since demonstrations are made in those of train.
    """
    homes: dict[str, list[tuple[Path, str]]] = defaultdict(list)
    for entry in entries(folder):
        homes[entry.record.home].append((entry.path, entry.name))
    sizes = Counter({home: len(found) for home, found in homes.items()})
    chosen: set[str] = set()
    if held_out and len(homes) > 1:
        taken = set(deal(homes, {VAL: held_out}, 0)[VAL])
        chosen = {home for home, found in homes.items() if taken.issuperset(found)}
    if len(chosen) == len(homes):
        # With all homes held out nothing would be left to train on; the name breaks ties.
        chosen.remove(max(chosen, key=lambda home: (sizes[home], home)))
    parts = {VAL: sorted(chosen), "train": sorted(set(homes) - chosen)}
    return {
        "by": "home",
        **{
            part: {
                "homes": names,
                "episodes": int(np.sum([sizes[home] for home in names])),
            }
            for part, names in sorted(parts.items())
        },
    }
