"""Demonstrations by the scripted expert, which acts in the training environment with its rewards."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

from mjhab.experts import make_expert
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder
from mjhab.learning.reinforcement.environments import demonstration_env
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.session import ReinforcementSession
from mjhab.learning.runs import distributed
from mjhab.tasks.style import Styles

DEMONSTRATION_WORLDS = 16
"""Number of parallel worlds that the expert acts in."""
DEMONSTRATION_SEED = 3_000_000
"""Offset of the demonstrations' seeds, so that they share no episode with training or evaluation."""


def collect_demonstrations(
    session: ReinforcementSession,
    episodes: int,
    make: Callable[[int], ReplayBuffer],
    tell: Callable[[int], object],
    style: tuple[str, ...] = (),
) -> ReplayBuffer:
    """Record at least ``episodes`` whole episodes of the expert into a replay buffer.

    Failed episodes are kept, too: the critics learn from their rewards.

    The buffer holds the intended actions. With noise in the style they differ from the executed ones (DART, arXiv
    1703.09327): a policy that imitates them knows the way back.

    Args:
        session: of the run. make: makes a buffer for a number of worlds.
        tell: called with the number of finished episodes. style: of the expert, see `Styles.parse`.

    Raises:
        OutOfTime: the rest of the time budget is needed for the evaluations.
    """
    began = time.perf_counter()
    play = _Play(session, min(DEMONSTRATION_WORLDS, episodes), Styles.parse(style))
    buffer = make(play.worlds)
    # Whole rounds: worlds that end early would otherwise start episodes that nobody finishes.
    rounds = -(-episodes // play.worlds)
    whole = rounds * play.worlds
    work = f"{whole} episodes of the expert"
    session.expect_work(whole, work, "--eval-episodes", of_expert=True)
    for number in range(rounds):
        play.record_round(buffer)
        finished = (number + 1) * play.worlds
        seconds = (time.perf_counter() - began) / finished
        session.time.estimate_evaluation(seconds)
        if not number:
            session.time.measured(seconds)
        # Several processes decide together, and only their numbers of rounds are the same.
        session.check_time()
        tell(min(finished, episodes))
    return buffer


class _Play:
    """The expert in an environment of its own, with a run's observations.

    Args:
        session: of the run. worlds: number of parallel worlds. styles: of the expert.
    """

    def __init__(
        self, session: ReinforcementSession, worlds: int, styles: Styles
    ) -> None:
        self.worlds = worlds
        self._session = session
        self._env = demonstration_env(
            session.spec.scene,
            session.config,
            worlds,
            session.spec.threads,
            DEMONSTRATION_SEED + session.seed,
        )
        self._encoder = AgentEncoder(
            self._env, session.layout, session.config.privileged_critic
        )
        self._expert = make_expert(self._env, styles)
        self._every = torch.ones(worlds, dtype=torch.bool)
        self._begun = False

    def record_round(self, buffer: ReplayBuffer) -> None:
        """Play one episode in every world and add its steps to a buffer.

        Raises:
            OutOfTime: the rest of the time budget is needed for the evaluations.
        """
        device = self._session.worlds.device
        obs, info = self._begin_episodes()
        seen = self._encoder.see(obs, info)
        ended = torch.zeros(self.worlds, dtype=torch.bool)
        # Episodes go on past success until the horizon, so that the buffer's rings stay side by side.
        while not bool(ended.all()):
            executed = torch.from_numpy(self._expert.act(obs, info))
            intended = torch.from_numpy(self._expert.notes().intended)
            obs, reward, terminated, truncated, info = self._env.step(executed.numpy())
            self._encoder.executed(executed)
            following = self._encoder.see(obs, info)
            paid, over = self._session.worlds.rules.apply(
                torch.from_numpy(reward).float(), torch.from_numpy(terminated), info
            )
            buffer.add(
                # The intended action, as imitation takes it; the rewards are those of the executed one.
                seen.to(device),
                intended.to(device),
                paid.to(device),
                over.to(device),
            )
            seen = following
            ended = ended | torch.from_numpy(terminated | truncated)
            # Processes must not leave each other alone in the middle of a round.
            if distributed.processes() == 1:
                self._session.check_time()
        buffer.close(torch.arange(self.worlds, device=device), seen.to(device))

    def _begin_episodes(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """First observations and info of the next episode of every world."""
        # Only the first reset names the seed: later ones go on to new episodes.
        seed = None if self._begun else DEMONSTRATION_SEED + self._session.seed
        obs, info = self._env.reset(seed=seed)
        self._begun = True
        self._expert.reset(self._every.numpy())
        self._encoder.begin(self._every)
        return obs, info
