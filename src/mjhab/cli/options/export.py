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

    Colour images become videos, depth images [mm] and segmentation become columns. Needs the extra `data` (pyarrow).
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Out
    """Folder of the data set; it is written atomically."""
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
    no_seg: bool = False
    """Leave out segmentation."""
    quality: Annotated[int, tyro.conf.arg(metavar="N")] = 18
    """Constant rate factor of videos: 0 (lossless) to 51 (smallest)."""
    overwrite: bool = False
    """Replace an existing data set."""
    resume: bool = False
    """Continue an interrupted export; options and episodes must be the same."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class ExportManiskillOptions:
    """Write recorded episodes in the format of MS-HAB's data set, one HDF5 file per task, subtask and target.

    `mjhab export maniskill runs/pick --preset pick_paper --out rearrange-dataset`
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    out: Out
    """Folder of the files; it is written atomically."""
    where: Where = None
    """Which episodes; all if absent."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    until: Until = ""
    """How much of an episode: success+N ends it N control steps after its first success; all of it if absent."""
    overwrite: bool = False
    """Replace an existing export."""
    resume: bool = False
    """Continue an interrupted export; options and episodes must be the same."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class ExportCommand:
    """Write recorded episodes in the formats of other tools."""

    command: (
        Annotated[ExportLerobotOptions, Sub("lerobot")]
        | Annotated[ExportManiskillOptions, Sub("maniskill")]
    )
