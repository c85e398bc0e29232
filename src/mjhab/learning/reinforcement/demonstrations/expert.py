"""Demonstrations by the scripted expert, which acts in the training environment with its rewards."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from mjhab.learning.reinforcement import distributed
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.session import ReinforcementSession, demonstration_env
from mjhab.learning.reinforcement.sight import Sight
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
    from mjhab.experts import make_expert

    began = time.perf_counter()
    worlds_count = min(DEMONSTRATION_WORLDS, episodes)
    buffer = make(worlds_count)
    env = demonstration_env(
        session.request.scene,
        session.config.inputs,
        worlds_count,
        session.request.threads,
        DEMONSTRATION_SEED + session.seed,
    )
    sight = Sight(env, session.layout, session.config.privileged_critic)
    expert = make_expert(env, Styles.parse(style))
    obs, info = env.reset(seed=DEMONSTRATION_SEED + session.seed)
    every = torch.ones(worlds_count, dtype=torch.bool)
    expert.reset(every.numpy())
    still = torch.zeros(worlds_count, len(session.layout.actions))
    sight.begin(every, info)
    seen = sight.see(obs, info, still, every)
    finished = 0
    device = session.worlds.device
    rounds = -(-episodes // worlds_count)
    for number in range(rounds):
        ended = torch.zeros(worlds_count, dtype=torch.bool)
        while not bool(ended.all()):
            executed = torch.from_numpy(expert.act(obs, info))
            intended = torch.from_numpy(expert.notes().intended)
            obs, reward, terminated, truncated, info = env.step(executed.numpy())
            over = torch.from_numpy(terminated | truncated)
            following = sight.see(obs, info, executed, ~every)
            buffer.add(
                seen.to(device),
                intended.to(device),
                torch.from_numpy(reward).float().to(device),
                torch.from_numpy(terminated).to(device),
            )
            seen = following
            ended = ended | over
            if distributed.processes() == 1:
                session.check_time()
        buffer.close(torch.arange(worlds_count, device=device), seen.to(device))
        finished += worlds_count
        session.estimate_evaluation((time.perf_counter() - began) / finished)
        # Several processes decide together, and only their numbers of rounds are the same.
        session.check_time()
        tell(min(finished, episodes))
        if number + 1 < rounds:
            obs, info = env.reset()
            expert.reset(every.numpy())
            sight.begin(every, info)
            seen = sight.see(obs, info, still, every)
    return buffer
