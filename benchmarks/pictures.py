"""Are pictures of the rasterizer what they were, and what does one cost: ``python -m benchmarks.pictures``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.core.errors import UsageError
from mjhab.envs import make
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.render.home_scene import ViewChange

SCENES = (
    ("tidy_house", "pick", ""),
    ("tidy_house", "pick", "colours:3,camera:3"),
    ("tidy_house", "place", ""),
    ("set_table", "open", ""),
    ("set_table", "navigate", ""),
)
"""Task, subtask and perturbations of the environments whose worlds are drawn."""
OUTPUTS = ("rgb", "depth", "seg")
WORLDS = 16
STEPS = 8
"""Control steps with one action before the pictures are drawn."""
ROUNDS = 5


@dataclass(frozen=True)
class PicturesSpec:
    """Draw what both robot cameras see in many homes; keep it or compare it with what was kept, and time it.

    `python -m benchmarks.pictures --out runs/pictures` with the code before,
    `python -m benchmarks.pictures --before runs/pictures` with the code now
    """

    out: Path | None = None
    """Folder to keep the pictures in; not with --before."""
    before: str = ""
    """Folder of kept pictures to compare with; empty for no comparison."""
    assets: tuple[str, ...] = ("builtin",)
    """Asset packs: builtin, names or folders."""
    sizes: tuple[int, ...] = (64, 128, 224)
    """Sides of the pictures [px]."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def envs(assets: str) -> Iterator[tuple[str, SequentialTaskEnv]]:
    """Environments of `SCENES` after some steps, with their names."""
    for task, subtask, perturb in SCENES:
        env = make(
            task=task,
            subtask=subtask,
            perturb=perturb,
            assets=assets,
            num_envs=WORLDS,
            threads=1,
            autoreset="disabled",
            obs_mode="rgb",
            camera_size=16,
        )
        env.reset(seed=0)
        random = np.random.default_rng(0)
        action = random.uniform(-1, 1, (WORLDS, len(env.action_table)))
        for _ in range(STEPS):
            env.step(action.astype(np.float32))
        pack = Path(assets).name
        yield f"{pack}-{task}-{subtask}{'-perturbed' if perturb else ''}", env


def changed_views(env: SequentialTaskEnv) -> ViewChange:
    """Other materials for the pictures."""
    count = len(env.observer.renderer.scene.mat_color)
    looks = np.random.default_rng(1).integers(count, size=(WORLDS, count))
    return ViewChange(None, looks.astype(np.int32))


def compare(found: dict[str, np.ndarray], before: Any) -> dict[str, Any]:
    """How pictures differ: bits of depth and segments, shares of pixels by the largest difference of a colour."""
    off = np.abs(found["rgb"].astype(np.int16) - before["rgb"]).max(-1)
    return {
        "depth_equal": found["depth"].tobytes() == before["depth"].tobytes(),
        "seg_equal": bool((found["seg"] == before["seg"]).all()),
        "rgb_equal_pct": 100.0 * float((off == 0).mean()),
        "rgb_within_1_pct": 100.0 * float((off <= 1).mean()),
        "rgb_largest": int(off.max()),
    }


def measure(spec: PicturesSpec) -> list[dict[str, Any]]:
    """A row per environment and size: processor time of an RGB-D picture [us], and what `compare` finds."""
    rows = []
    for assets in spec.assets:
        for name, env in envs(assets):
            change = changed_views(env) if "perturbed" in name else None
            for size in spec.sizes:
                rows.append(
                    {"name": name, "size": size} | _drawn(spec, env, change, name, size)
                )
            env.close()
    return rows


def _drawn(
    spec: PicturesSpec, env: SequentialTaskEnv, change: Any, name: str, size: int
) -> dict[str, Any]:
    def views(outputs: tuple[str, ...]) -> dict[str, np.ndarray]:
        renderer = env.observer.renderer
        return renderer.robot_views(env.state, env.homes, size, outputs, None, change)

    found = views(OUTPUTS)
    times = []
    for _ in range(ROUNDS):
        begun = time.process_time()
        views(OUTPUTS[:2])
        times.append(time.process_time() - begun)
    count = found["depth"].shape[0] * found["depth"].shape[1]
    row: dict[str, Any] = {"rgbd_us": 1e6 * median(times) / count}
    file = f"{name}-{size}.npz"
    if spec.out is not None:
        spec.out.mkdir(parents=True, exist_ok=True)
        np.savez(
            spec.out / file, rgb=found["rgb"], depth=found["depth"], seg=found["seg"]
        )
    if spec.before:
        with np.load(Path(spec.before) / file) as before:
            row |= compare(found, before)
    return row


def run(spec: PicturesSpec) -> int:
    """Draw and print; 1 where depth or segments differ, or a pixel in a thousand is off by more than 1 of 255."""
    if spec.out is not None and spec.before:
        raise UsageError("--out and --before: give one of them.")
    if spec.before and not Path(spec.before).is_dir():
        raise UsageError(f"--before: there is no folder {spec.before}.")
    rows = measure(spec)
    cells = [tuple(_told(cell) for cell in row.values()) for row in rows]
    report(spec.json, {"rows": rows}, Listing("Pictures", tuple(rows[0]), cells))
    good = (
        row["depth_equal"] and row["seg_equal"] and row["rgb_within_1_pct"] >= 99.9
        for row in rows
        if spec.before
    )
    return 0 if all(good) else 1


def _told(cell: Any) -> str:
    return f"{cell:.3f}" if isinstance(cell, float) else str(cell)


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return run_command("pictures", PicturesSpec, run, words, {"sizes": 1})


if __name__ == "__main__":
    sys.exit(main())
