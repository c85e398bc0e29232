"""Policies written by users: a class, a function that makes a policy, or an object."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

from mjhab.core.errors import UsageError, fault, missing_field, wrong_type
from mjhab.evaluation.resolve import OpenedPolicy, PolicyFacts, PolicyOptions
from mjhab.rollout.policy import Policy, RolloutEnv

METHODS = ("reset", "act")
"""Methods of the `Policy` protocol."""


def construct_policy(factory: Callable[..., Policy], env: RolloutEnv) -> Policy:
    """Call a class or function that makes a policy; the environment is passed if it has a parameter for it.

    Raises:
        UsageError: it needs more arguments, or its result lacks a part of the Policy protocol.
    """
    name = getattr(factory, "__name__", repr(factory))
    parameters = [
        parameter
        for parameter in inspect.signature(factory).parameters.values()
        if parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    ]
    required = [
        parameter for parameter in parameters if parameter.default is parameter.empty
    ]
    if len(required) > 1:
        raise UsageError(
            f"{name} needs {len(required)} arguments ({', '.join(p.name for p in required)}), but it is called with "
            "the environment or without arguments. Give the others default values."
        )
    # A parameter with a default may mean something else, unless it is called env.
    takes_env = bool(required) or (bool(parameters) and parameters[0].name == "env")
    policy = factory(env) if takes_env else factory()
    check_policy(policy, name)
    return policy


def check_policy(policy: Any, called: str) -> None:
    """Refuse an object that does not implement the Policy protocol.

    Raises:
        UsageError: a method or the name is missing.
    """
    check_methods(policy, called)
    if not isinstance(getattr(policy, "name", None), str):
        raise missing_field(
            "name", f"policy {called}", f"Give it one, as in: name = {called!r}."
        )


def env_options_of(policy: Any) -> Mapping[str, Any]:
    """Environment options that a policy, or its class, declares in ``env_options``.

    Raises:
        UsageError: ``env_options`` is not a mapping.
    """
    options = getattr(policy, "env_options", {})
    if not isinstance(options, Mapping):
        raise wrong_type(
            "env_options", options, "a dict like {'obs_mode': 'depth'}", where="policy"
        )
    return dict(options)


def check_methods(policy: Any, called: str) -> None:
    """Refuse a policy, or a class of policies, without the methods of the Policy protocol.

    Raises:
        UsageError: a method is missing.
    """
    lacking = [
        method for method in METHODS if not callable(getattr(policy, method, None))
    ]
    if lacking:
        raise fault(
            f"policy {called}",
            f"has no {' and no '.join(lacking)}; it needs reset(mask) and act(obs, info), see "
            "mjhab.rollout.policy.Policy.",
        )


class OwnPolicy(OpenedPolicy):
    """A policy that is an object of the caller, or a class or function that makes one.

    Args:
        policy: it.

    Raises:
        UsageError: the policy lacks a method.
    """

    def __init__(self, policy: Any) -> None:
        called = getattr(policy, "__name__", type(policy).__name__)
        name = getattr(policy, "name", None)
        # On a class, name may be a property; a function that makes a policy has no name attribute.
        super().__init__(name if isinstance(name, str) else called)
        self._policy = policy
        # A function is checked when it has made its policy.
        if isinstance(policy, type) or not callable(policy):
            check_methods(policy, called)

    @property
    def facts(self) -> PolicyFacts:
        """Its name and the environment options that it needs."""
        return PolicyFacts(self.spec, env_options=env_options_of(self._policy))

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        policy = self._policy
        # An object with act is a policy, even if it can be called.
        if isinstance(policy, type) or not hasattr(policy, "act"):
            return construct_policy(cast(Callable[..., Policy], policy), env)
        check_policy(policy, type(policy).__name__)
        return cast(Policy, policy)
