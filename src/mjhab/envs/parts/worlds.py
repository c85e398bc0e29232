"""What policies, scripted and learned ones, read of an environment besides its observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from mjhab.config.env import EnvConfig
from mjhab.core.arrays import Array
from mjhab.core.conventions.names import Conventions
from mjhab.envs.parts.observing import ObservedRows
from mjhab.envs.parts.plan_tables import PlanTables
from mjhab.envs.parts.sensing import Sensing
from mjhab.episodes.episode import Episode
from mjhab.layout.layout import Layout
from mjhab.sim.protocol import SimState
from mjhab.tasks.progress import Progress
from mjhab.tasks.signals import Signals
from mjhab.tasks.thresholds import TaskConfig


class PolicyWorlds(Protocol):
    """W worlds of an environment, read-only; those of `mjhab.make` have all of it, those on a device in tensors.

    Learned policies take no more than conventions, state, links and the tables of observations and actions.
    """

    @property
    def config(self) -> EnvConfig:
        """Options of the environment."""
        ...

    @property
    def task_config(self) -> TaskConfig:
        """Thresholds of success."""
        ...

    @property
    def num_envs(self) -> int:
        """Number of worlds W."""
        ...

    @property
    def layout(self) -> Layout:
        """Names and order of objects, links and homes."""
        ...

    @property
    def state(self) -> SimState:
        """State of all worlds after the last control step."""
        ...

    def state_as(self, conventions: Conventions, /) -> Array:
        """(W, D) float32, the observed state in other conventions, see `TaskLoop.state_as`."""
        ...

    def link_state(self) -> Array:
        """(W, 5) float32, see `Sensing.link_state`."""
        ...

    @property
    def observer(self) -> ObservedRows:
        """Table of the observations; entries with ``key`` and ``shape``, those of the state first."""
        ...

    @property
    def single_observation_space(self) -> Any:
        """A Dict space with a Box "state"."""
        ...

    @property
    def action_table(self) -> Sequence[Any]:
        """One entry with a ``name`` per dimension of an action."""
        ...

    @property
    def sensing(self) -> Sensing:
        """Positions of joints, bodies and objects in the simulator's arrays."""
        ...

    @property
    def tables(self) -> PlanTables:
        """The plans of all worlds."""
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
