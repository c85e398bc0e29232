"""``mjhab bench photo``: control steps per second with path-traced pictures (MS-HAB paper, App. A.5)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.bench.environments.memory_sampler import MemorySampler
from mjhab.bench.interact.run import IMAGE_SIDE_PX, PICTURE_OUTPUTS, WARM_STEPS, summarize
from mjhab.bench.interact.scene import (
    STIFF_BODY_MODE,
    InteractScene,
    interact_scene,
    with_body,
)
from mjhab.bench.specs import PhotoSpec
from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.files.cache import write_json, write_text
from mjhab.core.machine import resident_mb
from mjhab.core.progress import progress_bar
from mjhab.core.seeding import stream
from mjhab.render.home_scene import HomeRenderer
from mjhab.reports.interact import photo_page
from mjhab.robots.controllers import make_controller
from mjhab.scenes.shading import SCALAR, Shading
from mjhab.sim.mujoco.cpu import CpuSimulator

CLIP = 0.3
"""Bound of the random actions (App. A.5)."""
ARM_JOINTS = 7


class PhotoBench:
    """One world before its objects, and a camera of the robot that is drawn in every control step.

    Args:
        scene: what the world holds.
        shading: of its pictures.

    Raises:
        UsageError: the path tracer cannot run here.
    """

    def __init__(self, scene: InteractScene, shading: Shading) -> None:
        self.scene = scene
        self.camera = scene.layout.robot.camera_names[0]
        self._controller = make_controller(STIFF_BODY_MODE, 1)
        drives = self._controller.drives
        self._sim = CpuSimulator(scene.layout, 1, 1, drives)
        self._renderer = HomeRenderer(self._sim, 1, shading)
        self.reset()

    def reset(self) -> None:
        """Put the world at the start."""
        self._sim.reset([0], [self.scene.home], self.scene.qpos[None])

    def step(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """One control step with an action (A,), and its pictures "rgb" and "depth" (1, 1, h, w[, 3])."""
        robot_q = self._sim.state().robot_q
        self._sim.step(self._controller.command(action[None], robot_q))
        return self._renderer.robot_views(
            self._sim.state(),
            [self.scene.home],
            IMAGE_SIDE_PX,
            PICTURE_OUTPUTS,
            (self.camera,),
        )


def random_actions(scene: InteractScene, seed: int, run: int, steps: int) -> np.ndarray:
    """(T, A) actions of a run: the arm's are normal, clipped to `CLIP`; head and torso are held."""
    rng = stream(seed, "bench photo", run)
    arm = rng.standard_normal((steps, ARM_JOINTS)).clip(-CLIP, CLIP)
    return with_body(scene, arm)


def measure_photo(
    spec: PhotoSpec,
) -> tuple[dict[str, Any], dict[int, dict[str, np.ndarray]]]:
    """Measure every number of samples, ``runs`` times.

    Returns:
        All ``points`` (mean and 95 % confidence interval of the control steps/s; ``cpu_ms``, time of processors that a
        step takes, all threads together; largest memory), and the last pictures by number of samples.

    Raises:
        UsageError: the path tracer cannot run here.
    """
    scene = interact_scene(spec.asked.assets)
    points = []
    pictures = {}
    camera = ""
    with progress_bar("photo", len(spec.samples) * spec.runs) as advance:
        for samples in spec.samples:
            bench = PhotoBench(scene, spec.shading(samples))
            camera = bench.camera
            # Actions of run 0, which is not measured: kernels are compiled in these steps.
            for action in random_actions(scene, spec.asked.seed, 0, WARM_STEPS):
                bench.step(action)
            runs = []
            for run in range(1, spec.runs + 1):
                actions = random_actions(scene, spec.asked.seed, run, spec.steps)
                measured, pictures[samples] = measure_run(bench, actions)
                runs.append(measured)
                advance()
            point = summarize(runs)
            # One world on the processor: both would say the same in every point.
            del point["worlds"], point["device_mb"]
            busy = ordered_sum(run["cpu_s"] for run in runs) / (spec.runs * spec.steps)
            cpu_ms = round(1000.0 * busy, 1)
            points.append({"samples": samples, "cpu_ms": cpu_ms, **point})
    shading = spec.shading(spec.samples[0])
    common = {
        "home": scene.home,
        "camera": camera,
        "size": IMAGE_SIDE_PX,
        "variant": shading.variant or SCALAR,
        "denoise": shading.denoise,
        "steps": spec.steps,
        "runs": spec.runs,
        "points": points,
    }
    return common, pictures


def measure_run(
    bench: PhotoBench, actions: np.ndarray
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """One run from the start, and its last pictures."""
    images: dict[str, np.ndarray] = {}
    with MemorySampler(resident_mb, lambda: None) as memory:
        before = time.perf_counter()
        bench.reset()
        # Time of the process counts all cores, on which the path tracer spreads.
        begun, busy = time.perf_counter(), time.process_time()
        for action in actions:
            images = bench.step(action)
        ended, still = time.perf_counter(), time.process_time()
    measured = {
        "worlds": 1,
        "sps": round(len(actions) / (ended - begun), 2),
        "reset_and_step_sps": round(len(actions) / (ended - before), 2),
        "cpu_s": still - busy,
        "device_mb": None,
        "rss_mb": memory.peak_rss_mb,
    }
    return measured, {name: image[0] for name, image in images.items()}


def write_results(
    out: Path, found: dict[str, Any], pictures: dict[int, dict[str, np.ndarray]]
) -> None:
    """Write photo.json and report.html into a folder."""
    write_json(out / "photo.json", found)
    write_text(out / "report.html", photo_page(found, pictures))
