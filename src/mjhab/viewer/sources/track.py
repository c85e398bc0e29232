"""What a viewer knows of one episode: a row per state, from a running world or from a shard."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mjhab.data.store.reading import Episode
from mjhab.data.store.schema import CHECKS, FORCES
from mjhab.rollout.records import Event, PlanEntry
from mjhab.tasks.subtasks.registry import limits_of
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True, eq=False)
class Moment:
    """One state of an episode, and the control step that led to it.

    qpos: (nq,) generalized positions. active: index of the active subtask; the length of the plan once all are done.
    robot_force [N] and cumulative_force [N x control steps] of the active subtask. checks: (len(CHECKS),) uint8.
    reward, terms: of the step; 0 and empty in the first state. actor: name of who acted.
    """

    qpos: np.ndarray
    active: int
    robot_force: float
    cumulative_force: float
    checks: np.ndarray
    reward: float = 0.0
    terms: Mapping[str, float] = field(default_factory=dict)
    actor: str = ""


@dataclass(eq=False)
class Track:
    """An episode, growing while it runs.

    title: names it for people. index: its number among the episodes of its seed. plan: its subtasks; force_limits: of
    each [N x control steps], infinite without one. instruction: what the episode asks for, instructions: the same for
    each subtask; empty in recordings of older versions.
    moments: state 0 is that after the reset. events: (control step, name). ended: how each finished subtask ended.
    """

    title: str
    home: str
    index: int
    plan: tuple[PlanEntry, ...]
    force_limits: tuple[float, ...]
    instruction: str = ""
    instructions: tuple[str, ...] = ()
    moments: list[Moment] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    ended: dict[int, str] = field(default_factory=dict)
    over: str = ""
    """How the episode ended, in words; empty while it runs."""

    @property
    def last(self) -> int:
        """Index of the last state, -1 before the first one."""
        return len(self.moments) - 1

    def events_until(self, step: int) -> list[Event]:
        """Events up to a control step, the first one first."""
        return [event for event in self.events if event[0] <= step]

    def limit_at(self, step: int) -> float:
        """Limit of the cumulative force [N x control steps] in force in a state."""
        active = self.moments[step].active
        return self.force_limits[active] if active < len(self.force_limits) else math.inf

    def begin_of(self, step: int) -> int:
        """Index of the first state in which the subtask was active that is active in a state."""
        active = self.moments[step].active
        while step > 0 and self.moments[step - 1].active == active:
            step -= 1
        return step

    def actors(self) -> list[str]:
        """Names of those who acted, in the order of their first action."""
        return list(dict.fromkeys(moment.actor for moment in self.moments[1:]))

    def describe(self, index: int) -> str:
        """Name of a subtask of the plan."""
        entry = self.plan[index]
        return f"{entry.kind} {entry.target}".strip()


def force_limits(plan: Sequence[PlanEntry], config: TaskConfig) -> tuple[float, ...]:
    """Limit of the cumulative force of every subtask of a plan [N x control steps]."""
    return tuple(float(limits_of(config, entry.kind).force_limit) for entry in plan)


def recorded_track(episode: Episode, config: TaskConfig) -> Track:
    """The track of a recorded episode.

    Args:
        episode: of a shard; its states must have been recorded.
        config: thresholds in force when it was recorded.

    Raises:
        UsageError: it was recorded, or imported, without states.
        DamagedError: it cannot be read.
    """
    record = episode.record
    qpos = episode.array("states/qpos")
    checks = _checks(episode.array("signals/checks"))
    robot_force, _, cumulative = (
        episode.array("signals/forces")[:, column] for column in range(len(FORCES))
    )
    active = episode.array("subtasks/active")
    actors = episode.actors
    actor = episode.array("actor")
    reward = episode.array("reward/total")
    terms = episode.table("reward/terms") if "reward/terms" in episode.paths else {}
    moments = [
        Moment(
            qpos[t],
            int(active[t]),
            float(robot_force[t]),
            float(cumulative[t]),
            checks[t],
            float(reward[t - 1]) if t else 0.0,
            {name: float(values[t - 1]) for name, values in terms.items()} if t else {},
            actors[int(actor[t - 1])] if t else "",
        )
        for t in range(len(qpos))
    ]
    ended = {entry.index: entry.label or "" for entry in record.subtasks}
    what = record.subtask or record.task
    title = f"{what}, episode {record.index} of seed {record.seed}, {episode.run.policy}"
    return Track(
        title,
        record.home,
        record.index,
        record.plan,
        force_limits(record.plan, config),
        record.instruction,
        record.instructions,
        moments,
        list(record.events),
        ended,
        "success" if record.success_once else str(episode.attributes["ending"]).replace("_", " "),
    )


def _checks(rows: np.ndarray) -> np.ndarray:
    """(N+1, len(CHECKS)) uint8; shards of older versions lack the last column."""
    missing = len(CHECKS) - rows.shape[1]
    return np.pad(rows, ((0, 0), (0, missing)))
