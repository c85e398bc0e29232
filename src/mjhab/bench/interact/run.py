"""``mjhab bench interact``: the paper's Interact benchmark on either backend."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from mjhab.bench.environments.memory_sampler import MemorySampler, gpu_used_mb
from mjhab.bench.interact.scene import (
    OBJECTS,
    STEPS,
    STIFF_BODY_MODE,
    InteractScene,
    interact_actions,
    interact_scene,
)
from mjhab.bench.specs import InteractSpec
from mjhab.core.arrays import to_numpy
from mjhab.core.errors import wrong_value
from mjhab.core.files.cache import write_atomic, write_json, write_text
from mjhab.core.machine import resident_mb
from mjhab.core.progress import progress_bar
from mjhab.envs.parts.memory import WorldPictures, check_device_memory
from mjhab.reports.interact import interact_page
from mjhab.robots.controllers import make_controller
from mjhab.sim.backends import open_simulator, resolve
from mjhab.sim.mujoco.cpu import CpuSimulator

IMAGE_SIDE_PX = 128
PICTURE_OUTPUTS = ("rgb", "depth")
WORLD_MB = 0.34
"""A world on a device without pictures: 0.14 MB of arrays, 0.17 MB that a substep takes on its way (sums for 3 and for
32 worlds on Warp's CPU device, difference over 29), and a tenth on top."""
WARM_STEPS = 3
"""Control steps that are not timed: kernels are loaded and CUDA graphs captured."""
STAGE_STEPS = 80
"""Steps timed stage by stage after the runs: to where the hand is among the objects, which the report shows."""
MOVED = 0.01
"""An object farther than this from its start at the end [m] counts as moved."""
COLUMNS: tuple[str, ...] = (
    "backend",
    "device",
    "render",
    "worlds",
    "seed",
    "sps",
    "reset_and_step_sps",
    "device_mb",
    "rss_mb",
)
Pictures = dict[str, np.ndarray]


class InteractBench:
    """The worlds of one measurement, all alike.

    Args:
        scene: what they hold.
        backend: "cpu" or "warp".
        worlds: W.
        render: draw 2 x 128 x 128 RGB and depth after each step.
        device, threads: see `open_simulator`.

    Raises:
        UsageError: what `open_simulator` refuses; more worlds than the device has room for.
    """

    def __init__(
        self,
        scene: InteractScene,
        backend: str,
        worlds: int,
        *,
        render: bool,
        device: str = "",
        threads: int = 0,
    ) -> None:
        self.scene = scene
        self.worlds = worlds
        if backend == "warp":
            # Pictures are looked at, not kept as observations.
            mode = "rgbd" if render else "state"
            pictures = WorldPictures(mode, IMAGE_SIDE_PX)
            check_device_memory(worlds, pictures, device, copies=0, world_mb=WORLD_MB)
        controller = make_controller(STIFF_BODY_MODE, 1)
        self.sim = open_simulator(
            backend,
            scene.layout,
            worlds,
            threads=threads,
            device=device,
            drives=controller.drives,
        )
        self._start = np.tile(scene.qpos, (worlds, 1))
        self._homes = [scene.home] * worlds
        self._draw = self._drawer(threads) if render else None
        self.reset()
        self._offset: Any
        self._moves: Any
        self._offset, self._moves = affine_commands(interact_actions(scene))
        if backend == "warp":
            tensor = (
                self.sim.state().robot_q.new_tensor
            )  # on the device: no copy to the host in a step
            self._offset = tensor(self._offset)
            self._moves = tensor(self._moves)

    def _drawer(self, threads: int) -> Callable[[], Mapping[str, Any]]:
        sim = self.sim
        if not isinstance(sim, CpuSimulator):
            from mjhab.render.warp.cameras import WarpCameras

            return WarpCameras(
                sim,
                self.scene.layout.robot.camera_names,
                (IMAGE_SIDE_PX, IMAGE_SIDE_PX),
                PICTURE_OUTPUTS,
            ).draw
        from mjhab.render.home_scene import HomeRenderer

        renderer = HomeRenderer(sim, threads)
        return lambda: renderer.robot_views(
            sim.state(), self._homes, IMAGE_SIDE_PX, PICTURE_OUTPUTS
        )

    def reset(self) -> None:
        """Put all worlds at the start."""
        self.sim.reset(range(self.worlds), self._homes, self._start)

    def step(self, number: int) -> None:
        """Control step ``number`` of the recorded ones, with its pictures."""
        self.move(number)
        self.draw()

    def move(self, number: int) -> None:
        """Physics of control step ``number``."""
        self.sim.step(self._offset[number] + self._moves * self.sim.state().robot_q)

    def draw(self) -> Mapping[str, Any]:
        """Pictures of the present state, if any are wanted: "rgb" and "depth", see `HomeRenderer.robot_views`."""
        return self._draw() if self._draw else {}

    def sync(self) -> None:
        """Wait until the device has done all work."""
        device = getattr(self.sim, "device", None)
        if device is not None and device.is_cuda:
            from mjhab.sim.warp.probe import synchronize

            synchronize(device)

    def moved(self) -> list[str]:
        """Objects of world 0 that are not where they started."""
        start = self._start[0, self.sim.addresses.object_q[:, None] + np.arange(3)]
        offset = np.linalg.norm(
            to_numpy(self.sim.state().object_pose)[0, :, :3] - start, axis=1
        )
        return [name for name, far in zip(OBJECTS, offset > MOVED, strict=True) if far]

    def tainted(self) -> int:
        """Number of worlds with a taint (`sim.protocol.TAINTS`)."""
        return int((to_numpy(self.sim.taint()) != 0).sum())

    def device_used_mb(self) -> float | None:
        """Memory of the GPU that is in use, by anybody [MB]; None without a GPU."""
        return gpu_used_mb(getattr(self.sim, "device", None))


def affine_commands(actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Commands for actions (T, A) of STIFF_BODY_MODE with the base at rest: ``offset[t] + moves * robot_q``.

    The arm moves from where it is measured, head and torso are told where to be: offset (T, J), moves (J,).
    """
    controller = make_controller(STIFF_BODY_MODE, 1)

    def command(action: np.ndarray, robot_q: np.ndarray) -> np.ndarray:
        return controller.command(action[None], robot_q)[0]

    zero = np.zeros((1, len(controller.robot.joints)))
    # Computed before the clock runs: a step then only multiplies and adds.
    offset = np.stack([command(action, zero) for action in actions])
    # The command is affine in each joint, so two joint vectors determine it.
    return offset, command(actions[0], zero + 1.0) - offset[0]


def measure_interact(
    spec: InteractSpec,
) -> tuple[dict[str, Any], list[dict[str, Any]], Pictures]:
    """Measure every number of worlds, ``seeds`` times.

    Returns:
        The best point, and all ``points`` (mean and 95 % confidence interval of the control steps/s over all worlds;
        largest memory during the runs; ``moved`` objects; ``tainted_worlds``; time of each stage, see `stage_times`);
        the single runs; and pictures of a world in the midst of it.

    Raises:
        UsageError: more steps than are recorded, or no room for the worlds.
    """
    if spec.steps > STEPS:
        raise wrong_value(
            "steps", spec.steps, f"at most {STEPS}, as many as are recorded"
        )
    backend = resolve(spec.asked.backend)
    render = not spec.no_render
    scene = interact_scene(spec.asked.assets)
    points = []
    runs = []
    pictures = {}
    with progress_bar("interact", len(spec.worlds) * spec.seeds) as advance:
        for worlds in spec.worlds:
            bench = InteractBench(
                scene,
                backend,
                worlds,
                render=render,
                device=spec.asked.device,
                threads=spec.asked.threads,
            )
            mine, point, pictures = _measure_worlds(bench, worlds, spec, advance)
            points.append(point)
            device = str(getattr(bench.sim, "device", "cpu"))
            runs += [
                {"backend": backend, "device": device, "render": render, **run}
                for run in mine
            ]
            # Its worlds would take the memory that the next number of worlds is measured in.
            del bench
    common = {
        "backend": backend,
        "device": runs[0]["device"],
        "render": render,
        "steps": spec.steps,
    }
    best = max(points, key=lambda point: point["sps_mean"])
    return (
        best | common | {"seeds": spec.seeds, "home": scene.home, "points": points},
        runs,
        pictures,
    )


def _measure_worlds(
    bench: InteractBench, worlds: int, spec: InteractSpec, advance: Callable[[], None]
) -> tuple[list[dict[str, Any]], dict[str, Any], Pictures]:
    """The runs of one number of worlds, their point, and pictures of a world in the midst of it."""
    warm(bench)
    runs = []
    for seed in range(1, spec.seeds + 1):
        runs.append({"worlds": worlds, "seed": seed} | measure_run(bench, spec.steps))
        advance()
    outcome = {"moved": bench.moved(), "tainted_worlds": bench.tainted()}
    stages, pictures = stage_times(bench, min(spec.steps, STAGE_STEPS))
    return runs, summarize(runs) | outcome | stages, pictures


def warm(bench: InteractBench) -> None:
    """Untimed steps."""
    for number in range(WARM_STEPS):
        bench.step(number)
    bench.sync()


def measure_run(bench: InteractBench, steps: int) -> dict[str, Any]:
    """One run from the start; the clock stops when the device has finished."""
    with MemorySampler(resident_mb, bench.device_used_mb) as memory:
        before = time.perf_counter()
        bench.reset()
        bench.sync()
        begun = time.perf_counter()
        for number in range(steps):
            bench.step(number)
        bench.sync()
        ended = time.perf_counter()
    total = bench.worlds * steps
    return {
        "sps": round(total / (ended - begun), 2),
        "reset_and_step_sps": round(total / (ended - before), 2),
        "device_mb": memory.peak_device_mb,
        "rss_mb": memory.peak_rss_mb,
    }


def stage_times(
    bench: InteractBench, steps: int
) -> tuple[dict[str, float | None], Pictures]:
    """Mean time of a control step of all worlds by stage, "physics_ms" and "render_ms" (None without pictures), each
    waited for, so that on a GPU they add up to more than a step takes; and what world 0 sees at the end."""
    spent = {"physics": 0.0, "render": 0.0}
    bench.reset()
    bench.sync()
    images: Mapping[str, Any] = {}
    for number in range(steps):
        begun = time.perf_counter()
        bench.move(number)
        bench.sync()
        moved = time.perf_counter()
        images = bench.draw()
        bench.sync()
        spent["physics"] += moved - begun
        spent["render"] += time.perf_counter() - moved
    # Copies, as the memory of the pictures goes with the bench.
    views = {name: to_numpy(image[0]).copy() for name, image in images.items()}
    times: dict[str, float | None] = {
        f"{stage}_ms": round(1e3 * total / steps, 2) for stage, total in spent.items()
    }
    return times if views else times | {"render_ms": None}, views


def summarize(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean and interval of runs with one number of worlds. One run has no interval."""
    sps = np.array([run["sps"] for run in runs])
    count = len(sps)
    ci = (
        float(student.ppf(0.975, count - 1) * sps.std(ddof=1) / math.sqrt(count))
        if count > 1
        else None
    )
    device = [run["device_mb"] for run in runs if run["device_mb"] is not None]
    return {
        "worlds": runs[0]["worlds"],
        "sps_mean": round(float(sps.mean()), 2),
        "sps_ci95": None if ci is None else round(ci, 2),
        "reset_and_step_sps": round(
            float(np.mean([run["reset_and_step_sps"] for run in runs])), 2
        ),
        "device_mb": max(device) if device else None,
        "rss_mb": max(run["rss_mb"] for run in runs),
    }


def write_results(
    out: Path, found: dict[str, Any], runs: list[dict[str, Any]], pictures: Pictures
) -> None:
    """Write interact.json, interact.csv (a row per run) and report.html into a folder."""

    def table(path: Path) -> None:
        # csv ends lines itself.
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(COLUMNS))
            writer.writeheader()
            writer.writerows(runs)

    write_json(out / "interact.json", found)
    write_atomic(out / "interact.csv", table)
    write_text(out / "report.html", interact_page(found, pictures))
