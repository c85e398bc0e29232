"""Changes of single fields of a preset: ``chunk=4``, ``inputs.image_size=64``, ``optimizer.ema=0``."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast

from mjhab.core.errors import UsageError, unknown_name
from mjhab.learning.configs import DAGGER, TrainConfig

TRUTH = {"true": True, "false": False}
LEAST = {
    "hold_steps": -1,
    "sampling_steps": 0,
    "inputs.shift": 0,
    "network.layers": 0,
    "network.state_features": 0,
    "optimizer.warmup": 0,
    "dagger.rounds": 0,
    "dagger.first_prefix": 0,
    "dagger.prefix_growth": 0,
    "dagger.max_prefix": 0,
    "dagger.horizon": 0,
    "dagger.final_updates": 0,
    "ppo.critic_updates": 0,
    "ppo.demonstrations": 0,
    "ppo.imitation_updates": 0,
    "ppo.imitation_samples": 0,
    "sac.atoms": 0,
    "sac.warm_up": 0,
    "sac.demonstrations": 0,
    "sac.imitation_samples": 0,
    "sac.frozen_actor_samples": 0,
    "samples": 0,
    "horizon": 0,
    "episode_pool": 0,
}
"""Smallest allowed value of integer fields for which it is not 1."""
NO_LEAST = ("sac.value_low", "sac.value_high", "network.log_std")
"""Numbers that may be negative."""
FIXED = ("algorithm", "preset")
"""Fields of a config that name it."""
MAY_BE_EMPTY = ("style", "inputs.cameras", "ppo.demonstration_style")
SCHEDULES = ("constant", "cosine")
Record = TypeVar("Record")


def with_changes(config: TrainConfig, words: Sequence[str]) -> TrainConfig:
    """The config of an imitation run with the named fields set.

    Args:
        config: of a run.
        words: NAME=VALUE each. NAME is a field of `StudentConfig`, or PART.FIELD with the part inputs, network,
            optimizer or dagger; the items of a tuple are separated by commas.

    Raises:
        UsageError: there is no such field, or the value has another type.
    """
    known = settable(config)
    student: dict[str, Any] = {}
    dagger: dict[str, Any] = {}
    for name, value in _values(words, known).items():
        part, _, field = name.partition(".")
        if part == DAGGER:
            dagger[field] = value
        else:
            student[name] = value
    changed = dataclasses.replace(config, student=_replaced(config.student, student))
    return _replaced(
        changed, {f"{DAGGER}.{name}": value for name, value in dagger.items()}
    )


def with_fields(config: Record, words: Sequence[str]) -> Record:
    """Any config with the named fields set: NAME=VALUE of its own, PART.FIELD=VALUE of a config in its field PART.

    Raises:
        UsageError: there is no such field, or the value has another type.
    """
    return _replaced(config, _values(words, fields_of(config)))


def settable(config: TrainConfig) -> dict[str, Any]:
    """The fields of an imitation run that can be set, with their values in ``config``, by name."""
    found = fields_of(config.student)
    if config.dagger is not None:
        found |= {
            f"{DAGGER}.{name}": value for name, value in fields_of(config.dagger).items()
        }
    return found


def fields_of(config: Any) -> dict[str, Any]:
    """The fields of a config that can be set, with their values, by name; those of its parts as PART.FIELD."""
    found: dict[str, Any] = {}
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            found |= {f"{name}.{field}": part for field, part in vars(value).items()}
        elif name not in FIXED and value is not None:
            found[name] = value
    return found


def _split(word: str, known: Mapping[str, Any]) -> tuple[str, str]:
    """Name and value of NAME=VALUE."""
    name, sign, text = word.partition("=")
    if not sign:
        raise UsageError(
            f"--set takes NAME=VALUE, for instance inputs.image_size=64; got {word!r}."
        )
    if name not in known:
        raise unknown_name("field of the preset", name, known)
    return name, text


def _values(words: Sequence[str], known: Mapping[str, Any]) -> dict[str, Any]:
    """The values of NAME=VALUE words by name, each of the type of the known one."""
    found: dict[str, Any] = {}
    for word in words:
        name, text = _split(word, known)
        found[name] = _read(name, text, known[name])
    return found


def _replaced(config: Record, values: Mapping[str, Any]) -> Record:
    """The config with other values by name, those of its parts as PART.FIELD.

    They are set together, because a config is checked as a whole: chunk=1 alone would be refused before execute=1.
    """
    own: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        part, dot, field = name.partition(".")
        if dot:
            parts.setdefault(part, {})[field] = value
        else:
            own[name] = value
    for part, fields in parts.items():
        own[part] = dataclasses.replace(getattr(config, part), **fields)
    return dataclasses.replace(cast(Any, config), **own)


def _read(name: str, text: str, like: Any) -> Any:
    """The value of a text, of the type of ``like``.

    Raises:
        UsageError: it has another type, or is out of range.
    """
    if isinstance(like, tuple):
        items = [item for item in text.split(",") if item]
        if not items and name not in MAY_BE_EMPTY:
            raise UsageError(f"--set {name}: give at least one value.")
        return tuple(_read(name, item, like[0]) if like else item for item in items)
    if isinstance(like, bool):
        if text not in TRUTH:
            raise UsageError(f"--set {name}: {text!r} is neither true nor false.")
        return TRUTH[text]
    try:
        value = type(like)(text)
    except ValueError as error:
        raise UsageError(
            f"--set {name}: {text!r} is no {type(like).__name__}."
        ) from error
    least = LEAST.get(name, 1) if isinstance(value, int) else 0
    if name in NO_LEAST:
        least = -sys.float_info.max
    if not isinstance(value, str) and not least <= value < math.inf:
        raise UsageError(
            f"--set {name} must be at least {least}, and finite; got {text}."
        )
    known = _words(name)
    if known and value not in known:
        raise unknown_name(name, text, known)
    return value


def _words(name: str) -> tuple[str, ...]:
    """The words that a field may have; () for any."""
    if name == "optimizer.schedule":
        return SCHEDULES
    if name == "network.encoder":
        from mjhab.learning.networks import CAMERA_ENCODERS

        return (*CAMERA_ENCODERS, "paper_dp")
    return ()
