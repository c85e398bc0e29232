"""Workers as Ray actors on a cluster. Needs the extra ``scale``."""

from __future__ import annotations

import contextlib
import importlib
import platform
import socket
import threading
import time
import uuid
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.errors import UsageError
from mjhab.core.files.code_digest import code_digest
from mjhab.core.libraries import missing_library
from mjhab.core.machine import install_extra
from mjhab.core.version import __version__
from mjhab.data.record.messages import (
    Message,
    Request,
    WorkerExited,
    WorkerFailed,
    failure,
)
from mjhab.data.record.workers import Stopped, Work, WorkSpec

LOCAL = "local"
FOLDER = "folder"
_SHOWN = 12
"""Digits of a hash that are compared and shown."""
_LONGEST_STOP = 15.0
_LONGEST_CALL = 10.0
"""Time until an actor that does not stop is killed, and time limit for connecting to an address [s]."""


def node_identity() -> dict[str, str]:
    """What must be equal on all nodes: versions, code, and the last bits of arithmetic, see `arithmetic_digest`."""
    return {
        "mjhab": __version__,
        "mujoco": version("mujoco"),
        "code": code_digest("").hex()[:_SHOWN],
        "arithmetic": arithmetic_digest().hex()[:_SHOWN],
    }


def check_node(theirs: Mapping[str, str], folder: Path) -> None:
    """Refuse a node that would compute other numbers, or write where nobody looks.

    Args:
        theirs: what `_Actor.identity` says. folder: of the results.

    Raises:
        UsageError: names what differs, on both sides.
    """
    for name, ours in node_identity().items():
        if theirs[name] != ours:
            raise UsageError(
                f"node {theirs['node']} of the Ray cluster has {name} {theirs[name]}, this machine {ours}: episodes "
                "would depend on who made them. Install the same mjhab and libraries on all nodes, on processors of "
                "one kind."
            )
    # Episodes are written by the nodes, so that a local folder there would be lost.
    if theirs[FOLDER] != str(True):
        raise UsageError(
            f"node {theirs['node']} of the Ray cluster does not see {folder}: give an --out in a folder that all nodes "
            "share."
        )


class _Actor:
    """A worker as a Ray actor; its messages are returned together at the end of a request."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._worker: Work | None = None

    def identity(self, mark: Path) -> dict[str, str]:
        """What runs on this node, see `node_identity`, and whether it sees the file ``mark``."""
        # Texts alone, which every version of Python can unpickle.
        return {**node_identity(), "node": platform.node(), FOLDER: str(mark.is_file())}

    def begin(self, spec: WorkSpec, folder: Path) -> list[Message]:
        """Make the worker."""
        try:
            self._worker = spec.start(folder)
            return [self._worker.ready]
        except Exception as error:
            return [failure(error)]

    def run(self, request: Request) -> list[Message]:
        """Execute a request."""
        assert self._worker is not None, "begin was not called, or failed"
        said: list[Message] = []
        try:
            self._worker.run(request, said.append, self._stop.is_set)
        # What it had said so far still holds: those episodes are on the disk.
        except Stopped:
            pass
        except Exception as error:
            said.append(failure(error))
        return said

    def stop(self) -> None:
        """Abort the current request after the next control step; runs in a second thread."""
        self._stop.set()


class RayPool:
    """Workers that are actors of a Ray cluster, one CPU each. See `WorkerPool`.

    Args:
        address: of the cluster; LOCAL starts one on this machine.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, address: str) -> None:
        try:
            ray: Any = importlib.import_module("ray")
        except ImportError as error:
            raise missing_library("--ray", ("Ray",), install_extra("scale")) from error
        self._ray = ray
        _check_reachable(address)
        try:
            ray.init(
                address=None if address == LOCAL else address,
                # Lines of the nodes would run through the progress display.
                log_to_driver=False,
                configure_logging=False,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(
                f"no Ray cluster can be reached at {address!r}: {error}"
            ) from error
        # Two threads: one works, the other receives the request to stop.
        self._class = ray.remote(num_cpus=1, max_concurrency=2, max_restarts=0)(_Actor)
        self._actors: dict[int, Any] = {}
        self._calls: dict[Any, int] = {}
        self._beginning: dict[int, tuple[WorkSpec, Path]] = {}
        """Work of actors whose node has not told its identity yet, and the file that it should see."""

    def start(self, number: int, spec: WorkSpec, folder: Path) -> None:
        """See `WorkerPool`."""
        # Workers may have another current directory.
        folder = folder.resolve()
        folder.mkdir(parents=True, exist_ok=True)
        # A name of its own, so that a folder of the same path on a node's own disk is told apart.
        mark = folder / f".{uuid.uuid4().hex}"
        mark.touch()
        self._actors[number] = self._class.remote()
        self._beginning[number] = (spec, mark)
        # Before anything else is sent: another version might not be able to read it.
        self._calls[self._actors[number].identity.remote(mark)] = number

    def send(self, number: int, request: Request) -> None:
        """See `WorkerPool`."""
        self._calls[self._actors[number].run.remote(request)] = number

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """See `WorkerPool`."""
        # One at a time, since Ray would wait for all of a larger number.
        ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=seconds)
        found: list[tuple[int, Message]] = []
        for call in ready:
            number = self._calls.pop(call)
            try:
                said = self._ray.get(call)
                if number in self._beginning:
                    said = self._greet(number, said)
                found += [(number, message) for message in said]
            except self._ray.exceptions.RayActorError:
                # The file is no episode and would stay in the folder for good.
                self._forget_mark(number)
                # The process may still run on a node that cannot be reached.
                with contextlib.suppress(self._ray.exceptions.RayError):
                    self._ray.kill(self._actors[number])
                found.append((number, WorkerExited()))
            except self._ray.exceptions.RayError as error:
                found.append((number, WorkerFailed("error", str(error))))
        return found

    def _greet(self, number: int, theirs: Mapping[str, str]) -> list[Message]:
        """Let a worker begin whose node fits; a message if it does not."""
        spec, mark = self._beginning.pop(number)
        mark.unlink(missing_ok=True)
        try:
            check_node(theirs, mark.parent)
        except UsageError as error:
            return [failure(error)]
        self._calls[self._actors[number].begin.remote(spec, mark.parent)] = number
        return []

    def _forget_mark(self, number: int) -> None:
        """Delete the file that the node of a worker should have seen, if it did not come to that."""
        _, mark = self._beginning.pop(number, (None, None))
        if mark is not None:
            mark.unlink(missing_ok=True)

    def stop(self) -> None:
        """See `WorkerPool`. Also closes the connection to the cluster."""
        for actor in self._actors.values():
            with contextlib.suppress(self._ray.exceptions.RayError):
                # Nobody waits for the answer: the second thread sets the event at once.
                actor.stop.remote()
        end = time.monotonic() + _LONGEST_STOP
        # Requests end after their control step, and their files are then whole.
        while self._calls and time.monotonic() < end:
            ready, _ = self._ray.wait(
                list(self._calls), num_returns=1, timeout=_LONGEST_STOP
            )
            for call in ready:
                del self._calls[call]
        for actor in self._actors.values():
            self._ray.kill(actor)
        for number in list(self._beginning):
            self._forget_mark(number)
        self._ray.shutdown()


def _check_reachable(address: str) -> None:
    """Check an address quickly, because Ray itself would try for minutes.

    Raises:
        UsageError: no server listens at the "host:port" or "ray://host:port".
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    # "local", "auto" and others are not addresses to knock at.
    if not host or not port.isdigit():
        return
    try:
        # A refused connection fails in milliseconds here.
        socket.create_connection((host, int(port)), _LONGEST_CALL).close()
    except OSError as error:
        raise UsageError(
            f"no Ray cluster can be reached at {address!r}: {error}."
        ) from error
