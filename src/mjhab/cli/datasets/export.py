"""``mjhab export ...``: recorded episodes for other tools."""

from __future__ import annotations

import functools
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from mjhab.cli.datasets.data import read_filter
from mjhab.cli.options.datasets.export import ExportLerobotOptions, ExportManiskillOptions
from mjhab.cli.output import print_json
from mjhab.core.errors import UsageError
from mjhab.core.machine import install_extra
from mjhab.core.progress import late_bar
from mjhab.data.export.maniskill import export_maniskill
from mjhab.data.export.request import ExportRequest
from mjhab.data.select.until import Until
from mjhab.render.film import FilmWriter, join_films

_KEYFRAMES = 2
"""Frames per keyframe, as in LeRobot's own videos; it makes random access fast."""


def run_export(options: ExportLerobotOptions | ExportManiskillOptions) -> int:
    """Run a parsed ``mjhab export`` command; returns 0, or 130 after Ctrl-C or SIGTERM."""
    try:
        with _interrupted_by_sigterm():
            return (
                _lerobot(options)
                if isinstance(options, ExportLerobotOptions)
                else _maniskill(options)
            )
    except KeyboardInterrupt:
        print(
            f"mjhab: stopped; finished parts of {options.out} are kept. The same command with --resume continues.",
            file=sys.stderr,
        )
        return 130


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """Within this context SIGTERM has the effect of Ctrl-C."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _request(options: ExportLerobotOptions | ExportManiskillOptions) -> ExportRequest:
    return ExportRequest(
        options.places,
        options.out,
        read_filter(options.where, options.preset),
        options.overwrite,
        options.resume,
    )


def _lerobot(options: ExportLerobotOptions) -> int:
    if not 0 <= options.quality <= 51:
        raise UsageError(f"--quality must be 0 to 51, got {options.quality}.")
    try:
        from mjhab.data.export.lerobot.export import export_lerobot
        from mjhab.data.export.lerobot.features import Choice
        from mjhab.data.export.lerobot.pieces import FilmTools
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "pyarrow":
            raise
        raise UsageError(
            f"LeRobot data sets need pyarrow; install it with: {install_extra('data')}"
        ) from error
    choice = Choice(
        not options.no_rgb, not options.no_depth, not options.no_seg, options.until
    )
    films = FilmTools(
        functools.partial(FilmWriter, quality=options.quality, keyframes=_KEYFRAMES),
        join_films,
        {"quality": options.quality},
    )
    with late_bar("exporting") as begin:
        done = export_lerobot(
            _request(options), films, version=options.version, choice=choice, begin=begin
        )
    if options.json:
        print_json(
            {
                "episodes": done.episodes,
                "frames": done.frames,
                "images": list(done.images),
            }
        )
        return 0
    images = (
        f"with {', '.join(done.images)}"
        if done.images
        else "without images (mjhab replay --render adds them)"
    )
    print(f"{done.episodes} episodes, {done.frames:,} frames, {images}: {options.out}")
    return 0


def _maniskill(options: ExportManiskillOptions) -> int:
    with late_bar("exporting") as begin:
        done = export_maniskill(
            _request(options), until=Until.parse(options.until), begin=begin
        )
    if options.json:
        print_json(
            {
                "episodes": done.episodes,
                "frames": done.frames,
                "files": [str(path) for path in done.files],
            }
        )
        return 0
    print(
        f"{done.episodes} episodes, {done.frames:,} frames in {len(done.files)} files: {options.out}"
    )
    if done.without_depth:
        print(
            f"{done.without_depth} of them have no depth images, which MS-HAB's training scripts need; "
            "mjhab replay --render adds them"
        )
    return 0
