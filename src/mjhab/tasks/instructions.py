"""Instructions: sentences for subtasks and tasks, such as "put the soup can on the coffee table".

Wordings of subtasks and tasks are in their specs; names of objects and furniture are here. Each sentence has several
wordings; an episode draws one from its own random stream, so that seed and index determine it. Sentences are in lower
case and without a full stop, like the prompts on which vision-language-action models are trained.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjhab.core.names import kind_of
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS

BY_TELEPORT = " (by teleport)"
"""Suffix of the sentences of navigation by teleport, and of tasks with such navigation."""
MAX_INSTRUCTION_CHARACTERS = 1000
"""Greatest length of an instruction that is read from a file."""

OBJECT_WORDS: dict[str, tuple[str, ...]] = {
    "002_master_chef_can": ("coffee can", "master chef can"),
    "003_cracker_box": ("cracker box", "box of crackers"),
    "004_sugar_box": ("sugar box", "box of sugar"),
    "005_tomato_soup_can": ("soup can", "tomato soup can"),
    "007_tuna_fish_can": ("tuna can", "tuna fish can"),
    "008_pudding_box": ("pudding box", "box of pudding"),
    "009_gelatin_box": ("gelatin box", "box of gelatin"),
    "010_potted_meat_can": ("meat can", "potted meat can"),
}
"""Names of object types; one that is not here is called by its id, "024_bowl" by "bowl"."""
FURNITURE_WORDS: dict[str, str] = {
    "chair_01": "chair",
    "table_01": "dining table",
    "table_02": "coffee table",
    "tvstand": "TV stand",
}
"""Names of furniture; one that is not here is called by its id, "kitchen_counter" by "kitchen counter"."""
LINK_WORDS: dict[str, str] = {
    "fridge/top_door": "fridge",
    "fridge/bottom_door": "lower door of the fridge",
}
"""Names of links that open; another one is called like "drawer 3 of the kitchen counter"."""

CARRY_WORDINGS: tuple[str, ...] = (
    "carry {object} to {destination}",
    "bring {object} to {destination}",
)
"""Wordings of a navigation with an object in the hand."""
Draw = Callable[[int], int]
"""Chooses one of n wordings by its number, 0 to n - 1."""


@dataclass(frozen=True)
class Spot:
    """Where an object lies or belongs: the id of the furniture, "" if unknown, and whether it is inside of it."""

    furniture: str = ""
    inside: bool = False

    @property
    def words(self) -> str:
        """The furniture in words: "the coffee table"."""
        return f"the {furniture_words(self.furniture)}" if self.furniture else ""

    def phrase(self, unknown: str = "") -> str:
        """ "on the coffee table", "in the fridge"; ``unknown`` where the furniture is not known."""
        if not self.furniture:
            return unknown
        return f"{'in' if self.inside else 'on'} {self.words}"


@dataclass(frozen=True)
class Request:
    """Content of a subtask's sentence.

    Attributes:
        kind: name of the kind of subtask.
        target: target as in a plan (`Subtask.target`).
        source: where the object lies.
        goal: where the object belongs.
        names: names of the target's type, such as ("mug", "coffee mug"); () for those of `target_words`.
    """

    kind: str
    target: str
    source: Spot = Spot()
    goal: Spot = Spot()
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Instructions:
    """The sentences of an episode: ``task`` for all of it, ``subtasks`` one per subtask of the plan."""

    task: str
    subtasks: tuple[str, ...]


def first_wording(count: int) -> int:
    """The `Draw` that always takes the first wording."""
    return 0


def seeded_draw(random: np.random.Generator) -> Draw:
    """A `Draw` from a stream of random numbers."""
    return lambda count: int(random.integers(count))


def instructions(
    task: str, requests: Sequence[Request], alone: bool, draw: Draw
) -> Instructions:
    """Make the sentences of an episode.

    Args:
        task: name of the household task.
        requests: subtasks of the plan, in order.
        alone: the episode consists of the first subtask alone.
        draw: chooses the wordings.

    Raises:
        UsageError: an unknown task, or an unknown kind of subtask.
    """
    subtasks = tuple(subtask_instruction(request, draw) for request in requests)
    return Instructions(
        subtasks[0] if alone else task_instruction(task, requests, draw), subtasks
    )


def by_teleport(sentence: str) -> str:
    """``sentence`` with `BY_TELEPORT` at its end, for a navigation that the environment does."""
    return sentence if sentence.endswith(BY_TELEPORT) else sentence + BY_TELEPORT


def with_teleports(told: Instructions, kinds: Sequence[str]) -> Instructions:
    """Mark the sentences of an episode in which the environment does the navigation by teleports.

    Args:
        told: sentences for a robot that drives.
        kinds: kinds of the subtasks, in order of the plan.
    """
    ways = [SUBTASKS[kind].navigates for kind in kinds]
    if not any(ways):
        return told
    subtasks = [
        by_teleport(sentence) if way else sentence
        for sentence, way in zip(told.subtasks, ways, strict=True)
    ]
    return Instructions(by_teleport(told.task), tuple(subtasks))


def subtask_instruction(request: Request, draw: Draw = first_wording) -> str:
    """One subtask as a sentence.

    Raises:
        UsageError: an unknown kind.
    """
    carries = request.target.startswith(GOAL_OF)
    wordings = CARRY_WORDINGS if carries else SUBTASKS[request.kind].words
    target = request.target.removeprefix(GOAL_OF)
    thing = target_words(target, draw, request.names)
    destination = f"{thing} {request.source.phrase()}"
    if carries:
        destination = request.goal.words or "its goal"
    source = f"from {request.source.words}" if request.source.furniture else ""
    sentence = wordings[draw(len(wordings))].format(
        object=thing,
        link=thing,
        destination=destination,
        source=source,
        goal=request.goal.phrase("at its goal"),
    )
    return " ".join(sentence.split())


def task_instruction(
    task: str, requests: Sequence[Request], draw: Draw = first_wording
) -> str:
    """A whole task as a sentence: "set the table: put the bowl on the dining table, then ...".

    Raises:
        UsageError: an unknown task.
    """
    wordings = TASKS[task].words
    name = wordings[draw(len(wordings))]
    moves = [
        f"put {target_words(request.target, draw, request.names)} {request.goal.phrase('at its goal')}"
        for request in requests
        if SUBTASKS[request.kind].brings_to_goal
    ]
    return f"{name}: {', then '.join(moves)}" if moves else name


def target_words(target: str, draw: Draw = first_wording, own: Sequence[str] = ()) -> str:
    """A target in words: "the bowl" for "024_bowl_:0003", "drawer 3 of the kitchen counter" for a link.

    ``own``: names of its type, in place of those of `OBJECT_WORDS`.
    """
    kind = kind_of(target)
    if "/" in kind:
        return _link_words(kind)
    names = tuple(own) or OBJECT_WORDS.get(kind) or (_plain_words(kind),)
    return f"the {names[draw(len(names))]}"


def furniture_words(furniture: str) -> str:
    """A piece of furniture in words, without an article."""
    return FURNITURE_WORDS.get(furniture) or _plain_words(furniture)


def _link_words(link: str) -> str:
    if link in LINK_WORDS:
        return f"the {LINK_WORDS[link]}"
    furniture, _, part = link.rpartition("/")
    words = _plain_words(part)
    article = "" if words[-1:].isdigit() else "the "
    return f"{article}{words} of the {furniture_words(furniture)}"


def _plain_words(name: str) -> str:
    """An id as words: "drawer3" as "drawer 3", "024_bowl" as "bowl"."""
    words = re.sub(r"^\d+_", "", name).replace("_", " ")
    return re.sub(r"(?<=[a-z])(?=\d)", " ", words)
