"""Options of all commands that accept a remote policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro


@dataclass(frozen=True, kw_only=True)
class ServedOptions:
    """Options for requests to a remote policy (--policy ws://host:port); docs/serving.md lists the defaults."""

    dialect: Annotated[str | None, tyro.conf.arg(metavar="openpi|roboarena|behavior")] = (
        None
    )
    """With --policy ws://host:port: message format of the server; openpi if absent."""
    execute: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --policy ws://host:port: actions of a chunk that are executed before the next request; 8 if absent."""
    actions: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """With --policy ws://host:port: action space: joint (13 numbers), ee (end effector, gripper, base: 9),
    joint_position or joint_velocity (arm, gripper: 8). That of the server, else joint, if absent."""
    prompt: Annotated[str | None, tyro.conf.arg(metavar="subtask|task")] = None
    """With --policy ws://host:port: instruction in requests: of the active subtask (default) or of the whole task."""
    timeout: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """With --policy ws://host:port: longest wait for an answer, for each world that is asked about at once; 30 s
    if absent."""
    first_timeout: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """With --policy ws://host:port: longest wait for the first answer over a connection, before which servers compile,
    and for a connection until then; 300 s if absent. Never shorter than --timeout."""
    batch: bool = False
    """With --policy ws://host:port and the dialect behavior: one request for all worlds."""

    @property
    def served(self) -> dict[str, Any]:
        """The given options by the field names of `serving.address.Address`."""
        given: dict[str, Any] = {
            "dialect": self.dialect,
            "execute": self.execute,
            "actions": self.actions,
            "prompt": self.prompt,
            "timeout": self.timeout,
            "first_timeout": self.first_timeout,
            "batch": "yes" if self.batch else None,
        }
        return {name: value for name, value in given.items() if value is not None}
