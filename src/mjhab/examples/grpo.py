"""A small transformer that reads state, image and sentence, trained by group-relative policy optimization (GRPO).

    python examples/grpo.py --updates 100                     # from states: Close drawer, minutes on one core
    python examples/grpo.py --updates 100 --images --seed 1   # with the images of both cameras

Every update lets each of N starts be tried K times and pays what is better than the others of the same start
(arXiv 2402.03300, Sec. 4.1). The environment is that of RLinf's adapters, `mjhab.integrations.rlinf`.
"""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.distributions import Normal

from mjhab.integrations.rlinf import RLinfEnv

WORDS = 256
"""Entries of the table of hashed words."""
CHUNK = 4
"""Actions that are decided at once."""


class ChunkTransformer(nn.Module):
    """Tokens of the state, of the words and of patches of images; the first one gives the means of the actions."""

    def __init__(self, states: int, actions: int, images: bool, width: int = 64) -> None:
        super().__init__()
        self.actions = actions
        self.state = nn.Sequential(nn.Linear(states, width), nn.LayerNorm(width))
        self.words = nn.EmbeddingBag(WORDS, width, mode="mean")
        self.patches = nn.Conv2d(3, width, 8, 8) if images else None
        layer = nn.TransformerEncoderLayer(width, 4, 2 * width, 0.0, batch_first=True)
        self.body = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
        self.head = nn.Linear(width, CHUNK * actions)
        nn.init.zeros_(self.head.weight)
        self.log_std = nn.Parameter(torch.full((actions,), -1.0))

    def forward(self, obs: dict) -> Normal:
        words = [hashed(sentence) for sentence in obs["task_descriptions"]]
        starts = torch.tensor([0, *[len(w) for w in words[:-1]]]).cumsum(0)
        tokens = [
            self.state(obs["states"])[:, None],
            self.words(torch.cat(words), starts)[:, None],
        ]
        if self.patches is not None:
            for name in ("main_images", "wrist_images"):
                seen = self.patches(obs[name].movedim(-1, 1).float() / 255.0)
                tokens.append(seen.flatten(2).movedim(2, 1))
        first = self.body(torch.cat(tokens, 1))[:, 0]
        mean = self.head(first).unflatten(1, (CHUNK, self.actions))
        return Normal(mean, self.log_std.exp())


def hashed(sentence: str) -> Tensor:
    """Numbers of the words of a sentence, the same on every machine."""
    digests = [hashlib.blake2b(w.encode(), digest_size=2) for w in sentence.split()]
    return torch.tensor([int.from_bytes(d.digest(), "big") % WORDS for d in digests])


@dataclass
class Step:
    """What was seen and done in all worlds. acted (B, CHUNK, A), log_prob (B,), running (B,)."""

    seen: dict
    acted: Tensor
    log_prob: Tensor
    running: Tensor


def collect(
    env: RLinfEnv, policy: ChunkTransformer, chunks: int
) -> tuple[list[Step], Tensor]:
    """Let every start be tried by its group; what was done, and returns (B,)."""
    env.update_reset_state_ids()
    seen, _ = env.reset()
    steps: list[Step] = []
    returns = torch.zeros(env.num_envs)
    running = torch.ones(env.num_envs, dtype=torch.bool)
    with torch.no_grad():
        for _ in range(chunks):
            decided = policy(seen)
            acted = decided.sample()
            log_prob = decided.log_prob(acted).mean((1, 2))
            steps.append(Step(seen, acted, log_prob, running.clone()))
            observations, rewards, ends, cuts, _ = env.chunk_step(acted.clamp(-1, 1))
            seen = observations[-1]
            returns += rewards.sum(1)
            running = running & ~(ends | cuts)[:, -1]
            if not running.any():
                break
    return steps, returns


def advantages(returns: Tensor, group: int) -> Tensor:
    """How much better (B,) than the mean of its group, in standard deviations of the group."""
    groups = returns.unflatten(0, (-1, group))
    spread = groups.std(1, keepdim=True).clamp_min(1e-3)
    return ((groups - groups.mean(1, keepdim=True)) / spread).flatten()


def update(
    policy: ChunkTransformer,
    optimizer: torch.optim.Optimizer,
    steps: list[Step],
    gain: Tensor,
) -> float:
    """Two epochs of the clipped objective; the mean loss."""
    losses = []
    for _ in range(2):
        for step in steps:
            log_prob = policy(step.seen).log_prob(step.acted).mean((1, 2))
            ratio = (
                (CHUNK * policy.actions * (log_prob - step.log_prob)).clamp(-5, 5).exp()
            )
            won = torch.minimum(ratio * gain, ratio.clamp(0.8, 1.2) * gain)
            loss = -(won * step.running).sum() / step.running.sum().clamp_min(1)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()
            losses.append(loss.detach())
    return float(torch.stack(losses).mean())


def main(words: list[str] | None = None) -> list[float]:
    """Train, and print the mean return of every update; the returns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--groups", type=int, default=4, help="starts of an update (N)")
    parser.add_argument("--tries", type=int, default=8, help="tries of every start (K)")
    parser.add_argument("--chunks", type=int, default=15, help="chunks of an episode")
    parser.add_argument("--starts", type=int, default=100, help="starts to draw from")
    parser.add_argument("--images", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(words)
    torch.manual_seed(asked.seed)
    env = RLinfEnv(
        {
            "seed": asked.seed,
            "group_size": asked.tries,
            "num_starts": asked.starts,
            "reward_mode": "raw",
            "init_params": {
                "task": "set_table",
                "subtask": "close",
                "target": "kitchen_counter/drawer3",
                "obs_mode": "rgb" if asked.images else "state",
                "camera_size": 64,
            },
        },
        asked.groups * asked.tries,
    )
    seen, _ = env.reset()
    numbers = seen["states"].shape[1], len(env.env.controller.low)
    policy = ChunkTransformer(*numbers, asked.images)
    optimizer = torch.optim.Adam(policy.parameters(), 3e-4)
    means = []
    for number in range(asked.updates):
        steps, returns = collect(env, policy, asked.chunks)
        update(policy, optimizer, steps, advantages(returns, asked.tries))
        means.append(float(returns.mean()))
        print(f"update {number}: return {means[-1]:.3f}", flush=True)
    env.close()
    return means


if __name__ == "__main__":
    main()
