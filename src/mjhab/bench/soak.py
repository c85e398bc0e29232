"""``mjhab bench soak``: random actions for a long time in every training environment, to find faults of the physics
and leaks."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from mjhab.bench.specs import SoakSpec
from mjhab.bench.stages import resident_mb
from mjhab.config.profile_choice import profile_options
from mjhab.core.progress import progress_bar

QUARTERS = 4
"""Memory is read after every quarter. In the first half homes are met for the first time and the pool of arrangements
fills; growth counts over the second."""
MOST_GROWTH = 0.03


def soak(spec: SoakSpec) -> dict[str, Any]:
    """Step the environments in turn.

    Returns:
        ``steps`` and ``episodes`` done, ``seconds``, ``tainted`` episodes per kind of taint, ``nan_resets``,
        ``spawn_fallbacks``, ``rss_mb`` after each quarter, ``rss_growth`` (relative, over the second half).
    """
    from mjhab.envs import make_train
    from mjhab.tasks.household.registry import TASKS

    envs = [
        make_train(
            task=spec.task,
            subtask=kind,
            num_envs=spec.worlds,
            threads=spec.threads,
            seed=spec.seed + i,
            **profile_options(spec),
        )
        for i, kind in enumerate(TASKS[spec.task].subtasks)
    ]
    for env in envs:
        env.reset()
    rng = np.random.default_rng(spec.seed)
    rounds = -(-spec.steps // (spec.worlds * len(envs)))
    episodes = 0
    fallbacks = 0
    marks = {rounds * q // QUARTERS - 1 for q in range(1, QUARTERS + 1)}
    memory: list[float] = []
    tainted = dict.fromkeys(envs[0].taint_names, 0)
    begun = time.perf_counter()
    with progress_bar("random actions", rounds) as advance:
        for number in range(rounds):
            for env in envs:
                *_, info = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
                if "final_info" in info:
                    done = info["_final_info"]
                    final = info["final_info"]
                    episodes += int(done.sum())
                    fallbacks += int(final["spawn_fallback"][done].sum())
                    for bit, name in enumerate(env.taint_names):
                        tainted[name] += int((final["taint"][done] >> bit & 1).sum())
            if number in marks:
                memory.append(resident_mb())
            advance()
    half = memory[len(memory) // 2 - 1] if len(memory) > 1 else memory[-1]
    end = memory[-1]
    return {
        "profile": spec.profile,
        "steps": rounds * spec.worlds * len(envs),
        "episodes": episodes,
        "seconds": round(time.perf_counter() - begun, 1),
        "tainted": tainted,
        "nan_resets": int(sum(env.nan_resets.sum() for env in envs)),
        "spawn_fallbacks": fallbacks,
        "rss_mb": memory,
        "rss_growth": round(end / half - 1.0, 4) if half else 0.0,
    }
