"""Policies by specification, as for ``--policy`` of every command and for ``mjhab.evaluate``.

Each kind of specification (a name, ``FILE.py:CLASS``, ...) is an entry of ``POLICY_KINDS``. Its class lies in a module
that is imported on first use, so that a kind may need a heavy library, or a package that itself imports this one.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from mjhab.core.errors import UsageError, fault, unknown_name, wrong_value
from mjhab.core.files.reading import is_folder
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.tasks.style import Styles

EXPERT = "expert"
NAMED_POLICIES = (EXPERT, "random", "zero")
MS_HAB_PREFIX = "ms_hab:"
"""Before the file of a checkpoint of MS-HAB."""
LEARNED = "learned"
STUDENT = "student"
LEARNED_NAMES = (LEARNED, STUDENT)
"""Name of the checkpoints that come with the package, and the old one; `full_spec` adds task, subtask and target."""
POLICIES_SUFFIX = ".json"
"""Of files that name several policies."""


class NoPolicyError(UsageError):
    """A specification that names several policies has none for what is to be done."""


@dataclass(frozen=True)
class Wanted:
    """What a policy is to do: a subtask on a target ("" for all targets), or a whole task (subtask "")."""

    task: str
    subtask: str = ""
    target: str = ""

    @classmethod
    def parse(cls, text: str) -> Wanted:
        """Read ``TASK/SUBTASK/TARGET``; a target may have slashes of its own."""
        task, _, rest = text.partition("/")
        subtask, _, target = rest.partition("/")
        return cls(task, subtask, target)

    def __str__(self) -> str:
        return f"{self.task}/{self.subtask}/{self.target}"


@dataclass(frozen=True)
class PolicyFacts:
    """Description of a policy before its environment is built.

    name: for reports and folders. identity: JSON data that changes with the policy, e.g. the hash of a file; it is part
    of a run's configuration, so that episodes of two policies are never mixed. env_options: fields of `EnvConfig` that
    the policy needs, e.g. ``{"obs_mode": "depth"}``; options of the user take precedence. robot: name of the only robot
    that the policy can act with, "" if it can act with others. reads_instruction: False if the policy certainly makes
    nothing of instructions. caution: what to warn of, a sentence, "" for nothing.
    """

    name: str
    identity: Mapping[str, Any] = field(default_factory=dict)
    env_options: Mapping[str, Any] = field(default_factory=dict)
    robot: str = ""
    reads_instruction: bool = True
    caution: str = ""

    @property
    def described(self) -> dict[str, Any]:
        """The identity, and the caution if there is one as "policy_caution", for the configuration of a run."""
        caution = {"policy_caution": self.caution} if self.caution else {}
        return {**self.identity, **caution}


@dataclass(frozen=True)
class PolicyOptions:
    """Options of a policy.

    seed: of the run. style: style options of the expert, see `Styles.parse`. instruction: sentence that the policy gets
    in place of the episodes' own; "" for these. pools: whether the environment's images may be larger than those that
    the policy was trained with, as they may where several policies act.
    """

    seed: int = 0
    style: tuple[str, ...] = ()
    instruction: str = ""
    pools: bool = False


class OpenedPolicy(ABC):
    """A policy that a specification names: its files are read once, when they are first asked for.

    Args:
        spec: the specification.
    """

    takes_instruction = False
    """Whether it may be told `PolicyOptions.instruction`."""

    def __init__(self, spec: str) -> None:
        self.spec = spec

    @property
    def takes_style(self) -> bool:
        """Whether the expert acts in it, which alone has `PolicyOptions.style`."""
        return False

    @property
    @abstractmethod
    def facts(self) -> PolicyFacts:
        """Description of the policy without an environment.

        Raises:
            UsageError: there is no such policy; the message names what was looked for and a valid form.
        """

    def build(self, env: RolloutEnv, options: PolicyOptions | None = None) -> Policy:
        """Build the policy.

        Args:
            env: the vector environment that it will act in, with autoreset "disabled".
            options: None for seed 0, no style and the instructions of the episodes.

        Raises:
            UsageError: there is no such policy, it cannot act in this environment, or as `check`.
        """
        options = options or PolicyOptions()
        self.check(options)
        return self._build(env, options)

    def check(self, options: PolicyOptions) -> None:
        """Check what needs no environment.

        Raises:
            UsageError: ``options`` has an instruction or a style that the policy does not take; an option of the style
                is unknown or out of range.
        """
        if options.instruction and not self.takes_instruction:
            raise no_instruction(self.spec)
        Styles.parse(options.style)
        if options.style and not self.takes_style:
            raise no_style(self.spec, options.style)

    @abstractmethod
    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Build the policy of this kind, see `build`."""


@dataclass(frozen=True)
class PolicyKind:
    """A kind of policy specification.

    form: pattern of its specifications, for messages. matches: whether a specification is of this kind; kinds are
    tried in order of registration. opened: ``module:class`` of the kind's `OpenedPolicy`. takes_instruction: see there.
    """

    form: str
    matches: Callable[[str], bool]
    opened: str
    takes_instruction: bool = False

    def open(self, spec: str) -> OpenedPolicy:
        """Open a policy of this kind; its module is imported now."""
        module, _, name = self.opened.partition(":")
        # Imported now, because kinds of learned policies load torch.
        kind = getattr(importlib.import_module(module), name)
        opened = cast(OpenedPolicy, kind(spec))
        opened.takes_instruction = self.takes_instruction
        return opened


POLICY_KINDS: list[PolicyKind] = [
    PolicyKind(
        ", ".join(NAMED_POLICIES),
        lambda spec: spec in NAMED_POLICIES,
        "mjhab.evaluation.named_policies:NamedPolicy",
    ),
    PolicyKind(
        LEARNED,
        lambda spec: spec.partition(":")[0] in LEARNED_NAMES,
        "mjhab.learning.shipped_kind:ShippedPolicy",
        takes_instruction=True,
    ),
    PolicyKind(
        f"{MS_HAB_PREFIX}CHECKPOINT.pt",
        lambda spec: spec.startswith(MS_HAB_PREFIX),
        "mjhab.paper.ms_hab.policy_kind:MsHabFile",
    ),
    PolicyKind(
        "ws://HOST:PORT",
        lambda spec: spec.startswith(("ws://", "wss://")),
        "mjhab.evaluation.served.kind:ServerAddress",
        takes_instruction=True,
    ),
    PolicyKind(
        "CHECKPOINT.safetensors",
        lambda spec: spec.endswith(".safetensors"),
        "mjhab.learning.policy_kind:CheckpointFiles",
        takes_instruction=True,
    ),
    PolicyKind(
        "POLICIES.json",
        lambda spec: wanted_of(spec)[0].endswith(POLICIES_SUFFIX),
        "mjhab.learning.by_subtask:PoliciesFile",
        takes_instruction=True,
    ),
    PolicyKind(
        "FOLDER",
        lambda spec: is_folder(Path(wanted_of(spec)[0])),
        "mjhab.learning.by_subtask:PoliciesFolder",
        takes_instruction=True,
    ),
    PolicyKind(
        "FILE.py:CLASS",
        lambda spec: spec.endswith(".py") or ".py:" in spec,
        "mjhab.evaluation.policy_file:PolicyClass",
    ),
]
"""All kinds; the first match is used."""


def register_policy_kind(kind: PolicyKind) -> None:
    """Add a kind of policy, for all commands and `mjhab.evaluate`."""
    POLICY_KINDS.append(kind)


def open_policy(spec: str) -> OpenedPolicy:
    """Open the policy that a specification names: "expert", "FILE.py:CLASS" or another form; see `full_spec`.

    Raises:
        UsageError: the specification matches no kind.
    """
    return _kind_of(spec).open(spec)


def inspect_policy(spec: str) -> PolicyFacts:
    """Describe the policy that a specification names, without an environment.

    Raises:
        UsageError: the specification matches no kind, or there is no such policy.
    """
    return open_policy(spec).facts


def resolve_policy(
    spec: str, env: RolloutEnv, options: PolicyOptions | None = None
) -> Policy:
    """Build the policy that a specification names, see `OpenedPolicy.build`.

    Raises:
        UsageError: the specification matches no kind, or as `OpenedPolicy.build`.
    """
    return open_policy(spec).build(env, options)


def no_instruction(policy: str) -> UsageError:
    """Make the error for a policy that is told a sentence which it cannot read."""
    return fault(
        f"policy {policy}",
        "takes no instruction. A student does that was trained with sentences (mjhab train ... "
        "--set inputs.sentence=true), and so does a served policy (ws://HOST:PORT).",
    )


def no_style(policy: str, style: Sequence[str], advice: str = "") -> UsageError:
    """Make the error for a policy in which no expert acts, and that has a style."""
    meant = f"left out: only the expert has a style, and it does not act in {policy}"
    return wrong_value("style", tuple(style), meant, advice)


def full_spec(spec: str, task: str, subtask: str | None, target: str | None) -> str:
    """Add what is to be done to a specification that names several policies; keep others.

    These are "learned", or "student" as it was called, a file of policies and a folder of them.
    """
    if spec not in LEARNED_NAMES and not _names_several(spec):
        return spec
    return f"{spec}:{Wanted(task, subtask or '', target or '')}"


def wanted_of(spec: str) -> tuple[str, Wanted | None]:
    """What `full_spec` was given: the file or folder of policies, and what is to be done; None if nothing was added."""
    # From the right: the folder may have a colon, a wanted subtask has none.
    head, _, tail = spec.rpartition(":")
    return (head, Wanted.parse(tail)) if _names_several(head) else (spec, None)


def _names_several(spec: str) -> bool:
    # A folder named "expert" must not replace the expert.
    if spec in NAMED_POLICIES or not spec:
        return False
    return spec.endswith(POLICIES_SUFFIX) or is_folder(Path(spec))


def _kind_of(spec: str) -> PolicyKind:
    for kind in POLICY_KINDS:
        if kind.matches(spec):
            return kind
    # The first two are named as words in front of them.
    forms = ", ".join(kind.form for kind in POLICY_KINDS[2:])
    advice = f"Or a policy of your own: {forms}."
    raise unknown_name("policy", spec, (*NAMED_POLICIES, LEARNED), advice=advice)
