"""Parts of messages that the dialects have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.serving.dialects.dialect import OWN, REAL_TIME, Ask
from mjhab.serving.packing import ProtocolError


def present(images: Mapping[str, Any]) -> dict[str, Any]:
    """The images that there are."""
    return {key: image for key, image in images.items() if image is not None}


def own_parts(asks: Sequence[Ask], batch: bool) -> dict[str, Any]:
    """What servers of mjhab want to know, and of the time; under their keys, where they are asked for."""
    entries = {OWN: [ask.own for ask in asks], REAL_TIME: [ask.timing for ask in asks]}
    return {
        key: [dict(part) for part in parts] if batch else dict(parts[0])
        for key, values in entries.items()
        # Of all worlds or of none: lists of different lengths could not be put side by side.
        if len(parts := [value for value in values if value is not None]) == len(asks)
    }


def stacked(arrays: Sequence[np.ndarray | None], batch: bool) -> np.ndarray | None:
    """The arrays of a batch as one, or the single one; None if there are none."""
    there = [array for array in arrays if array is not None]
    if not there:
        return None
    return np.stack(there) if batch else there[0]


def mapping(message: Any) -> Mapping[str, Any]:
    """The message, if it is a map.

    Raises:
        ProtocolError: it is not.
    """
    if not isinstance(message, Mapping):
        raise ProtocolError(f"a message is a map, not {described(message)}")
    return message


def entry_of(answer: Any, key: str, dialect: str) -> Any:
    """An entry of an answer.

    Raises:
        ProtocolError: it is not there.
    """
    if not isinstance(answer, Mapping) or key not in answer:
        raise ProtocolError(
            f"the answer is {described(answer)}, and {dialect} has a map with {key!r}"
        )
    return answer[key]


def numbers_of(value: Any, dimensions: int) -> np.ndarray:
    """Actions as float32 with so many dimensions, or one less, which gets one in front.

    Raises:
        ProtocolError: they are no numbers, or of another shape.
    """
    try:
        numbers = np.asarray(value, np.float32)
    except (TypeError, ValueError) as error:
        raise ProtocolError(f"actions are numbers, not {described(value)}") from error
    if numbers.ndim == dimensions - 1:
        numbers = numbers[None]
    if numbers.ndim != dimensions or not numbers.size:
        raise ProtocolError(
            f"actions have {dimensions} dimensions, got the shape {numbers.shape}"
        )
    return numbers


def chunks_of(value: Any, batch: int) -> np.ndarray:
    """Chunks of actions (B, H, A) float32 for the worlds of a request.

    Raises:
        ProtocolError: they are no such numbers, or those of another number of worlds.
    """
    numbers = numbers_of(value, 3)
    if len(numbers) != batch:
        raise ProtocolError(
            f"the answer has actions for {len(numbers)} worlds, not {batch}"
        )
    return numbers


def batch_of(state: Any) -> int | None:
    """Number of worlds of a request by its state (B, S); None for that of one world (S,)."""
    return len(state) if isinstance(state, np.ndarray) and state.ndim == 2 else None


def described(value: Any) -> str:
    """A part of a message in few words."""
    if isinstance(value, Mapping):
        return f"a map with the keys {sorted(map(str, value))[:8]}"
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    return repr(value)[:80]
