"""What the greeting of a policy server says of the environment that its policy needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjhab.evaluation.served.action_spaces import ACTION_SPACES, DEFAULT_SPACE, space_named
from mjhab.serving.address import Address
from mjhab.serving.dialects.dialect import OWN

IMAGE_SIZE_PX = 224
"""Side of the images that policies want that do not say it: what vision-language-action models are trained with."""


def own_part(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """What only servers of mjhab say, empty from others."""
    own = metadata.get(OWN, {})
    return own if isinstance(own, Mapping) else {}


def space_of(address: Address, metadata: Mapping[str, Any]) -> str:
    """Name of the action space: the one asked for, or that of the server, or `DEFAULT_SPACE`.

    Raises:
        UsageError: the one asked for is unknown.
    """
    if address.actions:
        space_named(address.actions)
        return address.actions
    named = metadata.get("action_space")
    return named if isinstance(named, str) and named in ACTION_SPACES else DEFAULT_SPACE


def env_options_of(address: Address, metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the environment that show the policy what it wants to see, and take what it sends."""
    own = own_part(metadata)
    if isinstance(own.get("env"), Mapping):
        # msgpack knows lists only, and configurations hold tuples.
        return {
            str(key): tuple(value) if isinstance(value, list) else value
            for key, value in own["env"].items()
        }
    size: Any = metadata.get("image_resolution") or IMAGE_SIZE_PX
    size = tuple(size) if isinstance(size, list) else size
    space = space_named(space_of(address, metadata))
    return {"obs_mode": "rgb", "camera_size": size, "control_mode": space.control_mode}
