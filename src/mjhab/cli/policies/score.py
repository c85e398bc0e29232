"""``mjhab score``: parse options; score, check or tabulate; print the results."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

from mjhab.cli.exits import stopped
from mjhab.cli.options.policies.score import ScoreOptions
from mjhab.cli.output import print_json, print_table, tell_caution
from mjhab.cli.policies.evaluate import ProgressSink
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.core.progress import progress_bar
from mjhab.evaluation.evaluate import EvaluationInterrupted
from mjhab.evaluation.score.leaderboard import leaderboard
from mjhab.evaluation.score.result import (
    RESULT_FILE,
    ScoreResult,
    read_for_table,
    read_result,
)
from mjhab.evaluation.score.run import CHECKED_EPISODES, ScoreSpec, check, score
from mjhab.evaluation.score.starts import write_starts
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.serving.address import with_options, without_password

_MOST_SHOWN = 10
MODES = {
    "check": ("check", "check_seed", "json"),
    "table": ("table", "page", "json"),
    "starts": ("starts", "track", "split", "worlds", "threads", "json"),
}
"""What the command does instead of scoring, by option, and the options that it takes then."""


def run_score(options: ScoreOptions) -> int:
    """Run the command; returns 0, or 130 after Ctrl-C.

    1 if a check finds episodes with another outcome, or the policy could not finish an episode.
    """
    _check_options(options)
    if options.check:
        return _check(options.check, options)
    if options.table:
        return _table(options)
    if options.starts:
        count = write_starts(
            options.track, options.split, options.worlds, options.threads
        )
        print(f"{count} starts of {options.track}/{options.split} written")
        return 0
    return _score(options)


def _check_options(options: ScoreOptions) -> None:
    """Refuse options that would be passed over.

    Raises:
        UsageError: names the option.
    """
    modes = [name for name in MODES if getattr(options, name)]
    if len(modes) > 1:
        raise UsageError("--check, --table and --starts exclude each other.")
    given = [
        field.name
        for field in dataclasses.fields(options)
        if getattr(options, field.name) != field.default
    ]
    for name in given:
        shown = f"--{name.replace('_', '-')}"
        if modes and name not in MODES[modes[0]]:
            raise UsageError(f"{shown} has no meaning with --{modes[0]}: leave it out.")
        if not modes and name in (*MODES["check"], *MODES["table"]) and name != "json":
            mode = "check FILE" if name in MODES["check"] else "table FILE ..."
            raise UsageError(f"{shown} is for --{mode}")


def _score(options: ScoreOptions) -> int:
    policy = with_options(options.policy, options.served)
    spec = ScoreSpec(
        policy=policy,
        track=options.track,
        split=options.split,
        out=options.out or _default_out(options),
        worlds=options.worlds,
        threads=options.threads,
        episodes=options.episodes,
        robot=options.robot or DEFAULT_ROBOT,
    )
    with sigterm_interrupts():
        try:
            result = score(spec, lambda evaluation: [ProgressSink(evaluation)])
        except EvaluationInterrupted:
            return stopped(f"finished episodes are kept in {spec.out}", again="")
    # One policy may act in many rows.
    cautions = {
        told.get("policy_caution", "")
        for told in result.facts.get("policies", {}).values()
    }
    for caution in sorted(cautions):
        tell_caution({"policy_caution": caution})
    if options.json:
        print_json(_facts(result))
    else:
        _tell(result, spec.out)
    # An episode that the policy could not finish says nothing of how good it is.
    return 1 if result.summary["errors"] else 0


def _default_out(options: ScoreOptions) -> Path:
    words = [without_password(options.policy), options.track, options.split]
    if options.robot:
        words.append(options.robot)
    return Path("scores") / "_".join(re.sub(r"[^\w.-]+", "-", word) for word in words)


def _facts(result: ScoreResult) -> dict[str, object]:
    summary = result.summary
    return {
        "track": result.facts["track"],
        "score": summary["score"],
        "episodes": summary["episodes"],
        "digest": result.digest,
        "complete": summary["complete"],
    }


def _tell(result: ScoreResult, out: Path) -> None:
    summary = result.summary
    rows = [
        (
            row["name"],
            row["done"],
            f"{100 * row['score']:.1f} %",
            f"{100 * row['success_once']:.1f} %",
        )
        for row in summary["rows"]
    ]
    print_table("Rows", ("row", "episodes", "score", "success once"), rows)
    print(
        f"score {100 * summary['score']:.1f} of {summary['episodes']} episodes, tainted {summary['tainted']}, errors "
        f"{summary['errors']}"
    )
    if not summary["complete"]:
        print(
            f"incomplete: episodes are missing, or have another start than in the manifest ({summary['other_starts']})"
        )
    print(f"result: {out / RESULT_FILE}")


def _check(path: Path, options: ScoreOptions) -> int:
    result = read_result(path)
    total = min(CHECKED_EPISODES, len(result.episodes))
    with progress_bar("replaying", total) as advance:
        found = check(result, advance, options.check_seed)
    for name, what in list(found.wrong.items())[:_MOST_SHOWN]:
        print(f"{name}: {what}", file=sys.stderr)
    exact = found.episodes - len(found.wrong) - len(found.inexact)
    print(
        f"{found.episodes} episodes replayed: {exact} exact, {len(found.inexact)} with the same outcome but other "
        f"states (another machine or version?), {len(found.wrong)} with another outcome. Chosen with seed "
        f"{found.seed}.",
        file=sys.stderr if options.json else sys.stdout,
    )
    if options.json:
        counts = {
            "checked": found.episodes,
            "exact": exact,
            "inexact": len(found.inexact),
            "wrong": len(found.wrong),
            "seed": found.seed,
        }
        print_json({**_facts(result), **counts})
    return 1 if found.wrong else 0


def _table(options: ScoreOptions) -> int:
    results = [read_for_table(path) for path in options.table]
    places: dict[str, Path] = {}
    for path, result in zip(options.table, results, strict=True):
        first = places.setdefault(result.digest, path)
        if first != path:
            raise UsageError(f"{first} and {path} are the same result; give one of them.")
    text = leaderboard(results)
    page = options.page
    if page is None:
        print(text)
    else:
        page.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(page, lambda temporary: temporary.write_text(text, encoding="utf-8"))
        print(f"page: {page}")
    if options.json:
        print_json({"results": [_facts(result) for result in results]})
    return 0
