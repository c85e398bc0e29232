"""What a dialect is: how observations and actions go into messages, at both ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

OWN = "mjhab"
"""Key of what only servers of mjhab say (in their greeting) and want (in requests)."""
RESET_DONE = "reset successful"
"""Answer to the message that begins an episode, where there is one."""


@dataclass(frozen=True)
class Ask:
    """What is seen in one world, on its way to a server.

    external, wrist: images (H, W, 3) uint8, None without. state: (S,) float32 proprioception and goals. arm: (7,) joint
    positions [rad]. gripper: share to which the gripper is closed, 0 to 1. tcp: (6,) position [m] and rotation vector
    [rad] in the frame of the base. prompt: the instruction. session: name of the episode's session. chunk: most actions
    wanted. own: what servers of mjhab want beside it.
    """

    external: np.ndarray | None
    wrist: np.ndarray | None
    state: np.ndarray
    arm: np.ndarray
    gripper: float
    tcp: np.ndarray
    prompt: str
    session: str
    chunk: int
    own: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Incoming:
    """A message at the server: a reset, or a request for actions with the number of worlds in it (None: no batch)."""

    reset: bool
    request: Mapping[str, Any] = field(default_factory=dict)
    batch: int | None = None


class Dialect(Protocol):
    """One way to put observations and actions into messages."""

    name: ClassVar[str]
    batches: ClassVar[bool]
    """A request may hold several worlds."""
    remembers: ClassVar[bool]
    """Servers are told when an episode begins, so they may keep what they saw of it: a lost connection loses that."""

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Metadata that a server sends first. own: what clients of mjhab want to know."""
        ...

    def begin(self, session: str) -> dict[str, Any] | None:
        """The message that begins an episode, None if there is none."""
        ...

    @property
    def begin_answered(self) -> bool:
        """The server answers to the message that begins an episode."""
        ...

    def request(self, asks: Sequence[Ask], metadata: Mapping[str, Any]) -> dict[str, Any]:
        """The message that asks for actions, in one world or in a batch."""
        ...

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        """Actions (B, H, A) in the answer to a request about B worlds.

        Raises:
            ProtocolError: they are not where the dialect has them.
        """
        ...

    def read(self, message: Any) -> Incoming:
        """What a message asks of the server.

        Raises:
            ProtocolError: nothing that is known.
        """
        ...

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        """The answer to a request: chunks (B, H, A)."""
        ...
