"""Policies by name: what ``--policy`` of every command, and ``mjhab.evaluate``, understand.

Each kind of specification (a name, ``FILE.py:CLASS``, ...) is an entry of ``POLICY_KINDS``. Its code lies in a module
that is imported when such a policy is asked for, so that a kind may need a heavy library, or a package that is above
this one in the order of imports.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

from mjhab.core.errors import UsageError, unknown_name
from mjhab.rollout.policy import Policy, RolloutEnv

NAMED_POLICIES = ("expert", "random", "zero")
STUDENT = "student"
"""The checkpoint of the package for what is to be done; `full_spec` says what that is."""


@dataclass(frozen=True)
class PolicyFacts:
    """What is known of a policy before its environment is built.

    name: what reports and folders call it. identity: plain JSON data that changes when the policy does, e.g. the hash
    of a file; it goes into the configuration of a run, so that episodes of two policies are never mixed. env_options:
    fields of `EnvConfig` that the policy needs, e.g. ``{"obs_mode": "depth"}``; what the user asks for goes before it.
    """

    name: str
    identity: Mapping[str, Any] = field(default_factory=dict)
    env_options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class PolicyOptions:
    """What else decides how a policy acts. seed: of the run. style: of the expert, see `Styles.parse`."""

    seed: int = 0
    style: tuple[str, ...] = ()


class PolicyModule(Protocol):
    """What the module of a kind offers."""

    def inspect_policy(self, spec: str) -> PolicyFacts:
        """Describe the policy; cheap, and before anything is built.

        Raises:
            UsageError: there is no such policy; the message says what was looked for, and what to give.
        """
        ...

    def build_policy(self, spec: str, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build the policy for an environment.

        Raises:
            UsageError: the policy cannot act in this environment.
        """
        ...


@dataclass(frozen=True)
class PolicyKind:
    """A kind of policy specification.

    form: how one is written, for messages. matches: whether a specification is of this kind; asked in order of
    registration. module: full name of a `PolicyModule`.
    """

    form: str
    matches: Callable[[str], bool]
    module: str

    def load(self) -> PolicyModule:
        """The module, imported."""
        return cast(PolicyModule, importlib.import_module(self.module))


POLICY_KINDS: list[PolicyKind] = [
    PolicyKind(
        ", ".join(NAMED_POLICIES),
        lambda spec: spec in NAMED_POLICIES,
        "mjhab.evaluation.named_policies",
    ),
    PolicyKind(
        STUDENT, lambda spec: spec.partition(":")[0] == STUDENT, "mjhab.learning.shipped_kind"
    ),
    PolicyKind(
        "ms_hab:CHECKPOINT.pt",
        lambda spec: spec.startswith("ms_hab:"),
        "mjhab.learning.ms_hab.policy_kind",
    ),
    PolicyKind(
        "ws://HOST:PORT",
        lambda spec: spec.startswith(("ws://", "wss://")),
        "mjhab.evaluation.served.kind",
    ),
    PolicyKind(
        "CHECKPOINT.safetensors",
        lambda spec: spec.endswith(".safetensors"),
        "mjhab.learning.policy_kind",
    ),
    PolicyKind("POLICIES.json", lambda spec: spec.endswith(".json"), "mjhab.learning.by_subtask"),
    PolicyKind(
        "FILE.py:CLASS",
        lambda spec: spec.endswith(".py") or ".py:" in spec,
        "mjhab.evaluation.policy_file",
    ),
]
"""The kinds that are known; the first that matches is taken."""


def register_policy_kind(kind: PolicyKind) -> None:
    """Let every command and `mjhab.evaluate` understand another kind of policy."""
    POLICY_KINDS.append(kind)


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe the policy that a specification names, without an environment.

    Raises:
        UsageError: no kind of policy is written so, or there is no such policy.
    """
    return _kind_of(spec).load().inspect_policy(spec)


def resolve_policy(spec: str, env: RolloutEnv, options: PolicyOptions | None = None) -> Policy:
    """Build the policy that a specification names.

    Args:
        spec: "expert", "random", "zero", "FILE.py:CLASS", or what a registered kind understands; see `full_spec`.
        env: the vector environment it will act in, with autoreset "disabled".
        options: the seed of the run and the expert's style; seed 0 and no style if None.

    Raises:
        UsageError: no kind of policy is written so, there is no such policy, or it cannot act in this environment.
    """
    return _kind_of(spec).load().build_policy(spec, env, options or PolicyOptions())


def full_spec(spec: str, task: str, subtask: str | None, target: str | None) -> str:
    """A specification that does without what is to be done: "student" gets it, every other one stays as it is."""
    return f"{STUDENT}:{task}/{subtask or ''}/{target or ''}" if spec == STUDENT else spec


def _kind_of(spec: str) -> PolicyKind:
    for kind in POLICY_KINDS:
        if kind.matches(spec):
            return kind
    forms = ", ".join(kind.form for kind in POLICY_KINDS[2:])
    raise UsageError(
        f"{unknown_name('policy', spec, (*NAMED_POLICIES, STUDENT))} Or a policy of your own: {forms}."
    )
