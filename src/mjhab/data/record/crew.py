"""Workers that make episodes: what one does, the messages it is led by, and a crew of processes of this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

from mjhab.core.errors import UsageError
from mjhab.data.record.quotas import Outcome, Surety
from mjhab.data.record.recorder import Recorder
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.facts import target_of
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.shard import ShardWriter, StorageError, last_label
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.tasks.subtasks.registry import SUBTASKS

ALL = "all"
"""What quotas are counted by where a subtask has no target of its own."""
_LONGEST_STOP = 15.0
"""A process that does not stop within so many seconds (it may be in the middle of a reset) is ended."""


@dataclass(frozen=True)
class Stage:
    """What a worker acts in: the environment (autoreset "disabled"), the policy and its description.

    ``targets``: all that quotas count by; ``licence``: terms of the assets, see `provenance.describe_run`.
    """

    env: RecordedEnv
    policy: Policy
    about: Mapping[str, Any]
    targets: tuple[str, ...] = (ALL,)
    licence: str = ""


@dataclass(frozen=True)
class WorkerSpec:
    """How to make a worker in another process; all of it can be pickled.

    build: makes the stage. keep: filter, "" keeps everything. states, images: see `Recorder`.
    """

    build: Callable[[], Stage]
    seed: int
    keep: str = ""
    states: bool = True
    images: ImageFormat | None = None


@dataclass(frozen=True)
class Request:
    """Work for a worker: indices to roll out, which of them are to be kept whatever happens, who is sure to be kept,
    and what was decided about episodes that the worker holds back."""

    indices: tuple[int, ...]
    keep: frozenset[int] = frozenset()
    sure: Surety = field(default_factory=lambda: Surety(True))
    decided: Mapping[int, bool] = field(default_factory=dict)


@dataclass(frozen=True)
class Ready:
    """A worker is up. ``run``: what its episodes come from."""

    run: RunInfo
    targets: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """An episode is finished; ``stored``: it is on the disk."""

    outcome: Outcome
    stored: bool


@dataclass(frozen=True)
class Stored:
    """An episode that was held back is on the disk."""

    index: int


@dataclass(frozen=True)
class Done:
    """A request was carried out."""


@dataclass(frozen=True)
class Failed:
    """A worker gives up; ``kind``: "usage", "storage" or "error"."""

    kind: str
    text: str


@dataclass(frozen=True)
class Gone:
    """A worker is no more: killed, crashed, or stopped when it was asked to."""


Message = Ready | Report | Stored | Done | Failed | Gone


class Crew(Protocol):
    """Workers by number. A number may be started again when its worker is gone."""

    def start(self, number: int, spec: WorkerSpec, shard: Path) -> None:
        """Start a worker; it says Ready, or Failed."""
        ...

    def send(self, number: int, request: Request) -> None:
        """Give it work; it answers with Reports, and Done."""
        ...

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """What workers said; waits at most so long for something."""
        ...

    def stop(self) -> None:
        """End all workers, in the middle of episodes; returns when they are gone. Finished episodes are on the disk."""
        ...


class Stopped(Exception):
    """A worker was asked to stop in the middle of its work."""


class _StopSink(Sink[RolloutEnv]):
    """Looks after every control step whether to go on."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped = stopped

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Leave the rollout if somebody asked for it."""
        if self._stopped():
            raise Stopped


class Worker:
    """Rolls out episodes into a shard of its own. Episodes whose fate is open are held back in memory."""

    def __init__(self, spec: WorkerSpec, shard: Path) -> None:
        self._spec = spec
        self._stage = spec.build()
        self._filter = Filter(spec.keep) if spec.keep else None
        self._writer = ShardWriter(shard)
        self._held: dict[int, EpisodeData] = {}
        self._request = Request(())
        self._tell = _nobody
        self._recorder = Recorder(
            self,
            self._stage.env,
            self._stage.about,
            keep=self._passes,
            states=spec.states,
            images=spec.images,
            licence=self._stage.licence,
        )

    @property
    def ready(self) -> Ready:
        """What it says when it is up."""
        return Ready(self._recorder.run, self._stage.targets)

    def run(
        self, request: Request, tell: Callable[[Message], object], stopped: Callable[[], bool]
    ) -> None:
        """Carry out a request.

        Raises:
            StorageError: the disk is full. Stopped: ``stopped`` said so.
        """
        self._request = request
        self._tell = tell
        for index, keep in request.decided.items():
            data = self._held.pop(index, None)
            if keep and data is not None:
                self._writer.append(data)
                tell(Stored(index))
        if request.indices:
            sinks = [self._recorder, _StopSink(stopped)]
            rollout(self._stage.env, self._stage.policy, request.indices, self._spec.seed, sinks)
        tell(Done())

    def append(self, data: EpisodeData) -> int:
        """Take an episode that passed from the recorder."""
        outcome = outcome_of(data.record, True)
        if outcome.index in self._request.keep or self._request.sure(outcome.target):
            grown = self._writer.append(data)
            self._tell(Report(outcome, True))
            return grown
        self._held[outcome.index] = data
        self._tell(Report(outcome, False))
        return 0

    def _passes(self, record: EpisodeRecord, run: RunInfo) -> bool:
        passes = self._filter is None or self._filter(record, run)
        if not passes:
            self._tell(Report(outcome_of(record, False), False))
        return passes

    def close(self) -> None:
        """Close shard and environment."""
        self._writer.close()
        self._stage.env.close()


def _has_target(subtask: str | None) -> bool:
    """Whether episodes of it are about an object or a link: chains and ways to drive are not."""
    return bool(subtask) and not SUBTASKS[subtask].navigates


def outcome_of(record: EpisodeRecord, passes: bool) -> Outcome:
    """What counts of an episode. Objects and links have quotas of their own; chains and Navigate have one."""
    target = target_of(record) if _has_target(record.subtask) else ALL
    return Outcome(record.index, target, last_label(record), passes)


def failure(error: Exception) -> Failed:
    """How a worker tells of an exception."""
    if isinstance(error, StorageError):
        return Failed("storage", str(error))
    if isinstance(error, UsageError):
        return Failed("usage", str(error))
    return Failed("error", traceback.format_exc())


class ProcessCrew:
    """Workers that are processes of this machine, each started anew (spawned), led through pipes."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._members: dict[int, tuple[Any, Connection]] = {}

    @property
    def pids(self) -> dict[int, int]:
        """Process id of every worker."""
        return {number: process.pid for number, (process, _) in self._members.items()}

    def start(self, number: int, spec: WorkerSpec, shard: Path) -> None:
        """See `Crew`."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, spec, shard), daemon=True)
        process.start()
        # Ours alone holds the other end now: its death ends the pipe.
        theirs.close()
        self._members[number] = (process, ours)

    def send(self, number: int, request: Request) -> None:
        """See `Crew`."""
        # If it is gone, its pipe says so when it is read.
        with contextlib.suppress(OSError):
            self._members[number][1].send(request)

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """See `Crew`."""
        pipes = {pipe: number for number, (_, pipe) in self._members.items()}
        found: list[tuple[int, Message]] = []
        for pipe in wait(list(pipes), seconds):
            assert isinstance(pipe, Connection)
            try:
                found.append((pipes[pipe], pipe.recv()))
            except (EOFError, OSError):
                self._leave(pipes[pipe])
                found.append((pipes[pipe], Gone()))
        return found

    def _leave(self, number: int) -> None:
        process, pipe = self._members.pop(number)
        pipe.close()
        process.join(_LONGEST_STOP)
        if process.is_alive():
            process.kill()
            process.join()

    def stop(self) -> None:
        """See `Crew`."""
        for _, pipe in self._members.values():
            # A worker takes the end of its pipe as a sign to stop.
            pipe.close()
        for number in list(self._members):
            self._leave(number)


class InlineCrew:
    """One worker in this process: nothing has to be started, and its stage may be kept from one job to the next."""

    def __init__(self) -> None:
        self._workers: dict[int, Worker] = {}
        self._said: list[tuple[int, Message]] = []

    def start(self, number: int, spec: WorkerSpec, shard: Path) -> None:
        """See `Crew`."""
        worker = Worker(spec, shard)
        self._workers[number] = worker
        self._said.append((number, worker.ready))

    def send(self, number: int, request: Request) -> None:
        """See `Crew`; the work is done when this returns."""
        try:
            self._workers[number].run(
                request, lambda message: self._said.append((number, message)), bool
            )
        except Exception as error:
            self._said.append((number, failure(error)))

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """See `Crew`; nothing more comes by waiting."""
        said = self._said
        self._said = []
        return said

    def stop(self) -> None:
        """See `Crew`."""
        for worker in self._workers.values():
            worker.close()
        self._workers.clear()


def _serve(pipe: Connection, spec: WorkerSpec, shard: Path) -> None:
    """A worker process: carries out what comes through the pipe until that is closed."""
    # Ctrl-C reaches the whole group of processes: the one that leads decides what becomes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    worker = None

    def tell(message: Message) -> None:
        try:
            pipe.send(message)
        except OSError:
            raise Stopped from None

    try:
        worker = Worker(spec, shard)
        tell(worker.ready)
        while (request := _next(pipe)) is not None:
            worker.run(request, tell, pipe.poll)
    except Stopped:
        pass
    except Exception as error:
        with contextlib.suppress(OSError):
            pipe.send(failure(error))
    finally:
        if worker is not None:
            worker.close()


def _next(pipe: Connection) -> Request | None:
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None


def _nobody(message: Message) -> None:
    """There is nobody to tell yet."""
