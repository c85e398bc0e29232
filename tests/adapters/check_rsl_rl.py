"""rsl_rl trains in a mjhab environment: run by `make test-rsl-rl`, in an environment that has it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rsl_rl import runners  # pyright: ignore[reportMissingImports]

import mjhab
from mjhab.core.errors import UsageError
from mjhab.integrations.rsl_rl import to_rsl_rl

HORIZON = 6
OPTIONS = {
    "task": "set_table",
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "num_envs": 2,
    "horizon": HORIZON,
    "episode_pool": 2,
}
MODEL = {
    "class_name": "MLPModel",
    "hidden_dims": [32],
    "activation": "elu",
}
TRAINING = {
    "num_steps_per_env": 8,
    "save_interval": 100,
    "obs_groups": {"actor": ["state"], "critic": ["state"]},
    "actor": {
        **MODEL,
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0},
    },
    "critic": MODEL,
    "algorithm": {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 2},
}


def test_time_outs_are_told() -> None:
    env = to_rsl_rl(mjhab.make_train(**OPTIONS))
    still = torch.zeros(2, 13)
    for step in range(1, HORIZON + 1):
        obs, reward, done, extras = env.step(still)
        assert bool(done.all()) == bool(extras["time_outs"].all()) == (step == HORIZON)
    assert obs["state"].shape == (2, 42) and reward.shape == (2,)
    assert env.episode_length_buf.tolist() == [0, 0]


def test_ppo_trains(tmp_path: Path) -> None:
    env = to_rsl_rl(mjhab.make_train(**OPTIONS))
    runner = runners.OnPolicyRunner(env, TRAINING, str(tmp_path), "cpu")
    policy = runner.alg.get_policy()
    before = [value.clone() for value in policy.parameters()]
    runner.learn(2)
    assert any((a != b).any() for a, b in zip(before, policy.parameters(), strict=True))


def test_bad_input_is_told() -> None:
    with pytest.raises(UsageError, match="same_step"):
        to_rsl_rl(mjhab.make_train(**OPTIONS, autoreset="disabled"))
