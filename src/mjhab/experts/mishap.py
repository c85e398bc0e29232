"""Mishaps on purpose: demonstrations of how to go on after one.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.experts.arm import motion
from mjhab.robots.parts import ActionColumns

AFTER_STEPS = (8, 30)
"""Least and largest number of control steps with a closing hand before a mishap. After 8 an object is being lifted."""
CLOSED_AFTER_STEPS = (20, 60)
"""The same where the hand is closed from the start: it holds an object, or pushes a door with its back."""
OPEN_STEPS = 60
"""Control steps after which the hand counts as one that will not close: the arm alone is pushed."""
LASTING_STEPS = 8
"""Duration [control steps]; the hand opens fully in five."""
PUSH = 0.2
"""Largest action of each joint of the arm (of -1..1) while it lasts."""


class Mishap:
    """The one mishap of an episode: the hand opens and the arm is pushed aside, whatever is intended.

    Args:
        columns: of the robot's actions.
        random: source of its time and direction.
    """

    def __init__(self, columns: ActionColumns, random: np.random.Generator) -> None:
        self._columns = columns
        self._after, self._closed_after = (
            int(random.integers(least, most + 1))
            for least, most in (AFTER_STEPS, CLOSED_AFTER_STEPS)
        )
        arm = np.zeros(columns.dim)[columns.arm]
        self._push = random.uniform(-PUSH, PUSH, arm.shape)
        self._steps = self._closed = 0
        self._left = LASTING_STEPS

    def befall(self, intended: np.ndarray, executed: np.ndarray) -> np.ndarray:
        """Executed action (A,) of this control step, from the one without the mishap."""
        self._steps += 1
        self._closed += bool(intended[self._columns.gripper] < 0.0)
        # Closed from the very first step: the hand holds something, or is to push.
        if self._closed == self._steps == 1:
            self._after = self._closed_after
        late = self._closed == 0 and self._steps >= OPEN_STEPS + self._after
        if not self._left or not (late or self._closed >= self._after):
            return executed
        self._left -= 1
        # The intended action stays what is learned from.
        changed = executed.copy()
        changed[self._columns.arm] = self._push
        changed[self._columns.gripper] = motion.OPEN
        return changed
