"""Environments of reinforcement learning: of the training, and of the expert that demonstrates."""

from __future__ import annotations

from typing import Any

from mjhab.config.profiles import unbound
from mjhab.learning.configs import InputConfig
from mjhab.learning.observation.spec import image_options
from mjhab.learning.reinforcement.configs import ReinforcementConfig
from mjhab.learning.runs.specs import Scene


def training_env(
    scene: Scene, inputs: InputConfig, worlds: int, threads: int, seed: int, **more: Any
) -> Any:
    """Make the training environment, without automatic resets.

    ``more`` are further options of `make_train`; horizon and stillness may differ from those of the profile.
    """
    from mjhab.envs import make_train

    options = scene.env_options() | image_options(inputs)
    # A binding profile refuses other values of these.
    if more.get("horizon") or more.get("stillness"):
        options = unbound(options, scene.subtask, trains=True)
    options |= more
    return make_train(
        **options, num_envs=worlds, threads=threads, seed=seed, autoreset="disabled"
    )


def demonstration_env(
    scene: Scene, config: ReinforcementConfig, worlds: int, threads: int, seed: int
) -> Any:
    """The environment of the demonstrating expert: inputs and rewards of training, horizon of an evaluation.

    A profile may train for fewer control steps than it evaluates (ms_hab: 100 and 200); the expert would not finish.
    """
    from mjhab.envs import make

    options = scene.env_options() | image_options(config.inputs)
    return make(
        **options,
        num_envs=worlds,
        threads=threads,
        seed=seed,
        autoreset="disabled",
        reward_mode=config.reward_mode,
    )
