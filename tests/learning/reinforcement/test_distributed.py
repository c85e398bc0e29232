"""Two processes: their averaged gradients, runs of both that go on after a kill, and what is told."""

from __future__ import annotations

import dataclasses
import os
import socket
from pathlib import Path

import pytest
import torch
from torch.multiprocessing.spawn import spawn

from mjhab.cli.policies import train as command
from mjhab.learning.checkpoint import load_checkpoint
from mjhab.learning.reinforcement import session as sessions
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import SAC, SacConfig, changed
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.reinforcement.ppo.learner import PpoLearner
from mjhab.learning.reinforcement.ppo.rollout import Rollout
from mjhab.learning.reinforcement.worlds import Worlds
from mjhab.learning.runs import distributed
from mjhab.learning.runs.run import TrainingResult
from tests.learning.reinforcement.test_runs import TINY, Killed, request
from tests.learning.reinforcement.toy import LAYOUT, PPO_TOY, Toy, encoder_of
from tests.learning.small import train_in

CONFIG = changed(PPO_TOY, {"minibatches": 1, "epochs": 2, "target_kl": 0.0})
ROWS = 64
SHORT_EPISODES = dataclasses.replace(
    TINY,
    algorithm=SAC,
    ppo=None,
    sac=SacConfig(batch=8, warm_up=32, capacity=640, updates_per_step=0.25),
    samples=288,
    checkpoint_samples=96,
    horizon=5,
    worlds=4,
)
"""Episodes end at other steps in each of two processes."""


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
    learner = PpoLearner(agent, Worlds(env, encoder_of(env), 0), CONFIG, seed=0)
    learner.update(rollout(rows), 0.0)
    return agent.state_dict()


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def process(number: int, folder: str, port: int) -> None:
    """One of two processes, as torchrun starts them: it learns, it trains, and it trains, is killed and resumes."""
    own = {
        "RANK": number,
        "WORLD_SIZE": 2,
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": port,
    }
    os.environ |= {name: str(value) for name, value in own.items()}
    torch.set_num_threads(1)
    distributed.join()
    half = slice(number * ROWS // 2, (number + 1) * ROWS // 2)
    torch.save(learn(half), f"{folder}/{number}.pt")
    told = request(SHORT_EPISODES)
    timed = dataclasses.replace(told, budget_minutes=10.0)
    # A run that is over makes no more samples when it is resumed.
    for resume in (False, True):
        train_in(timed, Path(folder) / "whole", resume)
    check = sessions.ReinforcementSession.check_time

    def killed(self: sessions.ReinforcementSession) -> None:
        if self.state.samples >= 200:
            raise Killed
        check(self)

    sessions.ReinforcementSession.check_time = killed  # type: ignore[method-assign]
    with pytest.raises(Killed):
        train_in(told, Path(folder) / "killed")
    sessions.ReinforcementSession.check_time = check  # type: ignore[method-assign]
    train_in(told, Path(folder) / "killed", resume=True)
    torch.distributed.destroy_process_group()


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What two processes left."""
    assert distributed.processes() == 1
    folder = tmp_path_factory.mktemp("two")
    spawn(process, (str(folder), free_port()), nprocs=2)
    return folder


def test_two_processes_learn_what_one_learns_from_all(left: Path) -> None:
    first, second = (
        torch.load(left / f"{number}.pt", weights_only=True) for number in range(2)
    )
    alone = learn(slice(0, ROWS))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        assert torch.allclose(value, alone[name], atol=1e-5), name


def test_each_of_two_processes_goes_on_with_its_own_buffer(left: Path) -> None:
    whole = load_checkpoint(left / "whole" / "training.safetensors")
    assert whole.about["samples"] == SHORT_EPISODES.samples, "those of both count"
    wanted = whole.tensors
    found = load_checkpoint(left / "killed" / "training.safetensors").tensors
    assert all(torch.equal(value, found[name]) for name, value in wanted.items())


@pytest.mark.parametrize(
    ("processes", "gpus", "nccl"),
    [(2, 0, False), (4, 1, False), (1, 1, True), (8, 8, True)],
)
def test_nccl_only_where_every_process_has_a_gpu(
    processes: int, gpus: int, nccl: bool
) -> None:
    assert ("nccl" in distributed.backends(processes, gpus)) is nccl


@pytest.mark.parametrize(("rank", "lines"), [(0, 1), (1, 0)])
def test_the_first_process_alone_tells_the_results(
    rank: int,
    lines: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    summary = {"trained": True, "success_once": None, "checkpoint": "here"}
    result = TrainingResult(summary, tmp_path / "report.html", interrupted=False)
    monkeypatch.setattr(command, "train_spec", lambda spec: result)
    monkeypatch.setattr(distributed, "rank", lambda: rank)
    assert command.run_train(request(TINY), json=True) == 0
    assert len(capsys.readouterr().out.splitlines()) == lines
