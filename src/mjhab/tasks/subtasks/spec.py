"""What a kind of subtask is: one `SubtaskSpec` says everything that the rest of mjhab asks about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from string import Formatter
from typing import Any, Literal, get_args

import numpy as np

from mjhab.core.arrays import Array, value_text
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.joints import GROUPS
from mjhab.core.names import check_texts
from mjhab.core.registration.plugins import raised_text
from mjhab.tasks.labelling.state import WATCHED, LabelState, uneventful
from mjhab.tasks.rewards.table import RewardTable
from mjhab.tasks.signals import CHECKS, Active, WorldState
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig

About = Literal["object", "link", "way"]
"""What a subtask is about: an object, a drawer or door, or a place to drive to."""

COMMON_CHECKS = frozenset(CHECKS) - {
    "at_goal",
    "opened",
    "closed",
    "slightly_opened",
    "slightly_closed",
    "near",
    "oriented",
}
"""Checks that mean something for every kind; the others only for the kinds that name them in ``checks``."""
AT_REST = ("ee_rest", "robot_rest", "is_static", "force_ok")
"""Conditions that most kinds end with: hand and joints at rest, nothing moves, the force is within its limit."""

RELEASES = ("released_at_goal", "released_outside_goal")
"""The object is let go: at its goal, elsewhere."""
EDGES: tuple[str, ...] = (
    *(f"+{name}" for name in WATCHED),
    *(f"-{name}" for name in WATCHED),
    *RELEASES,
    "none",
)
"""Edges of a step: every watched signal rises (+) and falls (-), then the two kinds of release, then nothing."""
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
"""Events that every subtask can use, and the edge each is."""

USUAL_JOINT_GROUPS = ("base", "arm", "fingers")
"""Every action has columns for the base, an arm and a gripper, and every observation has the arm's tool centre."""
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
_NEEDED = {
    "words": 'words=("pick up {object}", ...), wordings of its instruction',
    "conditions": 'conditions=("at_goal", "is_static", ...), checks of mjhab.tasks.signals.CHECKS',
    "label_rules": 'label_rules=(LabelRule("done", lambda s: s.ever("success")), ..., LabelRule("failed"))',
    "start": "start=, an object of a subclass of mjhab.episodes.starts.SubtaskStart, or a reference to one",
}
"""Fields that have no default, and what to give."""
PLACEHOLDERS = ("object", "link", "destination", "source", "goal")
"""What wordings of subtasks may name in braces; `tasks.instructions` fills them in."""
_TRIED_WORLDS = 2
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_COLOR = re.compile(r"#[0-9a-fA-F]{6}")

Measure = Callable[[WorldState, Active, TaskConfig], Array]
"""(state, active, config) to (W,) bool; runs on numpy and torch (see `core.arrays.namespace`)."""


@dataclass(frozen=True)
class LabelRule:
    """One line of a decision list: the label, and when it is given, (W,) bool; None: whenever no earlier rule holds."""

    label: str
    when: Callable[[LabelState], Array] | None = None

    def holds(self, state: LabelState) -> Array:
        """(W,) bool: the rule gives its label if no earlier one does."""
        now = state.holds("success")
        return now | ~now if self.when is None else self.when(state)


@dataclass(frozen=True)
class PublishedLabels:
    """How the code that was published with MS-HAB labels a subtask, for comparison with its tables.

    events: what it counts. label: from the list of events, whether the subtask succeeded, and whether the object was at
    its goal after the first action. columns: labels in the order of the columns i, ii, ... of the paper's tables (App.
    A.6); empty where there is none.
    """

    events: tuple[str, ...]
    label: Callable[[Sequence[str], bool, bool], str]
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class SubtaskSpec:
    """A kind of subtask. Registering one (`mjhab.register_subtask`) makes it known to all of mjhab.

    Attributes:
        name: lower case, as in ``subtask="pick"``. color: in reports, "#rrggbb".
        words: wordings of its instruction, with {object}, {source}, {goal}, {link} or {destination}; see
            `tasks.instructions`.
        about: "object", "link" (a drawer or door, whose handle is then observed and rewarded as the goal), or "way" (a
            place to drive to; with ``navigate="teleport"`` the environment does that).
        limits: horizon and force. train_horizon: horizon in `make_train`, None for the same.
        conditions: checks (`signals.CHECKS`) that must hold together for success.
        arm_conditions: those of them that are dropped where `TaskConfig.ignore_arm` is set.
        checks: checks besides `COMMON_CHECKS` that mean something for it; those among ``conditions`` need no mention.
        measures: functions that give a check in place of the common one, by the name of the check.
        label_rules: decision list; the last rule has no condition. published: labels of the original, None if it has
            no such subtask.
        events: names in the order in which they are listed within a step; of `EVENT_EDGES` or of ``edges``.
        edges: event to edge (`EDGES`), for events of its own or with another meaning than usual.
        reward: the dense reward, None if there is none.
        shows: what the observation has of "object" (pose of the object) and "goal" (position of the goal).
        starts_holding: the robot begins with the object in its hand. rests_holding: it ends so, and then the arm may be
            further from rest. keeps_goal: in the rest of a plan the object must stay at its goal.
        joint_groups: groups of joints (`core.joints.GROUPS`) that a robot must have to do it.
        start: how the home and the robot begin, an `episodes.starts.SubtaskStart` or a reference "module:NAME" to one.
        expert: script that does it, ``(view) -> generator of actions``, or a reference; None: no expert can do it.
    """

    name: str = ""
    words: tuple[str, ...] = ()
    color: str = "#9ca3af"
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
        if not _NAME.fullmatch(self.name):
            raise UsageError(
                f"a subtask needs a name of lower-case letters, digits and _, got {self.name!r}."
            )
        for name in _TEXTS:
            check_texts(f"subtask {self.name!r}: {name}", getattr(self, name))
        missing = [part for part in _NEEDED if not getattr(self, part)]
        if missing:
            raise UsageError(
                f"subtask {self.name!r} has no {' and no '.join(missing)}; "
                f"give {'; '.join(_NEEDED[part] for part in missing)}."
            )
        self._check_words()
        self._check_names()
        self._check_labels()

    def _check_words(self) -> None:
        for wording in self.words:
            try:
                named = [name for _, name, _, _ in Formatter().parse(wording) if name is not None]
            except ValueError as error:
                raise UsageError(
                    f"subtask {self.name!r}: the wording {wording!r} cannot be read: {error}."
                ) from error
            for name in named:
                if name not in PLACEHOLDERS:
                    raise UsageError(
                        f"subtask {self.name!r}: words: "
                        f"{unknown_name(f'placeholder of the wording {wording!r}:', name, PLACEHOLDERS)}"
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
                if name not in valid:
                    raise UsageError(f"subtask {self.name!r}: {unknown_name(kind, name, valid)}")
        if not _COLOR.fullmatch(self.color):
            raise UsageError(
                f"subtask {self.name!r}: color must be like '#3b82f6', got {self.color!r}."
            )
        for name, function in self.measures.items():
            if not callable(function):
                raise UsageError(
                    f"subtask {self.name!r}: the measure of {name!r} must be a function of (state, active, config), "
                    f"got {function!r}."
                )

    def _check_labels(self) -> None:
        conditions = [rule.when for rule in self.label_rules]
        if conditions[-1] is not None or None in conditions[:-1]:
            raise UsageError(
                f"the last of the label_rules of subtask {self.name!r}, and no other, must be without a condition: "
                "then every episode has exactly one label."
            )
        if len(set(self.labels)) != len(self.labels):
            raise UsageError(f"subtask {self.name!r} has a label twice: {', '.join(self.labels)}.")
        for rule in self.label_rules[:-1]:
            self._try_rule(rule)

    def _try_rule(self, rule: LabelRule) -> None:
        """Ask a rule about worlds in which nothing has happened, so that a wrong name is told before any episode."""
        where = f"subtask {self.name!r}: label rule {rule.label!r}"
        try:
            given = rule.holds(uneventful(_TRIED_WORLDS))
        except UsageError as error:
            raise UsageError(f"{where}: {error}") from error
        # A rule is code of others, which raises whatever it likes.
        except Exception as error:
            raise UsageError(f"{where} raised {raised_text(error)}.") from error
        if not (isinstance(given, np.ndarray) and given.shape == (_TRIED_WORLDS,)) or (
            given.dtype != np.bool_
        ):
            raise UsageError(
                f"{where} must give one bool per world, shape (W,), as LabelState.ever and holds do; "
                f"got {value_text(given)}."
            )

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels in the order of their rules; the code of a label is its index."""
        return tuple(rule.label for rule in self.label_rules)

    @property
    def navigates(self) -> bool:
        """It is a way to drive."""
        return self.about == "way"

    @property
    def jointed(self) -> bool:
        """It moves the joint of a drawer or door."""
        return self.about == "link"

    @property
    def opens_link(self) -> bool:
        """It leaves a drawer or door open."""
        return self.jointed and "opened" in self.conditions

    @property
    def closes_link(self) -> bool:
        """It leaves a drawer or door closed."""
        return self.jointed and "closed" in self.conditions

    @property
    def brings_to_goal(self) -> bool:
        """It leaves its object at its goal."""
        return "at_goal" in self.conditions

    @property
    def may_hold(self) -> bool:
        """The robot may begin it with an object in its hand."""
        return self.starts_holding or self.navigates

    def applies(self, check: str) -> bool:
        """Whether a check means something for it; elsewhere it is False."""
        return check in COMMON_CHECKS or check in (*self.checks, *self.conditions, *self.measures)

    def needs(self, ignore_arm: bool) -> tuple[str, ...]:
        """The conditions of success; ``ignore_arm``: without ``arm_conditions``."""
        dropped = self.arm_conditions if ignore_arm else ()
        return tuple(name for name in self.conditions if name not in dropped)

    def edge(self, event: str) -> str:
        """The edge that is an event of it, "none" for what is no event of it."""
        if event not in self.events:
            return "none"
        return self.edges.get(event) or EVENT_EDGES[event]
