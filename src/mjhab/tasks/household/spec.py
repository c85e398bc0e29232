"""Specification of household tasks: which objects are moved, from where to where, by which subtasks."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

from mjhab.core.errors import (
    UsageError,
    about,
    unknown_name,
    wrong_type,
    wrong_value,
)
from mjhab.core.names import check_texts
from mjhab.core.typed.checks import check
from mjhab.core.typed.options import take_types
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
"""Required fields, with an example for the error message."""
_NAME = re.compile(r"[a-z][a-z0-9_]*")
# With links, so that chains which open something can be tried on it as well.
_SAMPLE = Target("object", (0.0, 0.0, 0.0), start_link="link", goal_link="link")


@dataclass(frozen=True)
class TargetRule:
    """Rule for one target of a task: how it is sampled, and the subtasks that move it.

    Attributes:
        start: roles of the receptacles on which the object starts (`scenes.roles`), sampled by their area.
        goal: roles of the receptacles on which its goal is, sampled by their area.
        object: object type; "" samples any object of the roster.
        opens: "start" or "goal": the plan opens the drawer or door there before and closes it after; "" opens none.
        link: role of that drawer or door.
        chain: function from a target to its subtasks, in place of the usual ones.
        distance_m: smallest and largest distance between start and goal [m].

    Raises:
        UsageError: an unknown ``opens``, no roles, ``opens`` without ``link`` or the reverse, or a field has another
            type.
    """

    start: tuple[str, ...]
    goal: tuple[str, ...]
    object: str = ""
    opens: Opens = ""
    link: str = ""
    chain: Chain | None = None
    distance_m: tuple[float, float] = (MIN_START_GOAL_M, math.inf)

    def __post_init__(self) -> None:
        take_types(self, ("start", "goal", "opens", "distance_m"), "a TargetRule")
        # `take_types` leaves it out, because an unknown word deserves the list of words.
        if self.opens not in get_args(Opens):
            raise unknown_name("opens of a TargetRule", self.opens, get_args(Opens))
        # A single role that is given as a text would be read letter by letter.
        check_texts("start", self.start, "a TargetRule")
        check_texts("goal", self.goal, "a TargetRule")
        for name in ("start", "goal"):
            check(
                bool(getattr(self, name)),
                name,
                getattr(self, name),
                "one role of receptacles or more",
                where="a TargetRule",
            )
        check(
            bool(self.opens) == bool(self.link),
            "link",
            self.link,
            "the role of the link that is opened, if one is, and empty otherwise",
            where="a TargetRule",
        )
        check(
            _is_range(self.distance_m),
            "distance_m",
            self.distance_m,
            "the smallest and the largest distance [m], as in (0.5, 2.0)",
            where="a TargetRule",
        )

    def subtasks(self, target: Target) -> list[Subtask]:
        """Subtasks for a target, in order."""
        return (self.chain or _CHAINS[self.opens])(target)


def _is_range(given: Any) -> bool:
    """Whether something is a pair of numbers, 0 <= least <= most; the second may be infinite."""
    numbers = isinstance(given, tuple | list) and all(
        isinstance(number, int | float) for number in given
    )
    return numbers and len(given) == 2 and 0.0 <= given[0] <= given[1]


@dataclass(frozen=True, eq=False)
class TaskSpec:
    """A household task; `mjhab.register_task` registers it.

    Attributes:
        name: lower case, as in ``task="set_table"``.
        words: wordings of its name in instructions (`instructions`).
        targets: one rule per target, in the order of the plan.
        objects: object types in the roster besides the clutter.
        clutter_copies: number of objects of every clutter type in the roster.
        openings: (role, joint position [rad or m]) of links that are open at the start.
        shelf_region: share of a shelf behind a door, about its centre, in which objects are placed; in HAB it is 0.5
            (sample_region_ratio).
        shelf_clutter: largest number of clutter objects on such a shelf.
        departs_from_last_goal: a single Navigate starts at the goal of the subtask before, not anywhere in the home.

    Raises:
        UsageError: an invalid name, a required field is missing, or a field has another type or is out of its range.
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
        take_types(self, ("words", "objects", "targets"), f"task {self.name!r}")
        check(
            bool(_NAME.fullmatch(self.name)),
            "name of a task",
            self.name,
            "a name of lower-case letters, digits and _",
        )
        for name in ("words", "objects"):
            check_texts(name, getattr(self, name), f"task {self.name!r}")
        missing = [part for part in _NEEDED if not getattr(self, part)]
        if missing:
            raise UsageError(
                f"task {self.name!r} has no {' and no '.join(missing)}; give "
                f"{'; '.join(_NEEDED[part] for part in missing)}.",
                option=missing[0],
                where=f"task {self.name!r}",
            )
        self._check_numbers()
        if not isinstance(self.targets, tuple | list):
            raise wrong_value(
                "targets",
                self.targets,
                "a tuple of TargetRules",
                where=f"task {self.name!r}",
            )
        for k, rule in enumerate(self.targets):
            if not isinstance(rule, TargetRule):
                raise wrong_type(
                    f"targets[{k}]", rule, "a TargetRule", where=f"task {self.name!r}"
                )

    def _check_numbers(self) -> None:
        for name in ("clutter_copies", "shelf_clutter"):
            if getattr(self, name) < 0:
                raise wrong_value(
                    name, getattr(self, name), "at least 0", where=f"task {self.name!r}"
                )
        check(
            0.0 < self.shelf_region <= 1.0,
            "shelf_region",
            self.shelf_region,
            "a share above 0 and up to 1",
            where=f"task {self.name!r}",
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
        # One rule for any object makes the whole roster possible.
        return () if "" in types else types

    @cached_property
    def subtasks(self) -> tuple[str, ...]:
        """Names of the kinds of subtasks in its plan, in the order of their numbers."""
        return tuple(name for name in subtask_names() if name in self.kinds)

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Names of the kinds of the subtasks of its plan, in the order of the plan."""
        return tuple(
            subtask.name for rule in self.targets for subtask in rule.subtasks(_SAMPLE)
        )

    @cached_property
    def length(self) -> int:
        """Number of subtasks of its plan."""
        return len(self.kinds)

    def plan(self, targets: Sequence[Target], home: str = "") -> TaskPlan:
        """Make the plan for the targets of an episode (MS-HAB paper Sec. 3.2, mshab/utils/gen/gen_task_plans.py).

        Args:
            targets: one per rule, in their order; imported episodes may have fewer.
            home: name of the home, stored in the plan.

        Raises:
            UsageError: no targets or too many, or one without a link that its rule opens.
        """
        check(
            1 <= len(targets) <= len(self.targets),
            f"number of targets of {self.name}",
            len(targets),
            f"1 to {len(self.targets)}",
        )
        # The chain may be a plugin's, and its error should tell which task it is of.
        with about(self.name, UsageError):
            subtasks = [
                subtask
                # Not strict: an episode of a file may have fewer targets than the task.
                for rule, target in zip(self.targets, targets, strict=False)
                for subtask in rule.subtasks(target)
            ]
        return TaskPlan(self.name, tuple(subtasks), home)
