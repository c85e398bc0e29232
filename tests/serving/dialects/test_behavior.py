"""Answers in the dialect of BEHAVIOR."""

from __future__ import annotations

from typing import Any

import pytest

from mjhab.serving.dialects.behavior import Behavior
from mjhab.serving.packing import ProtocolError


@pytest.mark.parametrize(
    "answer",
    [
        {"action": [[1.0, 2.0], [3.0]]},
        {"action": [1.0, 2.0], "action_chunk": [[1.0, 2.0], [3.0]]},
        {"action": {"arm": 1.0}},
    ],
)
def test_what_are_no_actions_is_told_as_that(answer: dict[str, Any]) -> None:
    with pytest.raises(ProtocolError, match="actions are numbers, not"):
        Behavior().actions(answer, 1)
