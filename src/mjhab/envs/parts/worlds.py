"""What the parts of an environment, and scripted experts, read of its worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.envs.parts.plan_tables import Focus, PlanTables
from mjhab.envs.parts.sensing import Sensing
from mjhab.episodes.generator import Episode
from mjhab.episodes.starts import StartMaker
from mjhab.layout.layout import Layout
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState
from mjhab.tasks.progress import Progress
from mjhab.tasks.signals import Signals
from mjhab.tasks.thresholds import TaskConfig


class Worlds(Protocol):
    """W worlds of an environment on the CPU, read-only. `sequential.SequentialTaskEnv` is one."""

    @property
    def config(self) -> EnvConfig:
        """What was asked for."""
        ...

    @property
    def task_config(self) -> TaskConfig:
        """Thresholds of success."""
        ...

    @property
    def num_envs(self) -> int:
        """W."""
        ...

    @property
    def layout(self) -> Layout:
        """Names and order of objects, links and homes."""
        ...

    @property
    def sim(self) -> CpuSimulator:
        """The worlds' physics."""
        ...

    @property
    def state(self) -> SimState:
        """State of all worlds after the last control step."""
        ...

    @property
    def sensing(self) -> Sensing:
        """What the simulator's arrays mean."""
        ...

    @property
    def tables(self) -> PlanTables:
        """The plans of all worlds."""
        ...

    @property
    def focus(self) -> Focus:
        """The active subtasks."""
        ...

    @property
    def signals(self) -> Signals | None:
        """Signals of the active subtasks; None before the first reset."""
        ...

    @property
    def progress(self) -> Progress:
        """Pointers, steps left, cumulative forces."""
        ...

    @property
    def starts(self) -> StartMaker:
        """Where robots begin."""
        ...

    @property
    def episodes_now(self) -> Sequence[Episode | None]:
        """The episode of every world; None before its first reset."""
        ...

    @property
    def homes(self) -> Sequence[str]:
        """Name of the home of every world."""
        ...

    @property
    def boxes(self) -> Sequence[dict[str, Any]]:
        """Floor areas in front of the links of every world's home, by link."""
        ...

    @property
    def fallback(self) -> np.ndarray:
        """(W,) bool: spawned where nothing better was found."""
        ...

    @property
    def success(self) -> np.ndarray:
        """(W,) bool: outcome of the last step, like ``fail``."""
        ...

    @property
    def fail(self) -> np.ndarray:
        """(W,) bool."""
        ...

    @property
    def nan_resets(self) -> np.ndarray:
        """(W,) int64: how often the state became NaN."""
        ...

    @property
    def reward_terms(self) -> dict[str, np.ndarray]:
        """(W,) terms of the last reward, by name."""
        ...

    def episode_of(self, world: int) -> Episode:
        """The episode of a world that has been reset."""
        ...
