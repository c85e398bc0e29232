"""Specification of a kind of subtask: one `SubtaskSpec` holds everything that is specific to the kind."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from string import Formatter
from typing import Any, Literal, get_args

import numpy as np

from mjhab.core.arrays import Array, value_text
from mjhab.core.errors import UsageError, about, fault, wrong_value
from mjhab.core.joints import GROUPS
from mjhab.core.names import check_texts
from mjhab.core.registration.plugins import raised_text
from mjhab.core.typed.checks import check, check_one_of
from mjhab.core.typed.options import take_types
from mjhab.tasks.label_state import WATCHED, LabelState, uneventful
from mjhab.tasks.rewards.table import RewardTable
from mjhab.tasks.signals import CHECKS, Active, WorldState
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

About = Literal["object", "link", "way"]
"""Type of a subtask's target: an object, a drawer or door, or a place to drive to."""

COMMON_CHECKS = frozenset(CHECKS) - {
    "at_goal",
    "opened",
    "closed",
    "slightly_opened",
    "slightly_closed",
    "near",
    "oriented",
}
"""Checks that apply to every kind; the others apply only to kinds that name them."""
AT_REST = ("ee_rest", "robot_rest", "is_static", "force_ok")
"""Conditions of success of most kinds: hand and joints at rest, no motion, force within its limit."""

RELEASES = ("released_at_goal", "released_outside_goal")
"""Edges of a release: the object is released at its goal, or elsewhere."""
EDGES: tuple[str, ...] = (
    *(f"+{name}" for name in WATCHED),
    *(f"-{name}" for name in WATCHED),
    *RELEASES,
    "none",
)
"""Edges of a step: rising (+) and falling (-) edge of every watched signal, the two kinds of release, and no edge."""
EVENT_EDGES: dict[str, str] = {
    "contact": "+contact",
    "lost_contact": "-contact",
    "grasped": "+is_grasped",
    "dropped": "-is_grasped",
    "at_goal": "+at_goal",
    "released_at_goal": "released_at_goal",
    "released_outside_goal": "released_outside_goal",
    "left_goal": "-at_goal",
    "navigated_close": "+near",
    "lost_navigated_close": "-near",
    "opened": "+opened",
    "slightly_opened": "+slightly_opened",
    "closed": "+closed",
    "slightly_closed": "+slightly_closed",
    "success": "+success",
    "lost_success": "-success",
    "excessive_collisions": "+excess",
}
"""Events that every subtask can use, with their edges."""

USUAL_JOINT_GROUPS = ("base", "arm", "fingers")
"""Joint groups that every robot needs: all actions command base, arm and gripper, and all observations have a tcp."""
USUAL_LIMITS = SubtaskConfig(horizon=200, force_limit=10000.0)

_TEXTS = (
    "words",
    "conditions",
    "arm_conditions",
    "checks",
    "events",
    "shows",
    "joint_groups",
)
"""Fields that are tuples of texts."""
_CHECKED_APART = (*_TEXTS, "about", "start", "expert")
"""Fields whose types are checked with their values."""
_NEEDED = {
    "words": 'words=("pick up {object}", ...), wordings of its instruction',
    "conditions": 'conditions=("at_goal", "is_static", ...), checks of mjhab.tasks.signals.CHECKS',
    "label_rules": 'label_rules=(LabelRule("done", lambda s: s.ever("success")), ..., LabelRule("failed"))',
    "start": "start=, an object of a subclass of mjhab.episodes.starts.SubtaskStart, or a reference to one",
}
"""Required fields, with an example for the error message."""
PLACEHOLDERS = ("object", "link", "destination", "source", "goal")
"""Placeholders in wordings of subtasks; `tasks.instructions` fills them in."""
_TRIED_WORLDS = 2
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_COLOR = re.compile(r"#[0-9a-fA-F]{6}")

Measure = Callable[[WorldState, Active, TaskConfig], Array]
"""(state, active, config) to (W,) bool; runs on numpy and torch (see `core.arrays.namespace`)."""


@dataclass(frozen=True)
class LabelRule:
    """One rule of a decision list.

    Attributes:
        label: name of the label.
        when: function from the state to the rule's condition, (W,) bool; None for the last rule, which always holds.
    """

    label: str
    when: Callable[[LabelState], Array] | None = None

    def holds(self, state: LabelState) -> Array:
        """(W,) bool: the rule gives its label if no earlier one does."""
        now = state.holds("success")
        return now | ~now if self.when is None else self.when(state)


@dataclass(frozen=True)
class PublishedLabels:
    """Labels of a subtask in the published code of MS-HAB, for comparison with its tables.

    Attributes:
        events: events that the rule reads.
        label: function from the list of events, whether the subtask succeeded, and whether the object was at its goal
            after the first action, to the label.
        columns: labels in the order of the columns i, ii, ... of the paper's tables (App. A.6); empty without a table.
    """

    events: tuple[str, ...]
    label: Callable[[Sequence[str], bool, bool], str]
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class SubtaskSpec:
    """A kind of subtask; `mjhab.register_subtask` registers it.

    Attributes:
        name: lower case, as in ``subtask="pick"``.
        words: wordings of its instruction, with {object}, {source}, {goal}, {link} or {destination}; see
            `tasks.instructions`.
        color: color in reports, "#rrggbb".
        about: type of its target: "object"; "link", a drawer or door, whose handle is observed and rewarded as the
            goal; or "way", a place to drive to, which the environment does with ``navigate="teleport"``.
        limits: horizon and force limit.
        train_horizon: horizon in `make_train`, None for that of ``limits``.
        conditions: checks (`signals.CHECKS`) that must hold together for success.
        arm_conditions: conditions that are dropped if `TaskConfig.ignore_arm` is set.
        checks: checks that apply to it besides `COMMON_CHECKS`, ``conditions`` and ``measures``.
        measures: functions that replace the common measure of a check, by the name of the check.
        label_rules: decision list; the last rule has no condition.
        published: labels of the published code, None if it lacks the subtask.
        events: names of its events, in their order within a step; from `EVENT_EDGES` or ``edges``.
        edges: edge (`EDGES`) of each event that is not in `EVENT_EDGES`, or differs from it.
        reward: the dense reward, None for none.
        shows: non-zero parts of the observation: "object" (pose of the object), "goal" (position of the goal).
        starts_holding: the robot starts with the object in its hand.
        rests_holding: the robot ends with the object in its hand; the arm may then be further from rest.
        keeps_goal: the object must stay at its goal in the rest of a plan.
        joint_groups: groups of joints (`core.joints.GROUPS`) that a robot needs for it.
        start: start states of home and robot: an `episodes.starts.SubtaskStart` or a reference "module:NAME" to one.
        expert: script ``(view) -> generator of actions``, or a reference to one; None if no expert can do it.

    Raises:
        UsageError: a required field is missing, or a field is invalid.
    """

    name: str = ""
    words: tuple[str, ...] = ()
    color: str = "#57534e"
    about: About = "object"
    limits: SubtaskConfig = USUAL_LIMITS
    train_horizon: int | None = None
    conditions: tuple[str, ...] = ()
    arm_conditions: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    measures: Mapping[str, Measure] = field(default_factory=dict)
    label_rules: tuple[LabelRule, ...] = ()
    published: PublishedLabels | None = None
    events: tuple[str, ...] = ("success", "excessive_collisions", "lost_success")
    edges: Mapping[str, str] = field(default_factory=dict)
    reward: RewardTable | None = None
    shows: tuple[str, ...] = ("object", "goal")
    starts_holding: bool = False
    rests_holding: bool = False
    keeps_goal: bool = False
    joint_groups: tuple[str, ...] = USUAL_JOINT_GROUPS
    start: Any = None
    expert: Any = None

    def __post_init__(self) -> None:
        take_types(self, _CHECKED_APART, f"subtask {self.name!r}")
        check(
            bool(_NAME.fullmatch(self.name)),
            "name of a subtask",
            self.name,
            "a name of lower-case letters, digits and _",
        )
        for name in _TEXTS:
            check_texts(name, getattr(self, name), f"subtask {self.name!r}")
        missing = [part for part in _NEEDED if not getattr(self, part)]
        if missing:
            raise UsageError(
                f"subtask {self.name!r} has no {' and no '.join(missing)}; give "
                f"{'; '.join(_NEEDED[part] for part in missing)}.",
                option=missing[0],
                where=f"subtask {self.name!r}",
            )
        self._check_limits()
        self._check_words()
        self._check_names()
        self._check_labels()

    def _check_limits(self) -> None:
        steps = {"horizon of limits": self.limits.horizon}
        if self.train_horizon is not None:
            steps["train_horizon"] = self.train_horizon
        for what, value in steps.items():
            if not isinstance(value, Integral) or value < 1:
                raise wrong_value(
                    what,
                    value,
                    "a whole number of control steps of at least 1",
                    where=f"subtask {self.name!r}",
                )
        force = self.limits.force_limit
        if not isinstance(force, Real) or not force > 0.0:
            raise wrong_value(
                "force_limit of limits",
                force,
                "a number above 0, or infinite",
                where=f"subtask {self.name!r}",
            )

    def _check_words(self) -> None:
        for wording in self.words:
            with about(f"subtask {self.name!r}: the wording {wording!r} cannot be read"):
                named = [
                    name
                    for _, name, _, _ in Formatter().parse(wording)
                    if name is not None
                ]
            for name in named:
                check_one_of(
                    f"placeholder of the wording {wording!r}:",
                    name,
                    PLACEHOLDERS,
                    where=f"subtask {self.name!r}: words",
                )

    def _check_names(self) -> None:
        for given, valid, kind in (
            ((self.about,), get_args(About), "about"),
            ((*self.conditions, *self.checks, *self.measures), CHECKS, "check"),
            (self.arm_conditions, self.conditions, "condition"),
            (self.shows, ("object", "goal"), "observation"),
            (self.events, (*EVENT_EDGES, *self.edges), "event"),
            (self.edges.values(), EDGES, "edge"),
            (self.edges, self.events, "event"),
            (self.joint_groups, GROUPS, "joint group"),
        ):
            for name in given:
                check_one_of(kind, name, valid, where=f"subtask {self.name!r}")
        if not _COLOR.fullmatch(self.color):
            raise wrong_value(
                "color", self.color, "like '#3b82f6'", where=f"subtask {self.name!r}"
            )
        for name, function in self.measures.items():
            if not callable(function):
                raise wrong_value(
                    f"the measure of {name!r}",
                    function,
                    "a function of (state, active, config)",
                    where=f"subtask {self.name!r}",
                )

    def _check_labels(self) -> None:
        conditions = [rule.when for rule in self.label_rules]
        check(
            conditions[-1] is None and None not in conditions[:-1],
            "label_rules",
            self.label_rules,
            "rules of which the last, and no other, is without a condition",
            "Then every episode has exactly one label.",
            f"subtask {self.name!r}",
        )
        check(
            len(set(self.labels)) == len(self.labels),
            "labels",
            self.labels,
            "different from each other",
            where=f"subtask {self.name!r}",
        )
        for rule in self.label_rules[:-1]:
            self._try_rule(rule)

    def _try_rule(self, rule: LabelRule) -> None:
        """Evaluate a rule on a state without events, so that a wrong name is refused before any episode.

        Raises:
            UsageError: the rule raises, or does not return one bool per world.
        """
        where = f"subtask {self.name!r}: label rule {rule.label!r}"
        try:
            given = rule.holds(uneventful(_TRIED_WORLDS))
        except UsageError as error:
            raise fault(where, str(error)) from error
        # A plugin's rule can raise any exception.
        except Exception as error:
            raise fault(where, f"raised {raised_text(error)}.") from error
        if not (isinstance(given, np.ndarray) and given.shape == (_TRIED_WORLDS,)) or (
            given.dtype != np.bool_
        ):
            raise fault(
                where,
                "must give one bool per world, shape (W,), as LabelState.ever and holds do; "
                f"got {value_text(given)}.",
            )

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels in the order of their rules; the code of a label is its index."""
        return tuple(rule.label for rule in self.label_rules)

    @property
    def navigates(self) -> bool:
        """Whether it is a drive to a place."""
        return self.about == "way"

    @property
    def jointed(self) -> bool:
        """Whether it moves the joint of a drawer or door."""
        return self.about == "link"

    @property
    def opens_link(self) -> bool:
        """Whether a success leaves a drawer or door open."""
        return self.jointed and "opened" in self.conditions

    @property
    def closes_link(self) -> bool:
        """Whether a success leaves a drawer or door closed."""
        return self.jointed and "closed" in self.conditions

    @property
    def aims_at_goal(self) -> bool:
        """Whether the hand's target is the observed goal: a handle, or where the object goes; else the object."""
        return "goal" in self.shows

    @property
    def brings_to_goal(self) -> bool:
        """Whether a success leaves its object at its goal."""
        return "at_goal" in self.conditions

    @property
    def may_hold(self) -> bool:
        """Whether the robot may start it with an object in its hand."""
        return self.starts_holding or self.navigates

    def applies(self, check: str) -> bool:
        """Whether a check applies to it; a check that does not apply is False."""
        return check in COMMON_CHECKS or check in (
            *self.checks,
            *self.conditions,
            *self.measures,
        )

    def needs(self, ignore_arm: bool) -> tuple[str, ...]:
        """The conditions of success; ``ignore_arm``: without ``arm_conditions``."""
        dropped = self.arm_conditions if ignore_arm else ()
        return tuple(name for name in self.conditions if name not in dropped)

    def edge(self, event: str) -> str:
        """Edge of an event; "none" if the kind does not have the event."""
        if event not in self.events:
            return "none"
        return self.edges.get(event) or EVENT_EDGES[event]
