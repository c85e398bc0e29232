"""Dialect behavior (BEHAVIOR-1K: OmniGibson/omnigibson/learning/utils/network_utils.py, and its batches of 2026).

The answer is a map with ``action`` (A,), or (B, A) for a batch, and ``action_chunk`` (..., H, A) if the request
asks for one; ``{"reset": True}`` gets no answer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from mjhab.serving.dialects.dialect import OWN, Ask, Incoming
from mjhab.serving.dialects.parts import (
    batch_of,
    chunks_of,
    described,
    entry_of,
    mapping,
    own_parts,
    present,
    stacked,
)
from mjhab.serving.packing import ProtocolError

_PROPRIO = "::proprio"
"""End of the key of the state; in front of it stands the robot."""
_CHUNK = "__action_chunk_size__"
"""Key of the number of actions that a request asks for."""


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

    def request(
        self, asks: Sequence[Ask], metadata: Mapping[str, Any], batch: bool
    ) -> dict[str, Any]:
        robot = f"robot_{asks[0].robot}"
        head, hand = asks[0].cameras
        images = {
            f"{robot}::{head}::rgb": stacked([ask.external for ask in asks], batch),
            f"{robot}::{hand}::rgb": stacked([ask.wrist for ask in asks], batch),
        }
        prompts = [ask.prompt for ask in asks]
        message = present(images) | {
            f"{robot}{_PROPRIO}": stacked([ask.state for ask in asks], batch),
            "prompt": prompts if batch else prompts[0],
            **own_parts(asks, batch=batch),
        }
        # Older servers do not know the key.
        if asks[0].chunk > 1:
            message[_CHUNK] = asks[0].chunk
        return message

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        first = entry_of(answer, "action", self.name)
        chunk = mapping(answer).get("action_chunk")
        try:
            if chunk is None:
                chunk = np.asarray(first)[..., None, :] if np.ndim(first) else first
            numbers = np.asarray(chunk)
        except ValueError as error:
            # Rows of unequal lengths.
            raise ProtocolError(f"actions are numbers, not {described(first)}") from error
        # A server may answer a batch of one without its axis.
        if numbers.ndim == 2:
            numbers = numbers[None]
        return chunks_of(numbers, batch)

    def read(self, message: Any) -> Incoming:
        request = mapping(message)
        if "reset" in request:
            return Incoming(True)
        state = next(
            (value for key, value in request.items() if str(key).endswith(_PROPRIO)), None
        )
        return Incoming(False, request, batch_of(state))

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        actions = chunks if incoming.batch is not None else chunks[0]
        reply: dict[str, Any] = {
            "action": actions[..., 0, :],
            "server_timing": {"infer_ms": infer_ms},
        }
        if _CHUNK in incoming.request:
            reply["action_chunk"] = actions
        return reply
