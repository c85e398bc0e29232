"""The used part of an episode. A demonstration that continues after its success mostly stands still."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import wrong_value

WHOLE = -1


@dataclass(frozen=True)
class Until:
    """The used part of an episode: up to ``hold_steps`` control steps after its first success; WHOLE uses all of it.

    An episode that never succeeds is used to its end.
    """

    hold_steps: int = WHOLE

    @classmethod
    def parse(cls, text: str) -> Until:
        """Parse "success+20" (20 steps after the first success), "success" (none after it), or "end" or "" for all.

        Raises:
            UsageError: the text is none of these.
        """
        if text in ("", "end"):
            return cls()
        found = re.fullmatch(r"success(?:\+(\d{1,6}))?", text)
        if found is None:
            raise wrong_value(
                "until",
                text,
                "end, success, or success+N for N control steps more, as in success+20",
            )
        return cls(int(found[1] or 0))

    @property
    def is_whole(self) -> bool:
        """Whether every episode is used to its end."""
        return self.hold_steps == WHOLE

    @property
    def text(self) -> str:
        """Text form, as ``parse`` reads it."""
        return "end" if self.is_whole else f"success+{self.hold_steps}"

    def steps(self, success: np.ndarray) -> int:
        """Number of control steps to use of an episode whose ``success`` (N,) is 0 or 1 after each step."""
        reached = np.flatnonzero(success)
        if self.is_whole or not len(reached):
            return len(success)
        # The step of the success itself counts, so that its state is the last one.
        return min(len(success), int(reached[0]) + 1 + self.hold_steps)
