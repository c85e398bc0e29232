"""Exports with all options as keyword arguments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjhab.data.export.lerobot.export import Exported, write_lerobot
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.export.maniskill import ManiSkillSet, write_maniskill
from mjhab.data.export.request import ExportRequest

REQUEST_FIELDS = ("where", "overwrite", "resume")


def to_lerobot(
    places: Path | Sequence[Path], out: Path, films: FilmTools, **options: Any
) -> Exported:
    return write_lerobot(_request(places, out, options), films, **options)


def to_maniskill(
    places: Path | Sequence[Path], out: Path, **options: Any
) -> ManiSkillSet:
    return write_maniskill(_request(places, out, options), **options)


def _request(
    places: Path | Sequence[Path], out: Path, options: dict[str, Any]
) -> ExportRequest:
    """Take the options of a request out of ``options``."""
    own = {name: options.pop(name) for name in REQUEST_FIELDS if name in options}
    return ExportRequest(places, out, **own)
