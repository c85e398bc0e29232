"""Time of MS-HAB's interface per control step, beside that of the environment below it.

``python -m benchmarks.mshab_layer --worlds 16 --steps 200`` steps the same worlds with the same actions in turn: bare
(``mjhab.make``), through ``gymnasium.make("PickSubtaskTrain-v0")``, and through ``make_env`` with all wrappers. Every
part is timed in rounds of ``--round`` steps that take turns, so that what else the machine does falls on all alike; the
median of the rounds is told, in ms per step.
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
from mjhab.envs.wrappers import FlattenStatePixels, FrameStack

ENV_ID = "PickSubtaskTrain-v0"


def main() -> None:
    """Measure and print a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--round", type=int, default=10)
    given = parser.parse_args()
    layer = gymnasium.make(ENV_ID, num_envs=given.worlds, obs_mode="depth")
    whole = make_env(EnvConfig(ENV_ID, given.worlds, 10_000, record_video=False))
    bare: Any = layer.unwrapped.worlds  # type: ignore[attr-defined]
    stacked = FlattenStatePixels(FrameStack(whole.unwrapped.worlds, 3))
    layer.reset(seed=0)
    whole.reset(seed=0)
    stacked.reset(seed=0)
    generator = np.random.default_rng(0)
    parts = {
        "bare": lambda a: bare.step(a),
        "layer": lambda a: layer.step(torch.from_numpy(a)),
        "bare_stacked": lambda a: stacked.step(a),
        "make_env": lambda a: whole.step(torch.from_numpy(a)),
    }
    times: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(max(given.steps // given.round, 1)):
        actions = generator.uniform(-1, 1, (given.round, given.worlds, 13))
        for name, step in parts.items():
            start = time.perf_counter()
            for action in actions.astype(np.float32):
                step(action)
            times[name].append((time.perf_counter() - start) / given.round * 1000)
    told = {name: round(statistics.median(rows), 3) for name, rows in times.items()}
    extra = {
        "layer_percent": round(100 * (told["layer"] / told["bare"] - 1), 1),
        "make_env_percent": round(100 * (told["make_env"] / told["bare_stacked"] - 1), 1),
    }
    print(json.dumps({"worlds": given.worlds, "ms": told, **extra}))


if __name__ == "__main__":
    main()
