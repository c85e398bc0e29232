"""The expert as a policy: one script per world, restarted whenever another subtask becomes active."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, cast

import numpy as np

from mjhab.core.action_notes import NOTHING, ActionNotes
from mjhab.core.errors import UsageError, fault
from mjhab.core.registration.plugins import raised_text, resolved
from mjhab.core.seeding import stream
from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.parts.worlds import PolicyWorlds
from mjhab.experts.arm import motion
from mjhab.experts.gaze import Gaze
from mjhab.experts.phases import doing, phases_in, phases_of
from mjhab.experts.style import ActionNoise, StyledView
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import Subtask
from mjhab.tasks.style import TARGET, Styles, recorded
from mjhab.tasks.subtasks.registry import SUBTASKS, spec_of

Script = Generator[np.ndarray, None, Any]


def _wait(view: WorldView) -> Script:
    """Script of a subtask that the environment does by a teleport: the robot stands still, holding what it has to."""
    subtask = view.subtask
    holding = subtask is not None and subtask.must_hold
    while True:
        yield motion.action(view, None, gripper=motion.CLOSED if holding else motion.OPEN)


def script_of(subtask: str) -> Callable[[WorldView], Script]:
    """Find the generator function that does a subtask, from the ``expert`` of its `SubtaskSpec`.

    Args:
        subtask: name of a registered subtask.

    Raises:
        UsageError: there is no such subtask, its spec names no expert, or what the spec names cannot be imported or
            called.
    """
    expert = SUBTASKS[subtask].expert
    if expert is None:
        raise fault(
            f"subtask {subtask!r}",
            "no expert can do it: its SubtaskSpec names none. Take another policy.",
        )
    where = f"{SUBTASKS.described(subtask)}: expert"
    try:
        script = resolved(expert)
    except UsageError as error:
        raise fault(where, str(error)) from error
    if not callable(script):
        raise fault(
            where,
            "must be a generator function from a WorldView to actions, or a reference 'module:NAME' to one; "
            f"got {type(script).__name__}.",
        )
    return cast("Callable[[WorldView], Script]", script)


@contextmanager
def _blamed(subtask: str) -> Iterator[None]:
    """Turn exceptions of a plugin's script into a message that names the subtask; those of mjhab's get a note.

    Raises:
        UsageError: the script of a subtask that a plugin registered raised an exception.
    """
    try:
        yield
    except Exception as error:
        phases = " > ".join(phases_in(error))
        where = f" in the phase {phases}" if phases else ""
        if SUBTASKS.is_builtin(subtask):
            error.add_note(f"The expert of {subtask!r} raised this{where}.")
            raise
        raise fault(
            f"expert of {SUBTASKS.described(subtask)}",
            f"raised {raised_text(error)}{where}.",
        ) from error


def _kinds_in(env: PolicyWorlds) -> tuple[str, ...]:
    """Names of the subtasks that an environment asks its expert for; without those that it does by teleports."""
    config = env.config
    kinds = (config.subtask,) if config.subtask else TASKS[config.task].subtasks
    return tuple(
        name for name in kinds if not (config.teleports and SUBTASKS[name].navigates)
    )


class ExpertPolicy:
    """Policy that runs one script per world, with privileged state, in the default control mode.

    Letters: W worlds, A action.

    Args:
        env: batch of worlds; its actions, control mode and subtasks decide which scripts are needed.
        styles: distribution from which every episode draws its style; the plain style if not given.

    Raises:
        UsageError: a subtask of the environment has no usable expert, see `script_of`.
    """

    name = "expert"

    def __init__(self, env: PolicyWorlds, styles: Styles | None = None) -> None:
        self._styles = styles or Styles()
        self._teleports = env.config.teleports
        # A missing expert is reported now, not in the middle of an episode.
        for name in _kinds_in(env):
            script_of(name)
        self._views = [StyledView(env, w) for w in range(env.num_envs)]
        self._action_noises: list[ActionNoise | None] = [None] * env.num_envs
        self._scripts: list[Script | None] = [None] * env.num_envs
        # What a script was made for: when the token changes, another subtask is active and the script is stale.
        self._tokens: list[tuple[int, int, int] | None] = [None] * env.num_envs
        self._columns = env.layout.robot.action
        self._gaze = Gaze(env.layout.robot, env.config.stationary)
        self._last = np.zeros((env.num_envs, self._columns.dim), np.float32)
        # Three copies, because slowing and noise change an action twice, and each stage repeats its own last one.
        self._wished = self._last.copy()
        self._intended = self._last.copy()

    def reset(self, mask: np.ndarray) -> None:
        """Forget the scripts and the actions of the worlds in ``mask`` (W,)."""
        for w in np.flatnonzero(mask):
            self._scripts[w] = self._tokens[w] = self._action_noises[w] = None
        for actions in (self._last, self._wished, self._intended):
            actions[mask] = 0.0

    def style(self, world: int) -> dict[str, Any]:
        """Style of a world's running episode as plain data; empty when the policy was made without styles."""
        if self._styles.plain:
            return {}
        seed, index, _ = self._views[world].token
        return recorded(self._styles.draw(seed, index))

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32 for the present state of all worlds; observations and infos are not read."""
        return self.act_in(obs, info, np.ones(len(self._views), bool))

    def act_in(self, obs: Any, info: Mapping[str, Any], mask: np.ndarray) -> np.ndarray:
        """Actions (W, A) float32; outside ``mask`` (W,) bool scripts pause and worlds keep their last action."""
        # Plain integers: numpy's would be slower as indices of lists.
        for w in np.flatnonzero(mask).tolist():
            self._intended[w], self._last[w] = self._next(w, self._views[w])
        # A copy, because the next call writes into the same array.
        return self._last.copy()

    def notes(self) -> ActionNotes:
        """Intended actions (W, A) of the last ``act``, without the noise of the style, and what scripts are doing."""
        plain = ActionNotes.plain(self._intended.copy(), self.name)
        now = [NOTHING if script is None else doing(script) for script in self._scripts]
        return replace(plain, doing=now)

    def script(self, world: int) -> Script | None:
        """Script that runs in a world; None before the first ``act`` of its episode."""
        return self._scripts[world]

    def phases(self, world: int) -> tuple[str, ...]:
        """Names of what a world's script is doing, outermost first: ("pick", "drive", ...); empty before it begins."""
        script = self._scripts[world]
        return () if script is None else phases_of(script)

    def _next(self, w: int, view: StyledView) -> tuple[np.ndarray, np.ndarray]:
        """Intended action (A,) and executed action (A,) of world ``w`` in this control step."""
        subtask = view.subtask
        if subtask is None or view.done:
            still = np.zeros(self._columns.dim, np.float32)
            return still, still
        action_noise = self._action_noise(w, view)
        token = view.token
        if action_noise.holds:
            gripper = (
                motion.CLOSED
                if subtask.must_hold or spec_of(subtask.kind).starts_holding
                else motion.OPEN
            )
            still = motion.action(view, motion.rest_goal(view), gripper=gripper)
            return still, action_noise.wait(still)
        begins = self._tokens[w] != token
        if begins:
            self._tokens[w] = token
            self._scripts[w] = self._start(subtask, view)
        if action_noise.due() or begins:
            with _blamed(subtask.name):
                self._wished[w] = self._from_script(w, view)
        intended = action_noise.slow(self._wished[w])
        if view.style.look == TARGET and not self._is_moved(subtask):
            intended = self._gaze.turn(view, intended)
        return intended, action_noise.disturb(intended)

    def _is_moved(self, subtask: Subtask) -> bool:
        """Whether the environment does a subtask by a teleport instead of the robot's actions."""
        return self._teleports and spec_of(subtask.kind).navigates

    def _start(self, subtask: Subtask, view: WorldView) -> Script:
        if self._is_moved(subtask):
            return _wait(view)
        script = script_of(subtask.name)
        with _blamed(subtask.name):
            begun = script(view)
        if not isinstance(begun, Iterator):
            raise fault(
                f"expert of {SUBTASKS.described(subtask.name)}",
                "must be a generator function, which yields actions; "
                f"it returned {type(begun).__name__}.",
            )
        return begun

    def _action_noise(self, w: int, view: StyledView) -> ActionNoise:
        """`ActionNoise` of the running episode of world ``w``; the first call in an episode draws its style."""
        action_noise = self._action_noises[w]
        if action_noise is None:
            seed, index, _ = view.token
            view.style = self._styles.draw(seed, index)
            self._action_noises[w] = action_noise = ActionNoise(
                view.style,
                self._columns,
                stream(seed, "style", "actions", index),
                begun=view.steps > 0,
            )
        return action_noise

    def _from_script(self, w: int, view: StyledView) -> np.ndarray:
        script = self._scripts[w]
        assert script is not None
        try:
            return next(script)
        except StopIteration:
            # After the end of its script the robot stays at rest with the gripper command unchanged.
            rest = motion.stay_at_rest(
                view, gripper=float(self._last[w, self._columns.gripper])
            )
            self._scripts[w] = rest
            return next(rest)
