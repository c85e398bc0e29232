"""Control steps and resets without end, for a profiler to look at: ``python -m benchmarks.steps``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.command import run_command
from mjhab.envs import make_train

STEPS_PER_RESET = 100
ACTION_SIZE = 0.3
"""Largest size of the random actions: the robot wanders and seldom presses against furniture."""


@dataclass(frozen=True)
class StepsSpec:
    """Step an environment under random actions, and reset it every 100 control steps, for some seconds.

    `py-spy record --function --format flamegraph --output step.svg -- python -m benchmarks.steps --obs-mode rgbd`
    """

    task: str = "tidy_house"
    subtask: str = "pick"
    obs_mode: str = "state"
    camera_size: int = 128
    """Side of the images [px]."""
    num_envs: int = 16
    """Number of worlds."""
    threads: int = 1
    """With one thread the profile has no threads that wait."""
    seconds: float = 20.0


def run_steps(spec: StepsSpec) -> int:
    """Step and reset; prints the control steps/s of all worlds, resets included."""
    env = make_train(
        task=spec.task,
        subtask=spec.subtask,
        obs_mode=spec.obs_mode,
        camera_size=spec.camera_size,
        num_envs=spec.num_envs,
        threads=spec.threads,
        autoreset="disabled",
    )
    random = np.random.default_rng(0)
    count = 0
    begun = time.perf_counter()
    while time.perf_counter() - begun < spec.seconds:
        env.reset(seed=0 if count == 0 else None)
        for _ in range(STEPS_PER_RESET):
            size = (spec.num_envs, *env.single_action_space.shape)
            actions = random.uniform(-ACTION_SIZE, ACTION_SIZE, size)
            env.step(actions.astype(np.float32))
        count += STEPS_PER_RESET * spec.num_envs
    print(f"{count / (time.perf_counter() - begun):,.0f} control steps/s with resets")
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command."""
    minima = {"camera_size": 1, "num_envs": 1, "seconds": 0.001}
    return run_command("steps", StepsSpec, run_steps, words, minima)


if __name__ == "__main__":
    sys.exit(main())
