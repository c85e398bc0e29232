"""Dialects: which keys a request and its answer have. All of them are msgpack over websockets, see `packing`.

* openpi (openpi: src/openpi/serving/websocket_policy_server.py): the answer is a map with ``actions`` (H, A). There is
  no reset; the keys of observations are those of LIBERO.
* roboarena (roboarena: roboarena/policy_server.py): ``endpoint`` says "infer" or "reset", the answer is an array (H, A)
  or the text "reset successful". The greeting tells which images are wanted. The keys are those of DROID.
* behavior (BEHAVIOR-1K: OmniGibson/omnigibson/learning/utils/network_utils.py, and its batches of 2026): the answer is
  a map with ``action`` (A,), or (B, A) for a batch, and ``action_chunk`` (..., H, A) if the request asks for one;
  ``{"reset": True}`` gets no answer.

In all of them a server greets with a map of metadata, and tells of an error in a text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.serving.packing import ProtocolError

OWN = "mjhab"
"""Key of what only servers of mjhab say (in their greeting) and want (in requests)."""
RESET_DONE = "reset successful"
_CHUNK = "__action_chunk_size__"
_ROBOARENA_KEYS = frozenset({"image_resolution", "needs_session_id", "n_external_cameras"})


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


class OpenPi:
    """Dialect openpi."""

    name: ClassVar[str] = "openpi"
    batches: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    begin_answered = False

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        return {OWN: dict(own)}

    def begin(self, session: str) -> dict[str, Any] | None:
        return None

    def request(self, asks: Sequence[Ask], metadata: Mapping[str, Any]) -> dict[str, Any]:
        (ask,) = asks
        images = {"observation/image": ask.external, "observation/wrist_image": ask.wrist}
        return _present(images) | {
            "observation/state": ask.state,
            "prompt": ask.prompt,
            **_own_parts(asks, batch=False),
        }

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        return _numbers(_entry(answer, "actions", self.name), 2)[None]

    def read(self, message: Any) -> Incoming:
        return Incoming(False, _mapping(message))

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        timing = {"infer_ms": infer_ms}
        return {"actions": chunks[0], "policy_timing": timing, "server_timing": timing}


class RoboArena:
    """Dialect roboarena."""

    name: ClassVar[str] = "roboarena"
    batches: ClassVar[bool] = False
    remembers: ClassVar[bool] = True
    begin_answered = True

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "image_resolution": None,
            "needs_wrist_camera": True,
            "n_external_cameras": 1,
            "needs_stereo_camera": False,
            "needs_session_id": True,
            "action_space": "mjhab",
            OWN: dict(own),
        }

    def begin(self, session: str) -> dict[str, Any] | None:
        return {"endpoint": "reset", "session_id": session}

    def request(self, asks: Sequence[Ask], metadata: Mapping[str, Any]) -> dict[str, Any]:
        (ask,) = asks
        images: dict[str, Any] = {}
        if metadata.get("n_external_cameras", 1):
            images["observation/exterior_image_0_left"] = ask.external
        if metadata.get("needs_wrist_camera", True):
            images["observation/wrist_image_left"] = ask.wrist
        return _present(images) | {
            "endpoint": "infer",
            "session_id": ask.session,
            "observation/joint_position": ask.arm,
            "observation/cartesian_position": ask.tcp,
            "observation/gripper_position": np.array([ask.gripper], np.float32),
            "observation/state": ask.state,
            "prompt": ask.prompt,
            **_own_parts(asks, batch=False),
        }

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        if not isinstance(answer, np.ndarray):
            raise ProtocolError(
                f"the answer is {_described(answer)}, and roboarena has an array (H, A)"
            )
        return _numbers(answer, 2)[None]

    def read(self, message: Any) -> Incoming:
        request = dict(_mapping(message))
        endpoint = request.pop("endpoint", None)
        if endpoint not in ("infer", "reset"):
            raise ProtocolError(f'the key "endpoint" must be "infer" or "reset", not {endpoint!r}')
        return Incoming(endpoint == "reset", request)

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        return chunks[0]


class Behavior:
    """Dialect behavior."""

    name: ClassVar[str] = "behavior"
    batches: ClassVar[bool] = True
    remembers: ClassVar[bool] = True
    begin_answered = False

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        return {OWN: dict(own)}

    def begin(self, session: str) -> dict[str, Any] | None:
        return {"reset": True}

    def request(self, asks: Sequence[Ask], metadata: Mapping[str, Any]) -> dict[str, Any]:
        batch = len(asks) > 1
        images = {
            "robot_fetch::fetch_head::rgb": _stacked([ask.external for ask in asks], batch),
            "robot_fetch::fetch_hand::rgb": _stacked([ask.wrist for ask in asks], batch),
        }
        prompts = [ask.prompt for ask in asks]
        message = _present(images) | {
            "robot_fetch::proprio": _stacked([ask.state for ask in asks], batch),
            "prompt": prompts if batch else prompts[0],
            **_own_parts(asks, batch=batch),
        }
        if asks[0].chunk > 1:
            message[_CHUNK] = asks[0].chunk
        return message

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        first = _entry(answer, "action", self.name)
        chunk = _mapping(answer).get("action_chunk")
        if chunk is None:
            chunk = np.asarray(first)[..., None, :] if np.ndim(first) else first
        numbers = np.asarray(chunk)
        if numbers.ndim == 2:
            numbers = numbers[None]
        numbers = _numbers(numbers, 3)
        if len(numbers) != batch:
            raise ProtocolError(f"the answer has actions for {len(numbers)} worlds, not {batch}")
        return numbers

    def read(self, message: Any) -> Incoming:
        request = _mapping(message)
        if "reset" in request:
            return Incoming(True)
        state = request.get("robot_fetch::proprio")
        batch = len(state) if isinstance(state, np.ndarray) and state.ndim == 2 else None
        return Incoming(False, request, batch)

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        actions = chunks if incoming.batch is not None else chunks[0]
        reply: dict[str, Any] = {
            "action": actions[..., 0, :],
            "server_timing": {"infer_ms": infer_ms},
        }
        if _CHUNK in incoming.request:
            reply["action_chunk"] = actions
        return reply


_DIALECTS: tuple[Dialect, ...] = (OpenPi(), RoboArena(), Behavior())
DIALECTS: dict[str, Dialect] = {dialect.name: dialect for dialect in _DIALECTS}


def dialect_named(name: str) -> Dialect:
    """A dialect by its name.

    Raises:
        UsageError: there is none of this name.
    """
    if name not in DIALECTS:
        raise unknown_name("dialect", name, DIALECTS)
    return DIALECTS[name]


def greeted_in(metadata: Mapping[str, Any]) -> str:
    """The dialect that a greeting tells of, "" if it does not."""
    own = metadata.get(OWN)
    spoken = own.get("dialect") if isinstance(own, Mapping) else None
    if isinstance(spoken, str) and spoken in DIALECTS:
        return spoken
    return RoboArena.name if set(metadata) >= _ROBOARENA_KEYS else ""


def answered_in(answer: Any) -> str:
    """The dialect that an answer is of, "" if it is of none."""
    if isinstance(answer, np.ndarray):
        return RoboArena.name
    if isinstance(answer, Mapping):
        for dialect, key in ((OpenPi.name, "actions"), (Behavior.name, "action")):
            if isinstance(answer.get(key), np.ndarray):
                return dialect
    return ""


def _present(images: Mapping[str, Any]) -> dict[str, Any]:
    return {key: image for key, image in images.items() if image is not None}


def _own_parts(asks: Sequence[Ask], batch: bool) -> dict[str, Any]:
    if any(ask.own is None for ask in asks):
        return {}
    return {OWN: [dict(ask.own or {}) for ask in asks] if batch else dict(asks[0].own or {})}


def _stacked(arrays: Sequence[np.ndarray | None], batch: bool) -> np.ndarray | None:
    there = [array for array in arrays if array is not None]
    if not there:
        return None
    return np.stack(there) if batch else there[0]


def _mapping(message: Any) -> Mapping[str, Any]:
    if not isinstance(message, Mapping):
        raise ProtocolError(f"a message is a map, not {_described(message)}")
    return message


def _entry(answer: Any, key: str, dialect: str) -> Any:
    if not isinstance(answer, Mapping) or key not in answer:
        raise ProtocolError(
            f"the answer is {_described(answer)}, and {dialect} has a map with {key!r}"
        )
    return answer[key]


def _numbers(value: Any, dimensions: int) -> np.ndarray:
    """Actions as float32 with so many dimensions, none of them empty."""
    try:
        numbers = np.asarray(value, np.float32)
    except (TypeError, ValueError) as error:
        raise ProtocolError(f"actions are numbers, not {_described(value)}") from error
    if numbers.ndim == dimensions - 1:
        numbers = numbers[None]
    if numbers.ndim != dimensions or not numbers.size:
        raise ProtocolError(f"actions have {dimensions} dimensions, got the shape {numbers.shape}")
    return numbers


def _described(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"a map with the keys {sorted(map(str, value))[:8]}"
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    return repr(value)[:80]
