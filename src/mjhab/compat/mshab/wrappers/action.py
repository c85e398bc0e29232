"""Parts of the robot that stand still."""

from __future__ import annotations

from typing import Any

import gymnasium

from mjhab.compat.mshab.wrappers.forwarding import ForwardingWrapper

HEAD = slice(8, 10)
TORSO = slice(10, 11)
BASE = slice(11, 13)
"""Columns of an action."""


class FetchActionWrapper(ForwardingWrapper):
    """Sets actions of the head, the torso or the base to 0, in place, as there.

    Args:
        env: an environment of `worlds.env`.
        stationary_base, stationary_torso, stationary_head: what stands still.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        stationary_base: bool = False,
        stationary_torso: bool = False,
        stationary_head: bool = True,
    ) -> None:
        super().__init__(env)
        chosen = (
            (HEAD, stationary_head),
            (TORSO, stationary_torso),
            (BASE, stationary_base),
        )
        self._still = [columns for columns, stands in chosen if stands]

    def action(self, action: Any) -> Any:
        """The action with the entries of what stands still set to 0."""
        for columns in self._still:
            action[..., columns] = 0
        return action

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step."""
        return self.env.step(self.action(action))
