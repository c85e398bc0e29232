"""Instructions of episodes name the furniture that things really lie on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.narration import InstructionGenerator
from mjhab.episodes.narration.apart import Landmark, Mark, mark
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.scenes.objects import OBJECTS, ObjectModel, register_object
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import chain
from mjhab.tasks.instructions import with_article
from mjhab.tasks.plan import GOAL_OF, Subtask, TaskPlan
from mjhab.tasks.subtasks.registry import number_of
from tests.real_data import real_data
from tests.refusals import refused


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
        (("your mug",), {"your mug"}),
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
        told = InstructionGenerator(layout).instructions(
            dataclasses.replace(episode, index=index), plan, alone=False
        )
        for sentence in (*told.subtasks, told.task):
            said = {name: f" {with_article(name)} " for name in called}
            found = sorted((name for name in called if said[name] in sentence), key=len)
            assert found, sentence
            names.add(found[-1])
    assert names == called


def test_words_of_an_object_are_a_tuple_of_texts() -> None:
    kind = open_pack().objects["005_tomato_soup_can"]
    for wrong in ("mug", ("",)):
        with refused("words", wrong, where="object '005_tomato_soup_can'"):
            ObjectModel(kind, words=wrong)  # type: ignore[arg-type]


def test_set_table_names_drawer_fridge_and_table() -> None:
    layout = Layout(open_pack("builtin"), roster("set_table"))
    narrator = InstructionGenerator(layout)
    episode = EpisodeMaker(CpuSimulator(layout, 1, 1), "set_table", "train").episode(0, 0)
    plan = chain("set_table", episode.targets, episode.home)
    told = narrator.instructions(episode, plan, alone=False)
    assert len(told.subtasks) == len(plan.subtasks) == 16
    assert "bowl" in told.task and "apple" in told.task
    assert told.task.count("on the dining table") == 2
    assert told.subtasks[3].endswith(
        "the bowl from the top right drawer of the kitchen counter"
    )
    assert (
        told.subtasks[5].endswith("on the dining table") or "down on" in told.subtasks[5]
    )
    assert told.subtasks[11].endswith(
        "the apple from the second highest shelf of the fridge"
    )

    # The words are those of the episode: the same when asked again, others in other episodes.
    assert InstructionGenerator(layout).instructions(episode, plan, alone=False) == told
    others = [dataclasses.replace(episode, index=index) for index in range(1, 20)]
    assert (
        len({narrator.instructions(other, plan, alone=False).task for other in others})
        > 1
    )


def test_drawers_and_doors_are_told_by_where_they_are() -> None:
    layout = Layout(open_pack("builtin"), roster("set_table"))
    words = InstructionGenerator(layout)._words(layout.pack.homes[0].name)
    called = {link: words.link(link) for link in layout.link_ids}
    assert called == {
        "fridge/top_door": "top door of the fridge",
        "fridge/bottom_door": "bottom door of the fridge",
        "kitchen_counter/drawer1_top": "top left drawer of the kitchen counter",
        "kitchen_counter/drawer1_bottom": "bottom left drawer of the kitchen counter",
        "kitchen_counter/drawer2_top": "top middle drawer of the kitchen counter",
        "kitchen_counter/drawer2_middle": "central drawer of the kitchen counter",
        "kitchen_counter/drawer2_bottom": "bottom middle drawer of the kitchen counter",
        "kitchen_counter/drawer3": "top right drawer of the kitchen counter",
        "kitchen_counter/drawer4": "bottom right drawer of the kitchen counter",
    }


@pytest.mark.parametrize("folder", ["builtin", "replica_cad"])
def test_no_two_places_of_a_home_have_the_same_words(folder: str) -> None:
    pack = open_pack(folder if folder == "builtin" else str(real_data(folder)))
    layout = Layout(pack, ())
    narrator = InstructionGenerator(layout)
    for home in pack.homes[::10]:
        words = narrator._words(home.name)
        told = [words.spot(place).phrase() for place in words.receptacles]
        assert len(set(told)) == len(told), home.name


BOWLS = np.array([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0]])
SOFA = Landmark("the sofa", np.array([5.0, 0.0]))
MIDDLE = Landmark("the bed", np.array([0.3, 0.2]))


@pytest.mark.parametrize(
    ("order", "left", "near", "words"),
    [
        ((0, 1), (1.0, 0.0), (), Mark("right")),
        ((1, 0), (1.0, 0.0), (), Mark("left")),
        ((0, 1, 2), (1.0, 0.0), (), Mark("rightmost")),
        # Neither end; the bed is beside the middle.
        ((1, 0, 2), (1.0, 0.0), (), Mark(after="nearest to the bed")),
        ((2, 0, 1), None, (), Mark(after="nearest to the sofa")),
        ((0, 1, 2), None, (), Mark(after="furthest from the sofa")),
        ((1, 0, 2), None, (), Mark(after="second nearest to the sofa")),
        (
            (0, 1),
            None,
            (Landmark("the apple", np.array([-0.1, 0.0])),),
            Mark(after="nearest to the apple"),
        ),
    ],
)
def test_what_tells_things_apart(
    order: tuple[int, ...],
    left: tuple[float, float] | None,
    near: tuple[Landmark, ...],
    words: Mark,
) -> None:
    far = (SOFA,) if words.after != "nearest to the bed" else (SOFA, MIDDLE)
    towards = None if left is None else np.array(left)
    assert mark(BOWLS[list(order)], towards, near, far) == words


def test_things_in_one_place_cannot_be_told_apart() -> None:
    assert mark(np.zeros((2, 2)), np.array([1.0, 0.0]), (), (SOFA, MIDDLE)) is None


def test_words_that_hold_at_any_time_presuppose_no_other_thing() -> None:
    told = mark(BOWLS[[1, 0]], np.array([1.0, 0.0]), (), (SOFA,), superlatives=True)
    assert told == Mark(after="nearest to the sofa")
