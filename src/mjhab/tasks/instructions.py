"""Instructions: sentences for subtasks and tasks, such as "put the soup can on the coffee table".

Wordings of subtasks and tasks are in their specs; names of objects and furniture are here; where things are and what
tells them from others, `episodes.narration` finds out. A sentence is true at the start of its subtask if the subtasks
before it succeeded, and one thing only fits its words. Each sentence has several wordings; an episode draws one from
its own random stream, so that seed and index determine it. Sentences are in lower case (but for names) and without a
full stop, like the prompts on which vision-language-action models are trained.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from mjhab.core.names import kind_of
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import GOAL_OF
from mjhab.tasks.subtasks.registry import SUBTASKS

BY_TELEPORT = " (by teleport)"
"""End of sentences in older records, where the environment did the navigation."""
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
    "tv": "TV",
    "tv_screen": "TV screen",
    "tvstand": "TV stand",
}
"""Names of furniture; one that is not here is called by its id, "kitchen_counter" by "kitchen counter"."""
CARRY_WORDINGS: tuple[str, ...] = (
    "carry {object} to {destination}",
    "bring {object} to {destination}",
)
"""Wordings of a navigation with an object in the hand."""
Draw = Callable[[int], int]
"""Chooses one of n wordings by its number, 0 to n - 1."""
_DETERMINERS = frozenset(
    ["a", "an", "the", "my", "your", "his", "her", "its", "our", "their", "this", "that"]
)
_JOINING = frozenset(
    [
        "at",
        "for",
        "from",
        "in",
        "into",
        "it",
        "of",
        "off",
        "on",
        "onto",
        "out",
        "to",
        "up",
        "with",
    ]
)
"""Words that tell nothing alone, and that other languages have, too."""
_MOST_DIGITS = 3
"""An id with more digits between its letters is a code, no words."""


@dataclass(frozen=True)
class Spot:
    """Where an object lies or belongs, in words: "on" "the coffee table"; ``words`` are "" if it is not known."""

    words: str = ""
    preposition: str = "on"

    def phrase(self, unknown: str = "") -> str:
        """ "on the coffee table", "in the sink of the kitchen counter"; ``unknown`` where it is not known."""
        return f"{self.preposition} {self.words}" if self.words else unknown


@dataclass(frozen=True)
class InstructionRequest:
    """Content of a subtask's sentence.

    Attributes:
        kind: name of the kind of subtask.
        target: target as in a plan (`Subtask.target`).
        source: where the object lies.
        goal: where the object belongs.
        names: names of the target's type, such as ("mug", "coffee mug"); () for those of `target_words`. Of a link its
            name in words, "top right drawer of the kitchen counter".
        before, after: what tells the object from others of its name: "left" in "the left bowl", "nearest to the fridge"
            in "the bowl nearest to the fridge".
    """

    kind: str
    target: str
    source: Spot = Spot()
    goal: Spot = Spot()
    names: tuple[str, ...] = ()
    before: str = ""
    after: str = ""

    @property
    def carries(self) -> bool:
        """Whether it is a navigation to the goal of the object in the hand."""
        return self.target.startswith(GOAL_OF)

    @property
    def holds(self) -> bool:
        """Whether the object is in the hand, so that its name alone tells which one it is."""
        return self.carries or SUBTASKS[self.kind].starts_holding

    @property
    def stays(self) -> bool:
        """Whether the object's goal is where it lies, as far as the words go."""
        return bool(self.source.words) and self.source == self.goal


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
    task: str,
    requests: Sequence[InstructionRequest],
    whole: Sequence[InstructionRequest],
    draw: Draw,
) -> Instructions:
    """Make the sentences of an episode.

    Args:
        task: name of the household task.
        requests: subtasks of the plan, in order.
        whole: the same for the sentence of the task, which is read at the start; empty where the episode consists of
            the first subtask alone.
        draw: chooses the wordings.

    Raises:
        UsageError: an unknown task, or an unknown kind of subtask.
    """
    subtasks = tuple(subtask_instruction(request, draw) for request in requests)
    return Instructions(
        task_instruction(task, whole, draw) if whole else subtasks[0], subtasks
    )


def without_teleport_mark(sentence: str) -> str:
    """A recorded sentence without "(by teleport)", which is nothing that a robot is asked to do."""
    return sentence.removesuffix(BY_TELEPORT)


def subtask_instruction(request: InstructionRequest, draw: Draw = first_wording) -> str:
    """One subtask as a sentence.

    An object that is not in the hand is told by where it lies and by what tells it from others, also where the wording
    has neither {source} nor {destination}.

    Raises:
        UsageError: an unknown kind.
    """
    wordings = CARRY_WORDINGS if request.carries else SUBTASKS[request.kind].words
    thing = _thing(request, draw, plain=request.holds)
    wording = wordings[draw(len(wordings))]
    destination = f"{thing} {request.source.phrase()}"
    # Always some words: a wording with an empty place would be no sentence.
    goal = request.goal.phrase("at its goal")
    if request.carries:
        destination = request.goal.words or "its goal"
    elif not request.holds:
        if "{goal}" in wording:
            goal = _moved_to(request)
        names_place = any(place in wording for place in ("{source}", "{destination}"))
        if not names_place and not ("{goal}" in wording and request.stays):
            thing = destination
    sentence = wording.format(
        object=thing,
        link=thing,
        destination=destination,
        source=f"from {request.source.words}" if request.source.words else "",
        goal=goal,
    )
    # Empty parts leave double spaces.
    return " ".join(sentence.split())


def subtask_wordings(request: InstructionRequest) -> tuple[str, ...]:
    """All sentences that `subtask_instruction` makes of one subtask, each once; the first wording comes first.

    Raises:
        UsageError: an unknown kind.
    """
    found: dict[str, None] = {}
    waiting: list[tuple[int, ...]] = [()]
    for begun in waiting:
        counts: list[int] = []

        def draw(
            count: int, begun: tuple[int, ...] = begun, counts: list[int] = counts
        ) -> int:
            counts.append(count)
            return begun[len(counts) - 1] if len(counts) <= len(begun) else 0

        # A dict as an ordered set: some wordings are equal for targets without a place.
        found[subtask_instruction(request, draw)] = None
        # What this run drew beyond ``begun`` was 0 each time: every other number begins a run of its own.
        for k in range(len(begun), len(counts)):
            zeros = (0,) * (k - len(begun))
            waiting += [(*begun, *zeros, other) for other in range(1, counts[k])]
    return tuple(found)


def task_instruction(
    task: str, requests: Sequence[InstructionRequest], draw: Draw = first_wording
) -> str:
    """A whole task as a sentence: "set the table: put the bowl from the top right drawer of the kitchen counter on the
    dining table, then ...".

    Raises:
        UsageError: an unknown task.
    """
    wordings = TASKS[task].words
    name = wordings[draw(len(wordings))]
    moves = [
        _move(request, draw)
        for request in requests
        if SUBTASKS[request.kind].brings_to_goal
    ]
    return f"{name}: {', then '.join(moves)}" if moves else name


def _move(request: InstructionRequest, draw: Draw) -> str:
    """One object of a task: where it is and where it belongs."""
    thing = _thing(request, draw)
    # "put the bowl from the table on the table" would say nothing.
    if request.stays:
        return f"move {thing} {request.source.phrase()} to another place there"
    source = f"from {request.source.words}" if request.source.words else ""
    return " ".join(f"put {thing} {source} {request.goal.phrase('at its goal')}".split())


def _moved_to(request: InstructionRequest) -> str:
    """Goal of an object that is moved without being held."""
    if request.stays:
        return f"to another place {request.goal.phrase()}"
    return f"to {request.goal.words or 'its goal'}"


def _thing(request: InstructionRequest, draw: Draw, plain: bool = False) -> str:
    """The target with what tells it apart, or without if ``plain``."""
    target = request.target.removeprefix(GOAL_OF)
    name = target_name(target, draw, request.names)
    if plain:
        return with_article(name)
    return f"{with_article(name, request.before)} {request.after}".strip()


def target_words(target: str, draw: Draw = first_wording, own: Sequence[str] = ()) -> str:
    """A target in words: "the bowl" for "024_bowl_:0003", "the left door of the cabinet" for a link.

    ``own``: names of its type, in place of those of `OBJECT_WORDS`.
    """
    return with_article(target_name(target, draw, own))


def target_name(target: str, draw: Draw = first_wording, own: Sequence[str] = ()) -> str:
    """`target_words` without the article."""
    names = tuple(own) or names_of(kind_of(target))
    return names[draw(len(names))]


def names_of(kind: str) -> tuple[str, ...]:
    """Names of an object type, or of a link of which nothing but its id is known."""
    if kind in OBJECT_WORDS:
        return OBJECT_WORDS[kind]
    furniture, _, part = kind.rpartition("/")
    if furniture:
        return (f"{plain_words(part)} of the {furniture_words(furniture)}",)
    return (plain_words(kind, "object"),)


def with_article(name: str, before: str = "") -> str:
    """A name with "the", unless it has an article or an owner: "my mug", "Ada's mug"; ``before``: an adjective."""
    first, _, rest = name.partition(" ")
    # Only with something behind it: a thing may be called "that" alone.
    if rest and (first.lower() in _DETERMINERS or first.endswith(("'s", "’s"))):
        return " ".join(f"{first} {before} {rest}".split())
    return " ".join(f"the {before} {name}".split())


def furniture_words(furniture: str) -> str:
    """A piece of furniture in words, without an article."""
    return FURNITURE_WORDS.get(furniture) or plain_words(furniture, "piece of furniture")


@cache
def plain_words(name: str, code: str = "thing") -> str:
    """An id as words, without numbers that only tell copies and versions: "drawer3" as "drawer", "024_bowl" as "bowl",
    "my_mug_2" as "my mug", "chestOfDrawers_01" as "chest of drawers".

    ``code``: what to say for an id without words, such as a hash.
    """
    # YCB ids begin with a number, such as 024 and 065-a.
    words = re.sub(r"^\d+(-[a-z])?_", "", name)
    # ReplicaCAD writes some names in camel case.
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", words)
    words = re.sub(r"[_\W]+", " ", words)
    # Before the numbers at the end are cut, so that those without a separator go, too.
    words = re.sub(r"(?<=[A-Za-z])(?=\d)", " ", words).lower()
    words = re.sub(r"( \d+)+$", "", words.strip())
    digits = sum(letter.isdigit() for letter in words)
    return code if not words or words.isdigit() or digits > _MOST_DIGITS else words


def telling_words(sentence: str) -> frozenset[str]:
    """The words of a sentence that say something alone, in lower case: no article, no preposition, no number."""
    words = frozenset(re.findall(r"[^\W\d_]+", sentence.lower()))
    return words - _DETERMINERS - _JOINING


def vocabulary(things: Iterable[str]) -> frozenset[str]:
    """`telling_words` of the wordings of all subtasks and of the names of ``things``, object types or ids of links."""
    wordings = [words for spec in SUBTASKS.values() for words in spec.words]
    names = [name for thing in things for name in names_of(thing)]
    sentences = [*wordings, *CARRY_WORDINGS, *names]
    return frozenset().union(
        *(telling_words(re.sub(r"{\w+}", "", each)) for each in sentences)
    )
