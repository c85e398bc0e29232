"""Changes of single fields of a preset: ``chunk=4``, ``inputs.image_size=64``, ``optimizer.ema=0``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

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
}
"""Smallest allowed value of integer fields for which it is not 1."""
MAY_BE_EMPTY = ("style", "inputs.cameras")
SCHEDULES = ("constant", "cosine")


def with_changes(config: TrainConfig, words: Sequence[str]) -> TrainConfig:
    """The config with the named fields set.

    Args:
        config: of a run.
        words: NAME=VALUE each. NAME is a field of `StudentConfig`, or PART.FIELD with the part inputs, network,
            optimizer or dagger; the items of a tuple are separated by commas.

    Raises:
        UsageError: there is no such field, or the value has another type.
    """
    for word in words:
        name, sign, text = word.partition("=")
        if not sign:
            raise UsageError(
                f"--set takes NAME=VALUE, for instance inputs.image_size=64; got {word!r}."
            )
        config = _changed(config, name, text)
    return config


def settable(config: TrainConfig) -> dict[str, Any]:
    """The fields that can be set, with their values in ``config``, by name."""
    found: dict[str, Any] = {}
    for name, value in vars(config.student).items():
        if dataclasses.is_dataclass(value):
            found |= {f"{name}.{field}": part for field, part in vars(value).items()}
        elif name not in ("algorithm", "preset"):
            found[name] = value
    if config.dagger is not None:
        found |= {f"{DAGGER}.{field}": part for field, part in vars(config.dagger).items()}
    return found


def _changed(config: TrainConfig, name: str, text: str) -> TrainConfig:
    known = settable(config)
    if name not in known:
        raise unknown_name("field of the preset", name, known)
    value = _read(name, text, known[name])
    part, dot, field = name.partition(".")
    if not dot:
        return dataclasses.replace(config, student=_replaced(config.student, name, value))
    if part == DAGGER:
        return dataclasses.replace(config, dagger=_replaced(config.dagger, field, value))
    inner = _replaced(getattr(config.student, part), field, value)
    return dataclasses.replace(config, student=_replaced(config.student, part, inner))


def _replaced(record: Any, name: str, value: Any) -> Any:
    return dataclasses.replace(record, **{name: value})


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
        raise UsageError(f"--set {name}: {text!r} is no {type(like).__name__}.") from error
    least = LEAST.get(name, 1) if isinstance(value, int) else 0
    if not isinstance(value, str) and not least <= value < math.inf:
        raise UsageError(f"--set {name} must be at least {least}, and finite; got {text}.")
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
