"""Who acted, and what was intended: what a policy tells about its actions beside the actions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ActionNotes:
    """What a policy tells about the actions of W worlds beside the actions themselves.

    intended: (W, 13) float32, the actions that it holds for right; they differ from those it gives where it adds noise,
        and where one policy acts while another one says what it would have done.
    actor: (W,) uint8, who acts in each world, as a place in ``actors``.
    actors: names of all who can act, the same in every step; for example ("student", "expert").

    Raises:
        ValueError: shapes do not fit each other, or a number in ``actor`` has no name.
    """

    intended: np.ndarray
    actor: np.ndarray
    actors: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.actor.shape != self.intended.shape[:1] or self.actor.dtype != np.uint8:
            raise ValueError(
                f"actor must be ({len(self.intended)},) uint8, one number per world; "
                f"got {self.actor.shape} {self.actor.dtype}"
            )
        if self.actor.size and int(self.actor.max()) >= len(self.actors):
            raise ValueError(f"actor {int(self.actor.max())} has no name among {self.actors}")

    @classmethod
    def plain(cls, actions: np.ndarray, name: str) -> ActionNotes:
        """Notes of a policy that means what it does: ``actions`` (W, 13), all by ``name``."""
        return cls(actions, np.zeros(len(actions), np.uint8), (name,))
