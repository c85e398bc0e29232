"""What data asks of an environment of W worlds, to record its episodes and to play them again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from mjhab.rollout.policy import RolloutEnv
from mjhab.tasks.progress import Progress
from mjhab.tasks.signals import Signals


class Physics(Protocol):
    """The simulator of the worlds; `sim.mujoco.cpu.CpuSimulator` is one."""

    @property
    def addresses(self) -> Any:
        """Where qpos and qvel hold what: int arrays by name, see `layout.Addresses`."""
        ...

    def model(self, home: str, /) -> Any:
        """The compiled ``mujoco.MjModel`` of a home."""
        ...

    def get_world(self, world: int, /) -> dict[str, np.ndarray]:
        """Copies of "qpos", "qvel", "ctrl" and what else the physics of one world depends on."""
        ...

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray, /) -> None:
        """Put worlds into homes at rest in the states ``qpos`` (n, nq)."""
        ...

    def state(self) -> Any:
        """The state of all worlds, a `sim.protocol.SimState`."""
        ...


class Views(Protocol):
    """What is seen in the worlds; `envs.parts.observing.Observer` is one."""

    @property
    def outputs(self) -> Sequence[str]:
        """What is drawn or derived of pictures."""
        ...

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras that see."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the pictures [px]."""
        ...

    @property
    def segmentation_names(self) -> Sequence[str]:
        """Name of every segmentation id, index = id."""
        ...

    def calibration(self) -> dict[str, dict[str, Any]]:
        """Size, intrinsic matrix and mount of each camera as plain data."""
        ...

    @property
    def renderer(self) -> Any:
        """Draws human views: ``follow_view(state, home, world, width, height)`` (H, W, 3) uint8."""
        ...

    def observe(
        self, state: Any, focus: Any, signals: Any, homes: Sequence[str], /
    ) -> dict[str, np.ndarray]:
        """Observations (W, ...) of all worlds."""
        ...

    def draw(self, state: Any, homes: Sequence[str], /) -> dict[str, np.ndarray]:
        """What cameras see in the worlds of ``state``."""
        ...


class Names(Protocol):
    """Names and order of what all homes share; `layout.layout.Layout` has them."""

    @property
    def object_names(self) -> Sequence[str]:
        """Of the object slots."""
        ...

    @property
    def robot(self) -> Any:
        """The `robots.robot.Robot` that works there."""
        ...

    @property
    def link_ids(self) -> Sequence[str]:
        """Of the drawers and doors."""
        ...


class RecordedEnv(RolloutEnv, Protocol):
    """An environment on the CPU whose episodes can be recorded, replayed and drawn; those of `mjhab.make` are."""

    @property
    def config(self) -> Any:
        """An `EnvConfig`."""
        ...

    @property
    def layout(self) -> Names:
        """Names and order of objects and links."""
        ...

    @property
    def action_table(self) -> Sequence[Any]:
        """One entry with a ``name`` per number of an action."""
        ...

    @property
    def sim(self) -> Physics:
        """The worlds' physics."""
        ...

    @property
    def observer(self) -> Views:
        """What is seen."""
        ...

    @property
    def state(self) -> Any:
        """State of all worlds after the last control step."""
        ...

    @property
    def focus(self) -> Any:
        """What the active subtasks are about."""
        ...

    @property
    def homes(self) -> Sequence[str]:
        """Name of the home of every world."""
        ...

    @property
    def signals(self) -> Signals | None:
        """Of the active subtasks; None before the first reset."""
        ...

    @property
    def judged(self) -> Signals | None:
        """Those that decided the last step."""
        ...

    @property
    def progress(self) -> Progress:
        """Pointers, clocks and forces of all worlds."""
        ...

    @property
    def success(self) -> np.ndarray:
        """(W,) bool: outcome of the last step."""
        ...

    def reset(
        self, *, seed: int | Sequence[int | None], options: dict[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes; ``seed``: one for all worlds or (W,) one each, None where it stays. See `RolloutEnv`."""
        ...

    def get_state(self, world: int, /) -> dict[str, Any]:
        """Everything one world is."""
        ...

    def set_state(self, world: int, state: dict[str, Any], /) -> None:
        """Put one world into a state from `get_state`."""
        ...
