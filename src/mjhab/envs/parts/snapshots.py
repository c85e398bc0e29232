"""Full states of single worlds: snapshot and restore."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

from mjhab.core.arrays import row_of, with_row
from mjhab.core.errors import UsageError, wrong_value
from mjhab.episodes.episode import Episode
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState
from mjhab.tasks.progress import Progress
from mjhab.tasks.signals import Signals

_ORDER = (
    "episode",
    "next",
    "sim",
    "progress",
    "signals",
    "tracker",
    "controller",
    "rewarder",
    "flags",
    "joint_start",
    "grip",
    "pending",
    "taint",
)
"""Order of the entries of a snapshot; further entries follow. The bytes of recorded episodes depend on the order."""


class Restorable(Protocol):
    """A part of an environment that holds state of its own for every world."""

    def get_state(self, world: int) -> Any:
        """Copy of the state of a world: arrays, numbers, strings, lists and dicts of them."""
        ...

    def set_state(self, world: int, state: Any) -> None:
        """Restore a world from `get_state`; other worlds are not changed."""
        ...


class RestorableWorlds(Protocol):
    """Interface of an environment that snapshots read and write."""

    sim: CpuSimulator
    state: SimState
    signals: Signals | None
    progress: Progress
    episodes_now: list[Episode | None]

    def restorable_parts(self) -> Mapping[str, Restorable]:
        """Every part with state of its own, by its key in a snapshot."""
        ...

    def get_columns(self, world: int) -> dict[str, Any]:
        """State of a world that the environment itself holds, by its keys in a snapshot."""
        ...

    def set_columns(self, world: int, columns: Mapping[str, Any]) -> None:
        """Restore the state that the environment itself holds from a snapshot."""
        ...

    def make_episode(self, seed: int, index: int) -> Episode:
        """Make the episode ``index`` of a seed."""
        ...

    def adopt(self, world: int, episode: Episode) -> object:
        """Set the episode of a world."""
        ...

    def follow(self, progress: Progress) -> None:
        """Set the progress of all worlds and look up their active subtasks."""
        ...


def snapshot(env: RestorableWorlds, world: int) -> dict[str, Any]:
    """Copy the full state of a world as a nested dict of arrays, numbers, strings and lists.

    It contains the episode's seed and index, physics, progress, signals, label notes, controller targets, reward state
    and faults. The sleep state of physics is not part of it: a restored world is awake, see `CpuSimulator.get_world`.

    Raises:
        UsageError: the world has not been reset yet.
    """
    episode = env.episodes_now[world]
    if episode is None or env.signals is None:
        raise UsageError(f"world {world} has no state yet: call reset first")
    found = {
        "episode": {"seed": episode.seed, "index": episode.index, "home": episode.home},
        "sim": env.sim.get_world(world),
        "taint": int(env.sim.taint()[world]),
        "progress": dataclasses.asdict(row_of(env.progress, world)),
        "signals": dataclasses.asdict(row_of(env.signals, world)),
        **{key: part.get_state(world) for key, part in env.restorable_parts().items()},
        **env.get_columns(world),
    }
    # Further parts follow behind those of the order.
    return {key: found[key] for key in _ORDER} | found


def restore(env: RestorableWorlds, world: int, state: dict[str, Any]) -> None:
    """Restore a world from a `snapshot` of any world of an environment with the same configuration.

    Raises:
        UsageError: the state belongs to another layout or its episode does not exist here.
    """
    if env.signals is None:
        raise UsageError("reset the environment once before putting a state into it")
    name = state["episode"]
    episode = env.make_episode(name["seed"], name["index"])
    # The same seed and index may mean another episode in another pack.
    if episode.home != name["home"]:
        raise wrong_value(
            "home",
            name["home"],
            repr(episode.home),
            "That episode is in another home here.",
            "state",
        )
    env.sim.set_world(world, episode.home, state["sim"])
    env.adopt(world, episode)
    # After the physics, whose restoring clears it.
    env.sim.add_taint(world, state["taint"])
    env.set_columns(world, state)
    # Snapshots of older versions lack ``ee_contact``; ``touch`` takes its place, as in their labels.
    env.signals = with_row(
        env.signals, world, {"ee_contact": state["signals"]["touch"], **state["signals"]}
    )
    # Likewise ``peak_finger_force``: what came before the snapshot is not known.
    progress = {"peak_finger_force": 0.0, **state["progress"]}
    env.follow(with_row(env.progress, world, progress))
    env.state = env.sim.state()
    # Last: parts such as the perturber begin anew when the episode is adopted.
    for key, part in env.restorable_parts().items():
        part.set_state(world, state[key])
