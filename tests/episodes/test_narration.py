"""Instructions of episodes name the furniture that things really lie on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest

from mjhab.core.errors import UsageError
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.narration import Narrator
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.scenes.objects import OBJECTS, ObjectModel, register_object
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import chain
from mjhab.tasks.plan import GOAL_OF, Subtask, TaskPlan
from mjhab.tasks.subtasks.registry import number_of


@pytest.fixture
def unregistered() -> Iterator[None]:
    yield
    OBJECTS.remove("my_mug")


@pytest.mark.parametrize(
    ("words", "called"),
    [
        (("mug",), {"mug"}),
        (("mug", "coffee mug"), {"mug", "coffee mug"}),
        ((), {"my mug"}),
    ],
)
def test_a_registered_object_is_called_by_its_words(
    words: tuple[str, ...], called: set[str], unregistered: None
) -> None:
    kind = dataclasses.replace(open_pack().objects["005_tomato_soup_can"], name="my_mug")
    register_object(ObjectModel(kind, words=words))
    layout = Layout(open_pack("builtin"), (*roster("set_table"), "my_mug"))
    maker = EpisodeMaker(CpuSimulator(layout, 1, 1), "set_table", "train")
    episode = maker.episode(0, 0)
    mug = "my_mug_:0000"
    way = Subtask(number_of("navigate"), mug, toward=f"{GOAL_OF}{mug}", must_hold=True)
    place = Subtask(number_of("place"), mug, goal_pos=episode.targets[0].goal_pos)
    plan = TaskPlan("set_table", (Subtask(number_of("pick"), mug), way, place))
    names = set()
    for index in range(12):
        told = Narrator(layout).instructions(
            dataclasses.replace(episode, index=index), plan, alone=False
        )
        for sentence in (*told.subtasks, told.task):
            found = sorted(
                (name for name in called if f"the {name} " in sentence), key=len
            )
            assert found, sentence
            names.add(found[-1])
    assert names == called


def test_words_of_an_object_are_a_tuple_of_texts() -> None:
    kind = open_pack().objects["005_tomato_soup_can"]
    for wrong, told in (("mug", "got the text 'mug'"), (("",), "must not be empty")):
        with pytest.raises(
            UsageError, match=f"object '005_tomato_soup_can': words .*{told}"
        ):
            ObjectModel(kind, words=wrong)  # type: ignore[arg-type]


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
    assert (
        told.subtasks[5].endswith("on the dining table") or "down on" in told.subtasks[5]
    )
    assert told.subtasks[11].endswith("the apple from the fridge")

    # The words are those of the episode: the same when asked again, others in other episodes.
    assert Narrator(layout).instructions(episode, plan, alone=False) == told
    others = [dataclasses.replace(episode, index=index) for index in range(1, 20)]
    assert (
        len({narrator.instructions(other, plan, alone=False).task for other in others})
        > 1
    )
