"""The environment of ours behind the arguments of MS-HAB, and how its episodes are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from mjhab.compat.mshab.files.matching import home_of
from mjhab.compat.mshab.files.navigable import FOLDER, MapWays, read_maps
from mjhab.compat.mshab.files.plan_requests import PlanRequest
from mjhab.compat.mshab.files.plan_starts import PlanStarts, plan_starts
from mjhab.compat.mshab.files.plans import task_of_dataset
from mjhab.compat.mshab.paths import REPLICA_CAD
from mjhab.compat.mshab.worlds.arguments import OBS_MODES, Arguments
from mjhab.compat.mshab.worlds.draws import OwnDraw, PlanDraw
from mjhab.compat.mshab.worlds.limits import ENDLESS, overrides_of
from mjhab.config.profiles import unbound
from mjhab.core.conventions.hand_turns import AS_MANISKILL
from mjhab.core.errors import warn_once
from mjhab.envs.catalog import make
from mjhab.envs.loop import TaskLoop
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.scenes.shading import PATH, RASTER
from mjhab.sim.backends import resolve
from mjhab.tasks.household.registry import TASKS

DEFAULT_TASK = "set_table"
"""Task of an environment without plans that is not told one."""
PROFILE = "ms_hab"


@dataclass(frozen=True)
class DrawnWorlds:
    """``worlds``: the environment of ours. ``draw``: which episodes its worlds get."""

    worlds: TaskLoop
    draw: PlanDraw | OwnDraw


def open_setting(arguments: Arguments) -> DrawnWorlds:
    """Make the environment of ours, with the values of profile "ms_hab".

    Raises:
        UsageError: plans, starts or options do not fit.
    """
    starts = _starts(arguments)
    chosen = _task_options(arguments)
    if starts is not None:
        # Single options stand for the profile here, so that some may differ from it.
        chosen = {n: v for n, v in starts.options.items() if n != "profile"}
    options = {**_options(arguments, chosen), **chosen, **arguments.mjhab_options}
    if starts is not None and options["backend"] == "warp":
        # On a device the number of an episode is its place in the pool.
        options["starts"] = sum(map(starts.spawns, range(len(starts.plans))))
    worlds = make(**options)
    if starts is not None and arguments.subtask == "navigate":
        count_ways_by_maps(worlds, starts)
    if starts is None:
        return DrawnWorlds(worlds, OwnDraw(arguments.num_envs))
    return DrawnWorlds(worlds, PlanDraw(arguments, starts, home_numbers(starts.plans)))


def count_ways_by_maps(worlds: TaskLoop, starts: PlanStarts) -> None:
    """Let Navigate count its way by the maps of its homes, where all of them are there."""
    homes = {
        plan.build_config_name or "": home_of(plan.build_config_name)
        for plan in starts.plans
    }
    found = read_maps((starts.root / FOLDER, REPLICA_CAD / FOLDER), list(homes))
    lacking = [scene for scene in homes if scene not in found]
    if found and lacking:
        warn_once(
            f"navigable positions: {len(lacking)} of {len(homes)} homes have none ({lacking[0]}), so the way to the "
            "goal is counted on mjhab's own map of the floor in all homes."
        )
    elif found and isinstance(worlds, SequentialTaskEnv):
        maps = {home: found[scene] for scene, home in homes.items()}
        worlds.nav = MapWays(maps, worlds.num_envs)
    elif found:
        warn_once(
            "navigable positions are read on the CPU alone: on a device the way to the goal is counted on mjhab's map."
        )


def home_numbers(plans: Any) -> dict[str, int]:
    """Index of every home of plans by its name there: the names in order."""
    names = sorted({plan.build_config_name or "" for plan in plans})
    return {name: number for number, name in enumerate(names)}


def _starts(arguments: Arguments) -> PlanStarts | None:
    """The starts of the plans; None without plans."""
    if not arguments.task_plans:
        return None
    dataset = arguments.scene_builder_cls
    request = PlanRequest(
        arguments.task_plans,
        dataset if isinstance(dataset, str) else dataset.__name__,
        arguments.subtask,
        arguments.spawn_data_fp,
        assets=arguments.mjhab_options.get("assets", ""),
        profile=PROFILE,
    )
    return plan_starts(request)


def _task_options(arguments: Arguments) -> dict[str, Any]:
    """Task and split of an environment without plans."""
    given = arguments.scene_builder_cls
    if not given:
        return {}
    name = given if isinstance(given, str) else given.__name__
    task, split = task_of_dataset(name)
    return {"task": task, "split": split}


def _options(arguments: Arguments, chosen: dict[str, Any]) -> dict[str, Any]:
    """Options of `mjhab.make` but those of the episodes."""
    subtask = arguments.subtask
    task = {"task": DEFAULT_TASK, **chosen, **arguments.mjhab_options}["task"]
    kinds = (subtask,) if subtask else tuple(TASKS[task].subtasks)
    backend = _backend(arguments.backend)
    values = unbound({"profile": PROFILE}, subtask, trains=False)
    return {
        **values,
        "task": task,
        "subtask": subtask,
        "num_envs": arguments.num_envs,
        "backend": backend,
        "obs_mode": "+".join(OBS_MODES[arguments.obs_mode]) or "state",
        "camera_size": arguments.camera_size,
        "shader": _shader(arguments, backend),
        "control_mode": AS_MANISKILL.get(arguments.control_mode, arguments.control_mode),
        # The wrapper of actions holds the head still, or does not.
        "stationary": (),
        "reward_mode": _reward(arguments),
        "horizon": ENDLESS,
        "continuous": True if subtask else None,
        "autoreset": "disabled",
        "navigate": "drive",
        "open_start": arguments.open_start,
        "overrides": {
            **overrides_of(arguments.configs, kinds),
            **({} if subtask else {"goes_on": True}),
        },
    }


def _shader(arguments: Arguments, backend: str) -> str:
    if arguments.ray_traced and backend == "warp":
        warn_once(
            "shader_dir='rt...': pictures of the GPU backend are drawn as with 'minimal'."
        )
        return RASTER
    return PATH if arguments.ray_traced else RASTER


def _backend(name: str) -> str:
    """ "auto" is a GPU where torch has one; to ask Warp would print to the terminal of a script."""
    if name == "auto" and not torch.cuda.is_available():
        warn_once("sim_backend='gpu': there is no GPU, so physics runs on the CPU.")
        return "cpu"
    return resolve(name)


def _reward(arguments: Arguments) -> str:
    if not arguments.subtask:
        return "none"
    # Sparse ones are computed from success and failure.
    return "none" if arguments.reward_mode == "sparse" else arguments.reward_mode
