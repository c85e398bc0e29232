"""An evaluation in several processes: workers of this machine, or actors of a Ray cluster.

An episode is a function of its seed and index, so the records are those of one process, whoever made them. Records
travel in messages; only films are written by the workers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.machine import cores
from mjhab.data.record.messages import (
    EpisodeEvaluated,
    Message,
    Request,
    RequestDone,
    WorkerExited,
    WorkerFailed,
    WorkerReady,
)
from mjhab.data.record.pools import PATIENCE, make_pool
from mjhab.data.record.workers import MOST_DEATHS, StopSink
from mjhab.evaluation.filming import FilmCrew
from mjhab.evaluation.global_random import SeededGlobals
from mjhab.evaluation.parts import (
    close_policy,
    env_options,
    make_env,
    open_any,
    policy_options,
)
from mjhab.evaluation.specs import EvalSpec
from mjhab.rollout.films import Film, FilmSink
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from mjhab.rollout.store import EvaluationFolder, film_path

FILM_QUALITY = 27
"""x264 constant rate factor. The film of a whole chain takes a few MB, because the report embeds it."""


def film_sink(spec: EvalSpec, folder: Path) -> FilmSink:
    """Films of the first episodes of an evaluation in ``folder``."""
    return FilmSink(
        range(spec.films),
        lambda index: film_path(folder, index),
        _open_film,
        crew=FilmCrew(*spec.film_px),
    )


def _open_film(path: Path, fps: int) -> Film:
    from mjhab.render.film import FilmWriter

    return FilmWriter(path, fps, FILM_QUALITY)


@dataclass(frozen=True)
class EvaluationWork:
    """Picklable description of a worker that evaluates."""

    spec: EvalSpec
    more_folders: tuple[Path, ...] = ()

    def moved(self, more_folders: tuple[Path, ...]) -> EvaluationWork:
        """See `data.record.workers.WorkSpec`."""
        return replace(self, more_folders=more_folders)

    def start(self, folder: Path) -> EvaluationWorker:
        """Build the worker; its films go to ``folder``."""
        return EvaluationWorker(self.spec, folder)


class EvaluationWorker:
    """Rolls out episodes and tells their records. See `data.record.workers.Work`.

    Raises:
        UsageError: environment or policy cannot be built.
    """

    def __init__(self, spec: EvalSpec, folder: Path) -> None:
        self._spec = spec
        self._closing = ExitStack()
        opened = open_any(spec.policy)
        self._env = make_env(spec, env_options(spec, opened.facts))
        self._closing.callback(self._env.close)
        random = self._closing.enter_context(SeededGlobals(spec.asked.seed))
        self._policy = opened.build(self._env, policy_options(spec))
        # A policy imports torch when it is built.
        random.take_torch()
        # Called in reverse order: the policy is closed before the environment that it acts in.
        self._closing.callback(close_policy, self._policy)
        self._films = film_sink(spec, folder)

    @property
    def ready(self) -> WorkerReady:
        """The message of a started worker."""
        return WorkerReady()

    def run(
        self,
        request: Request,
        tell: Callable[[Message], object],
        stopped: Callable[[], bool],
    ) -> None:
        """Roll out the episodes of a request.

        Raises:
            Stopped: ``stopped`` returned True.
        """
        sinks = [self._films, _TellSink(tell, self._films), StopSink(stopped)]
        seed = self._spec.asked.seed
        rollout(self._env, self._policy, request.indices, seed, sinks)
        tell(RequestDone())

    def close(self) -> None:
        """Close environment and policy."""
        self._closing.close()


class _TellSink(Sink[RolloutEnv]):
    """Tells the record of every finished episode."""

    def __init__(self, tell: Callable[[Message], object], films: FilmSink) -> None:
        self._tell = tell
        self._films = films

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Send the record."""
        self._tell(EpisodeEvaluated(record, self._films.problem))


class SpreadRollout:
    """The missing episodes of an evaluation, by several workers.

    Args:
        spec: the evaluation. folder: of its results. sinks: they hear of the beginning and of finished episodes alone,
            and of no environment.

    Raises:
        UsageError: Ray is not installed, or there is no cluster.
    """

    requests: dict[str, Any] = {}  # noqa: RUF012 (of policies that are asked elsewhere: each worker has its own)

    def __init__(
        self, spec: EvalSpec, folder: EvaluationFolder, sinks: Sequence[Sink]
    ) -> None:
        workers = max(1, spec.workers)
        threads = spec.asked.threads or max(1, cores() // workers)
        self._work = EvaluationWork(replace(spec, env={**spec.env, "threads": threads}))
        self._folder = folder
        self._sinks = sinks
        self._left = list(folder.missing(spec.episodes))
        self._chunk = spec.asked.num_envs
        # A worker without an episode would only make an environment.
        self._workers = min(workers, -(-len(self._left) // self._chunk))
        self._open: dict[int, list[int]] = {}
        self._deaths: dict[int, int] = {}
        self._pool = make_pool(workers, spec.ray)
        self.film_problem: str | None = None

    def run(self) -> None:
        """Roll them out; all workers have ended when this returns or raises.

        Raises:
            UsageError, MjhabError: a worker failed, or died several times without a finished episode.
        """
        # The worlds are in other processes; sinks that look at them cannot be used here.
        nobody = cast("RolloutEnv", None)
        for sink in self._sinks:
            sink.on_begin(nobody, self._left)
        try:
            for number in range(self._workers):
                self._start(number)
            while self._left or any(self._open.values()):
                for number, message in self._pool.messages(PATIENCE):
                    self._hear(number, message)
        finally:
            self._pool.stop()
            for sink in self._sinks:
                sink.close()

    def _start(self, number: int) -> None:
        self._open[number] = []
        self._pool.start(number, self._work, self._folder.path.resolve())

    def _send(self, number: int) -> None:
        some, self._left = self._left[: self._chunk], self._left[self._chunk :]
        if some:
            self._open[number] = some
            self._pool.send(number, Request(tuple(some)))

    def _hear(self, number: int, message: Message) -> None:
        match message:
            case WorkerReady() | RequestDone():
                self._send(number)
            case EpisodeEvaluated(record, problem):
                self._open[number].remove(record.index)
                # Only deaths in a row count: an episode that kills its worker does so every time.
                self._deaths[number] = 0
                # At once, so that a kill loses only what was running.
                self._folder.add(record)
                self.film_problem = self.film_problem or problem
                for sink in self._sinks:
                    sink.on_episode_end(cast("RolloutEnv", None), number, record)
            case WorkerFailed(kind, text):
                if kind == "usage":
                    raise UsageError(text)
                raise MjhabError(f"a worker failed:\n{text}")
            case WorkerExited():
                self._left = sorted(self._open[number] + self._left)
                self._deaths[number] = self._deaths.get(number, 0) + 1
                if self._deaths[number] >= MOST_DEATHS:
                    raise MjhabError(
                        f"worker {number} died {MOST_DEATHS} times without finishing an episode. Check that there is "
                        "enough memory. Every episode finished before is safe."
                    )
                self._start(number)
            case _:
                raise AssertionError(f"{message} is none of an evaluation")
