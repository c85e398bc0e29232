"""Styles of the expert: what can be asked for, what is refused, and that draws depend on (seed, index) alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjhab.tasks.style import (
    NAMES,
    PLAIN,
    Style,
    Styles,
    descriptions,
    recorded,
    value_of,
)
from tests.refusals import refused

WORDS = ("release=place,drop", "speed=0.5..0.9", "hold=3..6", "noise=0.05")


def test_a_value_holds_for_every_episode_and_a_range_is_drawn_from():
    styles = Styles.parse(WORDS)
    drawn = [styles.draw(4, index) for index in range(200)]
    assert {style.noise for style in drawn} == {0.05} and {
        style.grasp for style in drawn
    } == {"any"}
    assert {style.release for style in drawn} == {"place", "drop"} and {
        style.hold for style in drawn
    } == {3, 4, 5, 6}
    speeds = [style.speed for style in drawn]
    assert 0.5 <= min(speeds) < 0.55 and 0.85 < max(speeds) <= 0.9


@given(st.integers(0, 2**31), st.integers(0, 10_000))
def test_a_draw_depends_on_seed_and_index_alone(seed: int, index: int):
    assert Styles.parse(WORDS).draw(seed, index) == Styles.parse(WORDS[::-1]).draw(
        seed, index
    )
    # Another field that is asked for changes nothing in the others.
    assert (
        Styles.parse(("speed=0.5..0.9",)).draw(seed, index).speed
        == Styles.parse(WORDS).draw(seed, index).speed
    )


def test_nothing_asked_for_is_the_plain_style():
    assert Styles.parse(()).plain and Styles.parse(()).draw(1, 2) == PLAIN == Style()
    assert not Styles.parse(("speed=1",)).plain


def test_words_can_be_read_again_and_do_not_depend_on_order():
    words = Styles.parse(WORDS).words
    assert words == ["speed=0.5..0.9", "release=place,drop", "noise=0.05", "hold=3..6"]
    assert Styles.parse(words) == Styles.parse(WORDS)
    assert Styles.parse(("release=drop,place,drop",)).words == ["release=place,drop"]


@pytest.mark.parametrize(
    ("word", "option", "expected"),
    [
        ("sped=0.5", "style", "speed"),
        ("grasp=tops", "grasp in --style", "top"),
        ("release=place,", "release in --style", ""),
        ("speed", "--style speed", "a value, as in speed=1.0"),
        ("speed=2", "--style speed", "a number from 0.3 to 1.0"),
        ("speed=0.9..0.5", "--style speed", "a number"),
        ("speed=0.5..0.6..0.7", "--style speed", "a number"),
        ("speed=nan", "--style speed", "a number"),
        ("hold=2.5", "--style hold", "a whole number from 0 to 100"),
        ("noise=-0.1", "--style noise", "a number from 0.0 to 0.5"),
    ],
)
def test_what_cannot_be_asked_for_is_explained(word: str, option: str, expected: str):
    with refused(option) as caught:
        Styles.parse((word,))
    assert expected in caught.value.expected or not expected


def test_a_name_is_given_once():
    with refused("--style speed", expected="given once"):
        Styles.parse(("speed=0.5", "speed=0.6"))


def test_what_was_not_recorded_is_the_default():
    assert value_of({}, "speed") == 1.0 and value_of({"speed": 0.5}, "speed") == 0.5
    assert set(recorded(PLAIN)) == set(NAMES) == set(descriptions())
