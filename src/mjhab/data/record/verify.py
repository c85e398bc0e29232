"""Replay: check that the recorded actions reproduce the recorded states bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import reason
from mjhab.data.record.batches import MakeEnv, batches
from mjhab.data.record.provenance import model_hash
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.query import Filter
from mjhab.data.store.hdf5 import UNREADABLE
from mjhab.data.store.reading import RecordedEpisode
from mjhab.data.store.schema import DamagedError


@dataclass
class Verified:
    """Result of ``verify``.

    exact: number of bit-exact episodes. max_error: largest difference of a position or velocity [m, rad, m/s, rad/s];
    infinite if a value is NaN. wrong: the difference, by episode. unlike: episodes whose home compiles to another
    model here. moved: episodes whose start state differs here; they were replayed from the recorded first state.
    """

    episodes: int = 0
    exact: int = 0
    max_error: float = 0.0
    wrong: dict[str, str] = field(default_factory=dict)
    unlike: list[str] = field(default_factory=list)
    moved: list[str] = field(default_factory=list)


def verify(
    places: Path | Sequence[Path],
    make_env: MakeEnv,
    where: Filter | None = None,
    tell: Callable[[], object] = bool,
) -> Verified:
    """Simulate recorded actions again and compare positions and velocities of every state, bit by bit.

    Episodes without states are only compared in the last state, by the hash in their record.

    Args:
        places: shards, or folders of shards. where: filter on the episodes.
        make_env: called once for every config.
        tell: called after every episode.

    Raises:
        UsageError: no episode passes the filter.
        UsageError, DamagedError: see ``open_shard``.
    """
    found = Verified()
    for env, batch in batches(places, make_env, where):
        for episode, problem, error, moved in _verify_batch(env, batch):
            found.episodes += 1
            found.exact += not problem
            found.max_error = max(found.max_error, error)
            if problem:
                found.wrong[episode.name] = problem
            if moved:
                found.moved.append(episode.name)
            if (
                model_hash(env.sim.model(episode.record.home))
                != episode.attributes["model"]
            ):
                found.unlike.append(episode.name)
            tell()
    return found


class _Comparison:
    """Comparison of one episode's states during a replay."""

    def __init__(self, episode: RecordedEpisode) -> None:
        self.actions = episode.array("actions")
        self.final = episode.record.final_state
        self.first = episode.initial()["sim"]
        self.states = None
        if "states/qpos" in episode.paths and "states/qvel" in episode.paths:
            self.states = episode.array("states/qpos"), episode.array("states/qvel")
        self.problem = ""
        self.error = 0.0

    @property
    def steps(self) -> int:
        return len(self.actions)

    def refuse_other_shapes(self, episode: RecordedEpisode, width: int) -> None:
        """Refuse actions that are not (N, ``width``), and states that are not N+1 rows.

        Raises:
            DamagedError: names the episode.
        """
        rows = [len(values) for values in self.states or ()]
        if self.actions.shape != (self.steps, width) or set(rows) - {self.steps + 1}:
            raise DamagedError(
                f"episode {episode.name} of {episode.shard.path} has actions {self.actions.shape} and {rows} states; "
                f"its environment takes actions (N, {width}), and N of them lead to N+1 states. See what is wrong "
                f"with: mjhab data check {episode.shard.path}"
            )

    def begins_with(self, state: Mapping[str, np.ndarray]) -> bool:
        """Whether a state equals the recorded first state."""
        return all(_same_bits(state[name], self.first[name]) for name in ("qpos", "qvel"))

    def compare(self, t: int, state: Mapping[str, np.ndarray], digest: str) -> None:
        """Compare state ``t``."""
        # An earlier difference says more than the hash of the end.
        if t == self.steps and digest != self.final and not self.problem:
            self.problem = "the last state is another one"
        if self.states is None:
            return
        for name, rows in zip(("qpos", "qvel"), self.states, strict=True):
            if _same_bits(state[name], rows[t]):
                continue
            if not self.problem or self.problem.startswith("the last"):
                self.problem = f"{name} differs from state {t} of {self.steps} on"
            # A diverged state holds inf, and inf - inf is told as inf below.
            with np.errstate(invalid="ignore"):
                error = (
                    float(np.abs(state[name] - rows[t]).max())
                    if state[name].shape == rows[t].shape
                    else np.inf
                )
            self.error = max(self.error, error if np.isfinite(error) else np.inf)


def _same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    # Bytes, since == takes -0.0 for 0.0 and no nan for itself.
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def _verify_batch(
    env: RecordedEnv, batch: list[RecordedEpisode]
) -> list[tuple[RecordedEpisode, str, float, bool]]:
    """Replay at most W episodes of one config.

    Returns:
        Per episode: itself, what is wrong ("" if nothing), the largest difference, and whether its start state differs.
    """
    compared = [_Comparison(episode) for episode in batch]
    for episode, one in zip(batch, compared, strict=True):
        # A longer row would be broadcast or cut without an error.
        one.refuse_other_shapes(episode, len(env.action_table))
    # Start states may differ where homes were changed since; the physics is compared all the same.
    moved = _begin(env, batch, compared)
    longest = max(one.steps for one in compared)
    actions = np.zeros((env.num_envs, compared[0].actions.shape[1]), np.float32)
    for t in range(longest + 1):
        for world, one in enumerate(compared):
            if t <= one.steps:
                one.compare(t, env.sim.get_world(world), env.state_digest(world))
        if t < longest:
            for world, one in enumerate(compared):
                # Worlds that are done still step with the others.
                actions[world] = one.actions[t] if t < one.steps else 0.0
            env.step(actions)
    return [
        (episode, one.problem, one.error, other)
        for episode, one, other in zip(batch, compared, moved, strict=True)
    ]


def _begin(
    env: RecordedEnv, batch: list[RecordedEpisode], compared: list[_Comparison]
) -> list[bool]:
    """Reset worlds to episodes; where the start state differs, set the recorded one. Returns which ones differed."""
    # The last batch may be smaller than the number of worlds.
    mask = np.arange(env.num_envs) < len(batch)
    seeds = [episode.record.seed for episode in batch] + [None] * (
        env.num_envs - len(batch)
    )
    indices = np.array([episode.record.index for episode in batch])
    env.reset(seed=seeds, options={"episode": indices, "reset_mask": mask})
    moved = [
        not one.begins_with(env.sim.get_world(world))
        for world, one in enumerate(compared)
    ]
    for world, (episode, one) in enumerate(zip(batch, compared, strict=True)):
        if moved[world]:
            try:
                env.set_state(world, episode.initial())
            except (UsageError, *UNREADABLE) as error:
                one.problem = f"it cannot begin here: {reason(error)}"
    return moved
