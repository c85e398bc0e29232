"""Score a policy on the episodes of the manifest."""

from __future__ import annotations

import dataclasses
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mjhab.config.profiles import DEFAULT_PROFILE, profile_named
from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.core.machine import cores, processor
from mjhab.data.record.provenance import source_commit, versions
from mjhab.evaluation.evaluate import EvalSpec, run_evaluation
from mjhab.evaluation.parts import describe_policy
from mjhab.evaluation.resolve import NoPolicyError, PolicyFacts, full_spec
from mjhab.evaluation.score.actions import ActionKeeper, kept_path
from mjhab.evaluation.score.manifest import (
    BUILTIN_HOMES,
    Manifest,
    ScoreHomes,
    ScoreRow,
    manifest,
)
from mjhab.evaluation.score.result import (
    RESULT_FILE,
    ScoreResult,
    write_result,
    write_summary,
)
from mjhab.evaluation.score.spec import ScoreSpec
from mjhab.evaluation.score.summary import ScoredEpisode
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.rollout.loop import plain
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from mjhab.scenes.pack_source import Assets

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
    homes = ScoreHomes.of(spec.asked.assets)
    asked = manifest(spec.track, spec.asked.split, robot, homes)
    seconds = 0.0
    episodes: list[ScoredEpisode] = []
    policies: dict[str, Any] = {}
    for row in rows_of(asked, spec.rows):
        facts = facts_for(spec.policy, row, asked.profile)
        if facts is None:
            continue
        policies[row.name] = {"name": facts.name, **plain(facts.described)}
        options = scored_options(facts, asked.profile)
        if facts.robot not in ("", robot):
            raise wrong_value(
                "robot",
                robot,
                repr(facts.robot),
                f"Score it with --robot {facts.robot}.",
                f"policy {facts.name}",
            )
        # Left out for the default one, so that scores of older versions compare equal.
        if robot != DEFAULT_ROBOT:
            options["robot"] = robot
        policies[row.name]["env_options"] = plain(options)
        for seed in asked.seeds:
            evaluation = evaluation_of(spec, asked, row, seed, options)
            kept = spec.folder / "actions" / folder_name(asked, row, seed)
            # The keeper comes first: an episode with a record always has its actions.
            run = run_evaluation(evaluation, [ActionKeeper(kept), *sinks(evaluation)])
            # The summary of a run counts its earlier starts, too.
            seconds += run.summary["seconds"]
            # An earlier start may have run more episodes than are asked for now.
            wanted = [r for r in run.records if r.index < evaluation.episodes]
            episodes += [_scored(asked, row, record, kept) for record in wanted]
    if not policies:
        raise wrong_value(
            "policy", spec.policy, f"one for a row of the track {spec.track}"
        )
    facts = facts_of(spec, asked, policies, seconds)
    result = write_result(spec.folder / RESULT_FILE, facts, episodes)
    write_summary(spec.folder / SUMMARY_FILE, result)
    return result


def rows_of(asked: Manifest, names: Sequence[str]) -> list[ScoreRow]:
    """Rows of a manifest in its order, those that are named; () for all.

    Raises:
        UsageError: there is no such row.
    """
    known = [row.name for row in asked.rows]
    for name in names:
        if name not in known:
            raise unknown_name("row", name, known)
    return [row for row in asked.rows if not names or row.name in names]


def folder_name(asked: Manifest, row: ScoreRow, seed: int) -> str:
    """Name of the folder of a row's episodes of one seed."""
    return row.name if len(asked.seeds) == 1 else f"{row.name}.seed{seed}"


def evaluation_of(
    spec: ScoreSpec,
    asked: Manifest,
    row: ScoreRow,
    seed: int,
    options: Mapping[str, Any],
) -> EvalSpec:
    """The evaluation of a row with the options of `scored_options`; it resumes an earlier one."""
    out = spec.folder / "runs" / folder_name(asked, row, seed)
    return EvalSpec.of(
        policy=spec.policy,
        **{
            **row_options(asked, row, seed, spec.asked.assets),
            "episodes": min(row.episodes, spec.episodes or row.episodes),
        },
        worlds=spec.asked.num_envs,
        threads=spec.asked.threads,
        films=spec.films,
        out=out,
        resume=out.exists(),
        env=options,
    )


def row_options(
    asked: Manifest, row: ScoreRow, seed: int, assets: Assets
) -> dict[str, Any]:
    """Options of `EvalSpec.of` that say which episodes those of a row and a seed are."""
    return {
        "task": row.task,
        "subtask": row.subtask or None,
        "target": row.target or None,
        "episodes": row.episodes,
        "seed": seed,
        "split": asked.split,
        "assets": assets,
    }


def facts_for(
    policy: str, row: ScoreRow, rules: str = DEFAULT_PROFILE
) -> PolicyFacts | None:
    """Describe the policy for a row; None if the specification names several policies, and none is for this row.

    Raises:
        UsageError: there is no such policy, or it needs other rules than those of the profile ``rules``.
    """
    try:
        facts = describe_policy(
            full_spec(policy, row.task, row.subtask or None, row.target or None)
        )
    except NoPolicyError:
        return None
    check_rules(facts, rules)
    return facts


def check_rules(facts: PolicyFacts, rules: str = DEFAULT_PROFILE) -> None:
    """Refuse a policy that needs environment options outside FREE_OPTIONS.

    Raises:
        UsageError: the policy needs such an option.
    """
    others = sorted(set(facts.env_options) - FREE_OPTIONS)
    if others:
        asked = {name: facts.env_options[name] for name in others}
        raise wrong_value(
            "env_options",
            asked,
            f"of {', '.join(sorted(FREE_OPTIONS))} alone",
            f"Scores use the rules of the profile {rules}.",
            f"policy {facts.name}",
        )


def scored_options(facts: PolicyFacts, rules: str = DEFAULT_PROFILE) -> dict[str, Any]:
    """Environment options in which a policy is scored.

    Observations and control are those of the policy's options or else of its profile. The rules are those of the
    profile ``rules``; where it binds an option, they decide about it.
    """
    asked = dict(facts.env_options)
    profile = profile_named(asked.pop("profile", DEFAULT_PROFILE))
    told = {"profile": rules} if rules != DEFAULT_PROFILE else {}
    if profile.name == rules:
        return {**told, **asked}
    values = profile.options("", trains=False)
    chosen = {**{name: values[name] for name in FREE_OPTIONS & set(values)}, **asked}
    binding = profile_named(rules)
    if binding.binding:
        bound = binding.options("", trains=False)
        chosen = {name: value for name, value in chosen.items() if name not in bound}
    return {"profile": rules, **chosen}


def facts_of(
    spec: ScoreSpec, asked: Manifest, policies: Mapping[str, Any], seconds: float
) -> dict[str, Any]:
    """Facts of a result file: policy, track, versions, hardware, and wall time of all starts [s]."""
    first = next(iter(policies.values()))
    return {
        "track": asked.track,
        "split": asked.split,
        "robot": asked.robot,
        **({"homes": asdict(asked.homes)} if asked.homes != BUILTIN_HOMES else {}),
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
    # Not imported for the name of a GPU that nothing used.
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        found["gpu"] = torch.cuda.get_device_name(0)
    return found


def _scored(
    asked: Manifest, row: ScoreRow, record: EpisodeRecord, kept: Path
) -> ScoredEpisode:
    path = kept_path(kept, record.index)
    if not path.is_file():
        raise fault(
            path, "missing, with the actions of an episode; score into another --out."
        )
    # Those of tracks that do not ask may be of a version that did not keep the last one.
    start, actions, *continuing = path.read_text(encoding="ascii").split(" ")
    return ScoredEpisode(
        row.name,
        dataclasses.replace(record, config_hash=""),
        start,
        actions,
        continuing == ["1"] if asked.continuing else None,
    )
