"""Environment options derived from the metadata that a policy server sends on connection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjhab.core.errors import wrong_value
from mjhab.core.timing import STEP_SECONDS
from mjhab.core.typed.options import with_tuples
from mjhab.evaluation.served.action_spaces import (
    ACTION_SPACES,
    DEFAULT_SPACE,
    space_named,
)
from mjhab.serving.address import Address
from mjhab.serving.dialects.dialect import CONTROL_HZ, OWN

IMAGE_SIZE_PX = 224
"""Image side for servers that do not specify it: the usual input of vision-language-action models."""


def own_part(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """The part of the metadata that only mjhab servers send; empty for other servers."""
    own = metadata.get(OWN, {})
    return own if isinstance(own, Mapping) else {}


def check_rate(address: Address, metadata: Mapping[str, Any]) -> None:
    """Refuse a server whose actions are for another rate of control; most do not say for which.

    Raises:
        UsageError: names both rates.
    """
    hz = round(1.0 / STEP_SECONDS)
    told = metadata.get(CONTROL_HZ, own_part(metadata).get(CONTROL_HZ, hz))
    if isinstance(told, bool) or told != hz:
        raise wrong_value(
            CONTROL_HZ,
            told,
            f"{hz}, the control steps of the robot per second",
            "Serve actions of that rate.",
            f"the greeting of {address.shown}",
        )


def space_of(address: Address, metadata: Mapping[str, Any]) -> str:
    """Name of the action space: that of the address, else that of the server, else `DEFAULT_SPACE`.

    Raises:
        UsageError: the action space of the address is unknown.
    """
    if address.actions:
        # Checked here, because it was typed by the user; what a server names wrongly is passed over.
        space_named(address.actions)
        return address.actions
    named = metadata.get("action_space")
    return named if isinstance(named, str) and named in ACTION_SPACES else DEFAULT_SPACE


def env_options_of(address: Address, metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Options of an environment with the observations and the control mode that the policy needs."""
    own = own_part(metadata)
    if isinstance(own.get("env"), Mapping):
        return with_tuples(own["env"])
    size: Any = metadata.get("image_resolution") or IMAGE_SIZE_PX
    size = tuple(size) if isinstance(size, list) else size
    space = space_named(space_of(address, metadata))
    return {"obs_mode": "rgb", "camera_size": size, "control_mode": space.control_mode}
