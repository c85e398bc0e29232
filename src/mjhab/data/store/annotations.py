"""What is told of a recorded episode beside its numbers: the skills of who acted, and other wordings of what was asked.

It is JSON in the dataset ``annotations``: {"skills": [{"skill", "phases", "start", "end"}], "wordings": [[sentence]]}.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mjhab.core.action_notes import Doing
from mjhab.data.store.episode_data import from_bytes, to_bytes
from mjhab.tasks.instructions import MAX_INSTRUCTION_CHARACTERS

ANNOTATIONS = "annotations"
"""Path of the dataset."""


@dataclass(frozen=True)
class SkillSegment:
    """Control steps ``start`` to ``end`` - 1 of an episode, in which a policy did one thing.

    skill: one word such as "lift", see `experts.phases.SKILLS`. phases: in words, outermost first, such as ("pick up",
    "take the object", "lift").
    """

    skill: str
    phases: tuple[str, ...]
    start: int
    end: int


@dataclass(frozen=True)
class Annotations:
    """Annotations of an episode.

    skills: in order, without gaps; empty if who acted does not tell. wordings: for each subtask of the plan, the
    sentences that ask for it; that of the record is one of them unless it was given or perturbed.
    """

    skills: tuple[SkillSegment, ...] = ()
    wordings: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def of(cls, doing: Sequence[Doing], wordings: Sequence[Sequence[str]]) -> Annotations:
        """Those of an episode in which ``doing`` was done, one entry per control step."""
        # A learned policy tells nothing, and N empty entries are no segment.
        told = any(now != Doing() for now in doing)
        return cls(segments(doing) if told else (), tuple(map(tuple, wordings)))

    @classmethod
    def from_array(cls, data: np.ndarray, steps: int) -> Annotations:
        """Read the dataset of an episode of ``steps`` control steps.

        Raises:
            ValueError: it is not what a recorder writes.
        """
        values: Any = from_bytes(data)
        try:
            skills = tuple(
                SkillSegment(
                    _text(s["skill"]),
                    tuple(map(_text, s["phases"])),
                    s["start"],
                    s["end"],
                )
                for s in values["skills"]
            )
            wordings = tuple(tuple(map(_text, each)) for each in values["wordings"])
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{ANNOTATIONS} are not what was written ({error!r})"
            ) from error
        ends = [0, *(s.end for s in skills)]
        # `type`, because JSON's true would count as 1.
        fits = all(type(k) is int for s in skills for k in (s.start, s.end))
        if (
            not fits
            or [s.start for s in skills] != ends[:-1]
            or ends != sorted(set(ends))
        ):
            raise ValueError(f"skills of {ANNOTATIONS} do not follow each other")
        if skills and ends[-1] != steps:
            raise ValueError(f"skills of {ANNOTATIONS} end in step {ends[-1]} of {steps}")
        return cls(skills, wordings)

    @property
    def array(self) -> np.ndarray:
        """The dataset, (n,) uint8."""
        return to_bytes(asdict(self))

    def __bool__(self) -> bool:
        """Whether anything is told."""
        return bool(self.skills or any(self.wordings))


def segments(doing: Sequence[Doing]) -> tuple[SkillSegment, ...]:
    """Runs of equal entries of N control steps."""
    starts = [t for t, now in enumerate(doing) if not t or now != doing[t - 1]]
    ends = [*starts[1:], len(doing)]
    return tuple(
        SkillSegment(doing[t].skill, doing[t].phases, t, end)
        for t, end in zip(starts, ends, strict=True)
    )


def _text(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MAX_INSTRUCTION_CHARACTERS:
        raise TypeError(f"a text of at most {MAX_INSTRUCTION_CHARACTERS} characters")
    return value
