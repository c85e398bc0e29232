"""How much of an episode is used: a demonstration that goes on after its success is mostly standing still."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import UsageError

WHOLE = -1


@dataclass(frozen=True)
class Until:
    """``hold_steps``: control steps that are used after the one of the first success; WHOLE uses all of an episode.

    An episode that never succeeds is used to its end.
    """

    hold_steps: int = WHOLE

    @classmethod
    def parse(cls, text: str) -> Until:
        """Read "success+20" (20 steps after the first success), "success", or "end" or "" for the whole.

        Raises:
            UsageError: it is none of these.
        """
        if text in ("", "end"):
            return cls()
        found = re.fullmatch(r"success(?:\+(\d{1,6}))?", text)
        if found is None:
            raise UsageError(
                f"until must be end, success, or success+N for N control steps more, as in success+20; got {text!r}."
            )
        return cls(int(found[1] or 0))

    @property
    def is_whole(self) -> bool:
        """Whether every episode is used to its end."""
        return self.hold_steps == WHOLE

    @property
    def text(self) -> str:
        """What ``parse`` reads."""
        return "end" if self.is_whole else f"success+{self.hold_steps}"

    def steps(self, success: np.ndarray) -> int:
        """Control steps to use of an episode with ``success`` (N,), 0 or 1 after each of its steps: at most N."""
        reached = np.flatnonzero(success)
        if self.is_whole or not len(reached):
            return len(success)
        return min(len(success), int(reached[0]) + 1 + self.hold_steps)
