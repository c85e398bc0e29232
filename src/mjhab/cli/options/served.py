"""Options of every command whose policy may be served elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro


@dataclass(frozen=True, kw_only=True)
class ServedOptions:
    """How a policy at --policy ws://host:port is asked; what is absent has the default of docs/serving.md."""

    dialect: Annotated[str | None, tyro.conf.arg(metavar="openpi|roboarena|behavior")] = None
    """With --policy ws://host:port: what its server speaks; openpi if absent."""
    execute: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --policy ws://host:port: actions of a chunk that are executed before it is asked again; 8 if absent."""
    actions: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """With --policy ws://host:port: what it sends: joint (13 numbers), ee (end effector, gripper, base: 9),
    joint_position or joint_velocity (arm, gripper: 8). What its server says, or joint, if absent."""
    prompt: Annotated[str | None, tyro.conf.arg(metavar="subtask|task")] = None
    """With --policy ws://host:port: the instruction it gets: of the active subtask (default) or of the whole task."""
    timeout: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """With --policy ws://host:port: longest wait for an answer; 30 s if absent, 300 s for the first one."""
    batch: bool = False
    """With --policy ws://host:port and the dialect behavior: one request for all worlds."""

    @property
    def served(self) -> dict[str, Any]:
        """What was given, by the names of `serving.address.Address`."""
        given: dict[str, Any] = {
            "dialect": self.dialect,
            "execute": self.execute,
            "actions": self.actions,
            "prompt": self.prompt,
            "timeout": self.timeout,
            "batch": "yes" if self.batch else None,
        }
        if self.timeout is not None:
            given["first_timeout"] = max(self.timeout, 300.0)
        return {name: value for name, value in given.items() if value is not None}
