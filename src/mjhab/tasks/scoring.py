"""Dense rewards of every kind of subtask: tables of named raw terms times scales, scored over worlds of mixed kinds.

The tables are those of the subtasks (`SubtaskSpec.reward`). A dense reward is normalised by the largest sum its terms
can reach, which follows from the table (``RewardTable.attainable``): 29 for Pick and 36 for Close, whose published
normalisers are 28 and 37 (kept as ``RewardTable.published``), and 44, 27 and 28 for Place, Open and Navigate, as
published. `RewardOptions` chooses between them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjhab.core.arrays import Array, Table, constant, indices, namespace, pile, zeros
from mjhab.core.errors import UsageError, unknown_name, wrong_value
from mjhab.tasks.rewards.table import ALWAYS, RewardTable, RewardView
from mjhab.tasks.subtasks.registry import PADDING, SUBTASKS, name_of, number_of
from mjhab.tasks.thresholds import TaskConfig


def reward_table(kind: str) -> RewardTable:
    """The reward table of a kind such as ``"pick"``.

    Raises:
        UsageError: no such kind, or it has no dense reward.
    """
    table = SUBTASKS[kind].reward
    if table is None:
        raise wrong_value(
            "reward_mode",
            "dense",
            "'sparse'",
            "Or give its SubtaskSpec a reward.",
            f"subtask {kind!r}",
        )
    return table


REWARD_FORMULAS: tuple[str, ...] = ("bounded", "published")
REWARD_NORMALISERS: tuple[str, ...] = ("attainable", "published")


@dataclass(frozen=True)
class RewardOptions:
    """Options of dense rewards.

    Attributes:
        scales: scales that replace those of some terms, by kind, as ``{"pick": {"reach": 4.0}}``.
        formula: "bounded": every raw value is between 0 and 1, and ``gentle`` of Open reads the absolute joint speed;
            "published": as in mshab/envs/open.py and close.py, ``gentle`` reads the signed joint velocity, ``progress``
            is negative where a joint is beyond its limit, and the torso's share of its travel is its absolute value,
            not clipped.
        normaliser: divisor of "normalized_dense": "attainable", the largest possible sum of the terms with these
            scales; "published", the constant of the original: 28, 44, 28, 27, 37 (Pick, Place, Navigate, Open, Close).

    Raises:
        UsageError: no such formula or normaliser, or scales of another shape.
    """

    scales: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    formula: str = "bounded"
    normaliser: str = "attainable"

    def __post_init__(self) -> None:
        if self.formula not in REWARD_FORMULAS:
            raise unknown_name("reward formula", self.formula, REWARD_FORMULAS)
        if self.normaliser not in REWARD_NORMALISERS:
            raise unknown_name("reward normaliser", self.normaliser, REWARD_NORMALISERS)
        _check_scales(self.scales)


def _check_scales(scales: Any) -> None:
    """Raise a UsageError unless scales are terms with numbers by kind; the terms are checked with their table."""
    right = '{subtask: {term: scale}}, as in {"pick": {"reach": 10.0}}'
    if not isinstance(scales, Mapping):
        raise wrong_value("reward_scales", scales, right)
    for kind, changes in scales.items():
        if not isinstance(changes, Mapping):
            having = [name for name in SUBTASKS if kind in term_names(name)]
            # A term without its subtask is the usual slip.
            hint = (
                f"Did you mean {{{having[0]!r}: {{{kind!r}: {changes!r}}}}}?"
                if having
                else ""
            )
            raise wrong_value("reward_scales", {kind: changes}, right, hint)


def term_names(kind: str) -> tuple[str, ...]:
    """Names of the reward terms of a kind; () without a dense reward."""
    table = SUBTASKS[kind].reward
    return () if table is None else tuple(term.name for term in table.terms)


@dataclass(frozen=True)
class Scored:
    """Dense rewards of W worlds, of the dtype of the state."""

    terms: Array
    """(N, W) raw x scale of every term in ``DenseReward.names``; 0 where the world's kind does not have it."""
    total: Array
    """(W,) their sum; 0 where the plan is finished."""
    normaliser: Array
    """(W,) what the total of the world's kind is divided by; 1 where the plan is finished."""


class DenseReward:
    """Computes the dense rewards of worlds from the tables; it has no state.

    Args:
        config: thresholds.
        options: scales, formula and normaliser.
        kinds: names of the kinds of subtasks, all that have a dense reward if not given; ``names`` lacks the terms of
            others.

    Raises:
        UsageError: no such kind or term, a kind without a dense reward, or a scale that is not a finite number.
    """

    def __init__(
        self,
        config: TaskConfig,
        options: RewardOptions | None = None,
        kinds: Sequence[str] | None = None,
    ) -> None:
        self.config = config
        options = options or RewardOptions()
        rewarded = [name for name in SUBTASKS if SUBTASKS[name].reward is not None]
        tables = {
            name: reward_table(name).in_formula(options.formula)
            for name in dict.fromkeys((*rewarded, *(kinds or ())))
        }
        for name, changes in options.scales.items():
            tables[name] = (
                reward_table(name).in_formula(options.formula).scaled(name, changes)
            )
        wanted = rewarded if kinds is None else kinds
        self.tables: dict[int, RewardTable] = {
            number_of(name): tables[name] for name in wanted
        }
        self.names: tuple[str, ...] = tuple(
            dict.fromkeys(t.name for tb in self.tables.values() for t in tb.terms)
        )
        self._scales = {
            k: Table(tuple(t.scale for t in table.terms))
            for k, table in self.tables.items()
        }
        self._rows = {
            k: Table(tuple(self.names.index(t.name) for t in tb.terms))
            for k, tb in self.tables.items()
        }
        divisors = [
            # 0 becomes 1 below: a kind without rewards divides by nothing.
            _normaliser(tables[name], options.normaliser) if name in tables else 0.0
            for name in SUBTASKS
        ]
        # A table whose scales are all zero or negative has the divisor 1. Kind -1 reads the last entry.
        self._normaliser = Table((*(divisor or 1.0 for divisor in divisors), 1.0))

    def score(self, view: RewardView) -> Scored:
        """Compute the reward of every world from the table of its active subtask (``view.signals.kind``).

        Raises:
            UsageError: a world does a subtask that is not among ``kinds`` (numpy only; elsewhere it scores 0).
        """
        kind = view.signals.kind
        like = view.tcp_vel
        present = kinds_at_hand(kind, self.tables.keys())
        normaliser = constant(self._normaliser, like)[kind]
        xp = namespace(like)
        # The usual case of training: no scattering into a larger table.
        if len(present) == len(self.tables) == 1:
            terms, total = self._score_kind(kind, present.pop(), view)
            return Scored(terms, total, normaliser)
        terms = zeros((len(self.names), kind.shape[0]), like)
        # Of the dtype of the terms, not of Python's float.
        total = xp.zeros_like(terms[0])
        # In a fixed order: the last bit of a sum depends on it.
        for number in sorted(present):
            # For all worlds, because selecting those of the kind costs more; the others get 0.
            values, sums = self._score_kind(kind, number, view)
            terms[indices(self._rows[number], kind), :] += values
            total = total + sums
        return Scored(terms, total, normaliser)

    def _score_kind(
        self, kinds: Array, kind: int, view: RewardView
    ) -> tuple[Array, Array]:
        """Raw x scale (K, W) in the order of the kind's table, and their sums (W,); 0 in worlds of other kinds."""
        table = self.tables[kind]
        when, raw = table.raw(view, self.config)
        when[ALWAYS] = mine = kinds == kind
        gates = [when[t.when] for t in table.terms]
        scales = constant(self._scales[kind], view.tcp_vel)
        xp = namespace(scales)
        given = pile(gates) & mine
        # A term without a raw value is 1 where its condition holds.
        values = pile(
            [raw.get(t.name, gate) for t, gate in zip(table.terms, gates, strict=True)]
        )
        # Chosen and not multiplied: raw values of terms that do not hold may be NaN.
        values = xp.where(given, values, 0.0)
        # One contiguous row per world: the last bit of a sum must not depend on the number of worlds.
        by_world = values.T.reshape(-1).reshape(values.T.shape)
        return values * scales[:, None], xp.vecdot(by_world, scales)


def _normaliser(table: RewardTable, which: str) -> float:
    """Divisor of the sum of a table; "attainable" where the original has no such subtask."""
    if which == "published" and table.published is not None:
        return table.published
    return table.attainable


def kinds_at_hand(kind: Array, known: Collection[int]) -> set[int]:
    """The ``known`` kinds whose tables must be computed: on numpy those among ``kind`` (W,), else all.

    Raises:
        UsageError: a kind that is not known (numpy only, because reading device arrays would wait for the device).
    """
    if not isinstance(kind, np.ndarray):
        return set(known)
    present = set(kind.tolist()) - {PADDING}
    if not present <= set(known):
        strange = ", ".join(name_of(k) for k in sorted(present - set(known)))
        raise UsageError(f"these rewards are not for {strange}")
    return present
