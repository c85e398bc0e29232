"""The follow camera of films and of the viewer sees the robot."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjhab import envs
from mjhab.core.boxes import sphere_box_distance
from mjhab.core.joints import BASE
from mjhab.render.home_scene import HomeRenderer
from mjhab.render.pictures.follow_camera import FollowCamera


def test_nothing_tall_stands_between_camera_and_robot() -> None:
    env = envs.make(
        task="tidy_house", subtask="place", num_envs=16, autoreset="disabled", threads=1
    )
    env.reset(seed=0)
    camera = FollowCamera(env.sim.model)
    for home, q in zip(env.homes, env.state.robot_q, strict=True):
        eye, target = camera.look(home, q[BASE])
        ray = eye + np.linspace(0.0, 0.7, 40)[:, None] * (target - eye)
        assert sphere_box_distance(ray, camera.tall(home)).min() > 0.0
    env.close()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_world_that_diverged_is_blank_and_leaves_the_others(value: float) -> None:
    env = envs.make(subtask="pick", num_envs=2, autoreset="disabled", threads=1)
    env.reset(seed=0)
    renderer = HomeRenderer(env.sim, 1)
    homes = [str(home) for home in env.homes]
    before = renderer.follow_views(env.state, homes, [0, 1], 32, 24)
    fields = ("robot_q", "body_pos", "body_mat")
    state: Any = SimpleNamespace(
        **{name: getattr(env.state, name).copy() for name in fields}
    )
    for name in fields:
        getattr(state, name)[0] = value
    images = renderer.follow_views(state, homes, [0, 1], 32, 24)
    assert not images[0].any() and np.array_equal(images[1], before[1])
    assert not renderer.follow_view(state, homes[0], 0, 32, 24).any()
    env.close()
