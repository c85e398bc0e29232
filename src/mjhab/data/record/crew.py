"""Workers that record episodes: the worker, the messages between workers and coordinator, and local processes."""

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
from mjhab.data.store.episode_data import EpisodeData, RunInfo, last_label
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.shard import ShardWriter, StorageError
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.tasks.subtasks.registry import SUBTASKS

ALL = "all"
"""Name of the only target of whole tasks and Navigate in quotas."""
_LONGEST_STOP = 15.0
"""Time after which a process that does not stop, e.g. during a long reset, is killed [s]."""


@dataclass(frozen=True)
class Stage:
    """Environment and policy of a worker.

    env: with autoreset "disabled". about: description of the policy as JSON data. targets: all targets that quotas
    count. licence: of the assets, see `provenance.describe_run`.
    """

    env: RecordedEnv
    policy: Policy
    about: Mapping[str, Any]
    targets: tuple[str, ...] = (ALL,)
    licence: str = ""


@dataclass(frozen=True)
class WorkerSpec:
    """Picklable description of a worker.

    build: makes the stage. seed: of the episodes. keep: filter, "" keeps all episodes. states, images: see `Recorder`.
    """

    build: Callable[[], Stage]
    seed: int
    keep: str = ""
    states: bool = True
    images: ImageFormat | None = None


@dataclass(frozen=True)
class Request:
    """Work for a worker.

    indices: episodes to roll out. keep: those to keep in any case. sure: targets whose episodes are certainly kept.
    decided: whether to keep episodes that the worker holds back in memory, by index.
    """

    indices: tuple[int, ...]
    keep: frozenset[int] = frozenset()
    sure: Surety = field(default_factory=lambda: Surety(True))
    decided: Mapping[int, bool] = field(default_factory=dict)


@dataclass(frozen=True)
class Ready:
    """A worker has started. run: description of its episodes' source. targets: see `Stage`."""

    run: RunInfo
    targets: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """An episode is finished. stored: it is on the disk; otherwise the worker holds it back or has dropped it.

    error: why the policy could not finish it, so that it was dropped; "" if it could.
    """

    outcome: Outcome
    stored: bool
    error: str = ""


@dataclass(frozen=True)
class Stored:
    """An episode that was held back is on the disk."""

    index: int


@dataclass(frozen=True)
class Done:
    """A request is finished."""


@dataclass(frozen=True)
class Failed:
    """A worker failed with an error. kind: "usage", "storage" or "error"."""

    kind: str
    text: str


@dataclass(frozen=True)
class Gone:
    """A worker has ended: it was killed, crashed, or stopped on request."""


Message = Ready | Report | Stored | Done | Failed | Gone


class Crew(Protocol):
    """A group of workers, addressed by number. A number may be started again after its worker has ended."""

    def start(self, number: int, spec: WorkerSpec, shard: Path) -> None:
        """Start a worker, which writes to ``shard``; it answers with Ready or Failed."""
        ...

    def send(self, number: int, request: Request) -> None:
        """Send a request to a worker; it answers with Reports and then Done."""
        ...

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """New messages as (worker, message); waits at most ``seconds`` for the first one."""
        ...

    def stop(self) -> None:
        """End all workers, also within episodes, and wait for them. Finished episodes stay on the disk."""
        ...


class Stopped(Exception):
    """A worker was asked to stop during a request."""


class _StopSink(Sink[RolloutEnv]):
    """Checks after every control step whether the worker should stop."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped = stopped

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Leave the rollout if the worker should stop."""
        if self._stopped():
            raise Stopped


class Worker:
    """Rolls out episodes into its own shard. Episodes that are not yet decided on are held back in memory."""

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
        """The message of a started worker."""
        return Ready(self._recorder.run, self._stage.targets)

    def run(
        self,
        request: Request,
        tell: Callable[[Message], object],
        stopped: Callable[[], bool],
    ) -> None:
        """Execute a request.

        Raises:
            StorageError: the disk is full.
            Stopped: ``stopped`` returned True.
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
            rollout(
                self._stage.env,
                self._stage.policy,
                request.indices,
                self._spec.seed,
                sinks,
            )
        tell(Done())

    def append(self, data: EpisodeData) -> int:
        """Store or hold back an episode from the recorder; returns the bytes by which the shard has grown."""
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
        if record.error or not passes:
            self._tell(Report(outcome_of(record, False), False, record.error))
        return passes and not record.error

    def close(self) -> None:
        """Close shard and environment."""
        self._writer.close()
        self._stage.env.close()


def _has_target(subtask: str | None) -> bool:
    """Whether the subtask has a target object or link; whole tasks and Navigate have none."""
    return bool(subtask) and not SUBTASKS[subtask].navigates


def outcome_of(record: EpisodeRecord, passes: bool) -> Outcome:
    """The part of an episode that quotas count. Each object or link has its own quota; chains and Navigate have one."""
    target = target_of(record) if _has_target(record.subtask) else ALL
    return Outcome(record.index, target, last_label(record), passes, record.skipped_homes)


def failure(error: Exception) -> Failed:
    """Convert an exception to a message."""
    if isinstance(error, StorageError):
        return Failed("storage", str(error))
    if isinstance(error, UsageError):
        return Failed("usage", str(error))
    return Failed("error", traceback.format_exc())


class ProcessCrew:
    """Workers as spawned processes of this machine, connected by pipes."""

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
        process = self._context.Process(
            target=_serve, args=(theirs, spec, shard), daemon=True
        )
        process.start()
        # Only the worker holds its end of the pipe now, so the pipe ends when the worker dies.
        theirs.close()
        self._members[number] = (process, ours)

    def send(self, number: int, request: Request) -> None:
        """See `Crew`."""
        # If the worker is gone, reading its pipe will show it.
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
            # A worker stops when its pipe is closed.
            pipe.close()
        for number in list(self._members):
            self._leave(number)


class InlineCrew:
    """A single worker in this process; no process is started, and its stage may be reused for the next job."""

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
        """See `Crew`; it never waits."""
        said = self._said
        self._said = []
        return said

    def stop(self) -> None:
        """See `Crew`."""
        for worker in self._workers.values():
            worker.close()
        self._workers.clear()


def _serve(pipe: Connection, spec: WorkerSpec, shard: Path) -> None:
    """Main function of a worker process: executes requests from the pipe until it is closed."""
    # Ctrl-C reaches all processes of the group; only the coordinator reacts to it.
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
    """Ignore a message."""
