"""``make gpu-report``: run everything that measures the warp backend and write docs/results/gpu-*.json.

On a machine without a GPU it runs small versions on Warp's CPU device, and the files say so.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import gc
import platform
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.gpu_pictures import picture_stages
from benchmarks.parity.episodes import Leg
from benchmarks.parity.run import ParitySpec, measure_parity
from benchmarks.sleep import sleep_cost
from mjhab.bench.environments import env as bench_env
from mjhab.bench.interact.run import measure_interact
from mjhab.bench.specs import EnvBenchSpec, InteractSpec
from mjhab.core.errors import MjhabError, UsageError, unknown_name
from mjhab.core.files.cache import write_json
from mjhab.core.machine import cores, gpu_name, installed
from mjhab.core.version import __version__
from mjhab.envs.estimate import estimate_rows
from mjhab.sim.backends import cuda_devices, resolve

NO_GPU = "no GPU at hand: these numbers come from Warp's CPU device and say nothing about a GPU"
GPU_WORLDS = (64, 256, 1024, 4096, 8192)
CPU_WORLDS = (1, 16)
ENV_WORLDS = (256, 512, 1024, 2048, 4096)
PICTURE_WORLDS = (256, 1024, 4096)
CHAIN_WORLDS = (256, 1024)
"""Fewer: for the starts of a chain, all its teleport poses are searched on the host."""
PARITY_LOG = Path("runs/gpu-parity.jsonl")
"""Finished episodes of the full parity report, which goes on from there when it was stopped."""


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    packages = ("mujoco", "mujoco-warp", "warp-lang", "torch", "numpy", "numba")
    return {
        "gpu": gpu_name(),
        "cores": cores(),
        "processor": platform.machine(),
        "python": platform.python_version(),
        "versions": {name: installed(name) for name in packages},
    }


def memory_results(has_gpu: bool) -> dict[str, Any]:
    """Estimates of `mjhab estimate`."""
    return {
        "estimates": [
            {
                "num_envs": count,
                "obs": obs,
                "backends": estimate_rows(count, obs),
            }
            for count in (1024, 4096)
            for obs in ("state", "rgbd")
        ]
    }


def interact_results(has_gpu: bool) -> dict[str, Any]:
    """The Interact benchmark on both backends; a number of worlds that does not fit gives its error."""
    cpu = InteractSpec.of(backend="cpu", seeds=3)
    warp = InteractSpec.of(backend="warp")
    counts = GPU_WORLDS if has_gpu else (2,)
    if not has_gpu:
        warp = dataclasses.replace(
            warp, env={**warp.env, "device": "cpu"}, seeds=2, steps=40
        )
    plans = [
        dataclasses.replace(base, worlds=(count,), no_render=bare)
        for base, several in ((warp, counts), (cpu, CPU_WORLDS))
        for bare in (True, False)
        for count in several
    ]
    return {
        "points": [
            # One by one: a number of worlds that does not fit must not cost the others.
            attempt(lambda plan=plan: measure_interact(plan)[0], _words(plan))
            for plan in plans
        ]
    }


def _words(plan: InteractSpec) -> str:
    return f"interact {plan.asked.backend}, {plan.worlds[0]} worlds, {'no cameras' if plan.no_render else 'RGB-D'}"


def env_results(has_gpu: bool) -> dict[str, Any]:
    """TidyHouse with 30 objects, depth, dense reward: PickSubtaskTrain on both backends, on a GPU also the chain."""
    base = EnvBenchSpec.of(task="tidy_house", obs="depth", reward="dense")
    warp = dataclasses.replace(base, env={**base.env, "backend": "warp"})
    if has_gpu:
        chain = dataclasses.replace(warp, id="mjhab/TidyHouse-v1")
        plans = [dataclasses.replace(warp, worlds=(count,)) for count in ENV_WORLDS]
        plans += [dataclasses.replace(chain, worlds=(count,)) for count in CHAIN_WORLDS]
    else:
        small = {**warp.env, "device": "cpu"}
        plans = [dataclasses.replace(warp, worlds=(2,), env=small, steps=10, rounds=2)]
    plans.append(dataclasses.replace(base, rounds=3))
    points = [
        attempt(
            lambda plan=plan: bench_env.measure(plan)["points"][0],
            f"{plan.id.removeprefix('mjhab/')} {plan.asked.backend}, {plan.worlds[0]} worlds",
        )
        for plan in plans
    ]
    asked = base.asked
    return {
        "task": asked.task,
        "obs": asked.obs_mode,
        "reward": asked.reward_mode,
        "points": points,
    }


def picture_results(has_gpu: bool) -> dict[str, Any]:
    """Stages of the pictures of both cameras, by number of worlds and size."""
    device = "cuda:0" if has_gpu else "cpu"
    counts = PICTURE_WORLDS if has_gpu else (2,)
    return {
        "points": [
            attempt(
                lambda count=count, size=size: picture_stages(count, size, device),
                f"pictures of {size} px, {count} worlds",
            )
            for size in (64, 128)
            for count in counts
        ]
    }


def sleep_results(has_gpu: bool) -> dict[str, Any]:
    """What sleep changes and saves: Pick in TidyHouse with 30 objects."""
    worlds, steps, device = (256, 100, "cuda:0") if has_gpu else (4, 60, "cpu")
    leg = Leg("tidy_house", "pick", worlds=worlds, device=device)
    what = {"task": leg.task, "subtask": leg.subtask, "worlds": worlds, "steps": steps}
    return what | attempt(lambda: {"rows": sleep_cost(leg, steps)}, "sleep")


def parity_results(has_gpu: bool) -> dict[str, Any]:
    """The parity report over all subtasks with 200 expert episodes."""
    options = ParitySpec(
        worlds=16 if has_gpu else 10,
        episodes=200,
        task="all",
        subtask="all",
        log=PARITY_LOG,
    )
    return attempt(lambda: measure_parity(options), "parity")


def quick_parity_results(has_gpu: bool) -> dict[str, Any]:
    """The parity report of two starts of one subtask."""
    options = ParitySpec(worlds=2, steps=100, episodes=2, grasp_seconds=2.0)
    return attempt(lambda: measure_parity(options), "parity, quick")


MEASURES: dict[str, Callable[[bool], dict[str, Any]]] = {
    "memory": memory_results,
    "interact": interact_results,
    "env": env_results,
    "pictures": picture_results,
    "sleep": sleep_results,
    "parity": parity_results,
    "parity-quick": quick_parity_results,
}
"""What can be measured: name of the file after "gpu-", and function of whether there is a GPU."""


def attempt(work: Callable[[], dict[str, Any]], name: str) -> dict[str, Any]:
    """What the work finds, or the error that stopped it, so that the rest is measured all the same; a line on stderr
    says what is under way."""
    print(f"mjhab: {name} ...", file=sys.stderr, flush=True)
    try:
        return {"what": name} | work()
    except MjhabError as error:
        return {"what": name, "error": str(error)}
    except RuntimeError as error:  # of the device: Warp, torch
        print(traceback.format_exc(), file=sys.stderr, flush=True)
        return {"what": name, "error": f"{type(error).__name__}: {error}"}
    finally:
        gc.collect()  # makes room on the device


def main(words: Sequence[str] | None = None) -> int:
    """Run the command (words of ``sys.argv`` if None); returns the exit code.

    Raises:
        SystemExit: the words are no such command.
    """
    parser = argparse.ArgumentParser(
        "python -m benchmarks.gpu_report", description=__doc__
    )
    parser.add_argument(
        "out", type=Path, metavar="FOLDER", help="for gpu-NAME.json, one per measure"
    )
    shown = ", ".join(MEASURES)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"measures, of {shown}; all if absent"
    )
    options = parser.parse_args(words)
    try:
        report(options.out, options.names)
    except UsageError as error:
        print(f"mjhab: {error}", file=sys.stderr)
        return 2
    return 0


def report(out: Path, names: Sequence[str] = ()) -> None:
    """Measure and write gpu-NAME.json for the names of MEASURES.

    Without names: all; the quick parity report in place of the full one, which takes an hour, where there is no GPU.
    """
    # First, as nothing can be measured without Warp.
    resolve("warp")
    for name in names:
        if name not in MEASURES:
            raise unknown_name("measure", name, MEASURES)
    has_gpu = bool(cuda_devices())
    left_out = "parity-quick" if has_gpu else "parity"
    made = {"date": datetime.date.today().isoformat(), "version": __version__}
    head = made | {"machine": machine(), "note": None if has_gpu else NO_GPU}
    for name in names or [name for name in MEASURES if name != left_out]:
        told = {"command": f"python -m benchmarks.gpu_report docs/results {name}"}
        path = out / f"gpu-{name}.json"
        write_json(path, told | head | MEASURES[name](has_gpu))
        print(path, flush=True)
    if not has_gpu:
        print(f"Note: {NO_GPU}.")


if __name__ == "__main__":
    sys.exit(main())
