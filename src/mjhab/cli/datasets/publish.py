"""``mjhab dataset ...``: data sets that can be published."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from rich.progress import TaskID

from mjhab.cli.exits import stopped
from mjhab.cli.output import Listing, report
from mjhab.core.files.interrupts import stop_signals
from mjhab.core.progress import say, work_bar
from mjhab.data.record.job import Standing
from mjhab.evaluation.publishing.check import check_set
from mjhab.evaluation.publishing.make import run_making
from mjhab.evaluation.publishing.spec import DatasetCheckSpec, DatasetSpec
from mjhab.evaluation.score.manifest import ScoreRow

_TOLD = ("episodes", "frames", "gb", "hours", "cpu_hours", "per_target")


def run_make(spec: DatasetSpec, json: bool) -> int:
    """Run the command; returns 0, 130 after Ctrl-C or SIGTERM, or 1 if a target has too few demonstrations."""
    if not spec.workers:
        # A process of its own can be stopped in the middle of an episode.
        spec = dataclasses.replace(spec, workers=1)
    with stop_signals() as is_stopped, _progress(spec) as tell:
        made = run_making(spec, tell, is_stopped)
    # The card is written at the very end, so without it the work was stopped.
    if not made.about:
        # Making goes on by itself, so no --resume is named.
        return stopped(f"finished episodes are kept in {made.path}", again="")
    for name, (kept, tried) in made.short.items():
        say(
            f"mjhab: {name}: only {kept} demonstrations among {tried} episodes that were tried. A larger --episodes "
            "tries more."
        )
    about: dict[str, Any] = dict(made.about)
    rows = [(name, *each.values()) for name, each in about["per_target"].items()]
    columns = ("target", "demonstrations", "frames", "failures", "recoveries")
    report(
        json,
        {key: about[key] for key in _TOLD},
        Listing(f"Data set {made.path}", columns, rows),
        f"{about['episodes']} demonstrations, {about['frames']:,} frames, {about['gb']} GB in {about['hours']} hours "
        f"({about['cpu_hours']} CPU hours); card: {made.path / 'README.md'}",
    )
    return 1 if made.short else 0


def run_check(spec: DatasetCheckSpec, json: bool) -> int:
    """Compare the files of a set with its list; returns 0, or 1 if something differs."""
    wrong = check_set(spec.folder)
    report(
        json,
        {"folder": str(spec.folder), "differs": wrong},
        *wrong,
        "" if wrong else f"{spec.folder}: all files are as listed",
    )
    return 1 if wrong else 0


@contextmanager
def _progress(spec: DatasetSpec) -> Iterator[Callable[[ScoreRow, Standing], None]]:
    tasks: dict[str, TaskID] = {}
    with ExitStack() as shown:
        bar = work_bar(note="")

        def tell(row: ScoreRow, now: Standing) -> None:
            if not tasks:
                # What is refused before anything is recorded shows no bars.
                shown.enter_context(bar)
                for name in spec.chosen():
                    tasks[name] = bar.add_task(name, total=spec.per_target)
            bar.update(tasks[row.name], completed=now.kept, total=max(now.wanted, 1))

        yield tell
