"""``mjhab export ...``: recorded episodes for other tools."""

from __future__ import annotations

from mjhab.cli.exits import stopped
from mjhab.cli.output import report
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.core.progress import late_bar
from mjhab.evaluation.datasets.export import run_lerobot, run_maniskill
from mjhab.evaluation.datasets.specs import ExportSpec, LerobotSpec, ManiskillSpec


def run_export(spec: ExportSpec, json: bool) -> int:
    """Run a parsed ``mjhab export`` command; returns 0, or 130 after Ctrl-C or SIGTERM."""
    try:
        with sigterm_interrupts():
            if isinstance(spec, LerobotSpec):
                return _lerobot(spec, json)
            assert isinstance(spec, ManiskillSpec)
            return _maniskill(spec, json)
    except KeyboardInterrupt:
        return stopped(f"finished parts of {spec.out} are kept")


def _lerobot(spec: LerobotSpec, json: bool) -> int:
    with late_bar("exporting") as begin:
        done = run_lerobot(spec, begin)
    images = (
        f"with {', '.join(done.images)}"
        if done.images
        else "without images (mjhab replay --render adds them)"
    )
    report(
        json,
        {**vars(done), "images": list(done.images)},
        f"{done.episodes} episodes, {done.frames:,} frames, {images}: {spec.out}",
    )
    return 0


def _maniskill(spec: ManiskillSpec, json: bool) -> int:
    with late_bar("exporting") as begin:
        done = run_maniskill(spec, begin)
    files = [str(path) for path in done.files]
    report(
        json,
        {"episodes": done.episodes, "frames": done.frames, "files": files},
        f"{done.episodes} episodes, {done.frames:,} frames in {len(files)} files: {spec.out}",
        f"{done.without_depth} of them have no depth images, which MS-HAB's training scripts need; "
        "mjhab replay --render adds them"
        if done.without_depth
        else "",
    )
    return 0
