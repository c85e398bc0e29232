"""Full states of single worlds: read, restored, and stored in files."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

from mjhab.core.arrays import row_of, with_row
from mjhab.core.errors import UsageError
from mjhab.envs.parts.rewarding import Rewarder
from mjhab.envs.parts.teleport import Teleports
from mjhab.envs.parts.tracking import Tracker
from mjhab.episodes.generator import Episode
from mjhab.robots.controllers.controller import Controller
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState
from mjhab.tasks.progress import Progress
from mjhab.tasks.signals import Signals

_FLAGS = ("fallback", "success", "fail")


class RestorableWorlds(Protocol):
    """Interface of an environment that snapshots read and write."""

    sim: CpuSimulator
    state: SimState
    signals: Signals | None
    progress: Progress
    episodes_now: list[Episode | None]
    tracker: Tracker
    controller: Controller
    rewarder: Rewarder
    teleports: Teleports
    seeds: np.ndarray
    count: np.ndarray
    fallback: np.ndarray
    success: np.ndarray
    fail: np.ndarray
    due: np.ndarray
    joint_start: np.ndarray
    grip: np.ndarray

    def make_episode(self, seed: int, index: int) -> Episode:
        """An episode by its name."""
        ...

    def adopt(self, world: int, episode: Episode) -> object:
        """Set the episode of a world."""
        ...

    def follow(self, progress: Progress) -> None:
        """Set the progress of all worlds and everything derived from it."""
        ...


def snapshot(env: RestorableWorlds, world: int) -> dict[str, Any]:
    """Full state of a world: a nested dict of arrays, numbers, strings and lists, which later steps do not change.

    Its episode by name, physics, progress, signals, label notes, controller targets, reward memory, faults. Physics
    holds no sleep: a restored world is awake, see `CpuSimulator.get_world`.

    Raises:
        UsageError: the world has not been reset yet.
    """
    episode = env.episodes_now[world]
    if episode is None or env.signals is None:
        raise UsageError(f"world {world} has no state yet: call reset first")
    return {
        "episode": {"seed": episode.seed, "index": episode.index, "home": episode.home},
        "next": {"seed": int(env.seeds[world]), "count": int(env.count[world])},
        "sim": env.sim.get_world(world),
        "progress": dataclasses.asdict(row_of(env.progress, world)),
        "signals": dataclasses.asdict(row_of(env.signals, world)),
        "tracker": env.tracker.get_row(world),
        "controller": env.controller.get_state(world),
        "rewarder": env.rewarder.get_state(world),
        "flags": {name: bool(getattr(env, name)[world]) for name in _FLAGS},
        "joint_start": float(env.joint_start[world]),
        "grip": float(env.grip[world]),
        "pending": int(env.teleports.pending[world]),
        "taint": int(env.sim.taint()[world]),
    }


def restore(env: RestorableWorlds, world: int, state: dict[str, Any]) -> None:
    """Put a world into a state from `snapshot`, taken from any world of an environment of the same configuration.

    Raises:
        UsageError: the state belongs to another layout or its episode does not exist here.
    """
    if env.signals is None:
        raise UsageError("reset the environment once before putting a state into it")
    name = state["episode"]
    episode = env.make_episode(name["seed"], name["index"])
    if episode.home != name["home"]:
        raise UsageError(
            f"the state is of home {name['home']!r}, but that episode is in {episode.home!r} here"
        )
    env.sim.set_world(world, episode.home, state["sim"])
    env.adopt(world, episode)
    env.sim.add_taint(world, state["taint"])
    env.seeds[world] = state["next"]["seed"]
    env.count = _with_entry(env.count, world, state["next"]["count"])
    env.fallback = _with_entry(env.fallback, world, state["flags"]["fallback"])
    env.success = _with_entry(env.success, world, state["flags"]["success"])
    env.fail = _with_entry(env.fail, world, state["flags"]["fail"])
    env.due = _with_entry(env.due, world, False)
    env.joint_start = _with_entry(env.joint_start, world, state["joint_start"])
    env.grip = _with_entry(env.grip, world, state["grip"])
    env.teleports.pending[world] = state["pending"]
    # States of versions without ``ee_contact``: any link that touched stands in for it, as in their labels.
    env.signals = with_row(
        env.signals, world, {"ee_contact": state["signals"]["touch"], **state["signals"]}
    )
    env.follow(with_row(env.progress, world, state["progress"]))
    env.tracker.set_row(world, state["tracker"])
    env.state = env.sim.state()
    env.controller.set_state(world, state["controller"])
    env.rewarder.set_state(world, state["rewarder"])


def _with_entry(values: np.ndarray, world: int, value: float) -> np.ndarray:
    """Copy of an array with another value for one world; arrays that were returned before are not modified."""
    changed = values.copy()
    changed[world] = value
    return changed
