"""Styles of scripted experts: a `Style` for one episode, and `Styles`, the distribution from which it is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache
from typing import Any

from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.seeding import stream
from mjhab.core.typed.checks import check

ANY = "any"
TOP = "top"
TILTED = "tilted"
SIDE = "side"
PLACE = "place"
DROP = "drop"
PUSH = "push"
THROW = "throw"
SWEEP = "sweep"
GRASP = "grasp"
BASE = "base"
ARM = "arm"
TARGET = "target"
AHEAD = "ahead"
SMOOTH = "smooth"
STEP = "step"
BURSTS = "bursts"
COUNTED = "counted"
VISIBLE = "visible"
REST = "rest"
OPEN = "open"
SEARCH = "search"
RULE = "rule"
RANGE = ".."
OR = ","
"""Separators: between the ends of a range, and between alternative words."""


@dataclass(frozen=True)
class Style:
    """Style of an episode. The defaults are the plain expert; every field is an option of ``--style``."""

    speed: float = field(
        default=1.0,
        metadata={"low": 0.3, "high": 1.0, "about": "of all motions; 1 is the fastest"},
    )
    grasp: str = field(
        default=ANY,
        metadata={
            "words": (ANY, TOP, TILTED, SIDE),
            "about": "how the hand comes, where the object can be held so",
        },
    )
    release: str = field(
        default=PLACE,
        metadata={
            "words": (PLACE, DROP),
            "about": "put it down, or let it fall on its goal where there is room to",
        },
    )
    drop_height: float = field(
        default=0.18,
        metadata={
            "low": 0.0,
            "high": 0.5,
            "about": "from how high above its place a drop begins [m]",
        },
    )
    close: str = field(
        default=ANY,
        metadata={
            "words": (ANY, PUSH, THROW, SWEEP, GRASP),
            "about": "how doors and drawers are shut: push all the way, throw or sweep (doors), hold the handle "
            "(drawers)",
        },
    )
    pull: str = field(
        default=BASE,
        metadata={
            "words": (BASE, ARM),
            "about": "what opens drawers: the base drives back with the arm held, or the arm pulls as far as it can, "
            "which needs less room behind the robot",
        },
    )
    open_further: float = field(
        default=0.0,
        metadata={
            "low": 0.0,
            "high": 0.15,
            "about": "how much farther than usual doors are opened, as a share of their range",
        },
    )
    waits: str = field(
        default=COUNTED,
        metadata={
            "words": (COUNTED, VISIBLE),
            "about": "the hand waits a number of control steps before it closes or opens, or only until what it waits "
            "for can be observed",
        },
    )
    plan: str = field(
        default=SEARCH,
        metadata={
            "words": (SEARCH, RULE),
            "about": "how base, hand pose and path are found: a search for the quickest that are free, or a rule that "
            "depends on what can be observed",
        },
    )
    look: str = field(
        default=AHEAD,
        metadata={
            "words": (AHEAD, TARGET),
            "about": "the head looks ahead, or follows what is worked on; with a stationary head it stays",
        },
    )
    hand: str = field(
        default=REST,
        metadata={
            "words": (REST, OPEN),
            "about": "the empty hand while the robot drives: its fingers as at rest, where drawn starts have them, or "
            "open on the way to an object",
        },
    )
    noise: float = field(
        default=0.0,
        metadata={
            "low": 0.0,
            "high": 0.5,
            "about": "std on the arm while it moves; 1 is a whole action",
        },
    )
    base_noise: float = field(
        default=0.0,
        metadata={
            "low": 0.0,
            "high": 0.5,
            "about": "std on the base while it moves; 1 is a whole action",
        },
    )
    noise_kind: str = field(
        default=SMOOTH,
        metadata={
            "words": (SMOOTH, STEP, BURSTS),
            "about": "noise that drifts, or another one in every step, or in bursts, also at rest and on the torso",
        },
    )
    hold: int = field(
        default=0,
        metadata={
            "low": 0,
            "high": 100,
            "about": "control steps to stand still at the start of an episode",
        },
    )
    dither: float = field(
        default=0.0,
        metadata={
            "low": 0.0,
            "high": 0.5,
            "about": "std on the arm while it holds; 1 is a whole action",
        },
    )
    mishap: float = field(
        default=0.0,
        metadata={
            "low": 0.0,
            "high": 1.0,
            "chance": True,
            "about": "how likely the hand once opens and the arm is pushed aside, whatever is intended; in the "
            "record 1 where it does",
        },
    )


PLAIN = Style()
NAMES: tuple[str, ...] = tuple(f.name for f in fields(Style))
CHANCES = frozenset(f.name for f in fields(Style) if f.metadata.get("chance"))
"""Fields that are 0 or 1 in an episode; a distribution tells how likely 1 is."""


@dataclass(frozen=True)
class Styles:
    """Distribution from which every episode draws its style, each field independently.

    Attributes:
        choices: values of the fields that are not at their default. For numbers (value,) or the two ends of a range,
            both included; for words all alternatives.
    """

    choices: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)

    @classmethod
    def parse(cls, words: Sequence[str]) -> Styles:
        """Read ``("speed=0.5..1.0", "grasp=side", "release=place,drop")``.

        Raises:
            UsageError: an unknown name or word, or a number out of range; with the nearest name.
        """
        choices: dict[str, tuple[Any, ...]] = {}
        for word in words:
            name, equals, text = word.partition("=")
            if name not in NAMES:
                raise unknown_name("style", name, NAMES)
            check(
                bool(equals and text),
                f"--style {word}",
                text,
                f"a value, as in {name}={getattr(PLAIN, name)}",
            )
            check(
                name not in choices,
                f"--style {name}",
                text,
                f"given once; a range or a list is one, as in {_SAMPLE}",
            )
            choices[name] = _read(name, text)
        return cls(choices)

    def draw(self, seed: int, index: int) -> Style:
        """Draw the style of an episode; it depends on (seed, index) only."""
        drawn = {}
        for name, values in self.choices.items():
            random = stream(seed, "style", name, index)
            if isinstance(values[0], str):
                drawn[name] = values[int(random.integers(len(values)))]
            elif isinstance(values[0], int):
                # The end of a range counts, as a reader of "0..20" expects.
                drawn[name] = int(random.integers(values[0], values[-1] + 1))
            else:
                # Rounded, so that a record's text gives the very same style again.
                value = round(float(random.uniform(values[0], values[-1])), 4)
                drawn[name] = float(random.random() < value) if name in CHANCES else value
        return Style(**drawn)

    @property
    def plain(self) -> bool:
        """Whether every episode has the plain style."""
        return not self.choices

    @property
    def words(self) -> list[str]:
        """Words that `parse` reads, in the order of the fields; equal distributions have equal words."""
        return [
            f"{name}={_write(self.choices[name])}"
            for name in NAMES
            if name in self.choices
        ]


_SAMPLE = "speed=0.5..1.0 release=place,drop"


@lru_cache(maxsize=1)
def descriptions() -> dict[str, str]:
    """Description of each field of `Style`, with its values."""
    out = {}
    for f in fields(Style):
        values = f.metadata.get("words")
        text = (
            " or ".join(values)
            if values
            else f"{f.metadata['low']} to {f.metadata['high']}"
        )
        out[f.name] = f"{f.metadata['about']} ({text})"
    return out


def field_words(name: str) -> tuple[str, ...]:
    """All words that a field of `Style` can be; empty for a number."""
    return next(f for f in fields(Style) if f.name == name).metadata.get("words", ())


def value_of(style: Mapping[str, Any], name: str) -> Any:
    """Field of a recorded style; the default if the record lacks it."""
    return style.get(name, getattr(PLAIN, name))


def recorded(style: Style) -> dict[str, Any]:
    """A style as the plain data that records keep."""
    return asdict(style)


def _read(name: str, text: str) -> tuple[Any, ...]:
    f = next(f for f in fields(Style) if f.name == name)
    valid = f.metadata.get("words")
    if valid:
        words = tuple(text.split(OR))
        for word in words:
            if word not in valid:
                raise unknown_name(f"{name} in --style", word, valid)
        # In one order, so that equal distributions are recorded by equal words.
        return tuple(sorted(set(words), key=valid.index))
    kind: type[float] = type(getattr(PLAIN, name))
    low = f.metadata["low"]
    high = f.metadata["high"]
    try:
        values = [kind(part) for part in text.split(RANGE)]
    except ValueError:
        values = []
    good = len(values) in (1, 2) and all(
        math.isfinite(v) and low <= v <= high for v in values
    )
    if not good or values != sorted(values):
        what = "whole number" if kind is int else "number"
        raise wrong_value(
            f"--style {name}",
            text,
            f"a {what} from {low} to {high}, or a range of them, as in {name}={low}..{high}",
        )
    return tuple(values)


def _write(values: tuple[Any, ...]) -> str:
    return (OR if isinstance(values[0], str) else RANGE).join(
        str(value) for value in values
    )
