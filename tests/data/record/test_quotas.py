"""Which episodes are kept does not depend on who finishes when, and who is sure to be kept is."""

from __future__ import annotations

import random
from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.data.record.quotas import GuaranteedTargets, Outcome, Quotas
from tests.refusals import refused

TARGETS = ("bowl", "apple", "can")
LABELS = ("good", "bad")


def drawn(seed: int, count: int, chance: float) -> list[Outcome]:
    dice = random.Random(seed)
    return [
        Outcome(i, dice.choice(TARGETS), dice.choice(LABELS), dice.random() < chance)
        for i in range(count)
    ]


def one_after_another(
    outcomes: list[Outcome], per_target: int, per_label: int
) -> list[int]:
    """The rule itself."""
    count: Counter[tuple[str, str]] = Counter()
    kept = []
    for outcome in outcomes:
        keys = (outcome.target, ""), (outcome.target, outcome.label)
        room = all(
            not quota or count[key] < quota
            for key, quota in zip(keys, (per_target, per_label), strict=True)
        )
        if outcome.passes and room:
            kept.append(outcome.index)
            count.update(keys)
    return kept


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 999),
    st.integers(0, 8),
    st.integers(0, 5),
    st.floats(0.2, 1.0),
    st.integers(1, 7),
    st.integers(1, 5),
)
def test_the_set_is_that_of_one_worker(
    seed: int, per_target: int, per_label: int, chance: float, workers: int, chunk: int
) -> None:
    outcomes = drawn(seed, 90, chance)
    dice = random.Random(seed + 1)
    quotas = Quotas(TARGETS, per_target, per_label)
    open_now: list[tuple[int, GuaranteedTargets]] = []
    kept = set[int]()
    following = 0
    while True:
        while (
            len(open_now) < workers * chunk
            and following < len(outcomes)
            and not quotas.full
        ):
            indices = range(following, min(following + chunk, len(outcomes)))
            sure = quotas.guaranteed(indices[-1])
            open_now += [(index, sure) for index in indices]
            following = indices[-1] + 1
        if not open_now:
            break
        index, sure = open_now.pop(dice.randrange(len(open_now)))
        outcome = outcomes[index]
        certain = outcome.passes and sure(outcome.target)
        quotas.report(outcome, True if certain else None)
        if certain:
            kept.add(index)
        elif dice.random() < 0.1 and quotas.forget(index):
            # Its worker died before it was decided: it comes again.
            open_now.append((index, GuaranteedTargets(False)))
            assert quotas.is_open(index)
        kept |= {i for i, keep in quotas.decide().items() if keep}
    assert sorted(kept) == one_after_another(outcomes, per_target, per_label)
    assert quotas.kept == len(kept) and sum(quotas.labels.values()) == len(kept)
    if per_target and quotas.full:
        assert all(quotas.count(target) == per_target for target in TARGETS)


def test_what_is_far_from_the_quota_is_certain_at_once() -> None:
    quotas = Quotas(("bowl",), per_target=10)
    assert quotas.guaranteed(9)("bowl") and not quotas.guaranteed(10)("bowl")
    for index in range(5):
        quotas.report(Outcome(index, "bowl", "good", index % 2 == 0))
    assert quotas.decide() == {0: True, 2: True, 4: True} and not quotas.full
    assert (
        quotas.guaranteed(11)("bowl")
        and not quotas.guaranteed(12)("bowl")
        and quotas.guaranteed(12)("apple")
    )
    assert Quotas(()).guaranteed(10**6)("anything")


def test_an_open_lower_index_delays_the_decision() -> None:
    quotas = Quotas(("bowl",), per_target=1)
    quotas.report(Outcome(1, "bowl", "good", True))
    assert quotas.decide() == {}
    quotas.report(Outcome(0, "bowl", "good", True))
    assert (
        quotas.decide() == {0: True, 1: False}
        and quotas.full
        and quotas.labels == {"good": 1}
    )


def test_negative_quotas_are_refused() -> None:
    with refused("quotas", (-1, 0)):
        Quotas((), per_target=-1)
