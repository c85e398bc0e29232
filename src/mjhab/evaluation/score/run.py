"""Score a policy on the episodes of the manifest, and verify a score by replaying its actions."""

from __future__ import annotations

import dataclasses
import platform
import secrets
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjhab.config.profiles import DEFAULT_PROFILE, profile_named
from mjhab.core.errors import UsageError
from mjhab.core.machine import cores, processor
from mjhab.core.seeding import stream
from mjhab.data.record.provenance import source_commit, versions
from mjhab.evaluation.evaluate import (
    EvalSpec,
    Run,
    describe_policy,
    make_env,
    run_evaluation,
)
from mjhab.evaluation.resolve import STUDENT, PolicyFacts, full_spec
from mjhab.evaluation.score.actions import (
    ActionKeeper,
    Replayed,
    StartKeeper,
    kept_path,
    unpacked_actions,
)
from mjhab.evaluation.score.capabilities import capabilities_of
from mjhab.evaluation.score.manifest import Manifest, ScoreRow, manifest
from mjhab.evaluation.score.result import (
    RESULT_FILE,
    ScoredEpisode,
    ScoreResult,
    write_result,
    write_summary,
)
from mjhab.evaluation.score.spec import ScoreSpec
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.rollout.loop import plain, rollout
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

FREE_OPTIONS = frozenset(
    {
        "obs_mode",
        "cameras",
        "camera_size",
        "control_mode",
        "base",
        "stationary",
        "profile",
        "robot",
    }
)
"""Environment options that a policy may choose: observations, control and robot. The benchmark fixes all others."""
SUMMARY_FILE = "summary.json"
CHECKED_EPISODES = 100
"""Largest number of episodes that a check replays."""


@dataclass
class Checked:
    """Result of a check.

    seed: of the choice of episodes. episodes: number of replayed episodes. wrong: difference by "row index" for
    episodes with another outcome. inexact: "row index" of episodes with the same outcome but another start state or
    different numbers, for instance in the last bits of forces.
    """

    seed: int = 0
    episodes: int = 0
    wrong: dict[str, str] = field(default_factory=dict)
    inexact: list[str] = field(default_factory=list)


def score(
    spec: ScoreSpec, sinks: Callable[[EvalSpec], Sequence[Sink]] = lambda _: ()
) -> ScoreResult:
    """Run the missing episodes of a score and write ``out/result.json``, and what tables show of it as summary.json.

    Args:
        spec: the score.
        sinks: makes further listeners for an evaluation.

    Raises:
        UsageError: a name is unknown; the policy needs other rules; or the folder holds another run.
    """
    robot = spec.asked.robot
    asked = manifest(spec.track, spec.asked.split, robot)
    seconds = 0.0
    episodes: list[ScoredEpisode] = []
    policies: dict[str, Any] = {}
    for row in asked.rows:
        facts = facts_for(spec.policy, row)
        if facts is None:
            continue
        policies[row.name] = {"name": facts.name, **plain(facts.described)}
        options = scored_options(facts)
        if facts.robot not in ("", robot):
            raise UsageError(
                f"the policy {facts.name} was trained with robot {facts.robot!r}, not {robot!r}; score it with "
                f"--robot {facts.robot}."
            )
        if robot != DEFAULT_ROBOT:
            options["robot"] = robot
        policies[row.name]["env_options"] = plain(options)
        evaluation = evaluation_of(spec, asked, row, options)
        kept = spec.folder / "actions" / row.name
        run = run_evaluation(evaluation, [ActionKeeper(kept), *sinks(evaluation)])
        # The summary of a run counts its earlier starts, too.
        seconds += run.summary["seconds"]
        episodes += [_scored(row, record, kept) for record in _wanted(run, evaluation)]
    if not policies:
        raise UsageError(
            f"{spec.policy} has no policy for any row of the track {spec.track}."
        )
    facts = facts_of(spec, asked, policies, seconds)
    result = write_result(spec.folder / RESULT_FILE, facts, episodes)
    write_summary(spec.folder / SUMMARY_FILE, result)
    return result


def evaluation_of(
    spec: ScoreSpec, asked: Manifest, row: ScoreRow, options: Mapping[str, Any]
) -> EvalSpec:
    """The evaluation of a row with the options of `scored_options`; it resumes an earlier one."""
    out = spec.folder / "runs" / row.name
    return EvalSpec.of(
        policy=spec.policy,
        task=row.task,
        subtask=row.subtask or None,
        target=row.target or None,
        episodes=min(row.episodes, spec.episodes or row.episodes),
        worlds=spec.asked.num_envs,
        seed=asked.seed,
        split=asked.split,
        threads=spec.asked.threads,
        films=0,
        out=out,
        resume=out.exists(),
        env=options,
    )


def facts_for(policy: str, row: ScoreRow) -> PolicyFacts | None:
    """Describe the policy for a row; None if the policy is "student" and the package has none for this row.

    Raises:
        UsageError: there is no such policy, or it needs other rules than those of the benchmark.
    """
    try:
        facts = describe_policy(
            full_spec(policy, row.task, row.subtask or None, row.target or None)
        )
    except UsageError:
        if policy == STUDENT:
            return None
        raise
    check_rules(facts)
    return facts


def check_rules(facts: PolicyFacts) -> None:
    """Refuse a policy that needs environment options outside FREE_OPTIONS.

    Raises:
        UsageError: the policy needs such an option.
    """
    others = sorted(set(facts.env_options) - FREE_OPTIONS)
    if others:
        asked = {name: facts.env_options[name] for name in others}
        raise UsageError(
            f"the policy {facts.name} asks for {asked}; scores use the rules of the profile {DEFAULT_PROFILE}, and a "
            f"policy may only choose {', '.join(sorted(FREE_OPTIONS))}."
        )


def scored_options(facts: PolicyFacts) -> dict[str, Any]:
    """Environment options in which a policy is scored.

    Observations and control are those of the policy's options or else of its profile. The rules are those of the
    default profile.
    """
    asked = dict(facts.env_options)
    profile = profile_named(asked.pop("profile", DEFAULT_PROFILE))
    if profile.name == DEFAULT_PROFILE:
        return asked
    values = profile.options("", trains=False)
    of_profile = {name: values[name] for name in FREE_OPTIONS & set(values)}
    return {"profile": DEFAULT_PROFILE, **of_profile, **asked}


def facts_of(
    spec: ScoreSpec, asked: Manifest, policies: Mapping[str, Any], seconds: float
) -> dict[str, Any]:
    """Facts of a result file: policy, track, versions, hardware, and wall time of all starts [s]."""
    first = next(iter(policies.values()))
    return {
        "track": asked.track,
        "split": asked.split,
        "robot": asked.robot,
        "manifest": asked.digest,
        "policy": first["name"],
        "policies": dict(policies),
        "versions": versions(),
        "commit": source_commit(),
        "hardware": hardware(),
        "seconds": round(seconds, 1),
    }


def hardware() -> dict[str, Any]:
    """Description of the machine: processor, cores, system, and the GPU if torch is loaded and finds one."""
    found: dict[str, Any] = {
        "processor": processor(),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        found["gpu"] = torch.cuda.get_device_name(0)
    return found


def check(
    result: ScoreResult, tell: Callable[[], object] = bool, seed: int | None = None
) -> Checked:
    """Replay the actions of up to CHECKED_EPISODES random episodes and compare the outcomes with the result file.

    Args:
        result: content of the file.
        tell: called after every episode.
        seed: of the choice of episodes; None for one that nobody can know when the file is written.

    Raises:
        UsageError: the actions cannot be read.
    """
    seed = secrets.randbits(32) if seed is None else seed
    random = stream(seed, "score", "check")
    count = min(CHECKED_EPISODES, len(result.episodes))
    chosen = random.choice(len(result.episodes), count, replace=False)
    found = Checked(seed)
    asked = result.manifest
    for row in asked.rows:
        some = [
            result.episodes[k]
            for k in sorted(chosen.tolist())
            if result.episodes[k].row == row.name
        ]
        if some:
            _check_row(result, asked, row, some, found)
        for _ in some:
            tell()
    return found


def _check_row(
    result: ScoreResult,
    asked: Manifest,
    row: ScoreRow,
    episodes: Sequence[ScoredEpisode],
    found: Checked,
) -> None:
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in result.facts["policies"][row.name]["env_options"].items()
        if name not in ("obs_mode", "cameras", "camera_size", "profile")
    }
    check_rules(PolicyFacts(str(result.facts["policy"]), env_options=options))
    spec = EvalSpec.of(
        policy="zero",
        task=row.task,
        subtask=row.subtask or None,
        target=row.target or None,
        episodes=row.episodes,
        worlds=min(len(episodes), 8),
        seed=asked.seed,
        split=asked.split,
        films=0,
    )
    env = make_env(spec, options)
    try:
        actions = {e.record.index: unpacked_actions(e.actions) for e in episodes}
        width = len(env.action_table)
        if any(array.shape[1] != width for array in actions.values()):
            raise UsageError(f"the actions of {row.name} do not have the width {width}.")
        errors = {e.record.index: e.record.error for e in episodes}
        policy = Replayed(env.num_envs, width, actions, errors)
        begun = StartKeeper()
        records = rollout(env, policy, sorted(actions), asked.seed, [begun])
    finally:
        env.close()
    recorded = {e.record.index: e for e in episodes}
    for record in records:
        start = begun.starts[record.index]
        _compare(
            f"{row.name} {record.index}", recorded[record.index], record, start, found
        )


def _compare(
    name: str, scored: ScoredEpisode, seen: EpisodeRecord, start: str, found: Checked
) -> None:
    found.episodes += 1
    recorded = dataclasses.replace(scored.record, style={})
    if recorded == seen and scored.start == start:
        return
    if _outcome(recorded) == _outcome(seen):
        found.inexact.append(name)
    else:
        found.wrong[name] = f"file: {_outcome(recorded)}, replay: {_outcome(seen)}"


def _outcome(record: EpisodeRecord) -> tuple[Any, ...]:
    """The part of an episode's record that a score and its capabilities depend on."""
    labels = tuple(
        (s.index, s.kind, s.label, s.success_once, tuple(capabilities_of(s)))
        for s in record.subtasks
    )
    return (
        record.success_once,
        record.completed,
        bool(record.error),
        bool(record.taint),
        labels,
    )


def _wanted(run: Run, evaluation: EvalSpec) -> list[EpisodeRecord]:
    return [record for record in run.records if record.index < evaluation.episodes]


def _scored(row: ScoreRow, record: EpisodeRecord, kept: Path) -> ScoredEpisode:
    path = kept_path(kept, record.index)
    if not path.is_file():
        raise UsageError(
            f"{path} with the actions of an episode is missing; score into another --out."
        )
    start, _, actions = path.read_text(encoding="ascii").partition(" ")
    return ScoredEpisode(
        row.name, dataclasses.replace(record, config_hash=""), start, actions
    )
