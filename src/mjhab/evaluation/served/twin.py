"""Serving mjhab's policies: each connection has twins of the client's worlds, in which the policy acts.

Experts, and some students, read simulator state that is not part of the observations. So a client of mjhab sends the
state of its worlds with their observations; the server sets a twin to this state and lets the policy act there.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.core.errors import MjhabError, UsageError, missing_field, wrong_value
from mjhab.core.seeding import EpisodeId
from mjhab.core.typed.options import with_tuples
from mjhab.core.version import __version__
from mjhab.data.record.provenance import TRAIN_MAKER
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.resolve import (
    PolicyFacts,
    PolicyOptions,
    open_policy,
)
from mjhab.rollout.loop import plain
from mjhab.rollout.policy import Chunked, Correctable, Policy
from mjhab.scenes.pack_source import Assets, pack_request
from mjhab.scenes.packs import open_pack
from mjhab.serving.dialects.dialect import OWN

NEEDS = ("world", "observation")
"""Parts of every world that clients must send."""
FILES = ("episodes_file", "spawns")
"""Environment options that name files of the server; clients may not set them."""
BUILTIN = "builtin"


@dataclass(frozen=True)
class EpisodeStep(EpisodeId):
    """Identifies a control step of an episode."""

    step: int


@dataclass
class ObservationAdapter:
    """An environment of one world and the policy that acts in it. expects: control step of the next request."""

    env: SequentialTaskEnv
    policy: Policy
    expects: EpisodeStep | None = None


class TwinResponder:
    """Serves a policy of mjhab; see `serving.server.Responder`.

    Args:
        spec: the policy, as for ``--policy``.
        options: seed and style of the policy.
        assets: the asset pack whose homes clients may use.

    Raises:
        UsageError: there is no such policy or asset pack, or the policy has no such style.
    """

    def __init__(
        self, spec: str, options: PolicyOptions, assets: Assets = BUILTIN
    ) -> None:
        if assets != BUILTIN:
            open_pack(assets)
        self._opened = open_policy(spec)
        self._opened.check(options)
        self.facts: PolicyFacts = self._opened.facts
        self._options = options
        self._assets = pack_request(assets).as_json()
        self._idle: list[tuple[Mapping[str, Any], ObservationAdapter]] = []
        self._lock = threading.Lock()

    def metadata(self) -> Mapping[str, Any]:
        """Name and identity of the policy, and the environment options that it needs."""
        return {
            "version": __version__,
            "policy": self.facts.name,
            "identity": plain(self.facts.identity),
            "env": plain(self.facts.env_options),
            "needs": list(NEEDS),
            "reads_instruction": self.facts.reads_instruction,
        }

    def session(self) -> TwinSession:
        """Make the session of a new connection."""
        return TwinSession(self)

    def borrow(self, config: Mapping[str, Any]) -> ObservationAdapter:
        """Take an idle twin with this environment configuration, or make one.

        Raises:
            UsageError: the configuration names files, or assets that this server does not have, or the policy cannot
                act in such an environment.
        """
        # Environments are built one at a time: they share caches on disk, and each checks the free memory first.
        with self._lock:
            for place, (known, twin) in enumerate(self._idle):
                if known == config:
                    del self._idle[place]
                    return twin
            env = self._make_env(config)
            # A state must exist before a client's can be set.
            env.reset(seed=0)
            return ObservationAdapter(env, self._opened.build(env, self._options))

    def give_back(self, config: Mapping[str, Any], twin: ObservationAdapter) -> None:
        """Return a twin to the idle ones, for the next connection."""
        with self._lock:
            self._idle.append((config, twin))

    def _make_env(self, config: Mapping[str, Any]) -> Any:
        from mjhab.envs import make, make_train

        options = with_tuples(_mapping(config.get("env"), "env"))
        named = [name for name in FILES if options.get(name)]
        if named:
            raise wrong_value(
                named[0],
                options[named[0]],
                "left out by clients: they may not name files",
            )
        # A client may not make the server read other folders.
        if options.get("assets", BUILTIN) != self._assets:
            raise wrong_value(
                "assets",
                options.get("assets"),
                f"those of this server, {self._assets!r}",
                "Start it with --assets.",
            )
        # All option values of the profile are sent; its name would only forbid other cameras.
        options.pop("profile", None)
        sight = {
            name: value
            for name, value in self.facts.env_options.items()
            if name != "profile"
        }
        build = make_train if config.get("maker") == TRAIN_MAKER else make
        # One world per twin: clients come and go with any number of them.
        return build(**{**options, **sight}, num_envs=1, threads=1, autoreset="disabled")


class TwinSession:
    """One connection; see `serving.server.Session`."""

    def __init__(self, responder: TwinResponder) -> None:
        self._responder = responder
        self._config: Mapping[str, Any] = {}
        self._twins: list[ObservationAdapter] = []

    def reset(self) -> None:
        """Start a new episode."""
        for twin in self._twins:
            twin.expects = None

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        """Actions (B, H, A): one, or where the request asks for a chunk as many as the policy plans.

        Raises:
            UsageError: the request lacks the states of the worlds, or they do not fit the environment.
        """
        parts = _own_parts(request, batch)
        config = _mapping(parts[0].get("config"), "config")
        if config != self._config:
            self.close()
            self._config = config
        actions = [_act(twin, part) for twin, part in self._assigned(parts)]
        return np.stack(actions)

    def _assigned(
        self, parts: Sequence[Mapping[str, Any]]
    ) -> list[tuple[ObservationAdapter, Mapping[str, Any]]]:
        """Assign a twin to each world, if possible the one that served the previous step of its episode."""
        free = list(self._twins)
        chosen: dict[int, ObservationAdapter] = {}
        for k, part in enumerate(parts):
            # Its policy has the history of this episode; another twin would have to begin.
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
        """Return the twins after the connection has closed."""
        for twin in self._twins:
            twin.expects = None
            self._responder.give_back(self._config, twin)
        self._twins = []


def _act(twin: ObservationAdapter, part: Mapping[str, Any]) -> np.ndarray:
    """Actions (H, A) of the twin's policy in the state of a world."""
    env = twin.env
    place = _place_of(part)
    try:
        env.set_state(0, part["world"])
    except MjhabError:
        raise
    # The state is a nested structure from outside: any error in it is the client's.
    except Exception as error:
        raise UsageError(f"the state of the world cannot be used: {error!r}") from error
    # A new episode, or one whose last steps went elsewhere: nothing that the policy remembers fits.
    if twin.expects != place:
        twin.policy.reset(np.ones(1, bool))
    seen = _mapping(part.get("observation"), "observation")
    obs = {key: np.asarray(value)[None] for key, value in seen.items()}
    info = env.info()
    if "instruction" in part:
        info["instruction"] = np.array([str(part["instruction"])], object)
    twin.expects = dataclasses.replace(place, step=place.step + 1)
    policy = twin.policy
    if part.get("executed") is not None and isinstance(policy, Correctable):
        # What its world did meanwhile was not what it last said.
        policy.replace_action(np.asarray(part["executed"], np.float32)[None], True)
    if part.get("chunk") and isinstance(policy, Chunked):
        return policy.plan(obs, info)[0]
    return policy.act(obs, info)


def _place_of(part: Mapping[str, Any]) -> EpisodeStep:
    world = _mapping(part.get("world"), "world")
    episode = _mapping(world.get("episode"), "episode")
    numbers = (episode.get("seed"), episode.get("index"), part.get("step"))
    if not all(isinstance(number, int | np.integer) for number in numbers):
        raise wrong_value("seed, index and step", numbers, "integers", where="episode")
    seed, index, step = (int(number) for number in numbers if number is not None)
    return EpisodeStep(seed, index, step)


def _own_parts(request: Mapping[str, Any], batch: int | None) -> list[Mapping[str, Any]]:
    """The part of a request that only mjhab clients send, one entry per world.

    Raises:
        UsageError: the request comes from another client, or has another number of worlds.
    """
    given = request.get(OWN)
    given = [given] if batch is None else given
    parts = (
        [part for part in given if isinstance(part, Mapping)]
        if isinstance(given, list)
        else []
    )
    if not parts:
        raise UsageError(
            f"this server serves policies of mjhab, which need the state of the worlds (key {OWN!r}); ask it with: "
            "mjhab eval --policy ws://..."
        )
    if len(parts) != (batch or 1):
        raise wrong_value(
            "states", len(parts), f"as many as the worlds of the request, {batch}"
        )
    return parts


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise missing_field(name, "request", "It comes from another version of mjhab.")
    return value
