"""``mjhab eval``: parse options, evaluate a policy, print the results."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

from mjhab.cli.exits import INTERRUPTED, WITH_RESUME, stopped
from mjhab.cli.output import Listing, report, tell_caution, tell_skipped
from mjhab.cli.streams import with_way_on
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.core.progress import say, work_bar
from mjhab.evaluation.evaluate import EvaluationInterrupted, Run, run_evaluation
from mjhab.evaluation.specs import SMALL_FILM, DemoSpec, EvalSpec
from mjhab.reports.metrics import SubtaskRow, rows_of
from mjhab.reports.words import NOT_JUDGED, duration, newtons
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.rollout.store import REPORT

DISK_ADVICE = "Finished episodes are kept: free some space, then the same command with --resume continues."


def run_eval(spec: EvalSpec, json: bool) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C or SIGTERM (finished episodes are kept and reported).

    1 if the policy could not finish an episode, as `run_generate`.
    """
    interrupted = False
    with sigterm_interrupts(), with_way_on(DISK_ADVICE):
        try:
            run = run_evaluation(spec, [ProgressSink(spec)])
        except EvaluationInterrupted as stop:
            run = stop.run
            interrupted = True
    _tell(spec, run, interrupted, json)
    if interrupted:
        return INTERRUPTED
    return 1 if run.summary["errors"] else 0


def run_demo(spec: DemoSpec, json: bool) -> int:
    """Run the demonstration; returns the exit code of `run_eval`."""
    evaluation = EvalSpec.of(
        task="set_table",
        episodes=4,
        worlds=4,
        films=4,
        film_size=SMALL_FILM,
        out=spec.out,
        overwrite=True,
    )
    code = run_eval(evaluation, json)
    # Machines read one line of JSON, which was printed.
    if code == 0 and not json:
        page = (spec.out / REPORT).resolve()
        print(f"Open in a browser (no network needed): {page}")
    return code


class ProgressSink(Sink[RolloutEnv]):
    """Shows episodes done, control steps per second and the success rate so far."""

    REFRESH = 0.25
    """Time between updates [s]."""

    def __init__(self, spec: EvalSpec) -> None:
        self._bar = work_bar("{task.fields[rate]}{task.fields[success]}")
        self._total = spec.episodes
        name = f"{spec.asked.task} {spec.asked.subtask}".strip()
        self._task = self._bar.add_task(
            name, total=spec.episodes, start=False, rate="", success=""
        )
        self._started = 0.0
        self._shown = 0.0
        self._steps = 0
        self._done = 0
        self._won = 0

    def on_begin(self, env: RolloutEnv, episodes: Collection[int]) -> None:
        """Show the bar; it starts after the episodes that a resumed run already has."""
        self._started = time.perf_counter()
        self._bar.start()
        self._bar.start_task(self._task)
        self._bar.update(self._task, completed=self._total - len(episodes))

    def close(self) -> None:
        """Stop updating the bar."""
        self._bar.stop()

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Count control steps and update the rate."""
        self._steps += int(step.active.sum())
        now = time.perf_counter()
        # Drawing in every step would slow down short steps.
        if now - self._shown > self.REFRESH:
            self._shown = now
            self._bar.update(
                self._task, rate=f"{self._steps / (now - self._started):,.0f} steps/s"
            )

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Advance the bar by one episode."""
        self._done += 1
        self._won += record.success_once
        self._bar.update(
            self._task,
            advance=1,
            success=f", {100 * self._won / self._done:.0f} % success",
        )


_COLUMNS = (
    "#",
    "subtask",
    "target",
    "reached",
    "success once",
    "95 % interval",
    "at end",
    "time to success",
    "peak force",
    "on fingers",
)


def _tell(spec: EvalSpec, run: Run, interrupted: bool, json: bool) -> None:
    summary = run.summary
    if run.film_problem:
        say(f"mjhab: films stopped, the evaluation went on: {run.film_problem}")
    if interrupted:
        kept = f"{summary['episodes']} of {spec.episodes} episodes are kept in {run.path}"
        stopped(kept, f"{WITH_RESUME} (and without --overwrite)")
    if summary["errors"]:
        reasons = Counter(record.error for record in run.records if record.error)
        reason, count = reasons.most_common(1)[0]
        say(
            f"mjhab: the policy could not finish {summary['errors']} episodes; {count} of them: {reason}"
        )
    tell_skipped(summary["skipped_homes"])
    clipped: Mapping[str, int] = summary.get("out_of_range", {})
    if clipped:
        columns = ", ".join(f"{name} {number}" for name, number in clipped.items())
        say(
            f"mjhab: values of the policy's actions out of range, which were clipped: {columns}"
        )
    tell_caution(run.config)
    title = "Success per target" if spec.asked.subtask else "Success along the plan"
    latency = summary.get("latency_ms", {"p50": None})
    report(
        json,
        summary,
        Listing(title, _COLUMNS, map(_cells, rows_of(run.records))),
        _result_line(summary),
        f"answers of the policy: median {latency['p50']} ms, 99 % within {latency['p99']} ms"
        if latency["p50"] is not None
        else "",
        f"control steps without an action of the policy: {summary['late_steps']}"
        if "late_steps" in summary
        else "",
        f"report: {run.report}",
    )


def _result_line(summary: Mapping[str, Any]) -> str:
    episodes = summary["episodes"]
    if episodes and summary["errors"] == episodes:
        # A rate of 0 % would say that the policy tried and failed.
        return f"{episodes} episodes, none of them finished: there is no success rate of this policy"
    return (
        f"{episodes} episodes: success once {100 * summary['success_once']:.1f} %, at end "
        f"{100 * summary['success_at_end']:.1f} %, tainted {summary['tainted']}, {summary['seconds']:.0f} s"
    )


def _cells(row: SubtaskRow) -> tuple[object, ...]:
    head = (
        "" if row.position is None else row.position + 1,
        row.kind,
        row.target,
        row.reached,
    )
    if not row.reached:
        return (*head, *["-"] * 6)
    # What the environment did itself is no success of the policy.
    if not row.judged:
        return (*head, NOT_JUDGED, *["-"] * 5)
    low, high = row.interval
    interval = f"{100 * low:.0f} to {100 * high:.0f} %"
    return (
        *head,
        f"{100 * row.success_once:.1f} %",
        interval,
        f"{100 * row.success_at_end:.1f} %",
        duration(row.steps_to_success),
        newtons(row.peak_force),
        newtons(row.peak_finger_force),
    )
