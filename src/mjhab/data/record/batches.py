"""Recorded episodes in batches for the environment that they were recorded in."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from mjhab.core.errors import fault
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import nothing_passes
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.episode_files import EpisodeEntry
from mjhab.data.store.places import entries
from mjhab.data.store.reading import RecordedEpisode, open_shard

MakeEnv = Callable[[RunInfo], RecordedEnv]
"""Makes an environment (autoreset "disabled") equal to the one that a run was recorded in."""


def batches(
    places: Path | Sequence[Path], make_env: MakeEnv, where: Filter | None
) -> Iterator[tuple[RecordedEnv, list[RecordedEpisode]]]:
    """Batches of an environment and episodes of one config, at most as many as it has worlds.

    Raises:
        UsageError: no episode passes the filter, or one has no states.
    """
    # Grouped, because an environment takes seconds to make and serves one configuration.
    groups: dict[str, list[EpisodeEntry]] = defaultdict(list)
    for entry in entries(places, copies=True):
        if where is None or where(entry.record, entry.run):
            groups[entry.run.config_id].append(entry)
    if not groups:
        raise nothing_passes()
    for members in groups.values():
        # Before the environment is made, which costs seconds.
        require_states(members)
        env = make_env(members[0].run)
        for start in range(0, len(members), env.num_envs):
            batch = members[start : start + env.num_envs]
            with ExitStack() as stack:
                # Episodes are read faster while their file is open.
                shards = {
                    path: stack.enter_context(open_shard(path))
                    for path in dict.fromkeys(entry.path for entry in batch)
                }
                yield env, [shards[each.path].episode(each.name) for each in batch]


def require_states(members: Sequence[EpisodeEntry]) -> None:
    """Refuse imported episodes, which mjhab did not simulate.

    Raises:
        UsageError: the source of an episode had no states.
    """
    for episode in members:
        if "states/initial" in episode.run.absent:
            raise fault(
                f"episode {episode.name} of {episode.path}",
                "was imported from data without states, so it can "
                'neither be simulated again nor rendered; leave it out with a filter such as --where "policy == '
                "'expert'\".",
            )
