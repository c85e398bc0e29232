"""Policies of mjhab as a server: each connection has twins of the worlds at the other end, in which its policy acts.

Experts read the whole state of a world, and students some of what no camera sees. So a client of mjhab sends the state
of its worlds beside what they show; a twin is put into that state, and the policy acts there as it would at home.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.version import __version__
from mjhab.data.record.provenance import TRAIN_MAKER
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.resolve import PolicyFacts, PolicyOptions, inspect_policy, resolve_policy
from mjhab.rollout.loop import plain
from mjhab.rollout.policy import Policy
from mjhab.serving.dialects.dialect import OWN

NEEDS = ("world", "observation")
"""What clients are asked to send of every world."""
FILES = ("episodes_file", "spawns")
"""Options of environments that name files of this machine: no client may choose them."""
BUILTIN = "builtin"


@dataclass(frozen=True)
class Place:
    """A control step of an episode."""

    seed: int
    index: int
    step: int


@dataclass
class Twin:
    """An environment of one world, the policy that acts in it, and what it expects to be asked about next."""

    env: SequentialTaskEnv
    policy: Policy
    expects: Place | None = None


class TwinResponder:
    """Serves a policy of mjhab; see `serving.server.Responder`.

    Args:
        spec: the policy, as for ``--policy``.
        options: seed and style.
        assets: the asset pack whose homes may be asked for.

    Raises:
        UsageError: there is no such policy.
    """

    def __init__(self, spec: str, options: PolicyOptions, assets: str = BUILTIN) -> None:
        self.facts: PolicyFacts = inspect_policy(spec)
        self._spec = spec
        self._options = options
        self._assets = assets
        self._idle: list[tuple[Mapping[str, Any], Twin]] = []
        self._lock = threading.Lock()

    def metadata(self) -> Mapping[str, Any]:
        """Name and identity of the policy, and the environment that it needs."""
        return {
            "version": __version__,
            "policy": self.facts.name,
            "identity": plain(self.facts.identity),
            "env": plain(self.facts.env_options),
            "needs": list(NEEDS),
        }

    def session(self) -> TwinSession:
        """A new connection is there."""
        return TwinSession(self)

    def borrow(self, config: Mapping[str, Any]) -> Twin:
        """A twin for an environment of a configuration, made if none is idle.

        Raises:
            UsageError: the configuration names files or assets that this server does not have, or the policy cannot
                act in such an environment.
        """
        # Environments are built one at a time: they share caches on disk, and memory is checked before each.
        with self._lock:
            for place, (known, twin) in enumerate(self._idle):
                if known == config:
                    del self._idle[place]
                    return twin
            env = self._make_env(config)
            env.reset(seed=0)
            return Twin(env, resolve_policy(self._spec, env, self._options))

    def give_back(self, config: Mapping[str, Any], twin: Twin) -> None:
        """Keep a twin for the next connection."""
        with self._lock:
            self._idle.append((config, twin))

    def _make_env(self, config: Mapping[str, Any]) -> Any:
        from mjhab.envs import make, make_train

        options = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in _mapping(config.get("env"), "env").items()
        }
        named = [name for name in FILES if options.get(name)]
        if named:
            raise UsageError(f"a server opens no files that clients name: {', '.join(named)}")
        if options.get("assets", BUILTIN) != self._assets:
            raise UsageError(
                f"this server has the asset pack {self._assets!r}, not {options.get('assets')!r}; start it with "
                "--assets"
            )
        # The options that a profile gives values are told; its name would forbid other cameras.
        options.pop("profile", None)
        sight = {name: value for name, value in self.facts.env_options.items() if name != "profile"}
        build = make_train if config.get("maker") == TRAIN_MAKER else make
        return build(**{**options, **sight}, num_envs=1, threads=1, autoreset="disabled")


class TwinSession:
    """One connection; see `serving.server.Session`."""

    def __init__(self, responder: TwinResponder) -> None:
        self._responder = responder
        self._config: Mapping[str, Any] = {}
        self._twins: list[Twin] = []

    def reset(self) -> None:
        """An episode begins."""
        for twin in self._twins:
            twin.expects = None

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        """Actions (B, 1, A).

        Raises:
            UsageError: the request lacks the worlds' states, or they do not belong here.
        """
        parts = _own_parts(request, batch)
        config = _mapping(parts[0].get("config"), "config")
        if config != self._config:
            self.close()
            self._config = config
        actions = [_act(twin, part) for twin, part in self._assigned(parts)]
        return np.stack(actions)[:, None]

    def _assigned(self, parts: Sequence[Mapping[str, Any]]) -> list[tuple[Twin, Mapping[str, Any]]]:
        """A twin for each world: the one that has followed its episode, as worlds of a batch come and go."""
        free = list(self._twins)
        chosen: dict[int, Twin] = {}
        for k, part in enumerate(parts):
            known = [twin for twin in free if twin.expects == _place_of(part)]
            if known:
                chosen[k] = known[0]
                free.remove(known[0])
        for k in range(len(parts)):
            if k not in chosen:
                if not free:
                    free.append(self._responder.borrow(self._config))
                    self._twins.append(free[-1])
                chosen[k] = free.pop()
        return [(chosen[k], part) for k, part in enumerate(parts)]

    def close(self) -> None:
        """The connection is gone."""
        for twin in self._twins:
            twin.expects = None
            self._responder.give_back(self._config, twin)
        self._twins = []


def _act(twin: Twin, part: Mapping[str, Any]) -> np.ndarray:
    """The action (A,) of a policy in the state of a world."""
    env = twin.env
    place = _place_of(part)
    try:
        env.set_state(0, part["world"])
    except MjhabError:
        raise
    # A state is a deep structure from outside: whatever is wrong with it is the sender's fault.
    except Exception as error:
        raise UsageError(f"the state of the world cannot be used: {error!r}") from error
    if twin.expects != place:
        twin.policy.reset(np.ones(1, bool))
    seen = _mapping(part.get("observation"), "observation")
    obs = {key: np.asarray(value)[None] for key, value in seen.items()}
    info = env.info()
    action = twin.policy.act(obs, info)[0]
    twin.expects = dataclasses.replace(place, step=place.step + 1)
    return action


def _place_of(part: Mapping[str, Any]) -> Place:
    world = _mapping(part.get("world"), "world")
    episode = _mapping(world.get("episode"), "episode")
    numbers = (episode.get("seed"), episode.get("index"), part.get("step"))
    if not all(isinstance(number, int | np.integer) for number in numbers):
        raise UsageError(f"seed, index and step of an episode are whole numbers, got {numbers}")
    seed, index, step = (int(number) for number in numbers if number is not None)
    return Place(seed, index, step)


def _own_parts(request: Mapping[str, Any], batch: int | None) -> list[Mapping[str, Any]]:
    """What clients of mjhab say of each world of a request.

    Raises:
        UsageError: the request comes from another client, or is about another number of worlds.
    """
    given = request.get(OWN)
    given = [given] if batch is None else given
    parts = [part for part in given if isinstance(part, Mapping)] if isinstance(given, list) else []
    if not parts:
        raise UsageError(
            f"this server serves policies of mjhab, which need the state of the worlds (key {OWN!r}); ask it with: "
            "mjhab eval --policy ws://..."
        )
    if len(parts) != (batch or 1):
        raise UsageError(f"the request is about {batch} worlds and has the state of {len(parts)}")
    return parts


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UsageError(f"the request has no {name!r}; it comes from another version of mjhab")
    return value
