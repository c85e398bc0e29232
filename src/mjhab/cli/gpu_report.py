"""``make gpu-report``: run everything that measures the warp backend and write docs/results/gpu-*.json.

On a machine without a GPU it runs small versions on Warp's CPU device, and the files say so.
"""

from __future__ import annotations

import dataclasses
import json
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mjhab.cli.bench_interact import measure_interact
from mjhab.cli.bench_parity import measure_parity
from mjhab.cli.doctor import cores, gpu_name, installed
from mjhab.cli.estimate import estimate_rows
from mjhab.cli.gpu_options import BenchInteractOptions, BenchParityOptions
from mjhab.cli.options import DoctorOptions
from mjhab.core.cache import write_atomic
from mjhab.core.errors import MjhabError
from mjhab.sim.backends import cuda_devices, resolve

NO_GPU = "no GPU at hand: these numbers come from Warp's CPU device and say nothing about a GPU"
GPU_WORLDS, CPU_WORLDS = (64, 256, 1024, 4096, 8192), (1, 16)


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    packages = ("mujoco", "mujoco-warp", "warp-lang", "torch", "numpy", "numba")
    return {
        "gpu": gpu_name(), "cores": cores(), "processor": platform.machine(), "python": platform.python_version(),
        "versions": {name: installed(name) for name in packages},
    }  # fmt: skip


def interact_results(has_gpu: bool) -> list[dict[str, Any]]:
    """The Interact benchmark on both backends; a number of worlds that does not fit gives its error."""
    cpu = BenchInteractOptions(backend="cpu", seeds=3)
    warp = BenchInteractOptions(backend="warp", no_render=True)
    if has_gpu:
        plans = [dataclasses.replace(warp, worlds=(count,)) for count in GPU_WORLDS]
    else:
        plans = [dataclasses.replace(warp, device="cpu", worlds=(2,), seeds=2, steps=40)]
    plans += [
        dataclasses.replace(cpu, worlds=(count,), no_render=bare) for bare in (True, False) for count in CPU_WORLDS
    ]
    return [attempt(lambda plan=plan: measure_interact(plan)[0], f"interact {_words(plan)}") for plan in plans]


def _words(plan: BenchInteractOptions) -> str:
    return f"{plan.backend}, {plan.worlds[0]} worlds, {'no cameras' if plan.no_render else 'RGB-D'}"


def parity_results(has_gpu: bool) -> dict[str, Any]:
    """The parity report: 200 expert episodes on a GPU, two starts and no episodes without."""
    options = BenchParityOptions(worlds=16, episodes=200)
    if not has_gpu:
        options = BenchParityOptions(worlds=2, steps=100, grasp_seconds=2.0, device="cpu")
    return attempt(lambda: measure_parity(options), "parity")


def attempt(work: Callable[[], dict[str, Any]], name: str) -> dict[str, Any]:
    """What the work finds, or the one-line error that stopped it; a line on stderr says what is under way."""
    print(f"mjhab: {name} ...", file=sys.stderr, flush=True)
    try:
        return {"what": name} | work()
    except MjhabError as error:
        return {"what": name, "error": str(error)}


def main(out: Path) -> None:
    """Measure and write gpu-interact.json, gpu-parity.json and gpu-memory.json."""
    resolve("warp")
    has_gpu = bool(cuda_devices())
    head = {"machine": machine(), "note": None if has_gpu else NO_GPU}
    estimates = [
        {"num_envs": count, "obs": obs, "backends": estimate_rows(DoctorOptions(num_envs=count, obs=obs))}
        for count in (1024, 4096)
        for obs in ("state", "rgbd")
    ]
    results = {
        "memory": lambda: {"estimates": estimates},
        "interact": lambda: {"points": interact_results(has_gpu)},
        "parity": lambda: parity_results(has_gpu),
    }
    for name, work in results.items():
        text = json.dumps(head | work(), indent=1) + "\n"
        path = out / f"gpu-{name}.json"
        write_atomic(path, lambda temporary, text=text: temporary.write_text(text, encoding="utf-8"))
        print(path)
    if not has_gpu:
        print(f"Note: {NO_GPU}.")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
