"""torchrl trains in a mjhab environment: run by `make test-torchrl`, in an environment that has it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import pytest
import torch
from tensordict.nn import TensorDictModule  # pyright: ignore[reportMissingImports]
from torch import nn
from torchrl.data import Unbounded  # pyright: ignore[reportMissingImports]
from torchrl.envs import (  # pyright: ignore[reportMissingImports]
    GymEnv,
    GymWrapper,
    SerialEnv,
    default_info_dict_reader,
)
from torchrl.envs.utils import check_env_specs  # pyright: ignore[reportMissingImports]
from torchrl.modules import (  # pyright: ignore[reportMissingImports]
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss  # pyright: ignore[reportMissingImports]
from torchrl.objectives.value import GAE  # pyright: ignore[reportMissingImports]

import mjhab
from mjhab.core.errors import UsageError
from mjhab.envs.wrappers import FlattenStatePixels, FrameStack
from mjhab.integrations.torchrl import to_torchrl
from tests.docs.pages import ROOT, blocks

HORIZON = 6
OPTIONS = {
    "task": "set_table",
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "num_envs": 2,
    "horizon": HORIZON,
    "episode_pool": 2,
    "autoreset": "disabled",
}


def test_the_environment_keeps_the_contract_of_torchrl() -> None:
    check_env_specs(to_torchrl(mjhab.make_train(**OPTIONS)))


def test_the_last_observation_of_an_episode_is_kept() -> None:
    env = to_torchrl(mjhab.make_train(**OPTIONS))
    found = env.rollout(HORIZON + 2, break_when_any_done=False)
    ended = found["next", "truncated"][:, HORIZON - 1]
    assert bool(ended.all()) and not bool(found["next", "terminated"].any())
    assert not bool(found["next", "done"][:, HORIZON:].any())
    last = found["next", "state"][:, HORIZON - 1]
    assert not torch.equal(last, found["state"][:, HORIZON])
    assert torch.equal(found["next", "state"][:, 0], found["state"][:, 1])


def test_ppo_learns_from_a_rollout() -> None:
    env = to_torchrl(mjhab.make_train(**OPTIONS))
    layers = nn.Sequential(
        nn.Linear(42, 32), nn.Tanh(), nn.Linear(32, 26), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(layers, in_keys=["state"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(nn.Linear(42, 1), in_keys=["state"])
    with torch.no_grad():
        found = env.rollout(8, policy=actor, break_when_any_done=False)
    GAE(gamma=0.97, lmbda=0.95, value_network=critic)(found)
    losses = ClipPPOLoss(actor, critic)(found.reshape(-1))
    total = torch.stack(
        [value for name, value in losses.items() if name.startswith("loss_")]
    ).sum()
    total.backward()
    assert all(parameter.grad is not None for parameter in layers.parameters())


ENV_ID = "mjhab/CloseSubtaskTrain-v1"
SHORT = {"horizon": HORIZON, "episode_pool": 2}
CHAIN = {"task": "set_table", "num_envs": 2, "autoreset": "disabled"}
DEPTH = {"num_envs": 2, "autoreset": "disabled", "obs_mode": "depth", "camera_size": 16}


@pytest.mark.parametrize("keys", ["flat", "nested"])
@pytest.mark.parametrize(
    "make",
    [
        lambda **options: gymnasium.make(ENV_ID, **SHORT, **options),
        lambda **options: gymnasium.make(ENV_ID, **SHORT, **options).unwrapped,
        lambda **options: gymnasium.make_vec(ENV_ID, **SHORT, **DEPTH, **options),
        lambda **options: mjhab.make_train(**OPTIONS, **options),
        lambda **options: mjhab.make(**CHAIN, **options),
    ],
    ids=["single", "unwrapped", "make_vec", "make_train", "make"],
)
def test_gym_wrapper_takes_environments(make: Callable[..., Any], keys: str) -> None:
    check_env_specs(GymWrapper(make(obs_keys=keys)))


def test_gym_wrapper_takes_our_observation_wrappers() -> None:
    stacked = FrameStack(mjhab.make_train(**OPTIONS, obs_mode="depth", camera_size=16), 3)
    check_env_specs(GymWrapper(FlattenStatePixels(stacked)))


def test_gym_wrapper_resets_the_worlds_of_a_vector_environment_itself() -> None:
    env = GymWrapper(mjhab.make_train(**OPTIONS))
    types = {"success": Unbounded((2,), dtype=torch.bool)}
    env.set_info_dict_reader(default_info_dict_reader(["success"], spec=types))
    found = env.rollout(HORIZON + 2, break_when_any_done=False)
    assert found["next", "success"].shape == (2, HORIZON + 2)
    assert found["next", "truncated"][:, HORIZON - 1].all()
    assert not found["next", "done"][:, HORIZON:].any()
    # torchrl's name for "state".
    last = found["next", "observation"][:, HORIZON - 1]
    assert not torch.equal(last, found["observation"][:, HORIZON])
    assert torch.equal(found["next", "observation"][:, 0], found["observation"][:, 1])


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_gym_wrapper_refuses_worlds_that_reset_themselves(autoreset: str) -> None:
    # The errors are torchrl's: environments cannot tell who wraps them.
    with pytest.raises((IndexError, RuntimeError)):
        GymWrapper(mjhab.make_train(**{**OPTIONS, "autoreset": autoreset}))


def test_gym_env_makes_worlds_by_id() -> None:
    check_env_specs(GymEnv(ENV_ID, **SHORT))
    found = SerialEnv(2, lambda: GymEnv(ENV_ID, **SHORT)).rollout(
        HORIZON + 2, break_when_any_done=False
    )
    assert found["next", "truncated"][:, HORIZON - 1].all()


EXAMPLES = [
    block.code
    for block in blocks(ROOT / "docs" / "training.md")
    if block.language == "python" and "torchrl" in block.code
]


def test_the_documentation_has_examples() -> None:
    assert len(EXAMPLES) == 2


@pytest.mark.parametrize("code", EXAMPLES, ids=range(len(EXAMPLES)))
def test_the_examples_of_the_documentation_run(code: str) -> None:
    exec(compile(code, "docs/training.md", "exec"), {})


def test_bad_input_is_told() -> None:
    with pytest.raises(UsageError, match="autoreset='disabled'"):
        to_torchrl(mjhab.make_train(**{**OPTIONS, "autoreset": "same_step"}))
