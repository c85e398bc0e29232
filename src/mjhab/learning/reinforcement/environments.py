"""Environments of reinforcement learning: of the training, and of the expert that demonstrates."""

from __future__ import annotations

from typing import Any

from mjhab.config.env import TrainConfig
from mjhab.learning.configs import InputConfig
from mjhab.learning.layout import image_options
from mjhab.learning.runs.collection import Scene


def training_env(
    scene: Scene, inputs: InputConfig, worlds: int, threads: int, seed: int, **more: Any
) -> Any:
    """Make the training environment: dense rewards of at most 1, no automatic resets.

    ``more`` are further options of `make_train`.
    """
    from mjhab.envs import make_train

    options = scene.env_options() | image_options(inputs)
    return make_train(
        **options, num_envs=worlds, threads=threads, seed=seed, autoreset="disabled", **more
    )


def demonstration_env(
    scene: Scene, inputs: InputConfig, worlds: int, threads: int, seed: int
) -> Any:
    """The environment of the demonstrating expert: rewards of training, horizon of an evaluation.

    A profile may train for fewer control steps than it evaluates (ms_hab: 100 and 200); the expert would not finish.
    """
    from mjhab.envs import make

    options = scene.env_options() | image_options(inputs)
    return make(
        **options,
        num_envs=worlds,
        threads=threads,
        seed=seed,
        autoreset="disabled",
        reward_mode=TrainConfig.reward_mode,
    )
