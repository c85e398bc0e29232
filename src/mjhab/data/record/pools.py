"""Groups of workers: processes of this machine, or the present process."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

from mjhab.data.record.messages import Message, Request, WorkerExited, failure
from mjhab.data.record.workers import Stopped, Work, WorkSpec

# Short enough that Ctrl-C is answered at once, long enough that waiting takes no CPU time.
PATIENCE = 0.2
"""Longest time to wait for messages before checking whether to stop [s]."""
_LONGEST_STOP = 15.0
"""Time after which a process that does not stop, e.g. during a long reset, is killed [s]."""


class WorkerPool(Protocol):
    """A group of workers, addressed by number. A number may be started again after its worker has ended."""

    def start(self, number: int, spec: WorkSpec, folder: Path) -> None:
        """Start a worker, which writes episode files to ``folder``; it answers with WorkerReady or WorkerFailed."""
        ...

    def send(self, number: int, request: Request) -> None:
        """Send a request to a worker; it answers with an EpisodeDone each, and then RequestDone."""
        ...

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """New messages as (worker, message); waits at most ``seconds`` for the first one."""
        ...

    def stop(self) -> None:
        """End all workers, also within episodes, and wait for them. Finished episodes stay on the disk."""
        ...


class ProcessPool:
    """Workers as spawned processes of this machine, connected by pipes."""

    def __init__(self) -> None:
        # A forked child has the locks of this process's threads, and not the threads that would release them.
        self._context = multiprocessing.get_context("spawn")
        self._members: dict[int, tuple[Any, Connection]] = {}

    def start(self, number: int, spec: WorkSpec, folder: Path) -> None:
        """See `WorkerPool`."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            # A daemon dies with its parent, so that a crashed coordinator leaves no workers.
            target=_serve,
            args=(theirs, spec, folder),
            daemon=True,
        )
        process.start()
        # Only the worker holds its end of the pipe now, so the pipe ends when the worker dies.
        theirs.close()
        self._members[number] = (process, ours)

    def send(self, number: int, request: Request) -> None:
        """See `WorkerPool`."""
        # If the worker is gone, reading its pipe will show it.
        with contextlib.suppress(OSError):
            self._members[number][1].send(request)

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """See `WorkerPool`."""
        pipes = {pipe: number for number, (_, pipe) in self._members.items()}
        found: list[tuple[int, Message]] = []
        for pipe in wait(list(pipes), seconds):
            assert isinstance(pipe, Connection)
            try:
                found.append((pipes[pipe], pipe.recv()))
            # A killed process closes its pipe, which reads as the end of the file.
            except (EOFError, OSError):
                self._leave(pipes[pipe])
                found.append((pipes[pipe], WorkerExited()))
        return found

    def _leave(self, number: int) -> None:
        process, pipe = self._members.pop(number)
        pipe.close()
        # A worker notices the closed pipe only after its control step or reset.
        process.join(_LONGEST_STOP)
        if process.is_alive():
            process.kill()
            process.join()

    def stop(self) -> None:
        """See `WorkerPool`."""
        # All pipes are closed before the first wait, so that workers stop side by side.
        for _, pipe in self._members.values():
            # A worker stops when its pipe is closed.
            pipe.close()
        for number in list(self._members):
            self._leave(number)


class InlinePool:
    """A single worker in this process; no process is started, and its stage may be reused for the next job."""

    def __init__(self) -> None:
        self._workers: dict[int, Work] = {}
        self._said: list[tuple[int, Message]] = []

    def start(self, number: int, spec: WorkSpec, folder: Path) -> None:
        """See `WorkerPool`."""
        worker = spec.start(folder)
        self._workers[number] = worker
        self._said.append((number, worker.ready))

    def send(self, number: int, request: Request) -> None:
        """See `WorkerPool`; the work is done when this returns."""
        try:
            self._workers[number].run(
                request, lambda message: self._said.append((number, message)), bool
            )
        except Exception as error:
            # As a process would report it, so that the coordinator has one path for errors.
            self._said.append((number, failure(error)))

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """See `WorkerPool`; it never waits."""
        said = self._said
        self._said = []
        return said

    def stop(self) -> None:
        """See `WorkerPool`."""
        for worker in self._workers.values():
            worker.close()
        self._workers.clear()


def _serve(pipe: Connection, spec: WorkSpec, folder: Path) -> None:
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
        worker = spec.start(folder)
        tell(worker.ready)
        while (request := _next(pipe)) is not None:
            # Within a request the pipe is silent: whatever comes is its end, and asks to stop.
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


def make_pool(workers: int, ray: str | None = None) -> WorkerPool:
    """Make a pool of workers: actors of the Ray cluster at ``ray``, processes, or, for 0 workers, this process.

    Raises:
        UsageError: Ray is not installed, or the cluster cannot be reached.
    """
    if ray:
        from mjhab.data.record.ray_workers import RayPool

        return RayPool(ray)
    return ProcessPool() if workers else InlinePool()
