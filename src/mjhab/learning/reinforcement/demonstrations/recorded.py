"""Recorded demonstrations for reinforcement: their actions are simulated again in the environment of the run.

So rewards, images and what only a simulator knows are those that the run learns from, whatever was recorded.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from mjhab.core.errors import UsageError
from mjhab.data.record.replay import require_states
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import select
from mjhab.data.store.reading import Episode, open_shard
from mjhab.evaluation.recorded import recorded_env
from mjhab.learning.demos import SUCCESSES, nothing_to_learn, recorded_profile
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.session import ReinforcementSession, image_options
from mjhab.learning.reinforcement.sight import Seen, Sight

WORLDS = 16
REWARD_OPTIONS = ("reward_mode", "reward_formula", "reward_normaliser")
NOT_FROM_THE_RUN = ("profile", "spawn_rule", "horizon", "cameras", "frame_stack")
"""Options of a profile that stay those of the recording, or that the policy's view decides."""


def replay_recorded(
    session: ReinforcementSession,
    make: Callable[[int, int], ReplayBuffer],
    tell: Callable[[int, int], object],
) -> ReplayBuffer:
    """Simulate recorded episodes again, into a buffer.

    Args:
        session: of the run; its request names shards and filter.
        make: makes the buffer for so many worlds and control steps of each.
        tell: called with finished and with all episodes.

    Raises:
        UsageError: no episode passes the filter; one has another subtask, robot or control; or its profile or rewards
            are not those of the run, and recomputing them was not asked for.
    """
    request = session.request
    where = Filter(request.where or SUCCESSES)
    found = select(list(request.data), where)
    if not found.matched:
        raise nothing_to_learn()
    total = len(found.matched)
    longest = max(record.steps for record in found.records)
    # Episodes of one recording are simulated together; its name begins those of its episodes.
    recordings = {(path, name.partition("-")[0]) for path, name in found.matched}
    batches = total // WORLDS + len(recordings)
    buffer = make(min(WORLDS, total), batches * (longest + 1))
    by_shard: dict[Any, list[str]] = defaultdict(list)
    for path, name in found.matched:
        by_shard[path].append(name)
    done = 0
    for path, names in by_shard.items():
        with open_shard(path) as shard:
            groups: dict[str, list[Episode]] = defaultdict(list)
            for name in names:
                episode = shard.episode(name)
                check_episode(session, episode)
                groups[episode.run.config_id].append(episode)
            for members in groups.values():
                require_states(members)
                player = _Player(session, members[0], buffer.shape.worlds)
                for start in range(0, len(members), buffer.shape.worlds):
                    batch = members[start : start + buffer.shape.worlds]
                    player.play(batch, buffer)
                    done += len(batch)
                    tell(done, total)
    return buffer


def check_episode(session: ReinforcementSession, episode: Episode) -> None:
    """Refuse an episode whose actions mean something else, or whose rewards are other ones than those of the run.

    Raises:
        UsageError: what differs, and what to do.
    """
    config = session.env.config
    env = episode.run.config["env"]
    for name in ("task", "subtask", "robot", "control_mode", "base"):
        wanted = getattr(config, name)
        if env.get(name, wanted) != wanted:
            raise UsageError(
                f"episode {episode.name} of {episode.shard.path} was recorded with {name} {env[name]!r}, and the run "
                f"learns with {wanted!r}; choose others with --where."
            )
    if session.request.recompute_rewards:
        return
    wrong = []
    profile = recorded_profile(episode)
    if profile != session.layout.profile:
        wrong.append(f"profile {profile} instead of {session.layout.profile}")
    for name in REWARD_OPTIONS:
        recorded = episode.run.options.get(name, "")
        if recorded != getattr(config, name):
            wrong.append(f"{name} {recorded or 'sparse'} instead of {getattr(config, name)}")
    if wrong:
        raise UsageError(
            f"episode {episode.name} of {episode.shard.path} was recorded with {', '.join(wrong)}. With "
            "--recompute-rewards its actions are simulated again, from its first state, with the profile and the "
            "rewards of the run."
        )


class _Player:
    """Simulates episodes of one recording again, in worlds with the rules and rewards of the run."""

    def __init__(self, session: ReinforcementSession, like: Episode, worlds: int) -> None:
        config = session.env.config
        rules = {
            name: value
            for name, value in config.of_profile().items()
            if name not in NOT_FROM_THE_RUN
        }
        env_config = {**like.run.config["env"], **rules, "continuous": True}
        run = dataclasses.replace(like.run, config={**like.run.config, "env": env_config})
        self._env = recorded_env(
            run,
            num_envs=worlds,
            threads=session.request.threads,
            reward_mode=config.reward_mode,
            **image_options(session.config.inputs),
        )
        self._sight = Sight(self._env, session.layout, session.config.privileged_critic)
        self._width = len(session.layout.actions)
        self._device = session.worlds.device

    def play(self, batch: Sequence[Episode], buffer: ReplayBuffer) -> None:
        """Simulate at most W episodes again, and add their control steps but the first, which only leads there."""
        env = self._env
        count = len(batch)
        mine = torch.arange(env.num_envs) < count
        seeds = [episode.record.seed for episode in batch] + [None] * (env.num_envs - count)
        indices = np.array([episode.record.index for episode in batch])
        _, info = env.reset(seed=seeds, options={"episode": indices, "reset_mask": mine.numpy()})
        for world, episode in enumerate(batch):
            # What begins elsewhere with this version begins where it was recorded all the same.
            env.set_state(world, episode.initial())
        self._sight.begin(mine, info)
        recorded = [episode.array("actions") for episode in batch]
        longest = max(len(actions) for actions in recorded)
        seen: Seen | None = None
        fresh = mine
        for t in range(longest):
            actions = np.zeros((env.num_envs, self._width), np.float32)
            for world, rows in enumerate(recorded):
                if t < len(rows):
                    actions[world] = rows[t]
            obs, reward, terminated, _, info = env.step(actions)
            taken = torch.from_numpy(actions)
            following = self._sight.see(obs, info, taken, fresh)
            fresh = torch.zeros_like(mine)
            active = torch.tensor([w for w, rows in enumerate(recorded) if t < len(rows)])
            if seen is not None:
                buffer.add(
                    seen.rows(active).to(self._device),
                    taken[active].to(self._device),
                    torch.from_numpy(reward).float()[active].to(self._device),
                    torch.from_numpy(terminated)[active].to(self._device),
                    active.to(self._device),
                )
            seen = following
            over = torch.tensor([w for w, rows in enumerate(recorded) if t == len(rows) - 1])
            if len(over):
                buffer.close(over.to(self._device), seen.rows(over).to(self._device))
