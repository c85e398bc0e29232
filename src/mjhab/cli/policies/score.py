"""``mjhab score``: score a policy, check or tabulate scores; print the results."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjhab.cli.exits import stopped
from mjhab.cli.output import Listing, print_json, report, tell_caution
from mjhab.cli.policies.evaluate import ProgressSink
from mjhab.core.errors import fault
from mjhab.core.files.cache import write_text
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.core.progress import progress_bar, say
from mjhab.evaluation.evaluate import EvaluationInterrupted
from mjhab.evaluation.score.check import CHECKED_EPISODES, check
from mjhab.evaluation.score.leaderboard import leaderboard
from mjhab.evaluation.score.perturbed import ROBUSTNESS_PAGE, score_perturbed
from mjhab.evaluation.score.result import (
    RESULT_FILE,
    ScoreResult,
    read_for_table,
    read_result,
)
from mjhab.evaluation.score.run import score
from mjhab.evaluation.score.spec import CheckSpec, LeaderboardSpec, ScoreSpec, StartsSpec
from mjhab.evaluation.score.starts import write_starts
from mjhab.evaluation.specs import EvalSpec
from mjhab.reports.compared.page import points

_MOST_SHOWN = 10


def run_score(spec: ScoreSpec, json: bool) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C, or 1 if the policy could not finish an episode."""
    with sigterm_interrupts():
        try:
            result = score(spec, _with_progress)
            robustness = (
                score_perturbed(spec, result, _with_progress) if spec.axes else None
            )
        except EvaluationInterrupted:
            return stopped(f"finished episodes are kept in {spec.folder}", again="")
    result = robustness.result if robustness else result
    # One policy may act in many rows.
    cautions = {
        policy.get("policy_caution", "")
        for policy in result.facts.get("policies", {}).values()
    }
    for caution in sorted(cautions):
        tell_caution({"policy_caution": caution})
    _tell_incomplete(result.summary)
    facts = _facts(result)
    parts = _listings(result, spec.folder)
    if robustness:
        axes = [arm.as_json() for arm in robustness.arms]
        facts = {"clean": facts, "axes": axes}
        parts += [_arms(axes), f"perturbed: {spec.folder / ROBUSTNESS_PAGE}"]
    report(json, facts, *parts)
    # An episode that the policy could not finish says nothing of how good it is.
    return 1 if result.summary["errors"] else 0


def _with_progress(evaluation: EvalSpec) -> list[ProgressSink]:
    return [ProgressSink(evaluation)]


def _arms(axes: Sequence[Mapping[str, Any]]) -> Listing:
    """The table of a score's arms."""
    rows = [
        (
            arm["axis"],
            arm["level"],
            arm["episodes"],
            f"{100 * arm['success_once']:.1f} %",
            points(arm["difference"]),
            points(arm["low"], arm["high"]),
        )
        for arm in axes
    ]
    columns = ("axis", "level", "episodes", "success once", "difference", "95 % interval")
    return Listing("Perturbed, beside the clean episodes", columns, rows)


def _facts(result: ScoreResult) -> dict[str, object]:
    """What machines are told; of a track that publications compare nothing else, the rest is in its files."""
    summary = result.summary
    facts: dict[str, object] = {"track": result.facts["track"], "score": summary["score"]}
    rows = {row["name"]: row["score"] for row in summary["rows"]}
    homes = result.manifest.homes
    if result.manifest.continuing:
        facts["score_continuing"] = summary["score_continuing"]
        return {**facts, "rows": rows, "stage": homes.stage, "digest": result.digest}
    counts = {name: summary[name] for name in ("episodes", "complete")}
    places = {"assets": homes.pack, "stage": homes.stage}
    return {**facts, "rows": rows, **places, **counts, "digest": result.digest}


def _listings(result: ScoreResult, out: Path) -> list[Listing | str]:
    summary = result.summary
    columns = {"score": "score", "success_once": "success once"}
    going_on = ""
    if "score_continuing" in summary:
        columns["score_continuing"] = "goes on after a failure"
        going_on = f", {100 * summary['score_continuing']:.1f} where episodes go on after a failing termination"
    rows = [
        (row["name"], row["done"], *(f"{100 * row[name]:.1f} %" for name in columns))
        for row in summary["rows"]
    ]
    parts: list[Listing | str] = [
        Listing("Rows", ("row", "episodes", *columns.values()), rows),
        f"score {100 * summary['score']:.1f}{going_on} of {summary['episodes']} episodes, tainted "
        f"{summary['tainted']}, errors {summary['errors']}",
    ]
    return [*parts, f"result: {out / RESULT_FILE}"]


def _tell_incomplete(summary: Mapping[str, Any]) -> None:
    """Tell on stderr, for people and beside JSON, that a score cannot be compared with others."""
    if summary["complete"]:
        return
    empty = [row["name"] for row in summary["rows"] if not row["done"]]
    without = f"; none of {', '.join(empty)}" if empty else ""
    say(
        f"mjhab: incomplete: {summary['episodes']} episodes{without}; "
        f"{summary['other_starts']} begin elsewhere than in the manifest"
    )


def run_check(spec: CheckSpec, json: bool) -> int:
    """Replay episodes of a score; returns 1 if some have another outcome."""
    result = read_result(spec.file)
    total = min(CHECKED_EPISODES, len(result.episodes))
    with progress_bar("replaying", total) as advance:
        found = check(result, advance, spec.env.get("seed"), spec.asked.assets)
    for name, what in list(found.wrong.items())[:_MOST_SHOWN]:
        say(f"{name}: {what}")
    exact = found.episodes - len(found.wrong) - len(found.inexact)
    print(
        f"{found.episodes} episodes replayed: {exact} exact, {len(found.inexact)} with the same outcome but other "
        f"states (another machine or version?), {len(found.wrong)} with another outcome. Chosen with seed "
        f"{found.seed}.",
        # With --json the one line on stdout belongs to machines.
        file=sys.stderr if json else sys.stdout,
    )
    if json:
        counts = {
            "checked": found.episodes,
            "exact": exact,
            "inexact": len(found.inexact),
            "wrong": len(found.wrong),
            "seed": found.seed,
        }
        print_json({**_facts(result), **counts})
    return 1 if found.wrong else 0


def run_table(spec: LeaderboardSpec, json: bool) -> int:
    """Print or write the table of scores; returns 0."""
    results = [read_for_table(path) for path in spec.files]
    places: dict[str, Path] = {}
    for path, result in zip(spec.files, results, strict=True):
        # Twice the same result would look like two submissions.
        first = places.setdefault(result.digest, path)
        if first != path:
            raise fault(first, f"the same result as {path}; give one of them.")
    text = leaderboard(results)
    page = spec.page
    if page is None:
        print(text)
    else:
        write_text(page, text)
        print(f"page: {page}")
    if json:
        print_json({"results": [_facts(result) for result in results]})
    return 0


def run_starts(spec: StartsSpec, json: bool) -> int:
    """Write the missing starts of a track; returns 0."""
    asked = spec.asked
    count = write_starts(
        spec.track, asked.split, asked.num_envs, asked.threads, asked.assets
    )
    policy = f"{count} starts of {spec.track}/{asked.split} written"
    report(json, {"track": spec.track, "split": asked.split, "written": count}, policy)
    return 0
