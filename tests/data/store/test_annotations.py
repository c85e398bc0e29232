"""What is told beside the numbers of an episode: skills with their control steps, and wordings of the instruction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mjhab.core.action_notes import ActionNotes, Doing
from mjhab.data.record.recorder import Recorder
from mjhab.data.store.annotations import Annotations, SkillSegment, segments
from mjhab.data.store.episode_data import to_bytes
from mjhab.data.store.reading import open_shard
from mjhab.data.store.shard import ShardWriter
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.tasks.instructions import (
    InstructionRequest,
    Spot,
    seeded_draw,
    subtask_instruction,
    subtask_wordings,
)
from tests.data.fake_world import CHAIN, FakeEnv

REACH = Doing("approach", ("pick up", "reach for the object"))
LIFT = Doing("lift", ("pick up", "lift"))


class Telling(RandomPolicy):
    """Reaches for three control steps and lifts from then on."""

    def __init__(self) -> None:
        super().__init__(0)
        self._steps = np.zeros(0, int)

    def reset(self, mask: np.ndarray) -> None:
        super().reset(mask)
        self._steps = np.where(mask, 0, self._steps if len(self._steps) else mask * 0)

    def notes(self) -> ActionNotes:
        self._steps += 1
        plain = ActionNotes.plain(np.zeros((len(self._steps), 13), np.float32), self.name)
        return replace(plain, doing=[REACH if t <= 3 else LIFT for t in self._steps])


def test_skills_and_wordings_are_recorded(tmp_path: Path) -> None:
    env = FakeEnv()
    with ShardWriter(tmp_path / "a.h5") as writer:
        recorder = Recorder(writer, env, {"name": "random"})  # pyright: ignore[reportArgumentType]
        rollout(env, Telling(), range(3), 0, [recorder])  # pyright: ignore[reportArgumentType]
    with open_shard(tmp_path / "a.h5") as shard:
        for episode in shard:
            told = episode.annotations
            rest = [SkillSegment(*LIFT, 3, episode.steps)] if episode.steps > 3 else []
            assert list(told.skills) == [
                SkillSegment(*REACH, 0, min(3, episode.steps)),
                *rest,
            ]
            assert len(told.wordings) == len(CHAIN)
            assert told.wordings[1] == ("pick 024_bowl_:0000", "please pick")


def test_segments_tile_the_steps_and_neighbours_differ() -> None:
    doing = [REACH, REACH, LIFT, REACH, Doing()]
    found = segments(doing)
    assert [(s.start, s.end) for s in found] == [(0, 2), (2, 3), (3, 4), (4, 5)]
    assert [
        Doing(s.skill, s.phases) for s in found for _ in range(s.start, s.end)
    ] == doing
    told = Annotations(found, (("a", "b"),))
    assert Annotations.from_array(told.array, 5) == told


@pytest.mark.parametrize(
    ("skills", "why"),
    [
        ([{"skill": "lift", "phases": [], "start": 1, "end": 4}], "follow"),
        ([{"skill": "lift", "phases": [], "start": 0, "end": 9}], "step 9 of 4"),
        ([{"skill": "lift", "phases": [], "start": 0, "end": True}], "follow"),
        ([{"skill": 3, "phases": [], "start": 0, "end": 4}], "written"),
        ([{"skill": "x" * 2000, "phases": [], "start": 0, "end": 4}], "characters"),
        (7, "written"),
    ],
)
def test_what_no_recorder_writes_is_refused(skills: object, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Annotations.from_array(to_bytes({"skills": skills, "wordings": []}), 4)


def test_wordings_are_all_that_can_be_drawn() -> None:
    request = InstructionRequest(
        "pick", "005_tomato_soup_can_:0000", Spot("the coffee table")
    )
    wordings = subtask_wordings(request)
    drawn = {
        subtask_instruction(request, seeded_draw(np.random.default_rng(k)))
        for k in range(200)
    }
    assert set(wordings) == drawn and len(wordings) == 6
    assert wordings[0] == subtask_instruction(request)
