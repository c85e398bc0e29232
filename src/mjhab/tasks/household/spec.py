"""What a household task is: one `TaskSpec` says which objects go where, and by which subtasks."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.names import check_texts
from mjhab.tasks.household.steps import open_goal, open_start, pick_and_place
from mjhab.tasks.plan import Subtask, Target, TaskPlan
from mjhab.tasks.subtasks.registry import subtask_names

MIN_START_GOAL_M = 0.5
"""Smallest distance between where an object starts and its goal (HAB generator constant)."""

Opens = Literal["", "start", "goal"]
Chain = Callable[[Target], list[Subtask]]
_CHAINS: dict[str, Chain] = {"": pick_and_place, "start": open_start, "goal": open_goal}
_NEEDED = {
    "words": 'words=("set the table", ...), wordings of its name',
    "targets": 'targets=(TargetRule(start=("sink",), goal=("counter_top",)), ...), one per object that is handled',
}
"""Fields that have no default, and what to give."""
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_SAMPLE = Target("object", (0.0, 0.0, 0.0), start_link="link", goal_link="link")


@dataclass(frozen=True)
class TargetRule:
    """How one target of a task is drawn, and what is done with it.

    start, goal: roles of the receptacles that it starts on and goes to (`scenes.roles`), drawn by their area.
    object: its type; "" draws any object of the roster.
    opens: the plan opens the drawer or door of the "start" or of the "goal" before and closes it after; "" leaves doors
    as they are. link: role of that drawer or door.
    chain: other subtasks than these. distance_m: smallest and largest distance between start and goal.
    """

    start: tuple[str, ...]
    goal: tuple[str, ...]
    object: str = ""
    opens: Opens = ""
    link: str = ""
    chain: Chain | None = None
    distance_m: tuple[float, float] = (MIN_START_GOAL_M, math.inf)

    def __post_init__(self) -> None:
        if self.opens not in get_args(Opens):
            raise unknown_name("opens of a TargetRule", self.opens, get_args(Opens))
        check_texts("start of a TargetRule", self.start)
        check_texts("goal of a TargetRule", self.goal)
        if not self.start or not self.goal:
            raise UsageError("a TargetRule needs roles of receptacles for its start and its goal.")
        if bool(self.opens) != bool(self.link):
            raise UsageError(
                "a TargetRule that opens something needs the role of the link, and no other does."
            )

    def subtasks(self, target: Target) -> list[Subtask]:
        """What is done with a target."""
        return (self.chain or _CHAINS[self.opens])(target)


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """A household task. Registering one (`mjhab.register_task`) makes it known to all of mjhab.

    Attributes:
        name: lower case, as in ``task="set_table"``. words: wordings of its name in instructions (`instructions`).
        targets: one rule per target, in the order in which they are handled.
        objects: types of the objects that the roster has beside the clutter. clutter_copies: how many of every clutter
            type it has.
        openings: (role, joint position [rad or m]) of links that stand open from the start.
        shelf_region: share of a shelf behind a door, about its centre, in which objects stand; in HAB it is 0.5
            (sample_region_ratio). shelf_clutter: how many clutter objects may stand there.
        departs_from_last_goal: a Navigate done alone begins where the plan was before, not anywhere in the home.
    """

    name: str = ""
    words: tuple[str, ...] = ()
    targets: tuple[TargetRule, ...] = ()
    objects: tuple[str, ...] = ()
    clutter_copies: int = 3
    openings: tuple[tuple[str, float], ...] = ()
    shelf_region: float = 0.5
    shelf_clutter: int = 0
    departs_from_last_goal: bool = False

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise UsageError(
                f"a task needs a name of lower-case letters, digits and _, got {self.name!r}."
            )
        for name in ("words", "objects"):
            check_texts(f"task {self.name!r}: {name}", getattr(self, name))
        missing = [part for part in _NEEDED if not getattr(self, part)]
        if missing:
            raise UsageError(
                f"task {self.name!r} has no {' and no '.join(missing)}; "
                f"give {'; '.join(_NEEDED[part] for part in missing)}."
            )
        for k, rule in enumerate(self.targets):
            if not isinstance(rule, TargetRule):
                raise UsageError(
                    f"task {self.name!r}: targets[{k}] must be a TargetRule, got {type(rule).__name__}."
                )

    @property
    def roles(self) -> tuple[str, ...]:
        """Roles of the furniture it needs: of receptacles, then of links; without repeats."""
        places = (role for rule in self.targets for role in (*rule.start, *rule.goal))
        links = (*self.opened_links, *(role for role, _ in self.openings))
        return tuple(dict.fromkeys((*places, *links)))

    @property
    def opened_links(self) -> tuple[str, ...]:
        """Roles of the drawers and doors that its plan opens, without repeats."""
        return tuple(dict.fromkeys(rule.link for rule in self.targets if rule.link))

    @property
    def object_types(self) -> tuple[str, ...]:
        """Types of its targets, without repeats; empty where any object of the roster may be one."""
        types = tuple(dict.fromkeys(rule.object for rule in self.targets))
        return () if "" in types else types

    @cached_property
    def subtasks(self) -> tuple[str, ...]:
        """Names of the kinds of subtasks in its plan, in the order of their numbers."""
        used = {subtask.name for rule in self.targets for subtask in rule.subtasks(_SAMPLE)}
        return tuple(name for name in subtask_names() if name in used)

    @cached_property
    def length(self) -> int:
        """Number of subtasks of its plan."""
        return sum(len(rule.subtasks(_SAMPLE)) for rule in self.targets)

    def plan(self, targets: Sequence[Target], home: str = "") -> TaskPlan:
        """The plan for the targets of an episode (MS-HAB paper Sec. 3.2, mshab/utils/gen/gen_task_plans.py).

        Args:
            targets: in the order of the rules; imported episodes may have fewer.
            home: name of the home, carried along.

        Raises:
            UsageError: no targets or too many, or one without a link that its rule opens.
        """
        if not 1 <= len(targets) <= len(self.targets):
            raise UsageError(
                f"{self.name} handles 1 to {len(self.targets)} objects, got {len(targets)} targets."
            )
        try:
            subtasks = [
                subtask
                for rule, target in zip(self.targets, targets, strict=False)
                for subtask in rule.subtasks(target)
            ]
        except UsageError as error:
            raise UsageError(f"{self.name}: {error}") from error
        return TaskPlan(self.name, tuple(subtasks), home)
