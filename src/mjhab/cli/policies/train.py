"""``mjhab train``: train, print the results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjhab.cli.exits import INTERRUPTED, stopped
from mjhab.cli.output import report
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.core.progress import say
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs import distributed
from mjhab.learning.runs.run import TRAINING, TrainingResult
from mjhab.learning.runs.specs import SECONDS_PER_MINUTE, ImitationSpec, TrainSpec
from mjhab.learning.train import train_spec

UNTRAINED = (
    "the network was not trained: the budget ended before its first update. The same command with --resume and a "
    "larger --budget-minutes goes on."
)


def run_train(spec: ImitationSpec | ReinforcementSpec, json: bool) -> int:
    """Run the command. Of several processes (`runs.distributed`) the first tells the results.

    Returns:
        0; 130 after Ctrl-C or SIGTERM (a checkpoint is kept, if training had begun); 1 if the network was never
        updated, or the budget covers no update of a policy that training began from.
    """
    with sigterm_interrupts():
        result = train_spec(spec)
    # Of the processes of torchrun the first has the checkpoints.
    if not distributed.rank():
        _tell(spec, result, json)
    if result.interrupted:
        return INTERRUPTED
    # A checkpoint without an update, or of too few demonstrations, must not pass for a result.
    return 0 if result.summary["trained"] and "shortage" not in result.summary else 1


def _tell(spec: TrainSpec, result: TrainingResult, json: bool) -> None:
    summary = result.summary
    if result.interrupted:
        _tell_stopped(spec.out, summary)
    elif not summary["trained"] or "shortage" in summary:
        say(f"mjhab: {summary.get('shortage', UNTRAINED)}")
    success = summary["success_once"]
    judged = ""
    if success is not None:
        low, high = summary["interval"]
        interval = f"95 % interval {100 * low:.0f} to {100 * high:.0f} %"
        minutes = summary["seconds"] / SECONDS_PER_MINUTE
        judged = (
            f"success once {100 * success:.1f} % of {summary['episodes']} episodes in homes of split "
            f"{summary['split']} ({interval}), at end {100 * summary['success_at_end']:.1f} %, "
            f"{minutes:.1f} minutes"
        )
    student = f"student: {summary['checkpoint'] or 'no checkpoint yet'}"
    report(json, summary, judged, student, f"report: {result.report}")


def _tell_stopped(out: Path, summary: Mapping[str, Any]) -> None:
    """Tell what an interrupted run has left, and what --resume makes of it."""
    if (out / TRAINING).is_file():
        stopped(f"the last checkpoint is kept in {out}")
        return
    kept = "there is no checkpoint yet"
    if summary["checkpoint"]:
        kept = f"the policy is kept in {out}"
    stopped(kept, does="trains from the beginning")
