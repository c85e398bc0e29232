"""One measurement of `benchmarks.peers`, in the interpreter where the peer is installed; needs nothing of mjhab.

``python peers_worker.py NAME SECONDS`` prints a JSON object: {"version", "steps_per_s", "images_per_s", "about"}.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

SIDE = 128
"""Side of the images [px]."""
ENDLESS = 10**6
"""Control steps of an episode, so that no reset is measured."""
Found = tuple[str, Callable[[], Any], int]
"""Version, a control step with random actions, and images of it."""


def robosuite(images: bool) -> Found:
    """Panda in PickPlace, 20 Hz, two cameras with depth."""
    import robosuite as suite  # type: ignore[import-not-found]

    env = suite.make(
        "PickPlace",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=images,
        use_camera_obs=images,
        camera_names=["agentview", "robot0_eye_in_hand"],
        camera_heights=SIDE,
        camera_widths=SIDE,
        camera_depths=True,
        control_freq=20,
        horizon=ENDLESS,
    )
    env.reset()
    low, high = env.action_spec
    random = np.random.default_rng(0)
    return version("robosuite"), lambda: env.step(random.uniform(low, high)), 2 * images


def gymnasium_robotics(name: str) -> Found:
    """An environment of gymnasium-robotics, from states."""
    import gymnasium
    import gymnasium_robotics as robotics  # type: ignore[import-not-found]

    gymnasium.register_envs(robotics)
    env = gymnasium.make(name, max_episode_steps=ENDLESS)
    env.reset(seed=0)
    env.action_space.seed(0)
    step = lambda: env.step(env.action_space.sample())  # noqa: E731
    return version("gymnasium-robotics"), step, 0


def maniskill(images: bool) -> Found:
    """Panda in PickCube on the CPU, 20 Hz; with images two cameras by the renderer that is there."""
    import gymnasium
    import mani_skill.envs  # type: ignore[import-not-found]  # noqa: F401

    env: Any = gymnasium.make(
        "PickCube-v1",
        num_envs=1,
        sim_backend="physx_cpu",
        obs_mode="rgb+depth" if images else "state",
        render_backend="cpu" if images else "none",
        max_episode_steps=ENDLESS,
        sensor_configs={"width": SIDE, "height": SIDE},
    )
    env.reset(seed=0)
    env.action_space.seed(0)
    step = lambda: env.step(env.action_space.sample())  # noqa: E731
    return version("mani_skill"), step, int(images)


PEERS: dict[str, Callable[[], Found]] = {
    "robosuite PickPlace, states": lambda: robosuite(False),
    "robosuite PickPlace, RGB-D": lambda: robosuite(True),
    "gymnasium-robotics FetchPickAndPlace, states": lambda: gymnasium_robotics(
        "FetchPickAndPlace-v4"
    ),
    "gymnasium-robotics FrankaKitchen, states": lambda: gymnasium_robotics(
        "FrankaKitchen-v1"
    ),
    "ManiSkill PickCube, CPU, states": lambda: maniskill(False),
    "ManiSkill PickCube, CPU, RGB-D": lambda: maniskill(True),
}
"""What is measured, by name."""


def measure(name: str, seconds: float) -> dict[str, Any]:
    """Control steps per second of one environment, one process."""
    found, step, images = PEERS[name]()
    # Peers compile or load in their first step, too.
    step()
    count = 0
    begun = time.perf_counter()
    while (spent := time.perf_counter() - begun) < seconds:
        step()
        count += 1
    rate = count / spent
    return {
        "version": found,
        "steps_per_s": round(rate, 1),
        "images_per_s": round(images * rate, 1) if images else None,
    }


if __name__ == "__main__":
    # Before a peer is imported; not where this module is.
    os.environ.setdefault("MUJOCO_GL", "egl")
    print(json.dumps(measure(sys.argv[1], float(sys.argv[2]))))
