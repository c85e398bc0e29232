"""The follow camera of films and of the viewer sees the robot."""

from __future__ import annotations

import numpy as np

from mjhab import envs
from mjhab.core.boxes import sphere_box_distance
from mjhab.core.joints import BASE
from mjhab.render.follow_camera import FollowCamera


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
