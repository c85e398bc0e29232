"""Which runs a training may go on with: those with the same options, but for their length and for newer options."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, get_args, get_type_hints

from mjhab.core.errors import wrong_value
from mjhab.learning.configs import ImitationConfig
from mjhab.learning.reinforcement.configs import ALGORITHMS, ReinforcementConfig
from mjhab.learning.runs.specs import Scene

LEARNT = "config"
SCENE = "scene"
"""Keys of what a run's config.json has of the algorithm, and of where the policy learns."""


def as_begun_now(old: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """What a run's config.json would say if the run were begun by this version, and as long as it is to be now.

    Args:
        old: content of config.json.
        now: what the run is resumed with, as JSON data, too.

    Raises:
        UsageError: the run is to be longer, and what it has learned so far depends on how long it was to be.
    """
    reinforcement = now.get("algorithm") in ALGORITHMS
    kinds = {
        LEARNT: ReinforcementConfig if reinforcement else ImitationConfig,
        SCENE: Scene,
    }
    told = dict(old)
    for key, kind in kinds.items():
        # A damaged file is told by the comparison that follows.
        if isinstance(told.get(key), dict) and isinstance(now.get(key), dict):
            told[key] = _completed(told[key], now[key], kind)
    if old.get("algorithm") == now.get("algorithm") and isinstance(
        told.get(LEARNT), dict
    ):
        _lengthen(told[LEARNT], now[LEARNT], () if reinforcement else ("student",))
    return told


def _completed(
    old: Mapping[str, Any], now: Mapping[str, Any], kind: type
) -> dict[str, Any]:
    """A recorded dataclass with the defaults of the fields that were added to it since, where ``now`` has them."""
    hints = get_type_hints(kind)
    told = dict(old)
    for field in dataclasses.fields(kind):
        name = field.name
        inner = [
            hint
            # The arguments, because a part may be optional: ``PpoConfig | None``.
            for hint in (hints[name], *get_args(hints[name]))
            if isinstance(hint, type) and dataclasses.is_dataclass(hint)
        ]
        if name not in old and name in now:
            told[name] = _default(field)
        elif (
            inner and isinstance(old.get(name), dict) and isinstance(now.get(name), dict)
        ):
            told[name] = _completed(old[name], now[name], inner[0])
    return told


def _default(field: dataclasses.Field[Any]) -> Any:
    """Default of a field as JSON data; None, which no such field has, for one that must be given."""
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        value = None if field.default is dataclasses.MISSING else field.default
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    # As it reads from a file: tuples are lists there.
    return json.loads(json.dumps(value))


def _lengthen(old: dict[str, Any], now: Mapping[str, Any], path: tuple[str, ...]) -> None:
    """Write the length of ``now`` into ``old`` if the run becomes longer, and if it may."""
    name = "updates" if path else "samples"
    had, has = old, now
    for part in path:
        had, has = had[part], has[part]
    # A shorter run is another run, which the comparison refuses.
    if not had[name] < has[name]:
        return
    reason = _bound_to_its_length(old)
    if reason:
        raise wrong_value(
            name,
            has[name],
            f"{had[name]}, as the run was started with",
            f"Its length cannot change: {reason}. Begin a new run, which may --start from this one's student.",
        )
    had[name] = has[name]


def _bound_to_its_length(config: Mapping[str, Any]) -> str:
    """Why what a run has learned so far depends on its length, "" if it does not."""
    if config.get("dagger"):
        return "the rounds of DAgger begin after these updates"
    ppo = config.get("ppo") or {}
    if ppo.get("learning_rate_end", 1.0) != 1.0:
        return "its learning rate decreases until the last sample (ppo.learning_rate_end)"
    if config.get("student", {}).get("optimizer", {}).get("schedule") == "cosine":
        return "its learning rate decreases until the last update (optimizer.schedule)"
    return ""
