"""``mjhab bench soak``: random actions for a long time in every training environment, or generation of episodes by the
expert, to find faults of the physics and leaks."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mjhab.bench.specs import SoakSpec
from mjhab.config.profile_choice import profile_options
from mjhab.core.machine import resident_mb
from mjhab.core.memory_cache import memory_limit_mb, memory_use
from mjhab.core.progress import progress_bar

QUARTERS = 4
"""Memory is reported after every quarter. In the first half homes are met for the first time and caches fill; growth
counts over the second."""
MAX_GROWTH = 0.03
"""Largest share by which memory may grow, or shrink, over the second half."""
CURVE_POINTS = 200
"""Points of the memory curve."""


class MemoryCurve:
    """Resident memory over the course of a long job.

    Args:
        total: when the job is done, in any unit of progress.

    Attributes:
        points: (progress, memory [MB]) at about CURVE_POINTS places, in order.
    """

    def __init__(self, total: int) -> None:
        self.total = total
        self.points: list[tuple[int, float]] = []

    def note(self, done: int) -> None:
        """Tell that the job has come to ``done``; memory is read where a point of the curve is due."""
        last = self.points[-1][0] if self.points else 0
        if done >= self.total or (done - last) * CURVE_POINTS >= self.total:
            self.points.append((done, resident_mb()))

    def quarters(self) -> list[float]:
        """Memory [MB] at the end of each of QUARTERS parts of the job."""
        done, memory = np.array(self.points).T
        ends = self.total * np.arange(1, QUARTERS + 1) / QUARTERS
        return [float(memory[np.abs(done - end).argmin()]) for end in ends]

    def summary(self) -> dict[str, Any]:
        """``rss_mb`` after each quarter, ``growth_second_half`` (relative), ``ok``, and ``curve``: its points."""
        quarters = self.quarters()
        half = quarters[QUARTERS // 2 - 1]
        growth = quarters[-1] / half - 1.0 if half else 0.0
        return {
            "rss_mb": quarters,
            "growth_second_half": round(growth, 4),
            "ok": abs(growth) <= MAX_GROWTH,
            "cache_mb": memory_use(),
            "cache_limit_mb": memory_limit_mb(),
            "curve": self.points,
        }


def soak(spec: SoakSpec) -> dict[str, Any]:
    """Step the environments in turn, or make episodes with the expert in this process.

    Returns:
        ``steps`` (of random actions) and ``episodes`` done, ``seconds``, what `MemoryCurve.summary` says; of random
        actions also ``tainted`` episodes per kind of taint, ``nan_resets``, ``spawn_fallbacks``; of generation its
        ``labels``.

    Raises:
        UsageError: an unknown task or profile.
    """
    begun = time.perf_counter()
    found = _generate(spec) if spec.generate else _act_at_random(spec)
    seconds = round(time.perf_counter() - begun, 1)
    return {"profile": spec.profile, "seconds": seconds, **found}


def _act_at_random(spec: SoakSpec) -> dict[str, Any]:
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
    per_round = spec.worlds * len(envs)
    rounds = -(-spec.steps // per_round)
    episodes = 0
    fallbacks = 0
    curve = MemoryCurve(rounds * per_round)
    tainted = dict.fromkeys(envs[0].taint_names, 0)
    with progress_bar("random actions", rounds) as advance:
        for number in range(rounds):
            for env in envs:
                *_, info = env.step(
                    rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
                )
                if "final_info" in info:
                    done = info["_final_info"]
                    final = info["final_info"]
                    episodes += int(done.sum())
                    fallbacks += int(final["spawn_fallback"][done].sum())
                    for bit, name in enumerate(env.taint_names):
                        tainted[name] += int((final["taint"][done] >> bit & 1).sum())
            curve.note((number + 1) * per_round)
            advance()
    return {
        "steps": rounds * per_round,
        "episodes": episodes,
        "tainted": tainted,
        "nan_resets": int(sum(env.nan_resets.sum() for env in envs)),
        "spawn_fallbacks": fallbacks,
        **curve.summary(),
    }


def _generate(spec: SoakSpec) -> dict[str, Any]:
    from mjhab.data.record.generation import Standing
    from mjhab.evaluation.generate import GenerateSpec, run_generation

    curve = MemoryCurve(spec.generate)
    with (
        TemporaryDirectory(prefix="mjhab-soak-") as folder,
        progress_bar("episodes of the expert", spec.generate) as advance,
    ):
        shown = 0

        def tell(now: Standing) -> None:
            nonlocal shown
            curve.note(now.tried)
            for _ in range(now.tried - shown):
                advance()
            shown = now.tried

        made = run_generation(
            GenerateSpec.of(
                out=Path(folder) / "episodes",
                task=spec.task,
                subtask=spec.subtask,
                seed=spec.seed,
                env=profile_options(spec),
                episodes=spec.generate,
                worlds=spec.worlds,
                threads=spec.threads,
            ),
            tell,
        )
    return {
        "episodes": made.standing.tried,
        "labels": made.summary["labels"],
        **curve.summary(),
    }
