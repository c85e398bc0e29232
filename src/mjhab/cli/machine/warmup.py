"""``mjhab warmup``: compile homes and kernels before their first use."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from mjhab.cli.options.gpu import WarmupOptions
from mjhab.cli.output import print_json, print_table
from mjhab.config.profile_choice import profile_options
from mjhab.sim.backends import resolve
from mjhab.tasks.household.registry import TASKS

WORLDS = 2


def run_warmup(options: WarmupOptions) -> int:
    """Run `warmup` and print the duration of each part."""
    TASKS.check(options.task)
    backend = resolve(options.backend)
    seconds = warmup(options, backend)
    if options.json:
        print_json({"backend": backend, "seconds": seconds})
    else:
        print_table(f"ready for backend {backend}", ("what", "seconds"), list(seconds.items()))
    return 0


def warmup(options: WarmupOptions, backend: str) -> dict[str, float]:
    """Compile homes and kernels for a task; returns the duration of each part [s]. Progress goes to stderr."""
    from mjhab.config.env import EnvConfig, task_config
    from mjhab.episodes.rosters import roster
    from mjhab.episodes.starts import StartMaker
    from mjhab.layout.layout import Layout
    from mjhab.scenes.packs import open_pack
    from mjhab.sim.mujoco.cpu import CpuSimulator

    config = EnvConfig(task=options.task, assets=options.assets, **profile_options(options))
    layout = Layout(open_pack(options.assets), roster(options.task))
    homes = [home.name for home in layout.pack.homes]
    simulators: list[Any] = []

    def compile_homes() -> None:
        sim = CpuSimulator(layout, 1, 1)
        for home in homes:
            sim.model(home)
        simulators.append(sim)

    def rasterizer() -> None:
        from mjhab.envs.observations import CAMERA_OUTPUTS
        from mjhab.render.home_scene import HomeRenderer

        sim = simulators[0]
        HomeRenderer(sim, 1).robot_views(sim.state(), homes[:1], 16, CAMERA_OUTPUTS)

    def experts() -> None:
        from mjhab.experts.warmup import compile_kernels

        compile_kernels()

    def warp() -> None:
        from mjhab.envs import make_train

        env = make_train(
            task=options.task,
            subtask="pick",
            backend="warp",
            device=options.device,
            num_envs=WORLDS,
            starts=WORLDS,
            assets=options.assets,
            obs_mode="rgbd+seg",
            camera_size=16,
            **profile_options(options),
        )
        env.reset()
        env.step(env.sim.qpos.new_zeros(env.action_space.shape))

    def arms() -> None:
        starts = StartMaker(simulators[0], config, task_config(config, layout.robot))
        for kind in sorted(set(layout.roster)):
            starts.arms.arms(kind)

    parts: dict[str, Callable[[], None]] = {
        f"{len(homes)} homes": compile_homes,
        "rasterizer": rasterizer,
        "planning of the experts": experts,
    }
    if config.spawn_rule == "published":
        parts["arms that hold objects"] = arms
    if backend == "warp":
        parts["MuJoCo Warp (minutes the first time)"] = warp
    return {name.split(" (")[0]: _timed(name, work) for name, work in parts.items()}


def _timed(name: str, work: Callable[[], None]) -> float:
    print(f"mjhab: compiling: {name} ...", file=sys.stderr, flush=True)
    begun = time.perf_counter()
    work()
    return round(time.perf_counter() - begun, 2)
