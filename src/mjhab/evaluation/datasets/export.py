"""Export: recorded episodes for other tools.

`export_lerobot` and `export_maniskill` are those of `mjhab`; ``mjhab export`` calls `run_export`. All do the same.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.core.libraries import missing_library
from mjhab.core.machine import install_extra
from mjhab.data.export.maniskill import ManiSkillSet, write_maniskill
from mjhab.data.export.outside import Outside
from mjhab.data.export.request import ExportRequest
from mjhab.data.select.until import Until
from mjhab.evaluation.datasets.actions import base_height, converted, converted_columns
from mjhab.evaluation.datasets.roots import roots_of
from mjhab.evaluation.datasets.specs import (
    ExportSpec,
    LerobotSpec,
    ManiskillSpec,
    PlacesLike,
)
from mjhab.render.film import FilmWriter, join_films

if TYPE_CHECKING:
    from mjhab.data.export.lerobot.export import Exported

KEYFRAMES = 2
"""Frames per keyframe, as in LeRobot's own videos; it makes random access fast."""
Begin = Callable[[int], Callable[[], object]]
"""Called with the number of episodes to export; gives a function that is called after each."""


def export_lerobot(
    path: PlacesLike, out: str | PathLike[str], **options: Any
) -> Exported:
    """Write recorded episodes as a LeRobot data set, as ``mjhab export lerobot`` does. Needs the extra ``data``.

    >>> import mjhab
    >>> made = mjhab.generate("zero", subtask="close", episodes=2, horizon=5, out="runs/close")
    >>> done = mjhab.export_lerobot("runs/close", "exported/close", where="index < 1")
    >>> done.episodes, done.frames, done.images
    (1, 5, ())

    Args:
        path: a shard, a folder of shards, or several of them.
        out: the folder to write; it is written atomically.
        **options: fields of `LerobotSpec`, such as ``where``, ``until``, ``depth=False``.

    Returns:
        What was written: numbers of episodes and frames, names of videos and depth columns.

    Raises:
        UsageError: an option is unknown or invalid, no episode passes the filter, the folder exists, pyarrow is not
            installed, or episodes differ in their features.
        StorageError: the disk is full; the same call with ``resume=True`` continues.
        DamagedError: an episode is damaged, or holds numbers that are not finite.
    """
    return run_lerobot(LerobotSpec.of(path, out=out, **options))


def export_maniskill(
    path: PlacesLike, out: str | PathLike[str], **options: Any
) -> ManiSkillSet:
    """Write recorded episodes in the format of MS-HAB's data set, as ``mjhab export maniskill`` does.

    >>> import mjhab
    >>> made = mjhab.generate("zero", subtask="close", episodes=1, horizon=5, out="runs/close")
    >>> done = mjhab.export_maniskill("runs/close", "exported/rearrange")
    >>> print(done.files[0].name)
    kitchen_counter.h5

    Args:
        path: a shard, a folder of shards, or several of them.
        out: the folder to write; it is written atomically.
        **options: fields of `ManiskillSpec`, such as ``where``, ``until``, ``overwrite``.

    Returns:
        What was written: numbers of episodes and frames, the files.

    Raises:
        UsageError: an option is unknown or invalid, no episode passes the filter, or the folder exists.
        StorageError: the disk is full; the same call with ``resume=True`` continues.
        DamagedError: an episode is damaged, or holds numbers that are not finite.
    """
    return run_maniskill(ManiskillSpec.of(path, out=out, **options))


def run_lerobot(spec: LerobotSpec, begin: Begin | None = None) -> Exported:
    """Write a LeRobot data set.

    Args:
        spec: the episodes and the folder.
        begin: told of the episodes, see `Begin`.

    Raises:
        UsageError, StorageError, DamagedError: see `export_lerobot`.
    """
    try:
        from mjhab.data.export.lerobot.export import write_lerobot
        from mjhab.data.export.lerobot.features import Choice
        from mjhab.data.export.lerobot.parts import FilmTools
    except ModuleNotFoundError as error:
        # Another missing module is a fault of ours and keeps its trace.
        if error.name is None or error.name.partition(".")[0] != "pyarrow":
            raise
        raise missing_library(
            "a LeRobot data set", ("pyarrow",), install_extra("data")
        ) from error
    films = FilmTools(
        functools.partial(FilmWriter, quality=spec.quality, keyframes=KEYFRAMES),
        join_films,
        {"quality": spec.quality},
        film_frames,
    )
    choice = Choice(
        spec.rgb,
        spec.depth,
        spec.seg,
        spec.until,
        spec.colours,
        spec.points,
        spec.state,
        spec.actions,
        spec.language,
        spec.held_out(),
    )
    return write_lerobot(
        _request(spec),
        films,
        version=spec.version,
        choice=choice,
        outside=Outside(converted, converted_columns, base_height),
        begin=begin,
    )


def run_maniskill(spec: ManiskillSpec, begin: Begin | None = None) -> ManiSkillSet:
    """Write trajectory files of MS-HAB.

    Args:
        spec: the episodes and the folder.
        begin: told of the episodes, see `Begin`.

    Raises:
        UsageError, StorageError, DamagedError: see `export_maniskill`.
    """
    until = Until.parse(spec.until)
    return write_maniskill(
        _request(spec),
        until=until,
        begin=begin,
        roots=roots_of,
        points=spec.points,
        outside=Outside(base_height=base_height),
    )


def film_frames(path: Path) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) uint8 of a video file, as a reader decodes them."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    for frame in reader:
        yield np.frombuffer(frame, np.uint8).reshape(height, width, 3)


def _request(spec: ExportSpec) -> ExportRequest:
    return ExportRequest(
        spec.places, spec.out, spec.filter(), spec.overwrite, spec.resume
    )
