"""Changes of single fields of a preset: ``chunk=4``, ``inputs.image_size=64``, ``optimizer.ema=0``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.flags import mark_of
from mjhab.learning.configs import ImitationConfig

TRUTH = {"true": True, "false": False}
FIXED = ("algorithm", "preset")
"""Fields of a config that name it."""
STUDENT = "student"
SCHEDULES = ("constant", "cosine")
Record = TypeVar("Record")


@dataclass(frozen=True)
class Sets:
    """Marks an option of a run that changes a field of its preset.

    field: named as in ``--set``, e.g. "dagger.rounds".
    """

    field: str


def changes_of(spec: Any, config: Any) -> dict[str, Any]:
    """What the options of a run change in its preset: values by the names of fields.

    Args:
        spec: a dataclass whose options are marked with `Sets`. Those that are None or () change nothing.
        config: the preset.

    Raises:
        UsageError: a number is too small.
    """
    found: dict[str, Any] = {}
    for option in dataclasses.fields(spec):
        value = getattr(spec, option.name)
        # None and () are options that were not given: the preset decides.
        mark = mark_of(type(spec), option.name, Sets)
        if mark is None or value is None or value == ():
            continue
        own = mark_of(type(spec), option.name, Bound)
        _check(option.name, value, own or _bound(config, mark.field))
        found[mark.field] = value
    return found


def with_changes(
    config: Record, words: Sequence[str], values: Mapping[str, Any] | None = None
) -> Record:
    """A config with the named fields set.

    All fields are set together, because a config is checked as a whole: chunk=1 alone would be refused before execute=1
    is known.

    Args:
        config: of a run of imitation or reinforcement.
        words: NAME=VALUE each. NAME is a field, or PART.FIELD with a field of a part such as inputs, network,
            optimizer, dagger, ppo or sac; the items of a tuple are separated by commas.
        values: further fields by name; they go before those of ``words``.

    Raises:
        UsageError: there is no such field, or the value has another type or is out of range.
    """
    # Of the preset, since parts that it leaves out (`None`) cannot be set.
    known = settable(config)
    changed: dict[str, Any] = {}
    for word in words:
        name, text = _split(word, known)
        changed[name] = _read(name, text, known[name], _bound(config, name))
    return _with_values(config, {**changed, **(values or {})})


def settable(config: Any) -> dict[str, Any]:
    """The fields of a config that can be set, with their values, by name; those of its parts as PART.FIELD."""
    found: dict[str, Any] = {}
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            # The student is what a run is about, so that its fields go without its name.
            prefix = "" if name == STUDENT else f"{name}."
            found |= {f"{prefix}{field}": part for field, part in settable(value).items()}
        elif name not in FIXED and value is not None:
            found[name] = value
    return found


def _full(config: Any, name: str) -> str:
    """The name of a field with all its parts: those of the student are named without it."""
    own = {field.name for field in dataclasses.fields(config)}
    inside = isinstance(config, ImitationConfig) and name.partition(".")[0] not in own
    return f"{STUDENT}.{name}" if inside else name


def _bound(config: Any, name: str) -> Bound | None:
    """What values a field may have; None for the usual ones: whole numbers from 1, others from 0, tuples with items."""
    *parts, field = _full(config, name).split(".")
    for part in parts:
        config = getattr(config, part)
    return mark_of(type(config), field, Bound)


def _split(word: str, known: Mapping[str, Any]) -> tuple[str, str]:
    """Name and value of NAME=VALUE."""
    name, sign, text = word.partition("=")
    if not sign:
        raise wrong_value("set", word, "NAME=VALUE, for instance inputs.image_size=64")
    if name not in known:
        raise unknown_name("field of the preset", name, known)
    return name, text


def _with_values(config: Any, values: Mapping[str, Any]) -> Any:
    """A config with other values, those of its parts by PART.FIELD."""
    own: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        part, dot, field = _full(config, name).partition(".")
        if dot:
            parts.setdefault(part, {})[field] = value
        else:
            own[name] = value
    for part, fields in parts.items():
        own[part] = _with_values(getattr(config, part), fields)
    return dataclasses.replace(config, **own)


def _read(name: str, text: str, like: Any, bound: Bound | None) -> Any:
    """The value of a text, of the type of ``like``.

    Raises:
        UsageError: it has another type, or is out of range.
    """
    if isinstance(like, tuple):
        items = [item for item in text.split(",") if item]
        if not items and (bound is None or not bound.empty):
            raise wrong_value(f"--set {name}", text, "at least one value")
        return tuple(
            _read(name, item, like[0], bound) if like else item for item in items
        )
    # Before the cast: bool("false") is true.
    if isinstance(like, bool):
        if text not in TRUTH:
            raise wrong_value(f"--set {name}", text, ("true", "false"))
        return TRUTH[text]
    try:
        value = type(like)(text)
    except ValueError as error:
        raise wrong_value(
            f"--set {name}", text, f"of type {type(like).__name__}"
        ) from error
    _check(f"--set {name}", value, bound)
    known = _words(name)
    if known and value not in known:
        raise unknown_name(name, text, known)
    return value


def _check(label: str, value: Any, bound: Bound | None) -> None:
    """Refuse a number that is too small or not finite.

    Raises:
        UsageError: names the field as ``label``.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    # Counts and sizes begin at 1, rates and weights at 0.
    usual = 1 if isinstance(value, int) else 0
    least = usual if bound is None else bound.least
    # Whole numbers of any size are finite; math.isfinite would not take large ones.
    if not (least <= value < math.inf and value > -math.inf):
        raise wrong_value(label, value, f"at least {least}, and finite")


def _words(name: str) -> tuple[str, ...]:
    """The words that a field may have; () for any."""
    if name == "optimizer.schedule":
        return SCHEDULES
    if name == "network.encoder":
        from mjhab.learning.networks import CAMERA_ENCODERS

        return (*CAMERA_ENCODERS, "paper_dp")
    return ()
