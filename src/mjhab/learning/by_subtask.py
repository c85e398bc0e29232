"""A separate policy for each subtask: ``--policy POLICIES.json`` or a folder. See `evaluation.resolve.OpenedPolicy`.

`evaluation.resolve.full_spec` adds what is to be done, for instance ``runs/mine.json:set_table/open/fridge/top_door``:
of the policies of a file or a folder only those that act there are opened and belong to the identity of the run.
Navigate needs no policy in an environment that teleports the robot.
"""

from __future__ import annotations

import hashlib
import json
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from mjhab.core.errors import fault
from mjhab.core.names import kind_of
from mjhab.evaluation.parts import close_policy
from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    full_spec,
    no_style,
    open_policy,
    wanted_of,
)
from mjhab.learning import policy_kind
from mjhab.learning.assigned.entries import Entry, chosen
from mjhab.learning.assigned.files import entries_in, read_entries
from mjhab.rollout.policy import (
    Correctable,
    Fallible,
    Policy,
    RolloutEnv,
    Selective,
    Styled,
)
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS


class PoliciesTogether(OpenedPolicy):
    """The policies of some entries; each is opened once.

    Args:
        spec: their name.
    """

    @cached_property
    @abstractmethod
    def entries(self) -> tuple[Entry, ...]:
        """The entries.

        Raises:
            UsageError: they cannot be read.
        """

    @cached_property
    def opened(self) -> list[OpenedPolicy]:
        """Their policies."""
        return [open_policy(entry.checkpoint) for entry in self.entries]

    @property
    def takes_style(self) -> bool:
        """Whether the expert is one of them."""
        return any(one.takes_style for one in self.opened)

    @property
    def name(self) -> str:
        """Name of the policies together."""
        return Path(self.spec).stem

    @property
    def facts(self) -> PolicyFacts:
        """One hash over all of them, and the environment options that they need.

        Raises:
            UsageError: see `entries`; two policies need different environment options, or a checkpoint cannot be read.
        """
        hashes = []
        needed = []
        profiles = set()
        cautions = []
        every = [opened.facts for opened in self.opened]
        for entry, facts in zip(self.entries, every, strict=True):
            # The expert and servers have no file to hash.
            known = facts.identity.get("policy_sha256") or json.dumps(
                [facts.name, dict(facts.identity)], sort_keys=True
            )
            hashes.append([entry.subtask, entry.target, known])
            if "policy_profile" in facts.identity:
                profiles.add(facts.identity["policy_profile"])
            needed.append((entry.checkpoint, facts.env_options))
            cautions.append(facts.caution)
        # Sorted, so that the order of the entries does not matter.
        digest = hashlib.sha256(json.dumps(sorted(hashes)).encode()).hexdigest()
        identity = {"policy_sha256": digest}
        if profiles:
            identity["policy_profile"] = ", ".join(sorted(profiles))
        return PolicyFacts(
            self.name,
            identity,
            policy_kind.joined(self.name, needed),
            next((facts.robot for facts in every if facts.robot), ""),
            any(facts.reads_instruction for facts in every),
            " ".join(filter(None, dict.fromkeys(cautions))),
        )

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        return self.together(self.entries, self.opened, env, options)

    def together(
        self,
        entries: Sequence[Entry],
        opened: Sequence[OpenedPolicy],
        env: RolloutEnv,
        options: PolicyOptions,
    ) -> Policy:
        """Build the policies of entries.

        Raises:
            UsageError: as `facts`; ``options`` sets a style and no expert acts in this environment; or a subtask of it
                has no policy.
        """
        config = cast(Any, env).config
        every = (config.subtask,) if config.subtask else TASKS[config.task].subtasks
        teleports = config.navigate == "teleport"
        # The environment itself executes a teleport.
        wanted = [name for name in every if not (teleports and SUBTASKS[name].navigates)]
        having = {
            entry.subtask: one.takes_style
            for entry, one in zip(entries, opened, strict=True)
        }
        if options.style and not any(having.get(subtask) for subtask in wanted):
            drives = teleports and any(having.values())
            advice = "With --navigate drive it drives." if drives else ""
            raise no_style(self.name, options.style, advice)
        for subtask in wanted:
            # Found before the rollout: a chain would otherwise fail at its third subtask.
            if subtask not in having:
                raise fault(
                    self.spec,
                    f"has no policy for {subtask}; it has some for {sorted(having)}.",
                )
        policies = [_built(one, env, options) for one in opened]
        width = len(cast(Any, env).action_table)
        return PoliciesBySubtask(entries, policies, env.num_envs, width)


class PoliciesFile(PoliciesTogether):
    """The policies of a file."""

    @property
    def place(self) -> Path:
        """The file or folder."""
        return Path(wanted_of(self.spec)[0])

    @property
    def name(self) -> str:
        """Name of the file or folder."""
        return self.place.resolve().stem

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """The entries for what is to be done.

        Raises:
            UsageError: the policies cannot be read, or there is none for it, see `chosen`.
        """
        return chosen(str(self.place), self.read(), wanted_of(self.spec)[1])

    def read(self) -> tuple[Entry, ...]:
        """All entries, see `read_entries`."""
        return read_entries(self.place)

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        config = cast(Any, env).config
        told = full_spec(self.spec, config.task, config.subtask, config.target)
        # A script may name the file alone: the environment tells what is to be done.
        if told != self.spec:
            return type(self)(told)._build(env, options)
        return super()._build(env, options)


class PoliciesFolder(PoliciesFile):
    """The policies of a folder, each for what it was trained for."""

    def read(self) -> tuple[Entry, ...]:
        """All of them, see `entries_in`."""
        return entries_in(self.place)


def _built(opened: OpenedPolicy, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """The policy of an entry; a checkpoint may see means of the pixels of larger images."""
    style = options.style if opened.takes_style else ()
    return opened.build(env, replace(options, style=style, pools=True))


class PoliciesBySubtask:
    """In every world the policy of the active subtask acts; it is reset at the start of each subtask.

    Args:
        entries: subtask and target of each policy. policies: in the order of ``entries``. worlds: W.
        width: of an action (A).
    """

    name = "policies"

    def __init__(
        self, entries: Sequence[Entry], policies: list[Policy], worlds: int, width: int
    ) -> None:
        self._policies = policies
        self._places = {
            (entry.subtask, entry.target): number for number, entry in enumerate(entries)
        }
        # No subtask has this number, so that the first step enters one.
        self._pointer = np.full(worlds, -1)
        self._chosen = np.full(worlds, -1)
        self._width = width

    @property
    def acting_policies(self) -> Sequence[Policy]:
        """The policies, in the order of their entries."""
        return tuple(self._policies)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,)."""
        self._pointer[mask] = -1

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32 in [-1, 1]; zero where the active subtask has no policy."""
        episodes = info["episode_spec"]
        pointer = np.asarray(info["pointer"])
        chosen = np.array(
            [self._choose(episodes[w], int(p)) for w, p in enumerate(pointer)]
        )
        entering = pointer != self._pointer
        self._pointer = pointer.copy()
        self._chosen = chosen
        actions = np.zeros((len(pointer), self._width), np.float32)
        for number in np.unique(chosen[chosen >= 0]).tolist():
            mine = chosen == number
            policy = self._policies[number]
            # A policy keeps a history, which belongs to the subtask before.
            if (mine & entering).any():
                policy.reset(mine & entering)
            shown = [
                # None stands for a world that a policy has nothing to do in.
                episode if own else None
                for episode, own in zip(episodes, mine, strict=True)
            ]
            about = {**info, "episode_spec": shown}
            if isinstance(policy, Selective):
                actions[mine] = policy.act_in(obs, about, mine)[mine]
            else:
                # Policies without a choice of worlds act in all; what they do in those of others is dropped.
                actions[mine] = policy.act(obs, about)[mine]
        return actions

    def style(self, world: int) -> Mapping[str, Any]:
        """See `rollout.policy.Styled`: that of the expert."""
        # Experts of several entries draw the same for an episode.
        styles = (one.style(world) for one in self._policies if isinstance(one, Styled))
        return next(filter(None, styles), {})

    def replace_action(self, actions: np.ndarray, replan: bool = False) -> None:
        """See `rollout.policy.Correctable`."""
        for policy in self._policies:
            if isinstance(policy, Correctable):
                policy.replace_action(actions, replan)

    def fault(self, world: int) -> str:
        """Why the policy that acted last in a world cannot go on, "" if it can."""
        number = int(self._chosen[world])
        policy = self._policies[number] if number >= 0 else None
        return policy.fault(world) if isinstance(policy, Fallible) else ""

    def close(self) -> None:
        """Free what the policies hold."""
        for policy in self._policies:
            close_policy(policy)

    def _choose(self, episode: Mapping[str, Any] | None, pointer: int) -> int:
        """Index of the policy for the active subtask of an episode, -1 for none."""
        if episode is None or pointer >= len(episode["plan"]):
            return -1
        entry = episode["plan"][pointer]
        # A policy of the very target comes before one of all targets.
        of_all = self._places.get((entry["kind"], ""), -1)
        return self._places.get((entry["kind"], kind_of(entry["target"])), of_all)
