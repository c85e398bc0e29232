"""Protocols of an environment of W worlds for recording, replaying and rendering its episodes."""

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
        """Columns of qpos and qvel by name, int arrays, see `layout.Addresses`."""
        ...

    def model(self, home: str, /) -> Any:
        """The compiled ``mujoco.MjModel`` of a home."""
        ...

    def get_world(self, world: int, /) -> dict[str, np.ndarray]:
        """Copies of "qpos", "qvel", "ctrl" and all other physics state of one world."""
        ...

    def reset(
        self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray, /
    ) -> None:
        """Set worlds ``ids`` to homes, at rest, with positions ``qpos`` (n, nq)."""
        ...

    def state(self) -> Any:
        """The state of all worlds, a `sim.protocol.SimState`."""
        ...


class Views(Protocol):
    """Observations and images of the worlds; `envs.parts.observing.Observer` is one."""

    @property
    def outputs(self) -> Sequence[str]:
        """Image outputs, such as "rgb" and "depth"."""
        ...

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the images [px]."""
        ...

    @property
    def shading(self) -> Any:
        """Options of the path tracer, a dataclass; None for the rasterizer."""
        ...

    @property
    def segmentation_names(self) -> Sequence[str]:
        """Name of every segmentation id; the index is the id."""
        ...

    @property
    def perturber(self) -> Any:
        """What perturbs images, `envs.parts.perturbing.Perturber`; None for nothing."""
        ...

    def calibration(self) -> dict[str, dict[str, Any]]:
        """Size, intrinsic matrix and mount of each camera as JSON data."""
        ...

    @property
    def renderer(self) -> Any:
        """Renderer with ``follow_view(state, home, world, width, height)``, (H, W, 3) uint8."""
        ...

    def observe(
        self, state: Any, focus: Any, signals: Any, homes: Sequence[str], /
    ) -> dict[str, np.ndarray]:
        """Observations (W, ...) of all worlds."""
        ...

    def draw(
        self, state: Any, homes: Sequence[str], target: np.ndarray | None, /
    ) -> dict[str, np.ndarray]:
        """Camera images of all worlds in ``state``, by observation key; ``target``: see `targets.targets_in_base`."""
        ...


class Names(Protocol):
    """Names of the objects and links that all homes share; `layout.layout.Layout` is one."""

    @property
    def object_names(self) -> Sequence[str]:
        """Names of the object slots."""
        ...

    @property
    def objects(self) -> Sequence[Any]:
        """The `scenes.spec.ObjectType` of every object slot."""
        ...

    @property
    def robot(self) -> Any:
        """The `robots.robot.Robot` in the homes."""
        ...

    @property
    def link_ids(self) -> Sequence[str]:
        """Names of the drawers and doors."""
        ...

    @property
    def stage(self) -> str:
        """Where the walls of the homes come from (`scenes.spec.STAGES`); "" for homes without stages."""
        ...


class RecordedEnv(RolloutEnv, Protocol):
    """A CPU environment whose episodes can be recorded, replayed and rendered, such as those of `mjhab.make`."""

    @property
    def config(self) -> Any:
        """An `EnvConfig`."""
        ...

    @property
    def layout(self) -> Names:
        """Names and order of objects and links."""
        ...

    @property
    def controller(self) -> Any:
        """Turns actions into commands; ``still(state)`` are actions (W, A) that hold the robots' poses."""
        ...

    @property
    def action_table(self) -> Sequence[Any]:
        """One entry with a ``name`` per dimension of an action."""
        ...

    @property
    def sim(self) -> Physics:
        """The simulator of the worlds."""
        ...

    @property
    def observer(self) -> Views:
        """Observations and images of the worlds."""
        ...

    @property
    def state(self) -> Any:
        """State of all worlds after the last control step."""
        ...

    @property
    def focus(self) -> Any:
        """Targets of the active subtasks."""
        ...

    @property
    def homes(self) -> Sequence[str]:
        """Name of the home of every world."""
        ...

    @property
    def signals(self) -> Signals | None:
        """Signals of the active subtasks; None before the first reset."""
        ...

    @property
    def outcome_signals(self) -> Signals | None:
        """Signals that determined the outcome of the last step."""
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
        """Start episodes. ``seed`` is one for all worlds, or one per world with None to keep it. See `RolloutEnv`."""
        ...

    def wordings(self, world: int, /) -> Sequence[Sequence[str]]:
        """Sentences that ask for each subtask of a world's plan; none where the environment has no words."""
        ...

    def get_state(self, world: int, /) -> dict[str, Any]:
        """Complete state of one world."""
        ...

    def set_state(self, world: int, state: dict[str, Any], /) -> None:
        """Set one world to a state from `get_state`."""
        ...
