"""Notes of a policy about its actions: which policy acted, what it was doing, and the action without noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

HUMAN = "human"
"""Name of a person as an actor, and of the policy of episodes in which a person acted."""
EXPERT = "expert"
NOVICE = "student"
"""Name of a learned policy as an actor whose steps an expert, or a person, corrects."""
TAKE_OVER = "take_over"
"""Name of the policy of episodes that a student begins and the expert finishes."""


class Doing(NamedTuple):
    """What a policy is doing in a control step, in its own words.

    skill: one word, such as "lift"; "" if it does not tell. phases: names, outermost first.
    """

    skill: str = ""
    phases: tuple[str, ...] = ()


NOTHING = Doing()


@dataclass(frozen=True, eq=False)
class ActionNotes:
    """Notes about the actions of W worlds in one control step.

    intended: (W, A) float32, the actions to learn from. They equal the executed actions, except where a policy adds
        noise (intended: without noise) and where an expert corrects a student that acts (intended: the expert's).
    actor: (W,) uint8, index into ``actors`` of the policy whose action is executed in each world.
    actors: names of all policies that can act, the same in every step; for example ("student", "expert").
    doing: what the policy is doing in each world; empty if it does not tell.

    Raises:
        ValueError: the shapes differ in W, or an index in ``actor`` is outside of ``actors``.
    """

    intended: np.ndarray
    actor: np.ndarray
    actors: tuple[str, ...]
    doing: Sequence[Doing] = ()

    def __post_init__(self) -> None:
        # The type of the recorded column; a wider one would change the files.
        if self.actor.shape != self.intended.shape[:1] or self.actor.dtype != np.uint8:
            raise ValueError(
                f"actor must be ({len(self.intended)},) uint8, one number per world; "
                f"got {self.actor.shape} {self.actor.dtype}"
            )
        if self.actor.size and int(self.actor.max()) >= len(self.actors):
            raise ValueError(
                f"actor {int(self.actor.max())} has no name among {self.actors}"
            )

    @classmethod
    def plain(cls, actions: np.ndarray, name: str) -> ActionNotes:
        """Notes of one policy without noise: the executed ``actions`` (W, A) are the intended ones."""
        return cls(actions, np.zeros(len(actions), np.uint8), (name,))
