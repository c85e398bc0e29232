"""The request that all export formats share: which episodes to export, and which folder to write."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mjhab.data.select.query import Filter


@dataclass(frozen=True)
class ExportRequest:
    """Episodes to export, and the folder to write.

    places: shards, or folders of shards. out: the folder; it is written atomically. where: filter on the episodes, None
    takes all. overwrite: replace an existing export. resume: continue an interrupted export; finished episodes are not
    written again.
    """

    places: Path | Sequence[Path]
    out: Path
    where: Filter | None = None
    overwrite: bool = False
    resume: bool = False
