"""Data of one episode for the viewer: one `Moment` per state, from a running world or from a shard."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.schema import FORCES, STORED_CHECKS
from mjhab.rollout.records import Event, PlanEntry
from mjhab.tasks.scoring import term_names
from mjhab.tasks.subtasks.registry import limits_of
from mjhab.tasks.thresholds import TaskConfig


@dataclass(frozen=True, eq=False)
class Moment:
    """One state of an episode, and the control step that led to it.

    Attributes:
        qpos: (nq,) generalized positions of the world.
        active: index of the active subtask in the plan; the length of the plan once all are done.
        robot_force: contact force on the robot [N].
        cumulative_force: its sum since the active subtask began [N x control steps].
        checks: (len(STORED_CHECKS),) uint8, 0 or 1.
        reward, terms: reward of the step and its terms by name; 0 and empty in the first state.
        actor: name of the policy or person that acted in the step; "" in the first state.
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
    """An episode; a running one is appended to.

    Attributes:
        title: name for people.
        home: name of the home.
        index: number of the episode among those of its seed.
        plan: the subtasks.
        force_limits: limit of the cumulative force of each subtask [N x control steps], infinite for none.
        instruction, instructions: natural-language instruction of the episode and of each subtask; "" and () if the
            recording has none.
        moments: the states; the first is that after the reset.
        events: (control step, name), in order.
        ended: label of how each finished subtask ended, by index in the plan.
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
    """How the episode ended, for people; "" while it runs."""

    @property
    def last(self) -> int:
        """Index of the last state, -1 before the first one."""
        return len(self.moments) - 1

    def events_until(self, step: int) -> list[Event]:
        """Return the events up to and including a control step, in order."""
        return [event for event in self.events if event[0] <= step]

    def limit_at(self, step: int) -> float:
        """Return the limit of the cumulative force [N x control steps] that holds in a state; infinite for none."""
        active = self.moments[step].active
        return self.force_limits[active] if active < len(self.force_limits) else math.inf

    def begin_of(self, step: int) -> int:
        """Return the index of the first state of the subtask that is active in a state."""
        active = self.moments[step].active
        while step > 0 and self.moments[step - 1].active == active:
            step -= 1
        return step

    def terms_at(self, step: int) -> Mapping[str, float]:
        """Return the reward terms of the control step that led to a state, of the subtask active in that step.

        The reward of a chain of subtasks has the terms of all of them; those of inactive ones are 0 and left out.
        """
        terms = self.moments[step].terms
        active = self.moments[max(step - 1, 0)].active
        own = term_names(self.plan[active].kind) if active < len(self.plan) else ()
        return {name: value for name, value in terms.items() if name in own} or terms

    def instruction_of(self, index: int) -> str:
        """Return the instruction of the subtask at an index of the plan; "" if there is none."""
        return self.instructions[index] if index < len(self.instructions) else ""

    def actors(self) -> list[str]:
        """Return the names of the actors, in the order of their first action."""
        return list(dict.fromkeys(moment.actor for moment in self.moments[1:]))

    def describe(self, index: int) -> str:
        """Return a name of the subtask at an index of the plan: kind and target."""
        entry = self.plan[index]
        return f"{entry.kind} {entry.target}".strip()


def force_limits(plan: Sequence[PlanEntry], config: TaskConfig) -> tuple[float, ...]:
    """Look up the limit of the cumulative force of every subtask of a plan [N x control steps]."""
    return tuple(float(limits_of(config, entry.kind).force_limit) for entry in plan)


def recorded_track(episode: RecordedEpisode, config: TaskConfig) -> Track:
    """Read the track of a recorded episode.

    Args:
        episode: of a shard, recorded with states.
        config: thresholds that it was recorded with.

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
            # Rewards belong to actions, and the first state has none before it.
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
        "success"
        if record.success_once
        else str(episode.attributes["ending"]).replace("_", " "),
    )


def _checks(rows: np.ndarray) -> np.ndarray:
    """Checks (N + 1, len(STORED_CHECKS)) uint8 of N control steps; columns that the shard lacks are filled with 0."""
    missing = len(STORED_CHECKS) - rows.shape[1]
    return np.pad(rows, ((0, 0), (0, missing)))
