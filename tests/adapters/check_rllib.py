"""Ray RLlib trains in mjhab environments: run by `make test-rllib`, in an environment that has it.

The samplers of RLlib are other processes: what makes an environment is pickled and sent to them.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import ray  # pyright: ignore[reportMissingImports]
from ray.rllib.algorithms.ppo import PPOConfig  # pyright: ignore[reportMissingImports]
from ray.rllib.connectors.env_to_module import (  # pyright: ignore[reportMissingImports]
    FlattenObservations,
)

import mjhab  # noqa: F401 (makes the ids known)
from tests.docs.pages import ROOT, blocks

ENV_ID = "mjhab/CloseSubtaskTrain-v1"
HORIZON = 6
OPTIONS = {
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "horizon": HORIZON,
    "episode_pool": 2,
}
EXAMPLES = [
    block for block in blocks(ROOT / "docs" / "training.md") if "ray.rllib" in block.code
]


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    """Ray on this machine, with as many samplers as it is asked for, whatever the number of cores."""
    ray.init(num_cpus=4, include_dashboard=False)
    yield
    ray.shutdown()


@pytest.mark.parametrize("vectorize", ["sync", "async"])
def test_samplers_make_worlds_by_id(vectorize: str) -> None:
    config = (
        PPOConfig()
        .environment(f"mjhab:{ENV_ID}", env_config=OPTIONS)
        .env_runners(
            num_env_runners=2,
            num_envs_per_env_runner=2,
            rollout_fragment_length=8,
            gym_env_vectorize_mode=vectorize,
            env_to_module_connector=lambda env, spaces, device: FlattenObservations(),
        )
        .training(train_batch_size_per_learner=32, minibatch_size=16, num_epochs=1)
    )
    algorithm = config.build_algo()
    try:
        found = algorithm.train()
    finally:
        algorithm.stop()
    assert found["env_runners"]["num_env_steps_sampled"] == 32
    assert found["env_runners"]["episode_len_mean"] == HORIZON
    assert np.isfinite(found["learners"]["default_policy"]["total_loss"])


def test_an_environment_is_sent_to_an_actor() -> None:
    class Sampler:
        def __init__(self, env: Any) -> None:
            self.env = env

        def rewards(self) -> list[float]:
            self.env.reset(seed=3)
            still = np.zeros(self.env.action_space.shape, np.float32)
            return [float(self.env.step(still)[1]) for _ in range(HORIZON)]

    env: Any = gymnasium.make(ENV_ID, **OPTIONS)
    remote: Any = ray.remote(Sampler)
    there = ray.get([remote.remote(env).rewards.remote() for _ in range(2)])
    assert there == [Sampler(env).rewards()] * 2


def test_the_documentation_has_an_example() -> None:
    assert len(EXAMPLES) == 1


def test_the_example_of_the_documentation_runs(tmp_path: Path) -> None:
    script = tmp_path / EXAMPLES[0].file
    script.write_text(EXAMPLES[0].code)
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) == 512
