"""Random actions for a long time in every training environment, or generation of episodes by the expert, to find faults
of the physics and leaks: ``python -m benchmarks.soak``."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.command import run_command
from benchmarks.profile_choice import ProfileChoice, profile_options
from mjhab.cli.output import Listing, report
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_json, write_text
from mjhab.core.files.outputs import check_folder
from mjhab.core.machine import resident_mb
from mjhab.core.memory_cache import memory_limit_mb, memory_use, set_memory_limit
from mjhab.core.progress import progress_bar

QUARTERS = 4
"""Memory is reported after every quarter. In the first half homes are met for the first time and caches fill; growth
counts over the second."""
MAX_GROWTH = 0.03
"""Largest share by which memory may grow, or shrink, over the second half."""
CURVE_POINTS = 200
"""Points of the memory curve."""


RESULTS = "soak.json"
PICTURE = "memory.svg"
WIDTH = 760
HEIGHT = 300
MARGIN = 56
"""Size of the picture, and of the border with the axes [px]."""
COLORS = ("#2563eb", "#16a34a", "#ea580c", "#9333ea")
TICKS = 5


@dataclass(frozen=True)
class SoakSpec(ProfileChoice):
    """Step all training environments with random actions for a long time, to find errors and memory growth.

    With --generate, record episodes with the expert instead. Fails if memory changes by more than 3 % over the second
    half. For instance: `python -m benchmarks.soak --steps 1000000 --worlds 16 --out runs/soak`
    """

    steps: int = 1_000_000
    """Control steps over all worlds and subtasks."""
    generate: int = 0
    """Record this number of episodes with the expert instead, in this process; they are deleted at the end."""
    subtask: str | None = None
    """With --generate: episodes of one subtask, such as pick; the whole task if absent."""
    worlds: int = 8
    """Worlds of each subtask."""
    task: str = "set_table"
    """Task that sets homes and objects; subtasks that the task lacks are left out."""
    threads: int = 0
    """Threads of the physics; 0 takes all cores."""
    seed: int = 0
    """Seed of the episodes and of the actions."""
    cache_mb: float = 128.0
    """Limit of the cache of homes, maps and episodes in memory [MB]. Less than elsewhere (a million steps of SetTable
    fill it), so that it is full long before the end: a cache that still fills looks like growth."""
    out: Path | None = None
    """Folder of soak.json and memory.svg, the memory curve."""
    json: bool = False
    """Print one line of JSON instead of a table."""


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
        # The nearest point, as memory is not read in every step.
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
            # Equal seeds would give all environments the same homes.
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
    from mjhab.data.record.job import Standing
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


def memory_picture(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Draw resident memory over progress, from zero, one line for every run.

    Args:
        runs: what `soak.soak` returned, by name.
    """
    highest = 1.1 * max(mb for run in runs.values() for _, mb in run["curve"])
    parts = [*_axes(highest)]
    for number, (name, run) in enumerate(runs.items()):
        color = COLORS[number % len(COLORS)]
        total = run["curve"][-1][0]
        points = [_place(done / total, mb / highest) for done, mb in run["curve"]]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        growth = 100 * run["growth_second_half"]
        legend = escape(f"{name}: {growth:+.1f} % over the second half")
        parts.append(
            f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>'
            f'<text x="{MARGIN + 12}" y="{20 + 18 * number}" fill="{color}">{legend}</text>'
        )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" '
        f'font-family="sans-serif" font-size="13">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{"".join(parts)}</svg>\n'
    )


def _place(right: float, up: float) -> tuple[float, float]:
    """Pixel of a point, in shares of the axes."""
    x = MARGIN + right * (WIDTH - 1.5 * MARGIN)
    y = HEIGHT - MARGIN - up * (HEIGHT - 2 * MARGIN)
    return x, y


def _axes(highest: float) -> Sequence[str]:
    """Grid lines with their memory [MB] and the share of the run."""
    parts = []
    for share in (tick / TICKS for tick in range(TICKS + 1)):
        left, y = _place(0.0, share)
        right, _ = _place(1.0, share)
        x, bottom = _place(share, 0.0)
        parts.append(
            f'<line x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}" stroke="#d4d4d8"/>'
            f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end" fill="#52525b">'
            f"{share * highest:.0f}</text>"
            f'<text x="{x:.1f}" y="{bottom + 18:.1f}" text-anchor="middle" fill="#52525b">'
            f"{100 * share:.0f} %</text>"
        )
    parts.append(
        f'<text x="{WIDTH / 2}" y="{HEIGHT - 14}" text-anchor="middle" fill="#52525b">'
        "share of the run; resident memory [MB] upwards</text>"
    )
    return parts


def bench_soak(spec: SoakSpec) -> int:
    """Print the results of `soak`; returns 1 if memory changed by more than 3 % over the second half.

    Raises:
        UsageError: an option is given that only generation has.
    """
    if spec.subtask is not None and not spec.generate:
        raise UsageError(
            "--subtask needs --generate: random actions step the environments of all subtasks."
        )
    if spec.out is not None:
        check_folder(spec.out)
    set_memory_limit(spec.cache_mb)
    found = soak(spec)
    if spec.out is not None:
        name = "generation with the expert" if spec.generate else "random actions"
        write_json(spec.out / RESULTS, found)
        write_text(spec.out / PICTURE, memory_picture({name: found}))
    rows = [
        (k, ", ".join(f"{n} {c}" for n, c in v.items()) if isinstance(v, dict) else v)
        for k, v in found.items()
        if k != "curve"
    ]
    report(
        spec.json,
        found,
        Listing("Memory over a long time", ("what", "value"), rows),
        f"Memory changed by {100 * found['growth_second_half']:+.1f} % over the second half; "
        f"{100 * MAX_GROWTH:.0f} % are allowed.",
    )
    return 0 if found["ok"] else 1


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("soak", SoakSpec, bench_soak, words, {"steps": 1, "worlds": 1})


if __name__ == "__main__":
    sys.exit(main())
