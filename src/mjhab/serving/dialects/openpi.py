"""Dialect openpi (openpi: src/openpi/serving/websocket_policy_server.py).

The answer is a map with ``actions`` (H, A). There is no reset; the keys of observations are those of LIBERO.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from mjhab.serving.dialects.dialect import OWN, Ask, Incoming
from mjhab.serving.dialects.parts import entry_of, mapping, numbers_of, own_parts, present


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

    def request(
        self, asks: Sequence[Ask], metadata: Mapping[str, Any], batch: bool
    ) -> dict[str, Any]:
        (ask,) = asks
        images = {"observation/image": ask.external, "observation/wrist_image": ask.wrist}
        return present(images) | {
            "observation/state": ask.state,
            "prompt": ask.prompt,
            **own_parts(asks, batch=False),
        }

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        return numbers_of(entry_of(answer, "actions", self.name), 2)[None]

    def read(self, message: Any) -> Incoming:
        return Incoming(False, mapping(message))

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        timing = {"infer_ms": infer_ms}
        return {"actions": chunks[0], "policy_timing": timing, "server_timing": timing}
