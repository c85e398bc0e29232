"""Exports with all options as keyword arguments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjhab.data.export.lerobot.export import Exported, write_lerobot
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.export.maniskill import ManiSkillSet, write_maniskill
from mjhab.data.export.request import ExportRequest
from mjhab.data.store.reading import RecordedEpisode
from mjhab.rollout.records import Event

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


def from_nothing(episode: RecordedEpisode) -> list[Event]:
    """Events of a Pick as MS-HAB counts them: nothing held before the first action."""
    now = {name: bool(rows[1]) for name, rows in episode.table("signals/checks").items()}
    held = {
        "contact": now["contact"],
        "grasped": now["is_grasped"],
        "success": now["success"],
        "excessive_collisions": not now["force_ok"],
    }
    later = [event for event in episode.record.events if event[0] > 1]
    return [(1, name) for name, holds in held.items() if holds] + later
