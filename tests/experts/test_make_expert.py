"""What `make_expert` takes."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import pytest

import mjhab
from tests.refusals import refused

ENV_ID = "mjhab/CloseSubtaskTrain-v1"
OPTIONS = {"episode_pool": 1, "home": "builtin_m0_00"}


@pytest.mark.parametrize(
    "make",
    [
        lambda: None,
        lambda: "set_table",
        lambda: mjhab.make,
        lambda: gymnasium.make_vec("CartPole-v1", num_envs=2),
        lambda: gymnasium.make(ENV_ID, **OPTIONS),
        lambda: gymnasium.make(ENV_ID, **OPTIONS).unwrapped,
    ],
)
def test_what_is_no_vector_environment_of_ours_is_refused(
    make: Callable[[], object],
) -> None:
    with refused(said="make_expert takes the vector environment of mjhab.make"):
        mjhab.make_expert(make())  # type: ignore[arg-type]


def test_the_environment_within_is_taken() -> None:
    env = gymnasium.make(ENV_ID, **OPTIONS)
    worlds = env.unwrapped.worlds  # type: ignore[attr-defined]
    obs, info = worlds.reset(seed=0)
    assert mjhab.make_expert(worlds).act(obs, info).shape == worlds.action_space.shape


@pytest.mark.parametrize("styles", ["speed=0.5", ["speed=0.5"], {"speed": 0.5}])
def test_styles_of_another_type_are_refused(styles: object) -> None:
    env = mjhab.make(task="set_table", subtask="close", home="builtin_m0_00")
    with refused(said="styles as mjhab.tasks.style.Styles, for in"):
        mjhab.make_expert(env, styles)  # type: ignore[arg-type]
