"""What the commands ``mjhab data ...`` are asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from mjhab.core.errors import UsageError, missing_field, unknown_name, wrong_value
from mjhab.core.typed.bounds import SEED, Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.data.imports.origin import Origin
from mjhab.data.store.packing import SHARD_MB
from mjhab.evaluation.datasets.specs import RecordedSpec, SelectedSpec

IMPORTS = ("ms_hab",)
"""Formats that `mjhab data import` can read."""


@dataclass(frozen=True, kw_only=True)
class QuerySpec(SelectedSpec):
    """Count the recorded episodes that pass a filter, and list them.

    `mjhab data query runs/pick --where "label == 'straightforward_success' and max_force < 1400 and not dropped"`

    Tainted episodes pass only if the filter uses `tainted` or `taints`. Names: `mjhab data fields`.
    """

    list: int = 0
    """Print the first N of them."""


@dataclass(frozen=True, kw_only=True)
class StatsSpec(SelectedSpec):
    """Print labels, success, forces and sizes of recorded episodes, per task, subtask and target."""


@dataclass(frozen=True, kw_only=True)
class ReportSpec(SelectedSpec):
    """Write a report of recorded episodes: labels next to the paper's, films per label, forces. One HTML file."""

    out: Annotated[Path, Flag(metavar="FILE.html"), Output(".html")]
    """The self-contained HTML file to write."""


@dataclass(frozen=True, kw_only=True)
class MergeSpec(SelectedSpec):
    """Copy the episodes that pass a filter into one shard, byte for byte; the sources are not changed.

    `mjhab data merge runs/pick runs/place --preset gentle --out gentle.h5`
    """

    out: Annotated[Path, Flag(metavar="FILE.h5"), Output(".h5")]
    """The shard to make or to extend."""


@dataclass(frozen=True, kw_only=True)
class SplitSpec(RecordedSpec):
    """Divide recorded episodes into shards, one per part; the sources are not changed.

    `mjhab data split runs/pick --parts train=0.9 val=0.1 --by home --out runs/pick_split`

    Raises:
        UsageError: an option is invalid.
    """

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """Output folder; every part becomes <part>.h5 in it."""
    parts: Annotated[tuple[str, ...], Flag(metavar="NAME=SHARE ...")] = (
        "train=0.9",
        "val=0.1",
    )
    """Names and fractions of the parts; their sum is at most 1."""
    by: Annotated[str, Flag(metavar="episode|home|target")] = "episode"
    """Episodes with the same value stay together in one part."""
    seed: Annotated[int, SEED] = 0
    """Seed of the random assignment to parts."""

    def __post_init__(self) -> None:
        from mjhab.data.select.sets import GROUPINGS

        super().__post_init__()
        if self.by not in GROUPINGS:
            raise unknown_name("--by", self.by, GROUPINGS)
        _ = self.shares

    @property
    def shares(self) -> dict[str, float]:
        """The fractions of the parts by name."""
        shares: dict[str, float] = {}
        for word in self.parts:
            name, _, share = word.partition("=")
            try:
                number = float(share)
            except ValueError:
                number = float("nan")
            # NaN is the only number that is not itself.
            if not name or "/" in name or name in shares or number != number:
                raise wrong_value(
                    "parts",
                    word,
                    "names, each once, with shares, as in: train=0.9 val=0.1",
                )
            shares[name] = number
        return shares


@dataclass(frozen=True, kw_only=True)
class PackSpec:
    """Make shards of the episode files of data sets, to share them and to read them faster; the files are deleted.

    `mjhab data pack runs/pick`

    Raises:
        UsageError: an option is invalid.
    """

    folders: Annotated[tuple[Path, ...], Flag(metavar="FOLDER ...", positional=True)]
    """Folders as `mjhab generate` makes them."""
    shard_mb: Annotated[int, Flag(metavar="MB"), Bound(1)] = SHARD_MB
    """Approximate largest size of a shard [MB]."""

    def __post_init__(self) -> None:
        take_options(self)
        if not self.folders:
            raise missing_field(
                "places",
                advice="Name the folders to pack, as in: mjhab data pack runs/pick",
            )


@dataclass(frozen=True, kw_only=True)
class ShardCheckSpec(RecordedSpec):
    """Read recorded episodes completely and compare them with their digests; fails if anything is damaged."""


@dataclass(frozen=True, kw_only=True)
class RepairSpec(RecordedSpec):
    """Repair shards and episode files: complete interrupted writes and drop damaged episodes.

    If episodes are dropped, the damaged file is kept as *.damaged.
    """


@dataclass(frozen=True, kw_only=True)
class ImportSpec:
    """Convert data of another system to shards, so that filters, statistics, reports and training can use them.

    `mjhab data import ms_hab rearrange-dataset/set_table/pick/024_bowl.h5 --out runs/imported`

    ms_hab: files of MS-HAB's data set or generator, one per task, subtask and target, each with its .json beside it.
    They hold no states, so the episodes cannot be replayed, rendered or relabelled. The same command continues an
    interrupted import.

    Raises:
        UsageError: an option is invalid.
    """

    format: Annotated[str, Flag(metavar="ms_hab", positional=True)]
    """Format of the files."""
    files: Annotated[tuple[Path, ...], Flag(metavar="FILE.h5 ...", positional=True)]
    """The files to read."""
    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """The folder of shards; <task>/<subtask>/<name>.h5 in it are made or extended."""
    origin: Origin = field(default_factory=Origin)
    """Task and split of the episodes."""

    def __post_init__(self) -> None:
        take_options(self)
        if self.format not in IMPORTS:
            raise unknown_name("format", self.format, IMPORTS)
        if not self.files:
            raise UsageError(
                "name the files to import, as in: mjhab data import ms_hab 024_bowl.h5 --out runs/imported"
            )
