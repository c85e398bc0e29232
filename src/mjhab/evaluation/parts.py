"""What an evaluation is built of: its policy, its environment, and what it tells them."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.config.env_spec import env_names
from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.evaluation.own_policy import OwnPolicy
from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    open_policy,
)
from mjhab.evaluation.specs import EvalSpec, PolicyLike
from mjhab.rollout.policy import Clipped, Composed, Paced, Policy, Timed

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

RECORDED = {
    "task": "task",
    "subtask": "subtask",
    "target": "target",
    "worlds": "num_envs",
    "seed": "seed",
    "split": "split",
    "assets": "assets",
    "episodes_file": "episodes_file",
    "navigate": "navigate",
    "spawns": "spawns",
    "home": "home",
    "threads": "threads",
}
"""Keys of a run's configuration that hold options of the environment, and the fields of `EnvConfig`."""


def open_any(policy: PolicyLike) -> OpenedPolicy:
    """Open a policy before its environment is built.

    Raises:
        UsageError: there is no such policy, or it lacks a method.
    """
    return open_policy(policy) if isinstance(policy, str) else OwnPolicy(policy)


def describe_policy(policy: PolicyLike) -> PolicyFacts:
    """Describe a policy before its environment is built.

    Raises:
        UsageError: there is no such policy, or it lacks a method.
    """
    return open_any(policy).facts


def policy_options(spec: EvalSpec) -> PolicyOptions:
    """What an evaluation tells its policy."""
    return PolicyOptions(spec.asked.seed, spec.style, spec.instruction or "")


def env_options(spec: EvalSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Further environment options: those that the policy needs, overridden by those of the user.

    Raises:
        UsageError: the policy names an option that does not exist, or was trained with another robot than the user's.
    """
    check_env_options(facts.env_options)
    asked = spec.env.get("robot", facts.robot)
    if facts.robot and asked != facts.robot:
        raise wrong_value(
            "robot",
            asked,
            repr(facts.robot),
            f"Leave out --robot, or train a policy with it: mjhab train ALGORITHM --robot {asked}",
            f"policy {facts.name}",
        )
    # The user's come last: who asks for another camera must get it, and an error if the policy cannot.
    return {**facts.env_options, **spec.env}


def make_env(spec: EvalSpec, options: Mapping[str, Any]) -> SequentialTaskEnv:
    """Build the environment of an evaluation.

    Args:
        spec: the evaluation; the environment has at most as many worlds as episodes.
        options: further ones, which take precedence, see `env_options`.
    """
    from mjhab.envs import make

    # Worlds without an episode would be stepped for nothing.
    worlds = min(spec.asked.num_envs, spec.episodes)
    asked = {**spec.env_defaults, **spec.env, **options}
    return make(**{**asked, "num_envs": worlds, "autoreset": "disabled"})


def recorded_value(asked: EnvConfig, name: str) -> Any:
    """The value of an option of the environment as a run's configuration holds it: None for an empty text."""
    value = getattr(asked, name)
    return None if value == "" else value


def check_env_options(options: Mapping[str, Any]) -> None:
    """Refuse environment options of a policy that do not exist, or that an evaluation sets itself.

    Raises:
        UsageError: an option is not allowed.
    """
    valid = set(env_names(EvalSpec).values()) - set(RECORDED.values())
    for name in options:
        if name not in valid:
            raise unknown_name("environment option of a policy", name, sorted(valid))


def close_policy(policy: Policy | None) -> None:
    """Call the policy's method ``close()``, if it has one, to free its resources."""
    close = getattr(policy, "close", None)
    if callable(close):
        close()


def requests_of(policy: Policy) -> dict[str, Any]:
    """What is known of the requests of a policy that is asked elsewhere, as part of a summary; empty for others.

    Returns:
        "latency_ms": median "p50" and 99th percentile "p99" of their duration [ms], both None if none was answered.
        "late_steps": control steps without an action of it, if the world did not wait for it.
        "out_of_range": number of values of its actions that were clipped, by entry of the action.
    """
    parts = policy.acting_policies if isinstance(policy, Composed) else (policy,)
    facts: dict[str, Any] = {}
    timed = [part.latency_ms for part in parts if isinstance(part, Timed)]
    if timed:
        facts["latency_ms"] = _quantiles([value for values in timed for value in values])
    late = [part.late_steps for part in parts if isinstance(part, Paced)]
    counts = [steps for steps in late if steps is not None]
    if counts:
        facts["late_steps"] = int(np.sum(counts))
    clipped = [part.out_of_range for part in parts if isinstance(part, Clipped)]
    if clipped:
        total: Counter[str] = Counter()
        for counts in clipped:
            total.update(counts)
        facts["out_of_range"] = dict(total)
    return facts


def _quantiles(latency_ms: Sequence[float]) -> dict[str, float | None]:
    if not latency_ms:
        return {"p50": None, "p99": None}
    p50, p99 = np.percentile(latency_ms, [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}


def check_sendable(policy: PolicyLike, name: str) -> None:
    """Refuse a policy that cannot be sent to worker processes.

    Raises:
        UsageError: the policy cannot be pickled.
    """
    try:
        # Tried here: in a worker the error would name neither the policy nor a remedy.
        pickle.dumps(policy)
    # Pickle raises whatever the object's own methods raise.
    except Exception as error:
        raise fault(
            f"policy {name}",
            f"cannot be sent to worker processes ({error}); give FILE.py:CLASS or a class at the top "
            "level of a module, or workers=0 for all episodes in this process.",
        ) from error
