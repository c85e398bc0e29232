"""Start states from recorded episodes: a subtask begins where the drive before it really ended, or goes on later.

Policies that are trained from drawn starts alone fail after a drive, which ends elsewhere, with another posture of the
arm and with objects and drawers as the subtasks before left them. States in which a policy was stuck are starts from
which recovery is learned. `chain_starts` is `mjhab.chain_starts`; ``mjhab
spawns from`` calls `make_chain_starts`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError, fault, unknown_name, wrong_value
from mjhab.core.names import kind_of
from mjhab.data.record.batches import batches
from mjhab.data.select.sets import nothing_passes
from mjhab.data.store.places import entries
from mjhab.data.store.reading import RecordedEpisode
from mjhab.episodes.episode import Episode
from mjhab.episodes.spawn_sets import (
    SPAWNS_SUFFIX,
    SpawnRecipe,
    SpawnRow,
    SpawnSet,
    header_of,
    pack_rows,
    write,
)
from mjhab.evaluation.datasets.specs import ChainStartsSpec, PlacesLike
from mjhab.evaluation.recorded import recorded_env
from mjhab.layout.addresses import Addresses
from mjhab.scenes.pack_source import pack_request

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

_SAME = ("task", "split", "assets", "home", "spawn_rule", "robot", "joint_dynamics")
"""Options of the environment that all episodes of a set have in common."""


def chain_starts(path: PlacesLike, **options: Any) -> SpawnSet:
    """Make start states of a subtask from recorded episodes, as ``mjhab spawns from`` does.

    >>> import mjhab
    >>> made = mjhab.generate("zero", task="set_table", navigate="teleport", episodes=1, horizon=3, out="runs/chain")
    >>> found = mjhab.chain_starts("runs/chain", subtask="open", out="runs/chain_open.npz")
    >>> len(found), found.recipe.subtask
    (1, 'open')
    >>> env = mjhab.make(task="set_table", subtask="open", spawns="runs/chain_open.npz", split="train")

    Args:
        path: a shard, a folder of shards, or several of them.
        **options: further fields of `ChainStartsSpec`: ``subtask`` and ``out``, which must be given, ``target``,
            ``after``, ``where``, ``overwrite``.

    Returns:
        The set, for ``spawns`` of `EnvConfig`: one start for each time that such a subtask began.

    Raises:
        UsageError: an option is unknown or invalid, the episodes are of several environments, or no such subtask began.
    """
    return make_chain_starts(ChainStartsSpec.of(path, **options))


def make_chain_starts(spec: ChainStartsSpec) -> SpawnSet:
    """Make the set that a specification asks for.

    Raises:
        UsageError: see `chain_starts`.
    """
    if spec.out.suffix != SPAWNS_SUFFIX:
        raise wrong_value("out", str(spec.out), f"a name that ends with {SPAWNS_SUFFIX}")
    if spec.out.exists() and not spec.overwrite:
        raise fault(spec.out, "exists; add --overwrite, or choose another --out.")
    config = _common_options(spec)
    if config["subtask"] and 0 in spec.after:
        raise wrong_value(
            "subtask",
            config["subtask"],
            "that of whole tasks, whose episodes hold starts",
            f"Record such: mjhab generate --task {config['task']} --navigate drive; or take later states by --after",
        )
    rows: list[SpawnRow] = []
    began: set[str] = set()
    layout = None
    for made, batch in batches(
        spec.places, lambda run: recorded_env(run, num_envs=1), spec.filter()
    ):
        env = cast("SequentialTaskEnv", made)
        layout = env.layout
        # A recording may be of a version that had other walls.
        config["assets"] = pack_request(env.config.assets).as_json()
        for recorded in batch:
            # Only for the message: what else could have been asked for.
            began |= {f"{each.kind}/{kind_of(each.target)}" for each in _begun(recorded)}
            episode = env.make_episode(recorded.record.seed, recorded.record.index)
            # The plan of a single subtask is one entry of the whole plan.
            first = env.source.start(episode).position if config["subtask"] else 0
            for start in _starts(recorded, spec, episode, env.sim.addresses, first):
                rows.append(
                    replace(start, episode=replace(start.episode, index=len(rows)))
                )
    # The loop may have found no episode at all.
    if layout is None or not rows:
        wanted = "/".join(filter(None, (spec.subtask, spec.target)))
        if wanted in began or any(each.startswith(f"{wanted}/") for each in began):
            short = f"less: no {wanted} of these episodes went on for so many control steps without success"
            raise wrong_value("after", spec.after, short)
        raise unknown_name("subtask that began in these episodes", wanted, sorted(began))
    recipe = SpawnRecipe(
        subtask=spec.subtask,
        target=spec.target,
        seed=rows[0].episode.seed,
        count=len(rows),
        **{name: config[name] for name in _SAME},
    )
    return write(spec.out, header_of(recipe, layout, {}), pack_rows(rows))


def _common_options(spec: ChainStartsSpec) -> dict[str, Any]:
    """Options of the environment of the episodes that pass the filter: those of `_SAME`, and the subtask.

    Raises:
        UsageError: they were recorded with several, or none passes.
    """
    found: dict[str, Any] = {}
    where = spec.filter()
    for entry in entries(spec.places):
        if where is not None and not where(entry.record, entry.run):
            continue
        given = entry.run.config.get("env") or {}
        for name in (*_SAME, "subtask"):
            value = given.get(name, getattr(EnvConfig, name, ""))
            if found.setdefault(name, value) != value:
                raise UsageError(
                    f"the episodes have {name} {found[name]!r} and {value!r}; a spawn set has one: make a set of each, "
                    "for instance with --where."
                )
    if not found:
        raise nothing_passes()
    return found


def _begun(recorded: RecordedEpisode) -> list[Any]:
    """Entries of the plan whose subtask was active in a control step."""
    plan = recorded.record.plan
    active = np.unique(recorded.array("subtasks/active")).tolist()
    return [plan[k] for k in active if k < len(plan)]


def _starts(
    recorded: RecordedEpisode,
    spec: ChainStartsSpec,
    episode: Episode,
    addresses: Addresses,
    first: int,
) -> Iterator[SpawnRow]:
    """States of a recorded episode in which the subtask began, or later, with objects and links as they are then.

    ``first``: position of the recorded plan in that of the whole task.
    """
    active = recorded.array("subtasks/active")
    states = recorded.array("states/qpos")
    # Of single subtasks; a whole task goes on to its next subtask with the success of one.
    success = recorded.array("reward/success")
    for position, entry in enumerate(recorded.record.plan):
        about = (entry.target, kind_of(entry.target))
        steps = np.flatnonzero(active == position)
        if entry.kind != spec.subtask or not len(steps):
            continue
        if spec.target and spec.target not in about:
            continue
        for after in spec.after:
            if len(steps) <= after or success[steps[:after]].any():
                continue
            # The first state of the subtask is the one in which the drive before it ended.
            qpos = states[steps[after]]
            columns = addresses.object_q[:, None] + np.arange(7)
            now = replace(
                episode, object_pose=qpos[columns], link_q=qpos[addresses.link_q].copy()
            )
            yield SpawnRow(now, qpos, first + position, fallback=False, tries=1)
