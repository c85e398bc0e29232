"""The options of ``mjhab export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.data import Places, Preset, Sub, Until, Where

Out = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True)
class ExportLerobotOptions:
    """Write recorded episodes as a LeRobot data set: parquet, mp4 and meta.

    `mjhab export lerobot runs/pick --preset pick_paper --out exported/pick`

    Colour images become films, depth images columns of millimetres. Needs the extra `data` (pyarrow).
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Out
    """The data set to make; it appears whole or not at all."""
    version: Annotated[str, tyro.conf.arg(metavar="3.0|2.1")] = "3.0"
    """Version of the format."""
    where: Where = None
    """Which episodes; all if absent."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    until: Until = ""
    """How much of an episode: success+N ends it N control steps after its first success; all of it if absent."""
    no_rgb: bool = False
    """Leave out colour images."""
    no_depth: bool = False
    """Leave out depth images, which are by far the largest part."""
    quality: Annotated[int, tyro.conf.arg(metavar="N")] = 18
    """Films: 0 (without loss) to 51 (small)."""
    overwrite: bool = False
    """Take the place of a data set that is there."""
    resume: bool = False
    """Go on with an export that was stopped; with the same options and episodes."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class ExportManiskillOptions:
    """Write recorded episodes in the layout of MS-HAB's own data set, one HDF5 file per task, subtask and target.

    `mjhab export maniskill runs/pick --preset pick_paper --out rearrange-dataset`
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Out
    """The folder to make; it appears whole or not at all."""
    where: Where = None
    """Which episodes; all if absent."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    until: Until = ""
    """How much of an episode: success+N ends it N control steps after its first success; all of it if absent."""
    overwrite: bool = False
    """Take the place of an export that is there."""
    resume: bool = False
    """Go on with an export that was stopped; with the same options and episodes."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class ExportCommand:
    """Write recorded episodes in the formats of other tools."""

    command: (
        Annotated[ExportLerobotOptions, Sub("lerobot")]
        | Annotated[ExportManiskillOptions, Sub("maniskill")]
    )
