"""Time of MS-HAB's interface per control step, beside that of the environment below it.

``python -m benchmarks.mshab_layer --worlds 16 --steps 200`` steps worlds with depth through
``gymnasium.make("PickSubtaskTrain-v0")`` ("layer") and through ``make_env`` with all wrappers ("make_env"). The steps
of our environment inside are timed apart; medians in ms per step, and the rest as a share of what is inside. Processor
time, in which what else the machine does hardly counts; the environment inside has one thread.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import gymnasium
import numpy as np
import torch

import mjhab.compat.mshab  # noqa: F401  (registers the ids)
from mjhab.compat.mshab.making import EnvConfig, make_env

ENV_ID = "PickSubtaskTrain-v0"


def main() -> None:
    """Measure and print a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=200)
    given = parser.parse_args()
    own: dict[str, Any] = {"mjhab_options": {"threads": 1}}
    layer = gymnasium.make(ENV_ID, num_envs=given.worlds, obs_mode="depth", **own)
    # Episodes so long that none ends by time within a measurement.
    config = EnvConfig(ENV_ID, given.worlds, 10_000, record_video=False, env_kwargs=own)
    whole = make_env(config)
    told = {
        "layer": measured(layer, given.worlds, given.steps),
        "make_env": measured(whole, given.worlds, given.steps),
    }
    print(json.dumps({"worlds": given.worlds, **told}))


def measured(env: Any, worlds: int, steps: int) -> dict[str, float]:
    """Medians over the steps: "inside" [ms] of our environment, "around" [ms] of the layer, and its share [%]."""
    # Time of the process would count waiting threads.
    torch.set_num_threads(1)
    below = env.unwrapped.worlds
    inside = [0.0]
    step = below.step

    def timed(actions: Any) -> Any:
        start = time.process_time()
        found = step(actions)
        inside[0] = time.process_time() - start
        return found

    below.step = timed
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    rows = []
    for _ in range(steps):
        action = torch.from_numpy(
            generator.uniform(-1, 1, (worlds, 13)).astype(np.float32)
        )
        start = time.process_time()
        env.step(action)
        rows.append((inside[0], time.process_time() - start - inside[0]))
    core, rest = (1000 * statistics.median(column) for column in zip(*rows, strict=True))
    return {
        "inside": round(core, 3),
        "around": round(rest, 3),
        "percent": round(100 * rest / core, 1),
    }


if __name__ == "__main__":
    main()
