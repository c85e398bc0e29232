"""Two processes that average gradients learn what one with twice the worlds learns."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from torch.multiprocessing.spawn import spawn

from mjhab.learning.reinforcement.agent_encoder import AgentEncoder, AgentObs
from mjhab.learning.reinforcement.configs import changed
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.reinforcement.ppo.learner import PpoLearner, Rollout
from mjhab.learning.reinforcement.worlds import Worlds
from mjhab.learning.runs import distributed
from tests.learning.reinforcement.toy import LAYOUT, PPO_TOY, Toy

CONFIG = changed(PPO_TOY, {"minibatches": 1, "epochs": 2, "target_kl": 0.0})
ROWS = 64


def rollout(rows: slice) -> Rollout:
    """A part of a made-up rollout."""
    random = torch.Generator().manual_seed(0)
    vector = torch.randn(ROWS, 1, generator=random)[rows]
    count = len(vector)
    images = torch.zeros(count, 0, 0, 0, dtype=torch.uint8)
    actions = torch.randn(ROWS, 1, generator=random)[rows]
    numbers = torch.randn(3, ROWS, generator=random)[:, rows]
    seen = AgentObs(vector, images, torch.zeros(count, 0))
    return Rollout(seen, actions, numbers[0] - 1.0, actions, numbers[1], numbers[2])


def learn(rows: slice) -> dict[str, torch.Tensor]:
    """Weights after one update from a part of the rollout."""
    agent = Ppo(CONFIG, LAYOUT, 0, seed=0)
    env = Toy(2)
    learner = PpoLearner(
        agent, Worlds(env, AgentEncoder(env, LAYOUT, False), 0), CONFIG, seed=0
    )
    learner.update(rollout(rows), 0.0)
    return agent.state_dict()


def process(number: int, folder: str) -> None:
    """One of two processes."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/meet", rank=number, world_size=2
    )
    half = slice(number * ROWS // 2, (number + 1) * ROWS // 2)
    torch.save(learn(half), f"{folder}/{number}.pt")
    torch.distributed.destroy_process_group()


def test_two_processes_learn_what_one_learns_from_all() -> None:
    assert distributed.processes() == 1
    with tempfile.TemporaryDirectory() as folder:
        spawn(process, (folder,), nprocs=2)
        first, second = (
            torch.load(Path(folder) / f"{number}.pt", weights_only=True)
            for number in range(2)
        )
    alone = learn(slice(0, ROWS))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        assert torch.allclose(value, alone[name], atol=1e-5), name
