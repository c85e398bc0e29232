"""skrl trains in a mjhab environment without an adapter: run by `make test-skrl`, in an environment that has it."""

from __future__ import annotations

from typing import Any

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG  # pyright: ignore[reportMissingImports]
from skrl.envs.wrappers.torch import wrap_env  # pyright: ignore[reportMissingImports]
from skrl.memories.torch import RandomMemory  # pyright: ignore[reportMissingImports]
from skrl.trainers.torch import (  # pyright: ignore[reportMissingImports]
    SequentialTrainer,
    SequentialTrainerCfg,
)
from skrl.utils.model_instantiators.torch import (  # pyright: ignore[reportMissingImports]
    deterministic_model,
    gaussian_model,
)

import mjhab
from mjhab.envs.observations.state import state_dim
from mjhab.robots.fetch.robot import ROBOT

HORIZON = 6
OPTIONS: dict[str, Any] = {
    "task": "set_table",
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "num_envs": 2,
    "horizon": HORIZON,
    "episode_pool": 2,
    "obs_keys": "whole",
}
ROLLOUT = 4


def test_wrap_env_recognises_the_vector_environment_by_itself() -> None:
    env = wrap_env(mjhab.make_train(**OPTIONS))
    assert type(env).__name__ == "GymnasiumWrapper" and env.num_envs == 2
    obs, _ = env.reset()
    assert obs.shape == (2, state_dim(ROBOT))
    for _ in range(HORIZON):
        obs, reward, terminated, truncated, _ = env.step(torch.zeros(2, 13))
    assert truncated.all() and not terminated.any()
    assert obs.shape == (2, state_dim(ROBOT)) and reward.shape == (2, 1)


def test_ppo_trains() -> None:
    env = wrap_env(mjhab.make_train(**OPTIONS))
    network = [
        {
            "name": "net",
            "input": "OBSERVATIONS['state']",
            "layers": [32],
            "activations": "elu",
        }
    ]
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
    }
    models = {
        "policy": gaussian_model(
            **spaces, device="cpu", network=network, output="ACTIONS"
        ),
        "value": deterministic_model(
            **spaces, device="cpu", network=network, output="ONE"
        ),
    }
    for model in models.values():
        model.init_state_dict(role="")
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=ROLLOUT, num_envs=env.num_envs, device="cpu"),
        **spaces,
        device="cpu",
        cfg=PPO_CFG(rollouts=ROLLOUT, learning_epochs=1),
    )
    before = [value.clone() for value in models["policy"].parameters()]
    told = SequentialTrainerCfg(timesteps=2 * ROLLOUT, headless=True)
    SequentialTrainer(cfg=told, env=env, agents=agent).train()
    after = models["policy"].parameters()
    assert any((a != b).any() for a, b in zip(before, after, strict=True))
