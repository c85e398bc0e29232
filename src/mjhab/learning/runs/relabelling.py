"""Distillation: a student acts, and a teacher that is a policy names the action to imitate in every control step.

A policy can say at any state what it would do, which the scripted expert cannot: it plans, and has to act itself
(`intervention`). So whole episodes of the student are learned from, those that fail included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.core.action_notes import ActionNotes
from mjhab.rollout.policy import Correctable, Policy

RELABELLED = "relabelled"
TEACHER = "teacher"
ACTORS = (RELABELLED, TEACHER)
"""Names of the possible actors. The student's steps are learned from, unlike those of `intervention.STUDENT`."""


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
            self._teacher.replace_action(actions)
        return actions

    def notes(self) -> ActionNotes:
        """The teacher's actions as the intended ones, and who acted."""
        actor = ACTORS.index(TEACHER if self._student is None else RELABELLED)
        worlds = len(self._wanted)
        return ActionNotes(self._wanted.copy(), np.full(worlds, actor, np.uint8), ACTORS)
