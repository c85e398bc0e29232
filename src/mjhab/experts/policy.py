"""The expert as a policy: one script per world, restarted whenever another subtask becomes active."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.envs.actions import ACTION_DIM
from mjhab.envs.privileged import WorldView
from mjhab.experts import motion
from mjhab.experts.articulated import close_link, open_link
from mjhab.experts.navigate import navigate
from mjhab.experts.pick import pick
from mjhab.experts.place import place
from mjhab.tasks.plan import SubtaskKind

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

Script = Generator[np.ndarray, None, Any]


def _wait(view: WorldView) -> Script:
    """The environment teleports; the robot waits and keeps its grip."""
    subtask = view.subtask
    holding = subtask is not None and subtask.must_hold
    while True:
        yield motion.action(view, None, gripper=motion.CLOSED if holding else motion.OPEN)


SCRIPTS: dict[SubtaskKind, Callable[[WorldView], Script]] = {
    SubtaskKind.PICK: pick,
    SubtaskKind.PLACE: place,
    SubtaskKind.NAVIGATE: navigate,
    SubtaskKind.OPEN: open_link,
    SubtaskKind.CLOSE: close_link,
}


class ExpertPolicy:
    """Scripted whole-body experts for every subtask, with privileged state, acting through the 13-D action."""

    name = "expert"

    def __init__(self, env: SequentialTaskEnv) -> None:
        self._start = {**SCRIPTS, SubtaskKind.NAVIGATE: _wait} if env.config.teleports else SCRIPTS
        self._views = [env.view(w) for w in range(env.num_envs)]
        self._scripts: list[Script | None] = [None] * env.num_envs
        self._tokens: list[tuple[int, int, int] | None] = [None] * env.num_envs
        self._last = np.zeros((env.num_envs, ACTION_DIM), np.float32)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the scripts of the worlds in ``mask`` (W,)."""
        for w in np.flatnonzero(mask):
            self._scripts[w] = self._tokens[w] = None

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, 13) for the present state of the environment."""
        for w, view in enumerate(self._views):
            self._last[w] = self._next(w, view)
        return self._last.copy()

    def _next(self, w: int, view: WorldView) -> np.ndarray:
        subtask = view.subtask
        if subtask is None or view.done:
            return np.zeros(ACTION_DIM, np.float32)
        if self._tokens[w] != view.token:
            self._tokens[w], self._scripts[w] = view.token, self._start[subtask.kind](view)
        script = self._scripts[w]
        assert script is not None
        try:
            return next(script)
        except StopIteration:
            # A script that ends has nothing better to do than to stay at rest with its grip unchanged.
            rest = motion.stay_at_rest(view, gripper=float(self._last[w, 7]))
            self._scripts[w] = rest
            return next(rest)
