"""The policy of the viewer: a chosen policy, which teleoperation can replace in one world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.core.action_notes import HUMAN, ActionNotes
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.resolve import PolicyOptions, resolve_policy
from mjhab.rollout.policy import Annotated, Fallible, Policy
from mjhab.viewer.sources.hand import HandControl


class PolicySwitch:
    """A `Policy` that delegates to others, which can be changed between two control steps.

    A policy that gets control of a world is reset in that world, so that it starts from the present state. `notes` name
    who acted in each world.

    Args:
        env: the environment of W worlds; policies are built for it when they are first chosen.
        seed: seed of the policies.

    Attributes:
        hand: the teleoperation that took over last; None before.
        hand_world: index of the world that is teleoperated; None if none is.
    """

    name = "viewer"

    def __init__(self, env: SequentialTaskEnv, seed: int) -> None:
        self.hand: HandControl | None = None
        self.hand_world: int | None = None
        self._env = env
        self._seed = seed
        self._built: dict[str, Policy] = {}
        self._chosen = ""
        self._actors: list[str] = []
        self._last: ActionNotes | None = None
        self._due = np.ones(env.num_envs, bool)

    @property
    def chosen(self) -> str:
        """Specification of the policy that acts in all worlds that are not teleoperated."""
        return self._chosen

    def policy(self, spec: str) -> Policy:
        """Return the policy of a specification, built on first use.

        Raises:
            UsageError: there is no such policy, or it cannot act in this environment.
        """
        if spec not in self._built:
            self._built[spec] = resolve_policy(spec, self._env, PolicyOptions(self._seed))
        return self._built[spec]

    def choose(self, spec: str) -> None:
        """Let another policy act from the next step on.

        Raises:
            UsageError: see `policy`.
        """
        self.policy(spec)
        self._chosen = spec
        # A policy that did not act has an old history.
        self._due[:] = True

    def take_over(self, hand: HandControl, world: int) -> None:
        """Let teleoperation act in a world from the next step on.

        Raises:
            UsageError: the environment has another control mode than teleoperation needs.
        """
        hand.begin(self._env, world)
        self.hand = hand
        self.hand_world = world

    def give_back(self) -> None:
        """Let the chosen policy act everywhere again."""
        if self.hand_world is not None:
            # The state is none that the policy has brought about.
            self._due[self.hand_world] = True
        self.hand_world = None

    def reset(self, mask: np.ndarray) -> None:
        """Note that new episodes began in the worlds of ``mask`` (W,) bool."""
        self._due |= mask
        if (
            self.hand is not None
            and self.hand_world is not None
            and mask[self.hand_world]
        ):
            self.hand.begin(self._env, self.hand_world)

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Compute the actions (W, A) float32 for the present state."""
        policy = self.policy(self._chosen)
        if self._due.any():
            policy.reset(self._due)
            self._due = np.zeros_like(self._due)
        # A copy: the hand's action is written into it.
        actions = np.array(policy.act(obs, info), np.float32)
        notes = policy.notes() if isinstance(policy, Annotated) else None
        if notes is None:
            notes = ActionNotes.plain(actions, policy.name)
        intended = notes.intended.copy()
        places = np.array([self._place(name) for name in notes.actors], np.uint8)
        actor = places[notes.actor]
        if self.hand is not None and self.hand_world is not None:
            world = self.hand_world
            actions[world] = self.hand.action(self._env, world)
            intended[world] = actions[world]
            actor[world] = self._place(HUMAN)
        self._last = ActionNotes(intended, actor, tuple(self._actors))
        return actions

    def fault(self, world: int) -> str:
        """Return why the episode in a world cannot go on, "" if it can; a teleoperated one always can."""
        policy = self.policy(self._chosen)
        if world == self.hand_world or not isinstance(policy, Fallible):
            return ""
        return policy.fault(world)

    def notes(self) -> ActionNotes:
        """Return who acted in each world in the last `act`, and which action was intended."""
        assert self._last is not None
        return self._last

    def _place(self, name: str) -> int:
        if name not in self._actors:
            self._actors.append(name)
        return self._actors.index(name)
