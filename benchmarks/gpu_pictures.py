"""Time of the stages of pictures on a device: `WarpCameras.stages`, over all worlds of one environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import warp as wp

from mjhab.envs import make_train
from mjhab.envs.device.env import DeviceEnv
from mjhab.render.warp.cameras import WarpCameras

ROUNDS = 5
"""Times that a stage is run; the fastest counts, since other work can only slow it."""


def picture_stages(worlds: int, size: int, device: str) -> dict[str, Any]:
    """Time the stages of RGB-D of the robot's cameras in fresh episodes of Pick, TidyHouse.

    Args:
        worlds: number of worlds.
        size: height and width of the images [px].
        device: Warp's name of the device.

    Returns:
        "worlds", "size", "images": of all worlds together, "stages_ms": milliseconds per stage for all of them,
        "images_per_s".
    """
    env = make_train(
        task="tidy_house",
        subtask="pick",
        num_envs=worlds,
        backend="warp",
        device=device,
        autoreset="disabled",
    )
    assert isinstance(env, DeviceEnv)
    env.reset(seed=0)
    names = env.layout.robot.camera_names
    cameras = WarpCameras(env.sim, names, (size, size), ("rgb", "depth"))
    cameras.draw()

    def whole(stage: Callable[[int], None]) -> float:
        """Milliseconds of a stage over all chunks."""
        times = []
        for _ in range(ROUNDS):
            wp.synchronize_device(device)
            begun = time.perf_counter()
            for first in cameras.chunks:
                stage(first)
            wp.synchronize_device(device)
            times.append(1e3 * (time.perf_counter() - begun))
        return min(times)

    with wp.ScopedDevice(device):
        stages = {
            name: round(whole(stage), 3) for name, stage in cameras.stages().items()
        }
    images = worlds * len(names)
    return {
        "worlds": worlds,
        "size": size,
        "images": images,
        "stages_ms": stages,
        "images_per_s": round(1e3 * images / sum(stages.values())),
    }
