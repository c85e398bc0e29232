"""``mjhab export ...``: recorded episodes for other tools."""

from __future__ import annotations

import functools

from mjhab.cli.data import read_filter
from mjhab.cli.export_options import ExportLerobotOptions, ExportManiskillOptions
from mjhab.cli.output import late_bar, print_json
from mjhab.core.errors import UsageError
from mjhab.data.export_maniskill import export_maniskill
from mjhab.sim.film import FilmWriter

_KEYFRAMES = 2
"""As LeRobot's own films have them: every frame is quick to reach."""


def run_export(options: ExportLerobotOptions | ExportManiskillOptions) -> int:
    """Run a parsed ``mjhab export`` command; returns the exit code."""
    if isinstance(options, ExportLerobotOptions):
        return _lerobot(options)
    return _maniskill(options)


def _lerobot(options: ExportLerobotOptions) -> int:
    if not 0 <= options.quality <= 51:
        raise UsageError(f"--quality must be 0 to 51, got {options.quality}.")
    try:
        from mjhab.data import export_lerobot as lerobot
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "pyarrow":
            raise
        raise UsageError("LeRobot data sets need pyarrow; install it with: pip install 'mjhab[data]'") from error
    choice = lerobot.Choice(rgb=not options.no_rgb, depth=not options.no_depth)
    open_film = functools.partial(FilmWriter, quality=options.quality, keyframes=_KEYFRAMES)
    with late_bar("exporting") as begin:
        done = lerobot.export_lerobot(
            options.places, options.out, open_film, version=options.version,
            where=read_filter(options.where, options.preset), choice=choice, overwrite=options.overwrite, begin=begin,
        )  # fmt: skip
    if options.json:
        print_json({"episodes": done.episodes, "frames": done.frames, "images": list(done.images)})
        return 0
    images = f"with {', '.join(done.images)}" if done.images else "without images (mjhab replay --render adds them)"
    print(f"{done.episodes} episodes, {done.frames:,} frames, {images}: {options.out}")
    return 0


def _maniskill(options: ExportManiskillOptions) -> int:
    with late_bar("exporting") as begin:
        done = export_maniskill(
            options.places, options.out, where=read_filter(options.where, options.preset),
            overwrite=options.overwrite, begin=begin,
        )  # fmt: skip
    if options.json:
        print_json({"episodes": done.episodes, "frames": done.frames, "files": [str(path) for path in done.files]})
        return 0
    print(f"{done.episodes} episodes, {done.frames:,} frames in {len(done.files)} files: {options.out}")
    if done.without_depth:
        print(
            f"{done.without_depth} of them have no depth images, which MS-HAB's training scripts need; "
            "mjhab replay --render adds them"
        )
    return 0
