"""Dialect lerobot: observations by the names that LeRobot's data sets and policies have (lerobot/utils/constants.py).

The keys are those of ``mjhab export lerobot``, so that a policy that was trained on an export reads what it was trained
with. The answer is a map with ``action``: (H, A), or (B, H, A) for a batch; ``{"reset": True}`` gets no answer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from mjhab.serving.dialects.dialect import OWN, Ask, Incoming
from mjhab.serving.dialects.parts import (
    batch_of,
    chunks_of,
    entry_of,
    mapping,
    own_parts,
    stacked,
)
from mjhab.serving.packing import ProtocolError

STATE = "observation.state"
UNSENSED = "observation.environment_state"
IMAGES = "observation.images"
SENTENCE = "task"
ACTION = "action"
IMAGE_NAMES = "cameras"
"""Key of a greeting: the policy's own names of up to three images, of which the third is black."""
MOST_IMAGES = 3
GREETED = (IMAGE_NAMES, "state", "image_resolution", "action_space")
"""What a policy may say of its observations and actions, see docs/serving.md."""


class LeRobot:
    """Dialect lerobot."""

    name: ClassVar[str] = "lerobot"
    batches: ClassVar[bool] = True
    remembers: ClassVar[bool] = True
    begin_answered = False

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        return {OWN: dict(own), **{key: own[key] for key in GREETED if key in own}}

    def begin(self, session: str) -> dict[str, Any] | None:
        return {"reset": True}

    def request(
        self, asks: Sequence[Ask], metadata: Mapping[str, Any], batch: bool
    ) -> dict[str, Any]:
        tasks = [ask.prompt for ask in asks]
        parts: dict[str, Sequence[np.ndarray | None]] = {
            f"{IMAGES}.{name}": images for name, images in _images(asks, metadata).items()
        }
        # Without a wish in the greeting the whole state is sent, as in the other dialects.
        if asks[0].sensed is None:
            parts[STATE] = [ask.state for ask in asks]
        else:
            parts[STATE] = [ask.sensed for ask in asks]
            parts[UNSENSED] = [ask.unsensed for ask in asks]
        arrays = {key: stacked(values, batch) for key, values in parts.items()}
        return {
            **{key: array for key, array in arrays.items() if array is not None},
            SENTENCE: tasks if batch else tasks[0],
            **own_parts(asks, batch=batch),
        }

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        return chunks_of(entry_of(answer, ACTION, self.name), batch)

    def read(self, message: Any) -> Incoming:
        request = mapping(message)
        if "reset" in request:
            return Incoming(True)
        state = request.get(STATE)
        return Incoming(False, request, batch_of(state))

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        actions = chunks if incoming.batch is not None else chunks[0]
        return {ACTION: actions, "server_timing": {"infer_ms": infer_ms}}


def _images(
    asks: Sequence[Ask], metadata: Mapping[str, Any]
) -> dict[str, list[np.ndarray | None]]:
    """Images of all worlds by the names that the policy has for them."""
    seen = [[ask.external for ask in asks], [ask.wrist for ask in asks]]
    # Some policies want three images, and the robot has two cameras.
    seen.append([None if image is None else np.zeros_like(image) for image in seen[0]])
    wanted = metadata.get(IMAGE_NAMES)
    names = [camera for camera in asks[0].cameras if camera]
    if isinstance(wanted, list | tuple):
        if not 1 <= len(wanted) <= MOST_IMAGES:
            raise ProtocolError(
                f"{IMAGE_NAMES!r} in the greeting names 1 to {MOST_IMAGES} images, not {len(wanted)}"
            )
        names = [str(name) for name in wanted]
    return dict(zip(names, seen, strict=False))
