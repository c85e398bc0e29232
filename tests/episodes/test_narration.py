"""Instructions of episodes name the furniture that things really lie on."""

from __future__ import annotations

import dataclasses

from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.narration import Narrator
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import chain


def test_set_table_names_drawer_fridge_and_table() -> None:
    layout = Layout(open_pack("builtin"), roster("set_table"))
    narrator = Narrator(layout)
    episode = EpisodeMaker(CpuSimulator(layout, 1, 1), "set_table", "train").episode(0, 0)
    plan = chain("set_table", episode.targets, episode.home)
    told = narrator.instructions(episode, plan, alone=False)
    assert len(told.subtasks) == len(plan.subtasks) == 16
    assert "bowl" in told.task and "apple" in told.task
    assert told.task.count("on the dining table") == 2
    assert told.subtasks[3].endswith("the bowl from the kitchen counter")
    assert told.subtasks[5].endswith("on the dining table") or "down on" in told.subtasks[5]
    assert told.subtasks[11].endswith("the apple from the fridge")

    # The words are those of the episode: the same when asked again, others in other episodes.
    assert Narrator(layout).instructions(episode, plan, alone=False) == told
    others = [dataclasses.replace(episode, index=index) for index in range(1, 20)]
    assert len({narrator.instructions(other, plan, alone=False).task for other in others}) > 1
