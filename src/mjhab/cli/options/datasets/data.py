"""The options of ``mjhab data``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

Sub = tyro.conf.subcommand
Places = Annotated[
    tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE|FOLDER ...")
]
Where = Annotated[str | None, tyro.conf.arg(metavar="FILTER")]
Preset = Annotated[str | None, tyro.conf.arg(metavar="NAME")]


@dataclass(frozen=True)
class DataQueryOptions:
    """Count the recorded episodes that pass a filter, and list them.

    `mjhab data query runs/pick --where "label == 'straightforward_success' and max_force < 1400 and not dropped"`

    Tainted episodes pass only if the filter uses `tainted` or `taints`. Names: `mjhab data fields`.
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    where: Where = None
    """Which episodes; all if absent."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`; with --where, both must hold."""
    list: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Print the first N of them."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class DataFieldsOptions:
    """Print the names that filters can use, with their meanings, and the predefined filters."""

    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class DataStatsOptions:
    """Print labels, success, forces and sizes of recorded episodes, per task, subtask and target."""

    places: Places
    """Shards (*.h5) or folders of shards."""
    where: Where = None
    """Only these episodes, as in `mjhab data query`."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class DataMergeOptions:
    """Copy the episodes that pass a filter into one shard, byte for byte; the sources are not changed.

    `mjhab data merge runs/pick runs/place --preset gentle --out gentle.h5`
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.h5")]
    """The shard to make or to extend."""
    where: Where = None
    """Which episodes; all if absent."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class DataSplitOptions:
    """Divide recorded episodes into shards, one per part; the sources are not changed.

    `mjhab data split runs/pick --parts train=0.9 val=0.1 --by home --out runs/pick_split`
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Output folder; every part becomes <part>.h5 in it."""
    parts: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=SHARE ...")] = (
        "train=0.9",
        "val=0.1",
    )
    """Names and fractions of the parts; their sum is at most 1."""
    by: Annotated[str, tyro.conf.arg(metavar="episode|home|target")] = "episode"
    """Episodes with the same value stay together in one part."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Seed of the random assignment to parts."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class DataPackOptions:
    """Make shards of the episode files of data sets, to share them and to read them faster; the files are deleted.

    `mjhab data pack runs/pick`
    """

    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FOLDER ...")
    ]
    """Folders as `mjhab generate` makes them."""
    shard_mb: Annotated[int, tyro.conf.arg(metavar="MB")] = 512
    """Approximate largest size of a shard [MB]."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class DataCheckOptions:
    """Read recorded episodes completely and compare them with their digests; fails if anything is damaged."""

    places: Places
    """Shards (*.h5) or folders of shards."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class DataRepairOptions:
    """Repair shards and episode files: complete interrupted writes and drop damaged episodes.

    If episodes are dropped, the damaged file is kept as *.damaged.
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class DataReportOptions:
    """Write a report of recorded episodes: labels next to the paper's, films per label, forces. One HTML file."""

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.html")]
    """The self-contained HTML file to write."""
    where: Where = None
    """Only these episodes, as in `mjhab data query`."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class DataImportOptions:
    """Convert data of another system to shards, so that filters, statistics, reports and training can use them.

    `mjhab data import ms_hab rearrange-dataset/set_table/pick/024_bowl.h5 --out runs/imported`

    ms_hab: files of MS-HAB's data set or generator, one per task, subtask and target, each with its .json beside it.
    They hold no states, so the episodes cannot be replayed, rendered or relabelled. The same command continues an
    interrupted import.
    """

    format: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ms_hab")]
    """Format of the files."""
    files: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE.h5 ...")
    ]
    """The files to read."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """The folder of shards; <task>/<subtask>/<name>.h5 in it are made or extended."""
    task: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Task of the files; the folder above that of the subtask if absent."""
    split: Annotated[str, tyro.conf.arg(metavar="train|val|test")] = "train"
    """Split of the homes, if the files do not contain it; the published data are of train."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class DataCommand:
    """Query, count, report, merge, split, pack, import, check or repair recorded episodes."""

    command: (
        Annotated[DataQueryOptions, Sub("query")]
        | Annotated[DataStatsOptions, Sub("stats")]
        | Annotated[DataReportOptions, Sub("report")]
        | Annotated[DataMergeOptions, Sub("merge")]
        | Annotated[DataSplitOptions, Sub("split")]
        | Annotated[DataPackOptions, Sub("pack")]
        | Annotated[DataImportOptions, Sub("import")]
        | Annotated[DataCheckOptions, Sub("check")]
        | Annotated[DataRepairOptions, Sub("repair")]
        | Annotated[DataFieldsOptions, Sub("fields")]
    )
