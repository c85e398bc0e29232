"""Who acts while a student learns: it starts an episode and the expert finishes it, or it acts and a policy labels.

A policy can say at any state what it would do, which the scripted expert cannot: it plans, and has to act itself. So of
a student that a teaching policy labels, whole episodes are learned from, those that fail included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from mjhab.core.action_notes import EXPERT, NOVICE, TAKE_OVER, ActionNotes
from mjhab.core.seeding import stream
from mjhab.rollout.policy import ACTION_SIZE, Correctable, Policy

ACTORS = (NOVICE, EXPERT)
"""Names of the possible actors; every recorded control step has the index of its actor."""
RELABELLED = "relabelled"
TEACHER = "teacher"
OF_DISTILLATION = (RELABELLED, TEACHER)
"""The same where a teacher labels: its student's steps are learned from, unlike those of `NOVICE`."""


class Replanning(Protocol):
    """An expert that can plan from any state, in a subset of the worlds."""

    @property
    def name(self) -> str:
        """Short name."""
        ...

    def reset(self, mask: np.ndarray) -> None:
        """Plan again from the current states of the worlds in ``mask`` (W,) bool."""
        ...

    def act_in(self, obs: Any, info: Mapping[str, Any], mask: np.ndarray) -> np.ndarray:
        """Actions (W, A); only those of the worlds in ``mask`` (W,) bool are computed."""
        ...

    def notes(self) -> ActionNotes:
        """Notes on the last actions: the intended actions without noise."""
        ...

    def style(self, world: int) -> Mapping[str, Any]:
        """Values of the expert's style options in a world's current episode."""
        ...


class Intervention:
    """A policy in which the student acts for a prefix of every episode and the expert acts after it.

    The length of the prefix is a function of the episode's seed and index.

    Args:
        student: acts first; may be None if ``longest`` is 0.
        expert: acts after the prefix; it is reset in the control step of the take-over, to plan from that state.
        longest: largest prefix [control steps]; lengths are uniform from 0 to this value inclusive.
        width: of an action (A).
    """

    name = TAKE_OVER

    def __init__(
        self,
        student: Policy | None,
        expert: Replanning,
        longest: int,
        width: int = ACTION_SIZE,
    ) -> None:
        if longest and student is None:
            raise ValueError("a prefix needs a student")
        self._student = student
        self._expert = expert
        self._longest = longest
        self._prefix = np.zeros(0, np.int64)
        self._step = np.zeros(0, np.int64)
        self._fresh = np.zeros(0, bool)
        self._intended = np.zeros((0, width), np.float32)
        self._width = width
        self._actor = np.zeros(0, np.uint8)

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the worlds of ``mask`` (W,)."""
        # The number of worlds is first known here.
        if len(self._prefix) != len(mask):
            self._prefix = np.zeros(len(mask), np.int64)
            self._step = np.zeros(len(mask), np.int64)
            self._fresh = np.zeros(len(mask), bool)
        self._step[mask] = 0
        # Lengths are drawn when the episodes are known, which is in the next step.
        self._fresh |= mask
        if self._student is not None:
            self._student.reset(mask)

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32."""
        self._draw(info)
        taken = self._step >= self._prefix
        beginning = self._step == self._prefix
        # The expert plans from where the student has led, and not before.
        if beginning.any():
            self._expert.reset(beginning)
        actions = np.zeros((len(taken), self._width), np.float32)
        if self._student is not None and not taken.all():
            actions[~taken] = self._student.act(obs, info)[~taken]
        self._intended = actions.copy()
        if taken.any():
            # Planning is the slow part, so that only worlds it acts in are asked.
            actions[taken] = self._expert.act_in(obs, info, taken)[taken]
            self._intended[taken] = self._expert.notes().intended[taken]
        self._step += 1
        self._actor = taken.astype(np.uint8)
        return actions

    def notes(self) -> ActionNotes:
        """Actor of the last actions per world, and the intended actions without the expert's noise."""
        return ActionNotes(self._intended.copy(), self._actor.copy(), ACTORS)

    def style(self, world: int) -> Mapping[str, Any]:
        """Values of the expert's style options in a world's current episode."""
        return self._expert.style(world)

    def _draw(self, info: Mapping[str, Any]) -> None:
        for w in np.flatnonzero(self._fresh).tolist():
            episode = info["episode_spec"][w]
            if episode is not None:
                self._prefix[w] = prefix_length(
                    int(episode["seed"]), int(episode["index"]), self._longest
                )
        self._fresh[:] = False


class Relabelling:
    """A policy that executes the student's actions and notes those of the teacher as the intended ones.

    Args:
        student: acts; None lets the teacher act, which makes its demonstrations.
        teacher: names the actions to imitate. It is told what is executed in place of its own actions if it is
            `Correctable`.
    """

    name = "relabel"

    def __init__(self, student: Policy | None, teacher: Policy) -> None:
        self._student = student
        self._teacher = teacher
        self._wanted = np.zeros((0, 0), np.float32)

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the worlds of ``mask`` (W,)."""
        self._teacher.reset(mask)
        if self._student is not None:
            self._student.reset(mask)

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32."""
        self._wanted = self._teacher.act(obs, info)
        if self._student is None:
            return self._wanted.copy()
        actions = self._student.act(obs, info)
        if isinstance(self._teacher, Correctable):
            # Another action than its own was executed: what remains of its chunk is of another state.
            self._teacher.replace_action(actions, replan=True)
        return actions

    def notes(self) -> ActionNotes:
        """The teacher's actions as the intended ones, and who acted."""
        actor = OF_DISTILLATION.index(TEACHER if self._student is None else RELABELLED)
        worlds = len(self._wanted)
        return ActionNotes(
            self._wanted.copy(), np.full(worlds, actor, np.uint8), OF_DISTILLATION
        )


def prefix_length(seed: int, index: int, longest: int) -> int:
    """Control steps for which the student acts in an episode, from 0 to ``longest``."""
    # By the identity of the episode, so that workers and worlds do not matter.
    return int(stream(seed, "take_over", index).integers(0, longest + 1))
