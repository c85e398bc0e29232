"""What ``mjhab score`` says of a score that cannot be compared."""

from __future__ import annotations

from typing import Any

import pytest

from mjhab.cli.policies import score
from mjhab.core.arithmetic.digest import PLAIN_ARITHMETIC


@pytest.mark.parametrize("others", [0, 3])
def test_other_starts_come_with_what_to_set(
    others: int, capsys: pytest.CaptureFixture[str]
) -> None:
    summary: dict[str, Any] = {
        "complete": False,
        "episodes": 5,
        "rows": [{"name": "a.b", "done": 5}],
        "other_starts": others,
    }
    score._tell_incomplete(summary)
    said = capsys.readouterr().err
    assert f"{others} begin elsewhere" in said
    for name, value in PLAIN_ARITHMETIC.items():
        assert (f"{name}={value!r}" in said) == bool(others)
