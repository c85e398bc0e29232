"""``mjhab warmup``: compile homes and kernels before their first use."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.config.env_spec import PROFILE, EnvSpec, env_options
from mjhab.core.progress import say
from mjhab.sim.backends import resolve

if TYPE_CHECKING:
    from mjhab.sim.mujoco.cpu import CpuSimulator

WORLDS = 2
"""Worlds of the environment that compiles the kernels of the device."""


@dataclass(frozen=True)
class WarmupSpec(EnvSpec):
    """Compile and cache everything that is compiled at first use: homes, kernels of the rasterizer and of the experts'
    planning, and those of MuJoCo Warp.

    With `--profile ms_hab` it also computes the arm postures with a held object in which Place starts.

    It takes minutes the first time and seconds later. Kernels of Warp are cached in $WARP_CACHE_PATH, else
    ~/.cache/warp.
    """

    env: Annotated[
        Mapping[str, Any],
        env_options(
            *PROFILE,
            "task",
            "assets",
            "backend",
            "device",
            docs={
                "backend": "cpu: rasterizer and planning; warp: also MuJoCo Warp; auto: warp where there is a CUDA "
                "device."
            },
            task="tidy_house",
            backend="auto",
        ),
    ] = field(default_factory=dict)
    """What to compile for, fields of `EnvConfig`."""


def run_warmup(spec: WarmupSpec, json: bool) -> int:
    """Run `warmup` and print the duration of each part."""
    backend = resolve(spec.asked.backend)
    seconds = warmup(spec, backend)
    title = f"ready for backend {backend}"
    table = Listing(title, ("what", "seconds"), list(seconds.items()))
    report(json, {"backend": backend, "seconds": seconds}, table)
    return 0


def warmup(spec: WarmupSpec, backend: str) -> dict[str, float]:
    """Compile homes and kernels for a task; returns the duration of each part [s]. Progress goes to stderr."""
    work = _Work(spec)
    parts: dict[str, Callable[[], None]] = {
        f"{len(work.layout.pack.homes)} homes": work.compile_homes,
        "rasterizer": work.compile_rasterizer,
        "planning of the experts": work.compile_experts,
    }
    if work.config.spawn_rule == "published":
        # Only the published rule searches a posture of the arm for every object.
        parts["arms that hold objects"] = work.find_holding_arms
    if backend == "warp":
        parts["MuJoCo Warp (minutes the first time)"] = work.compile_warp
    return {name.split(" (")[0]: _timed(name, part) for name, part in parts.items()}


class _Work:
    """The parts of a warm-up, on the layout of one task."""

    def __init__(self, spec: WarmupSpec) -> None:
        from mjhab.episodes.rosters import roster
        from mjhab.layout.layout import Layout
        from mjhab.robots.registry import robot_named
        from mjhab.scenes.packs import open_pack

        self.options = spec.env_options
        self.config = spec.asked
        robot = robot_named(self.config.robot)
        self.layout = Layout(
            open_pack(self.config.assets),
            roster(self.config.task),
            robot,
            self.config.joint_dynamics,
        )

    @functools.cached_property
    def simulator(self) -> CpuSimulator:
        """One world; its making compiles the first home, so that the first part that asks for it pays."""
        from mjhab.sim.mujoco.cpu import CpuSimulator

        return CpuSimulator(self.layout, 1, 1)

    def compile_homes(self) -> None:
        for home in self.layout.pack.homes:
            self.simulator.model(home.name)

    def compile_rasterizer(self) -> None:
        """Draw one small picture of every kind in the first home."""
        from mjhab.envs.observations.modes import DRAWN_OUTPUTS
        from mjhab.render.home_scene import HomeRenderer

        first = self.layout.pack.homes[0].name
        renderer = HomeRenderer(self.simulator, 1)
        # The size does not matter: kernels are compiled for types, not for sizes.
        renderer.robot_views(self.simulator.state(), [first], 16, DRAWN_OUTPUTS)

    def compile_experts(self) -> None:
        from mjhab.experts.warmup import compile_kernels

        compile_kernels()

    def find_holding_arms(self) -> None:
        """Find the arm configurations in which the robot begins with each object of the roster in its hand."""
        from mjhab.config.thresholds import task_config
        from mjhab.episodes.starts import StartMaker

        task = task_config(self.config, self.layout.robot)
        starts = StartMaker(self.simulator, self.config, task)
        for kind in sorted(set(self.layout.roster)):
            starts.arms.arms(kind)

    def compile_warp(self) -> None:
        """Make a small environment on the device, reset it and take one step."""
        from mjhab.envs import make_train

        options = {
            **self.options,
            "subtask": "pick",
            "backend": "warp",
            "num_envs": WORLDS,
            "starts": WORLDS,
            "obs_mode": "rgbd+seg",
            "camera_size": 16,
        }
        env = make_train(**options)
        env.reset()
        # Kernels of the step are compiled when it is first taken.
        env.step(env.sim.qpos.new_zeros(env.action_space.shape))


def _timed(name: str, work: Callable[[], None]) -> float:
    say(f"mjhab: compiling: {name} ...")
    begun = time.perf_counter()
    work()
    return round(time.perf_counter() - begun, 2)
