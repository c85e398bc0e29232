"""``mjhab generate``: parse options, generate a data set, print the results."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mjhab.cli.exits import INTERRUPTED, stopped
from mjhab.cli.output import Listing, report, tell_caution, tell_skipped
from mjhab.core.files.interrupts import stop_signals
from mjhab.core.progress import say, work_bar
from mjhab.data.record.job import Standing
from mjhab.evaluation.generate import GeneratedData, run_generation
from mjhab.evaluation.specs import GenerateSpec


def run_generate(spec: GenerateSpec, json: bool) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C or SIGTERM.

    1 if a quota could not be filled, or the policy could not finish an episode.
    """
    if not spec.workers:
        # A process of its own can be stopped in the middle of an episode.
        spec = dataclasses.replace(spec, workers=1)
    with stop_signals() as is_stopped, _progress(spec) as tell:
        made = run_generation(spec, tell, is_stopped)
    # A signal after the last episode has left nothing to continue.
    interrupted = is_stopped() and not made.standing.complete
    _tell(json, made, interrupted)
    if interrupted:
        return INTERRUPTED
    return 1 if made.is_short or made.standing.errors else 0


@contextmanager
def _progress(spec: GenerateSpec) -> Iterator[Callable[[Standing], None]]:
    begun = time.perf_counter()
    with work_bar() as bar:
        name = f"{spec.asked.task} {spec.asked.subtask or 'chain'}"
        task = bar.add_task(name, total=spec.per_target or spec.max_tries, note="")

        def tell(now: Standing) -> None:
            # Without a quota the number of tries is all that is known to end the work.
            done = now.kept if now.wanted else now.tried
            total = now.wanted or spec.max_tries
            rate = now.written / (time.perf_counter() - begun) * 3600
            share = f", yield {100 * now.passed / now.tried:.0f} %" if now.tried else ""
            bar.update(
                task,
                completed=done,
                total=max(total, 1),
                note=f"{share}, {rate:,.0f} episodes/h",
            )

        yield tell


def _tell(json: bool, made: GeneratedData, interrupted: bool) -> None:
    done = made.standing
    numbers = made.summary
    if interrupted:
        stopped(f"{done.kept} episodes are kept in {made.path}")
    elif made.is_short:
        say(
            f"mjhab: only {done.kept} of {done.wanted} episodes passed of {done.tried} that were tried. A larger "
            "--episodes with --resume tries more."
        )
    if done.errors:
        reason, count = Counter(done.errors).most_common(1)[0]
        say(
            f"mjhab: the policy could not finish {numbers['errors']} episodes. They are not kept; the same command "
            f"with --resume tries them again. {count} of them: {reason}"
        )
    tell_caution(made.config)
    tell_skipped(numbers["skipped_homes"])
    rows = [(label or "none", count) for label, count in numbers["labels"].items()]
    report(
        json,
        numbers,
        Listing(f"Episodes in {made.path}", ("label", "kept"), rows),
        f"{done.kept} episodes kept, {done.written} of them written now, {done.tried} tried; "
        f"{numbers['episodes_per_hour']:,.0f} episodes per hour, {numbers['bytes_per_episode']:,} bytes per episode",
    )
