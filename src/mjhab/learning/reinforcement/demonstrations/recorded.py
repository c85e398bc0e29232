"""Demonstrations from recorded episodes: their actions are simulated again in the environment of the run.

So rewards, images and privileged inputs are those of the run, whatever the recording contains.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from mjhab.core.errors import fault
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import select
from mjhab.data.store.places import Place
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.evaluation.recorded import recorded_env
from mjhab.learning.demos import (
    SUCCESSES,
    nothing_to_learn,
    recorded_profile,
)
from mjhab.learning.observation.recorded import lacks_states
from mjhab.learning.observation.spec import image_options
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder, AgentObs
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.session import ReinforcementSession

WORLDS = 16
"""Largest number of episodes simulated in parallel."""
REWARD_OPTIONS = ("reward_mode", "reward_formula", "reward_normaliser")
"""Environment options that determine rewards."""
NOT_FROM_THE_RUN = ("profile", "spawn_rule", "horizon", "cameras", "frame_stack")
"""Options of the profile that are not taken from the run: the recording or the policy's inputs determine them."""


def replay_recorded(
    session: ReinforcementSession,
    make: Callable[[int, int], ReplayBuffer],
    tell: Callable[[int, int], object],
) -> ReplayBuffer:
    """Simulate recorded episodes again and store them in a replay buffer.

    Args:
        session: of the run; its spec names shards and filter.
        make: makes a buffer for a number of worlds and a number of control steps per world.
        tell: called with the number of finished episodes and the number of all episodes.

    Raises:
        UsageError: no episode passes the filter; or an episode has another subtask, robot or control mode than the
            run; or it has another profile or other rewards and the spec does not set ``recompute_rewards``.
    """
    spec = session.spec
    where = Filter(spec.where or SUCCESSES)
    found = select(list(spec.data), where)
    if not found.matched:
        raise nothing_to_learn()
    total = len(found.matched)
    longest = max(record.steps for record in found.records)
    # Episodes of one recording are simulated together; their names start with that of the recording.
    recordings: dict[str, list[Place]] = defaultdict(list)
    for path, name in found.matched:
        recordings[name.partition("-")[0]].append((path, name))
    # Each recording may end with a batch that is not full.
    batches = total // WORLDS + len(recordings)
    # One more entry per episode, for its last observation.
    buffer = make(min(WORLDS, total), batches * (longest + 1))
    done = 0
    for members in recordings.values():
        episodes = [_episode(session, *member) for member in members]
        player = _Player(session, episodes[0], buffer.shape.worlds)
        for start in range(0, len(episodes), buffer.shape.worlds):
            batch = episodes[start : start + buffer.shape.worlds]
            player.play(batch, buffer)
            done += len(batch)
            tell(done, total)
    return buffer


def _episode(session: ReinforcementSession, path: Path, name: str) -> RecordedEpisode:
    """An episode that is checked; its file is opened again when it is played."""
    with open_shard(path) as shard:
        episode = shard.episode(name)
        check_episode(session, episode)
        return episode


def check_episode(session: ReinforcementSession, episode: RecordedEpisode) -> None:
    """Refuse an episode whose actions have another meaning than in the run, or whose rewards differ from the run's.

    Raises:
        UsageError: it was imported without states; or names the difference and the remedy.
    """
    if lacks_states(episode):
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            "was imported from data without states, so its actions "
            "cannot be simulated again, as reinforcement learning does with demonstrations. Imitate it instead "
            "(mjhab train bc --data ...), exclude it with --where, or leave out --data: the expert then generates "
            "demonstrations in the environment.",
        )
    config = session.env.config
    env = episode.run.config["env"]
    for name in ("task", "subtask", "robot", "control_mode", "base"):
        wanted = getattr(config, name)
        if env.get(name, wanted) != wanted:
            raise fault(
                f"episode {episode.name} of {episode.shard.path}",
                f"was recorded with {name} {env[name]!r}, but the run "
                f"uses {wanted!r}; exclude such episodes with --where.",
            )
    if session.spec.recompute_rewards:
        return
    wrong = []
    profile = recorded_profile(episode)
    if profile != session.layout.profile:
        wrong.append(f"profile {profile} instead of {session.layout.profile}")
    for name in REWARD_OPTIONS:
        recorded = episode.run.options.get(name, "")
        if recorded != getattr(config, name):
            wrong.append(
                f"{name} {recorded or 'sparse'} instead of {getattr(config, name)}"
            )
    if wrong:
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            f"was recorded with {', '.join(wrong)}. With "
            "--recompute-rewards its actions are simulated again, from its first state, with the profile and the "
            "rewards of the run.",
        )


class _Player:
    """Simulates episodes of one recording again, with the rules and rewards of the run."""

    def __init__(
        self, session: ReinforcementSession, like: RecordedEpisode, worlds: int
    ) -> None:
        config = session.env.config
        rules = {
            name: value
            for name, value in config.of_profile().items()
            if name not in NOT_FROM_THE_RUN
        }
        # Continuous: the environment must not end an episode before its recorded actions do.
        env_config = {**like.run.config["env"], **rules, "continuous": True}
        run = dataclasses.replace(like.run, config={**like.run.config, "env": env_config})
        self._env = recorded_env(
            run,
            num_envs=worlds,
            threads=session.spec.threads,
            reward_mode=config.reward_mode,
            **image_options(session.config.inputs),
        )
        self._encoder = AgentEncoder(
            self._env, session.layout, session.config.privileged_critic
        )
        self._width = len(session.layout.actions)
        self._device = session.worlds.device
        self._rules = session.worlds.rules

    def play(self, batch: Sequence[RecordedEpisode], buffer: ReplayBuffer) -> None:
        """Simulate at most W episodes and add their control steps to the buffer, except the first step of each."""
        env = self._env
        count = len(batch)
        mine = torch.arange(env.num_envs) < count
        seeds = [episode.record.seed for episode in batch] + [None] * (
            env.num_envs - count
        )
        indices = np.array([episode.record.index for episode in batch])
        env.reset(seed=seeds, options={"episode": indices, "reset_mask": mine.numpy()})
        for world, episode in enumerate(batch):
            # This version may generate another start state, so the recorded one is set.
            env.set_state(world, episode.initial())
        self._encoder.begin(mine)
        recorded = [episode.array("actions") for episode in batch]
        longest = max(len(actions) for actions in recorded)
        seen: AgentObs | None = None
        for t in range(longest):
            # Worlds whose episode is over stand still.
            actions = np.zeros((env.num_envs, self._width), np.float32)
            for world, rows in enumerate(recorded):
                if t < len(rows):
                    actions[world] = rows[t]
            obs, reward, terminated, _, info = env.step(actions)
            taken = torch.from_numpy(actions)
            self._encoder.executed(taken)
            following = self._encoder.see(obs, info)
            active = torch.tensor([w for w, rows in enumerate(recorded) if t < len(rows)])
            # `set_state` gives no observation, so that the first one is that after the first step.
            if seen is not None:
                paid, ended = self._rules.apply(
                    torch.from_numpy(reward).float(), torch.from_numpy(terminated), info
                )
                buffer.add(
                    seen.rows(active).to(self._device),
                    taken[active].to(self._device),
                    paid[active].to(self._device),
                    ended[active].to(self._device),
                    active.to(self._device),
                )
            seen = following
            over = torch.tensor(
                [w for w, rows in enumerate(recorded) if t == len(rows) - 1]
            )
            if len(over):
                buffer.close(over.to(self._device), seen.rows(over).to(self._device))
