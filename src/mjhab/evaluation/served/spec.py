"""What ``mjhab serve`` is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import fault
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.flags import Flag
from mjhab.serving.address import SCHEMES, without_password


@dataclass(frozen=True)
class ServeSpec(EnvSpec):
    """Serve a policy of mjhab over websockets, for `mjhab eval --policy ws://host:port` on this or another machine.

    For instance: `mjhab serve expert --port 8000`, or `mjhab serve my.safetensors --dialect behavior`

    The first printed line contains the port. Ctrl-C ends the server. On other networks (--host 0.0.0.0) clients need a
    token: that of the environment variable MJHAB_POLICY_TOKEN, or else a random one, which is printed.

    Raises:
        UsageError: an option is invalid, or the policy is served already.
    """

    policy: Annotated[str, Flag(metavar="NAME", positional=True)]
    """The policy: expert, learned (with --task, --subtask and --target), random, zero, a CHECKPOINT.safetensors, or
    FILE.py:CLASS."""
    dialect: Annotated[str, Flag(metavar="openpi|roboarena|behavior|lerobot")] = "openpi"
    """Message format."""
    host: Annotated[str, Flag(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all networks of this machine."""
    port: Annotated[int, Bound(most=65_535)] = 8000
    """Port to listen on; if it is in use, the next free one. 0 for any free port."""
    style: Annotated[tuple[str, ...], Flag(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, see `mjhab eval --help`."""
    max_message_mb: Annotated[int, Bound(1, 4096)] = 16
    """Largest accepted message [MiB]; clients that send a larger one are disconnected."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "seed",
            "task",
            "subtask",
            "target",
            "assets",
            docs={
                "seed": "Seed of the policy's random numbers.",
                "task": "With learned: the task.",
                "subtask": "With learned: the subtask.",
                "target": "With learned: the object or link.",
                "assets": "Asset pack of the homes that clients may use: builtin, the name of another pack, or the "
                "folder of one.",
            },
            shown={"subtask": "default: none", "target": "default: none"},
        ),
    ] = field(default_factory=dict)
    """What the policy is for: fields of `EnvConfig`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.policy.startswith(SCHEMES):
            raise fault(without_password(self.policy), "is served already.")
