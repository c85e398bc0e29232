"""Verify a score by replaying its actions."""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.core.seeding import stream
from mjhab.core.typed.options import with_tuples
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.evaluation.parts import make_env
from mjhab.evaluation.resolve import PolicyFacts
from mjhab.evaluation.score.actions import Replayed, StartKeeper, unpacked_actions
from mjhab.evaluation.score.capabilities import capabilities_of
from mjhab.evaluation.score.manifest import ScoreHomes, ScoreRow
from mjhab.evaluation.score.result import ScoreResult
from mjhab.evaluation.score.run import check_rules, row_options
from mjhab.evaluation.score.summary import ScoredEpisode
from mjhab.rollout.loop import rollout
from mjhab.scenes.pack_source import Assets

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


def check(
    result: ScoreResult,
    tell: Callable[[], object] = bool,
    seed: int | None = None,
    assets: Assets = "builtin",
) -> Checked:
    """Replay the actions of up to CHECKED_EPISODES random episodes and compare the outcomes with the result file.

    Args:
        result: content of the file.
        tell: called after every episode.
        seed: of the choice of episodes; None for one that nobody can know when the file is written.
        assets: the homes; result files name no places on a disk.

    Raises:
        UsageError: the score was made in other homes, or with another stage; or the actions cannot be read.
    """
    check_homes(result, ScoreHomes.of(assets))
    # Not to be foreseen, so that nobody can know which episodes will be checked.
    seed = secrets.randbits(32) if seed is None else seed
    random = stream(seed, "score", "check")
    count = min(CHECKED_EPISODES, len(result.episodes))
    chosen = random.choice(len(result.episodes), count, replace=False)
    found = Checked(seed)
    asked = result.manifest
    for row, episode_seed in product(asked.rows, asked.seeds):
        some = [
            episode
            for episode in (result.episodes[k] for k in sorted(chosen.tolist()))
            if (episode.row, episode.record.seed) == (row.name, episode_seed)
        ]
        if some:
            _check_row(result, row, some, assets, found)
        for _ in some:
            tell()
    return found


def check_homes(result: ScoreResult, homes: ScoreHomes) -> None:
    """Refuse homes other than those of a score.

    Raises:
        UsageError: names both.
    """
    scored = result.manifest.homes
    if scored != homes:
        raise UsageError(
            f"this score was made in the homes of {scored}, and the check is to be in those of {homes}: give "
            "--assets and --stage as for the score.",
            option="assets",
            given=str(homes),
            expected=str(scored),
        )


def _check_row(
    result: ScoreResult,
    row: ScoreRow,
    episodes: Sequence[ScoredEpisode],
    assets: Assets,
    found: Checked,
) -> None:
    """Replay episodes of one row and one seed."""
    asked = result.manifest
    seed = episodes[0].record.seed
    options = with_tuples(result.facts["policies"][row.name]["env_options"])
    # A replay sees nothing, and drawing would take most of its time.
    for name in ("obs_mode", "cameras", "camera_size", "profile"):
        options.pop(name, None)
    facts = PolicyFacts(str(result.facts["policy"]), env_options=options)
    check_rules(facts, asked.profile)
    options["profile"] = asked.profile
    spec = EvalSpec.of(
        policy="zero",
        **row_options(asked, row, seed, assets),
        worlds=min(len(episodes), 8),
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
        records = rollout(env, policy, sorted(actions), seed, [begun])
    finally:
        env.close()
    recorded = {e.record.index: e for e in episodes}
    of_seed = f" of seed {seed}" if len(asked.seeds) > 1 else ""
    for record in records:
        index = record.index
        later = begun.continuing[index] if asked.continuing else None
        seen = ScoredEpisode(row.name, record, begun.starts[index], "", later)
        _compare(f"{row.name} {index}{of_seed}", recorded[index], seen, found)


def _compare(
    name: str, scored: ScoredEpisode, seen: ScoredEpisode, found: Checked
) -> None:
    found.episodes += 1
    # The replay has no style; what it did is in the actions.
    plain = dataclasses.replace(scored.record, style={})
    told, replayed = _outcome(scored), _outcome(seen)
    if told != replayed:
        found.wrong[name] = f"file: {told}, replay: {replayed}"
    # Forces may differ in their last bits between machines, while outcomes agree.
    elif plain != seen.record or scored.start != seen.start:
        found.inexact.append(name)


def _outcome(episode: ScoredEpisode) -> tuple[Any, ...]:
    """The part of an episode that a score and its capabilities depend on."""
    record = episode.record
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
        episode.continuing,
    )
