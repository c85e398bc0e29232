"""Pairs of episodes: McNemar's exact p, Newcombe's interval, labels that change."""

from __future__ import annotations

import dataclasses
import math
from itertools import product

import numpy as np
import pytest

from mjhab.reports.compared.paired import (
    NOT_REACHED,
    mcnemar,
    paired,
    paired_interval,
    together,
)
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.records import EpisodeRecord
from tests.rollout.fake_env import FakeEnv


def test_mcnemar_known_values() -> None:
    assert mcnemar(0, 0) == 1.0 and mcnemar(4, 4) == 1.0
    assert mcnemar(0, 6) == mcnemar(6, 0) == pytest.approx(2 / 64, abs=1e-6)
    assert mcnemar(12, 2) == pytest.approx(2 * (1 + 14 + 91) / 2**14, abs=1e-6)
    far = 2 * sum(math.comb(129, few) for few in range(34)) / 2**129
    assert mcnemar(33, 96) == pytest.approx(far, rel=1e-3) and 0 < far < 1e-7
    assert mcnemar(530, 469) == pytest.approx(mcnemar(530, 470), abs=0.005)


def test_the_interval_is_that_of_newcombe() -> None:
    """Table II of Newcombe (1998), method 10, counts 36, 12, 2, 0: 0.0569 to 0.3404 for A minus B."""
    low, high = paired_interval(36, 12, 2, 0)
    assert (-high, -low) == pytest.approx((0.0569, 0.3404), abs=1e-4)
    assert paired_interval(0, 0, 0, 0) == (-1.0, 1.0)


def test_the_interval_holds_the_difference_and_mirrors() -> None:
    for both, a, b, neither in product((0, 1, 7, 40), repeat=4):
        total = both + a + b + neither
        if not total:
            continue
        low, high = paired_interval(both, a, b, neither)
        assert -1 <= low <= (b - a) / total + 1e-4 and (b - a) / total - 1e-4 <= high <= 1
        other = paired_interval(both, b, a, neither)
        assert (-other[1], -other[0]) == pytest.approx((low, high), abs=1e-4)


def test_the_interval_covers_the_truth() -> None:
    """Rates 0.8 and 0.7 with half of the outcomes shared: about 95 % of the intervals hold -0.1."""
    random = np.random.default_rng(0)
    shares = (0.68, 0.12, 0.02, 0.18)
    drawn = random.multinomial(60, shares, size=400)
    held = [low <= -0.1 <= high for low, high in (paired_interval(*row) for row in drawn)]
    assert 0.92 < np.mean(held) < 0.99


def episodes() -> list[EpisodeRecord]:
    plan = (("pick", "024_bowl_:0000"),)
    env = FakeEnv(2, plan, "pick", quality=0.5)
    return rollout(env, RandomPolicy(0), range(8), seed=3)


def test_episodes_are_paired_by_seed_and_index() -> None:
    first = episodes()
    won = [record.index for record in first if record.success_once]
    assert 0 < len(won) < 8
    lost = dataclasses.replace(
        first[won[0]], success_once=False, subtasks=(), completed=0
    )
    other = [lost if record.index == won[0] else record for record in first]
    found = paired(first, list(reversed(other)))
    assert found.only_a == (won[0],) and found.only_b == ()
    assert (found.both, found.neither) == (len(won) - 1, 8 - len(won))
    assert found.difference == -0.125 and found.p == 1.0
    label = first[won[0]].subtasks[0].label
    assert found.labels == ((label, NOT_REACHED, 1),)
    elsewhere = [dataclasses.replace(record, seed=4) for record in first]
    assert paired(first, elsewhere).episodes == 0
    assert paired(first, other[:3]).episodes == 3
    whole = together([found, paired(first, first)])
    assert (whole.episodes, whole.only_a, whole.labels) == (16, (won[0],), found.labels)
