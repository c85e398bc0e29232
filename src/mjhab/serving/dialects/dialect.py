"""Interface of a dialect: the message format in which observations and actions are exchanged with a policy server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

OWN = "mjhab"
"""Key of the entries that only mjhab sends: in the greeting of its servers and in the requests of its clients."""
REAL_TIME = "real_time"
"""Key of `Ask.timing` in requests."""
CONTROL_HZ = "control_hz"
"""Key in greetings: control steps per second that the actions of a policy are for."""
STEP = "step"
"""Key in `Ask.timing`, and in answers the control step that the first action is for; without it that of the request."""
RESET_DONE = "reset successful"
"""Answer to the message that begins an episode, in dialects that answer it."""


@dataclass(frozen=True)
class Ask:
    """Observation of one world that is sent to a policy server.

    robot: its name. cameras: of the external and the wrist image, "" for a camera that the robot lacks.
    external, wrist: images (H, W, 3) uint8, None if not rendered. state: (S,) float32 proprioception and goals. arm:
    (N,) positions of the arm's joints [rad]. gripper: 0 for an open gripper, 1 for a closed one. tcp: (7,) position [m]
    and quaternion wxyz in the frame of the base. prompt: the instruction. session: name of the episode's session.
    chunk: largest number of actions in the answer. own: additional entries for servers of mjhab. timing: where the
    world goes on while the server thinks, what it must know of the time: "step", the control step of the observation in
    its episode; "hz", control steps per second; "delay", control steps until the answer is expected to be there.
    sensed, unsensed: float32, what the robot's own sensors tell, and what only the simulation knows; where they are
    asked for in place of ``state``.
    """

    robot: str
    cameras: tuple[str, str]
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
    timing: Mapping[str, Any] | None = None
    sensed: np.ndarray | None = None
    unsensed: np.ndarray | None = None


@dataclass(frozen=True)
class Incoming:
    """A message at the server: a reset, or a request for actions with the number of worlds in it (None: no batch)."""

    reset: bool
    request: Mapping[str, Any] = field(default_factory=dict)
    batch: int | None = None


class Dialect(Protocol):
    """A message format for observations and actions."""

    name: ClassVar[str]
    batches: ClassVar[bool]
    """A request may hold several worlds."""
    remembers: ClassVar[bool]
    """Whether clients tell the server that an episode begins. The server may then keep state of the episode, which is
    lost with the connection."""

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Metadata that a server sends on connection. own: entries for clients of mjhab."""
        ...

    def begin(self, session: str) -> dict[str, Any] | None:
        """The message that begins an episode; None if the dialect has none."""
        ...

    @property
    def begin_answered(self) -> bool:
        """Whether the server answers the message that begins an episode."""
        ...

    def request(
        self, asks: Sequence[Ask], metadata: Mapping[str, Any], batch: bool
    ) -> dict[str, Any]:
        """The request for actions.

        Args:
            asks: one per world. metadata: the greeting of the server.
            batch: arrays have the worlds in front, also when one world is left; else there is one world.
        """
        ...

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        """Actions (B, H, A) in the answer to a request about B worlds.

        Raises:
            ProtocolError: the answer has no actions at the place that the dialect defines.
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
