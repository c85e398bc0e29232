"""A separate policy for each subtask of a chain: ``--policy POLICIES.json``. See `evaluation.resolve.PolicyModule`.

The file is ``{"policies": [{"subtask": "pick", "target": "024_bowl", "checkpoint": "pick.safetensors"}, ...]}``; its
paths are relative to its folder. In place of a checkpoint an entry may name any other policy, as for ``--policy``:
``"expert"``, ``"ms_hab:pick.pt"``, ``"mine.py:Mine"``. An entry with the target "" applies to all targets without an
entry of their own. Navigate needs no policy in an environment that teleports the robot.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import beside, is_file, read_json_object
from mjhab.core.names import kind_of
from mjhab.core.typed.records import read_record
from mjhab.evaluation.evaluate import close_policy
from mjhab.evaluation.resolve import (
    EXPERT,
    MS_HAB_PREFIX,
    NAMED_POLICIES,
    STUDENT,
    PolicyFacts,
    PolicyOptions,
    resolve_policy,
)
from mjhab.evaluation.resolve import inspect_policy as inspect_any
from mjhab.learning import policy_kind
from mjhab.rollout.policy import Fallible, Policy, RolloutEnv, Selective
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

SUFFIX = ".json"
WITHOUT_FILE = (f"{STUDENT}:", "ws://", "wss://")
"""Beginnings of specifications that name no file."""
_FIELDS = ("subtask", "target", "checkpoint")


@dataclass(frozen=True)
class Entry:
    """A policy for a subtask and a type of target ("" for all targets).

    checkpoint: a file of `mjhab train`, several joined by "+" (see `policy_kind`), or another specification as for
    ``--policy``, such as "expert".
    """

    subtask: str
    target: str
    checkpoint: str


def read_entries(path: Path) -> tuple[Entry, ...]:
    """Read a policies file.

    Raises:
        UsageError: the file does not exist or has another format, a subtask is unknown, or two entries name one.
    """
    if not is_file(path):
        raise UsageError(
            f"{path} does not exist; give a JSON file that names one checkpoint per subtask."
        )
    try:
        rows = read_record(
            tuple[Entry, ...], read_json_object(path).get("policies"), "policies"
        )
        entries = tuple(
            replace(row, checkpoint=_beside(path, row.checkpoint)) for row in rows
        )
    except ValueError as error:
        raise UsageError(
            f'{path} must hold {{"policies": [{{{", ".join(_FIELDS)}}}, ...]}}. {error}'
        ) from error
    seen: set[tuple[str, str]] = set()
    for entry in entries:
        SUBTASKS.check(entry.subtask)
        place = (entry.subtask, entry.target)
        if place in seen:
            told = f"{entry.subtask} {entry.target or 'of all targets'}"
            raise UsageError(f"{path} names two policies for {told}; leave one out.")
        seen.add(place)
    return entries


def _beside(path: Path, spec: str) -> str:
    """The specification of an entry, with its files below the folder of the policies file.

    Raises:
        UsageError: it is another policies file, or a student of the package without what it does.
        ValueError: it names a file that cannot be.
    """
    if spec == STUDENT:
        raise UsageError(f"{path}: say which student: {STUDENT}:TASK/SUBTASK/TARGET.")
    if spec.endswith(SUFFIX):
        raise UsageError(
            f"{path}: an entry names one policy, not another policies file ({spec})."
        )
    if spec in NAMED_POLICIES or spec.startswith(WITHOUT_FILE):
        return spec
    prefix = MS_HAB_PREFIX if spec.startswith(MS_HAB_PREFIX) else ""
    files = policy_kind.members(spec.removeprefix(prefix))
    return prefix + policy_kind.AND.join(str(beside(path, str(file))) for file in files)


def entries_text(path: Path, entries: Sequence[Entry]) -> str:
    """Text of a policies file at ``path``; the checkpoints must lie below its folder."""
    rows = [
        {
            "subtask": entry.subtask,
            "target": entry.target,
            "checkpoint": policy_kind.AND.join(
                str(member.relative_to(path.parent))
                for member in policy_kind.members(entry.checkpoint)
            ),
        }
        for entry in entries
    ]
    return json.dumps({"policies": rows}, indent=1) + "\n"


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe the policies together: one hash over all of them, and the environment options that they need.

    Raises:
        UsageError: see `read_entries`; or two policies need different environment options.
    """
    path = Path(spec)
    return describe_entries(path.stem, read_entries(path))


def describe_entries(name: str, entries: Sequence[Entry]) -> PolicyFacts:
    """`inspect_policy` for the policies of ``entries``.

    Raises:
        UsageError: two policies need different environment options, or a checkpoint cannot be read.
    """
    hashes = []
    needed = []
    profiles = set()
    robot = ""
    reads = False
    cautions = []
    for entry in entries:
        facts = inspect_any(entry.checkpoint)
        known = facts.identity.get("policy_sha256") or json.dumps(
            [facts.name, dict(facts.identity)], sort_keys=True
        )
        hashes.append([entry.subtask, entry.target, known])
        if "policy_profile" in facts.identity:
            profiles.add(facts.identity["policy_profile"])
        needed.append((entry.checkpoint, facts.env_options))
        robot = robot or facts.robot
        reads = reads or facts.reads_instruction
        cautions.append(facts.caution)
    options = policy_kind.joined(name, needed)
    digest = hashlib.sha256(json.dumps(sorted(hashes)).encode()).hexdigest()
    identity = {"policy_sha256": digest}
    if profiles:
        identity["policy_profile"] = ", ".join(sorted(profiles))
    caution = " ".join(filter(None, dict.fromkeys(cautions)))
    return PolicyFacts(name, identity, options, robot, reads, caution)


def build_policy(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """Build all policies.

    Raises:
        UsageError: as `inspect_policy`; ``options`` sets a style; or a subtask of the environment has no policy.
    """
    return build_entries(spec, read_entries(Path(spec)), env, options)


def build_entries(
    name: str, entries: Sequence[Entry], env: RolloutEnv, options: PolicyOptions
) -> Policy:
    """`build_policy` for the policies of ``entries``.

    Raises:
        UsageError: as `build_policy`.
    """
    config = cast(Any, env).config
    wanted = (config.subtask,) if config.subtask else TASKS[config.task].subtasks
    having = {entry.subtask for entry in entries}
    for subtask in wanted:
        teleports = SUBTASKS[subtask].navigates and config.navigate == "teleport"
        if subtask not in having and not teleports:
            raise UsageError(
                f"{name} has no policy for {subtask}; it has some for {sorted(having)}."
            )
    policies = [_build(entry.checkpoint, env, options) for entry in entries]
    width = len(cast(Any, env).action_table)
    return PoliciesBySubtask(entries, policies, env.num_envs, width)


def _build(spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
    """The policy of an entry; a checkpoint may see means of the pixels of larger images."""
    if spec.endswith(policy_kind.SUFFIX):
        return policy_kind.build_policy(spec, env, options, pools=True)
    # Only the expert has a style.
    return resolve_policy(
        spec, env, options if spec == EXPERT else replace(options, style=())
    )


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
            if (mine & entering).any():
                policy.reset(mine & entering)
            shown = [
                episode if own else None
                for episode, own in zip(episodes, mine, strict=True)
            ]
            told = {**info, "episode_spec": shown}
            if isinstance(policy, Selective):
                actions[mine] = policy.act_in(obs, told, mine)[mine]
            else:
                actions[mine] = policy.act(obs, told)[mine]
        return actions

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
        of_all = self._places.get((entry["kind"], ""), -1)
        return self._places.get((entry["kind"], kind_of(entry["target"])), of_all)
